"""Recognition of objects in an overview if only the kinds and the plate's size are known.

Bottom-up as in the paper: first the plate, then sub-objects (circles, rectangles, slots, closed groups of edges), whose
middles are the candidates. The features of every candidate (its look) are compared with the taught features of all
kinds and of "nothing". The most likely candidates that do not overlap a more likely one are accepted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.errors import NotFound
from perception.vision.finding.cables import without_cables
from perception.vision.finding.circles import find_circles
from perception.vision.finding.components import components
from perception.vision.finding.features import PLATE_PX_PER_M, Ground, half_turned, look_at, plate_gray
from perception.vision.finding.framing import one_plate
from perception.vision.finding.match import Prepared, nearest, nearest_look, nearest_of, nothing_column, prepared
from perception.vision.finding.shapes import Edges, direction_maps, distinct, find_edges, find_rectangles, find_slots
from perception.vision.image import as_gray
from perception.vision.knowledge import NOTHING, Knowledge
from perception.vision.noise import noise_sigma
from perception.vision.projection import PanelProjection

PLATE_M = (0.40, 0.30)
NOISY = 2.4  # gray levels; of synthetic overviews those of medium difficulty have 2.2 at most, hard ones 2.5 at least
UPSIDE_DOWN = 0.15  # a panel is refused if its `uprightness` is below minus this
# So many objects so certain confirm a plate; close-ups and rotated panels that resemble a plate have 3 at most.
SURE, LEAST_SURE = 0.95, 4
FURTHEST = 0.8  # a place with a larger distance from every look is unlike anything taught
# A place further than this from its nearest look is never surely recognised. Of the objects on drawings by another hand 6 to 18 %
# are further, and on two lift panels of which nothing was taught all that was named with .8 or more.
ALIKE, UNLIKE_AT_MOST = 0.5, 0.79
SECOND_LOOK = 0.05  # a candidate nearer to "nothing" by up to this is compared again at its best middle
# Confidence = logistic((lead - EVEN) / SCALE), where the lead is how much nearer the kind is than the next one.
# Logistic regression gives 0.018 and 0.021 over overviews that were not used for teaching (benchmarks/vision_knowledge
# prints the reliability), and 0.029 and 0.018 over drawings by another author. The values lie between these, nearer to
# the latter, because wrong answers are worse than refusals.
EVEN, SCALE = 0.026, 0.020
# In a noisy image a single look is too often nearest by chance, so the mean distance of several looks decides.
# Overviews in hard light that were not used for teaching give 0.005 for NOISY_EVEN, drawings by another author 0.010;
# the scales are 0.020 and 0.018.
NOISY_MEAN_OF = 3
NOISY_EVEN = 0.014
# Of the names with a confidence from here to 0.5, 12 of 21 are right: 3 of 7 on held-out overviews, 9 of 14 on drawings of ours.
NAMED_AT = 0.43
Space = tuple[float, float, float]
"""Middle (u, v) and size of an object, pixels of the rectified plate."""
CROSS = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
CENTRING_STEPS_PX = (2.0, 0.8)
CIRCLE_RADII_M = (0.004, 0.042)
SIDES_M = (0.016, 0.095)
SLOT_M = (0.034, 0.085)
OVERLAP = 0.475  # objects overlap if their middles are closer than this share of the larger one's size
SAME_PX = 1.5  # candidates closer than this are one
# How much nearer a place in the middle of a rectangle counts to the kinds whose width and height differ from the rectangle's by
# less than this logarithm. On drawings by another hand in medium light recall is .952 in place of .921; precision does not fall.
FRAMED_NEARER, FRAME_FITS, FRAME_COVERAGE = 0.15, 0.3, 0.7
SQUARE = 0.15  # logarithm of width over height of a kind that is about as wide as it is high


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detection:
    """A place where there may be an object.

    Attributes:
        kind: the most likely kind.
        confidence: 0 to 1.
        centre_px, centre_m: (2,) middle in the image, and on the plate (origin in its middle, y up).
        place_m: (2,) place on the plate with the look of the kind: `centre_m`, or a more distinct part of the object.
        box_px: (4, 2) outline of a typical object there.
        distance: to the nearest look of that kind.
        rival: the next kind and its distance.
        reason: why the candidate is refused; None for an object.
    """

    kind: str
    confidence: float
    centre_px: Array
    centre_m: Array
    place_m: Array
    box_px: Array
    distance: float
    rival: tuple[str, float]
    reason: str | None = None


def recognise(
    image: NDArray[Any],
    knowledge: Knowledge,
    *,
    plate_m: tuple[float, float] = PLATE_M,
    view: PanelProjection | None = None,
    focal_px: float | None = None,
) -> tuple[Detection, ...]:
    """Find objects of known kinds, best first; then the refused candidates with their reasons.

    Args:
        image: overview, gray or RGB uint8; the plate fills most of it.
        plate_m: width and height of the plate.
        view: projection of the plate, if known; else its border is searched.
        focal_px: of the camera, if known; helps to complete a plate that the image cuts off.

    Raises:
        InvalidRequest, NotObservable: bad image.
        NotFound: no plate in the image, or a panel upside down.
        Ambiguous: two panels are in view.
    """
    gray = as_gray(image)
    is_sure = True
    if view is None:
        plate = one_plate(gray, plate_m, focal_px=focal_px)
        view, is_sure = plate.view, plate.is_sure
    ground = lay_out(gray, view, plate_m)
    places = candidate_places(ground)
    found = chosen(ground, places, look_at(ground, places), knowledge, view, plate_m) if len(places) else ()
    if not is_sure and sum(c.confidence >= SURE for c in found) < LEAST_SURE:
        raise NotFound(
            "what may be the plate's border is not confirmed, neither by edges nor by objects on it",
            hint="take an overview of one panel, upright, with its border in view",
        )
    if uprightness(ground, found, knowledge, plate_m) < -UPSIDE_DOWN:
        raise NotFound(
            "the panel is upside down: its objects look more like the taught ones turned by half a turn",
            hint="turn the camera or the picture by half a turn",
        )
    return found


def uprightness(
    ground: Ground, found: Sequence[Detection], knowledge: Knowledge, plate_m: tuple[float, float]
) -> float:
    """Return the evidence that the panel is upright, summed over the accepted objects.

    It is the distance of each object's features from its kind when rotated by half a turn, minus the distance as it is.
    Labels stand below, pivots of meters lie low, and light comes from above, so a whole panel is conclusive even if a
    single object is not. The features for images of normal noise are used with full weights, because those far from a
    middle discriminate best. Of 47 overviews that were not used for teaching the least value upright is 0.14; rotated
    ones are below -0.2, except a hard one (-0.01).
    """
    knowledge = knowledge.for_image(noisy=False)
    names = [kind.name for kind in knowledge.kinds]
    objects = [c for c in found if c.reason is None and c.kind in names]
    if not objects:
        return 0.0
    middles = np.array([c.place_m for c in objects]) * [1.0, -1.0] + np.array(plate_m) / 2
    looks = look_at(ground, middles * PLATE_PX_PER_M)
    known = prepared(knowledge)
    kinds = np.array([names.index(c.kind) for c in objects])
    return float((nearest_of(half_turned(looks), known, kinds) - nearest_of(looks, known, kinds)).sum())


def lay_out(gray: Image, view: PanelProjection, plate_m: tuple[float, float]) -> Ground:
    """Rectify the plate to a frontal view, remove cables, and find its edges, rectangles and slots."""
    w, h = plate_m
    size = (round(w * PLATE_PX_PER_M), round(h * PLATE_PX_PER_M))
    corners = np.array([[-w / 2, h / 2, 0], [w / 2, h / 2, 0], [w / 2, -h / 2, 0], [-w / 2, -h / 2, 0]])
    target = np.array([[0, 0], [size[0], 0], [size[0], size[1]], [0, size[1]]], np.float32)
    turn = cv2.getPerspectiveTransform(view.project(corners).astype(np.float32), target)
    picture = np.asarray(cv2.warpPerspective(gray, turn, size, flags=cv2.INTER_LINEAR), np.uint8)
    level = plate_gray(picture)
    picture = without_cables(picture, level)
    edges, s = find_edges(picture), PLATE_PX_PER_M
    maps = direction_maps(edges)
    return Ground(
        picture=picture.astype(np.float32),
        edges=edges,
        plate_gray=level,
        noisy=noise_sigma(gray) > NOISY,
        rectangles=tuple(find_rectangles(maps, least_px=SIDES_M[0] * s, most_px=SIDES_M[1] * s)),
        slots=tuple(find_slots(maps, least_px=SLOT_M[0] * s, most_px=SLOT_M[1] * s)),
    )


def candidate_places(ground: Ground) -> Array:
    """Return the middles (N, 2) of sub-objects on the rectified plate, px."""
    edges, s = ground.edges, PLATE_PX_PER_M
    places = [(c.u, c.v) for c in find_circles(edges, least_px=CIRCLE_RADII_M[0] * s, most_px=CIRCLE_RADII_M[1] * s)]
    places += [(r.u, r.v) for r in ground.rectangles]
    places += [*ground.slots, *_groups(edges)]
    found = np.array(places, float).reshape(-1, 2)
    return found[distinct(found, np.full(2, SAME_PX))]


def _groups(edges: Edges) -> list[tuple[float, float]]:
    """Return the middles of the boxes around groups of neighbouring edges, at two grouping distances."""
    places = []
    for reach in (2, 5):
        joined = cv2.morphologyEx(edges.thin.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((2 * reach + 1,) * 2, np.uint8))
        for x, y, width, height in components(np.asarray(joined, np.uint8), diagonal=True)[:, :4]:
            if 18 <= max(width, height) < 150:
                places.append((float(x + (width - 1) / 2), float(y + (height - 1) / 2)))
    return places


def chosen(
    ground: Ground,
    places: Array,
    looks: Array,
    knowledge: Knowledge,
    view: PanelProjection,
    plate_m: tuple[float, float],
) -> tuple[Detection, ...]:
    """Return the accepted candidates, most likely first, then the refused ones; see the module's docstring.

    Args:
        places, looks: (N, 2) candidates in pixels of the rectified plate, and (N, LENGTH) their features.
    """
    knowledge = knowledge.for_image(noisy=ground.noisy)
    known = prepared(knowledge)
    mean_of = NOISY_MEAN_OF if ground.noisy else 1
    names = [kind.name for kind in knowledge.kinds]
    nothing = nothing_column(knowledge)
    closer = _framed(ground, places, knowledge)
    kinds, to_nothing = _parted(nearest(looks, known, mean_of=mean_of), nothing)
    kinds -= closer
    best = kinds.argmin(axis=1)
    near = kinds.min(axis=1)
    size_m = np.array([max(kind.size_m) if kind.middles_m is None else 0.0 for kind in knowledge.kinds])
    spaces = [(u, v, size) for u, v, size in np.column_stack([places, size_m[best] * PLATE_PX_PER_M]).tolist()]
    order = np.argsort(near - np.minimum(to_nothing, near + 0.3))
    waiting = order[near[order] <= np.minimum(to_nothing[order] + SECOND_LOOK, FURTHEST)].tolist()
    taken: list[Space] = []
    accepted, refused = [], []
    while waiting:
        now, waiting = _apart(spaces, waiting, taken)
        if not now:
            break
        at = _centred(ground, places[now], known, best[now])
        seen_looks = look_at(ground, at)
        parted = _parted(nearest(seen_looks, known, mean_of=mean_of), nothing)
        for i, place, look, seen, to_other in zip(now, at, seen_looks, *parted, strict=True):
            if _is_taken(spaces[i], taken):
                continue
            kind = knowledge.kinds[int((seen - closer[i]).argmin())]
            middle, size = place, max(kind.size_m) * PLATE_PX_PER_M
            if kind.middles_m is not None:
                across, up = kind.middles_m[nearest_look(look, kind, knowledge)]
                middle = place + np.array([across, -up]) * PLATE_PX_PER_M
                if _is_taken((*middle.tolist(), size), taken):
                    continue
            even = NOISY_EVEN if ground.noisy else EVEN
            candidate = _candidate(
                place, middle, names, seen, float(to_other), kind.size_m, view, plate_m, closer=closer[i], even=even
            )
            if candidate.reason is None:
                taken.append((*middle.tolist(), size))
                accepted.append(candidate)
            else:
                refused.append(candidate)
    return (*accepted, *refused)


def _parted(distance: Array, nothing: int | None) -> tuple[Array, Array]:
    """Return the distances (N, kinds) to the kinds, infinite to "nothing" (a column), and those (N,) to "nothing"."""
    if nothing is None:
        return distance, np.full(len(distance), np.inf)
    to_nothing = distance[:, nothing].copy()
    distance[:, nothing] = np.inf
    return distance, to_nothing


def _framed(ground: Ground, places: Array, knowledge: Knowledge) -> Array:
    """Return how much nearer (N, kinds) places count to kinds of whose size they are the middle of a rectangle.

    For a kind that is about as wide as it is high a rectangle proves nothing, because most of these are round.
    """
    sizes_px = np.array([kind.size_m for kind in knowledge.kinds]) * PLATE_PX_PER_M
    is_long = np.abs(np.log(sizes_px[:, 0] / sizes_px[:, 1])) > SQUARE
    closer = np.zeros((len(places), len(sizes_px)))
    for one in ground.rectangles:
        fits = is_long & (np.abs(np.log(sizes_px / [one.width, one.height])) < FRAME_FITS).all(axis=1)
        if one.coverage >= FRAME_COVERAGE and fits.any():
            closer[np.ix_((np.abs(places - [one.u, one.v]) < SAME_PX).all(axis=1), fits)] = FRAMED_NEARER
    return closer


def _apart(spaces: Sequence[Space], waiting: Sequence[int], taken: Sequence[Space]) -> tuple[list[int], list[int]]:
    """Return which of the waiting candidates overlap no better one, and which have to wait for what becomes of that one.

    Those that overlap an accepted object (`taken`) are in neither. A size of 0 means that the middle is not known yet.
    """
    now, later = [], []
    claimed: list[Space] = []
    for i in waiting:
        if _is_taken(spaces[i], taken):
            continue
        if _is_taken(spaces[i], claimed):
            later.append(i)
            continue
        now.append(i)
        if spaces[i][2] > 0:
            claimed.append(spaces[i])
    return now, later


def _is_taken(space: Space, taken: Sequence[Space]) -> bool:
    """Return whether an object overlaps one of `taken`; one of size 0 does not."""
    u, v, size = space
    return size > 0 and any(max(abs(u - x), abs(v - y)) < OVERLAP * max(size, other) for x, y, other in taken)


def _refusal(near: float, confidence: float, rival: str) -> str | None:
    """Return the reason for a refusal; None if the candidate is accepted."""
    if near > FURTHEST:
        return "unlike everything taught: teach it, or come closer"
    if confidence >= NAMED_AT:
        return None
    other = "something that is no object" if rival == NOTHING else f"a {rival}"
    return f"as much like {other}: come closer, or change the angle or the light"


def _centred(ground: Ground, places: Array, known: Prepared, kinds: NDArray[np.int64]) -> Array:
    """Return the place (N, 2) near each given one whose features are most similar to its kind (N,; column of `known`).

    A shadow or a wall may shift the middle of a sub-object, but hardly affects the features as a whole, which were
    taught at the true middles. The result is the mean of a cross of places, weighted towards small distances, computed
    twice, the second time finer.
    """
    for step in CENTRING_STEPS_PX:
        tried = places[:, None] + step * CROSS
        looks = look_at(ground, tried.reshape(-1, 2))
        d = nearest_of(looks, known, np.repeat(kinds, len(CROSS))).reshape(-1, len(CROSS))
        least, most = d.min(axis=1, keepdims=True), d.max(axis=1, keepdims=True)
        w = np.exp(-(d - least) / np.maximum(0.25 * (most - least), 1e-6))
        places = (w[:, :, None] * tried).sum(axis=1) / w.sum(axis=1, keepdims=True)
    return places


def _candidate(
    place: Array, middle: Array, names: list[str], kinds: Array, to_nothing: float, size: tuple[float, float],
    view: PanelProjection, plate_m: tuple[float, float], *, closer: Array, even: float,
) -> Detection:  # fmt: skip
    """Build the detection for a place from the distances to all kinds.

    Args:
        place, middle: (2,) place with that look, and the object's middle, pixels of the rectified plate.
        kinds, to_nothing: distances to the kinds `names`, and to "nothing".
        closer: how much nearer it counts to each kind; see `_framed`.
        even: lead at which the confidence is one half.
    """
    counted = kinds - closer
    order = np.argsort(counted)
    first, second = int(order[0]), int(order[min(1, len(order) - 1)])
    to_second = float(counted[second]) if second != first else np.inf
    rival, to_rival = (names[second], to_second) if to_second < to_nothing else (NOTHING, to_nothing)
    lead = to_rival - float(counted[first])
    confidence = float(1.0 / (1.0 + np.exp(-np.clip((lead - even) / SCALE, -8.0, 8.0))))
    if kinds[first] > ALIKE:
        confidence = min(confidence, UNLIKE_AT_MOST)
    place_m, (x, y) = (_on_plate(at, plate_m) for at in (place, middle))
    w, h = size[0] / 2, size[1] / 2
    box = np.array([[x - w, y + h, 0], [x + w, y + h, 0], [x + w, y - h, 0], [x - w, y - h, 0], [x, y, 0]])
    px = view.project(box)
    return Detection(
        kind=names[first],
        confidence=confidence,
        centre_px=px[4],
        centre_m=np.array([x, y]),
        place_m=place_m,
        box_px=px[:4],
        distance=float(kinds[first]),
        rival=(rival, to_rival),
        reason=_refusal(float(kinds[first]), confidence, rival),
    )


def _on_plate(place: Array, plate_m: tuple[float, float]) -> Array:
    """Return the point (2,) on the plate at a pixel of the rectified plate."""
    return np.array([place[0] / PLATE_PX_PER_M - plate_m[0] / 2, plate_m[1] / 2 - place[1] / PLATE_PX_PER_M])
