"""Teaching of a new kind, or of a further look of a known one, from one image and at most three clicks.

A further look is accepted only if it does not make another kind's examples ambiguous: every look that was taught for
another kind must stay nearest to its own kind. `check` shows what the system now finds. For whole panels see
`panel_teach`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.arrays import Array, Image
from hal.errors import Ambiguous, InvalidRequest, NotFound
from perception.vision.finding.blind import PLATE_M, Detection, candidate_places, chosen, lay_out, recognise
from perception.vision.finding.features import PLATE_PX_PER_M, Ground, look_at
from perception.vision.finding.framing import one_plate
from perception.vision.finding.match import distances
from perception.vision.image import as_gray
from perception.vision.knowledge import NOTHING, Knowledge, TaughtKind
from perception.vision.look import LEAST_REACH_M
from perception.vision.patch import CORNERS, rectify
from perception.vision.projection import PanelProjection, PlateProjection, homography
from perception.vision.teaching.sub_object import SubObject, outline_at

SNAP_M = 0.004  # a click is moved to the middle of a sub-object that is so near
# Radius of further middles of the same object, because hub and face of a gauge are not quite concentric.
ABOUT_M = 0.012
SAME_LOOK = 0.10  # a look that is so near to one already taught adds nothing
ROBBED = 0.2  # a taught look that is so near to the new one could be classified as the new kind
NOTHING_SIZE_M = (0.010, 0.010)
# Reach of a look over half of the object's larger side. On two lift panels five clicks find .81 and .92 of the buttons without a
# limit, and .95 and .91 with it; 1.7 and 2.2 are as good.
REACH = 2.0
# Side of the square around an object that a look needs: its circles, and the plate between objects.
SURROUNDINGS_M = 0.15


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overview:
    """The rectified image of one panel, from which any number of examples can be taught."""

    view: PanelProjection
    ground: Ground
    plate_m: tuple[float, float]

    def on_ground(self, points_m: ArrayLike) -> Array:
        """Convert plate points (N, 2; m, origin in the middle, y up) to pixels of the rectified plate."""
        points = np.asarray(points_m, float)
        half = np.array(self.plate_m) / 2
        return np.asarray(np.column_stack([points[:, 0] + half[0], half[1] - points[:, 1]]) * PLATE_PX_PER_M)

    def on_plate(self, points_px: ArrayLike) -> Array:
        """Convert pixels of the rectified plate to plate points, the inverse of `on_ground`."""
        points = np.asarray(points_px, float) / PLATE_PX_PER_M
        return np.column_stack([points[:, 0] - self.plate_m[0] / 2, self.plate_m[1] / 2 - points[:, 1]])

    def in_image(self, points_m: ArrayLike) -> Array:
        """Return the pixels (N, 2) of the image at plate points."""
        points = np.asarray(points_m, float)
        return self.view.project(np.column_stack([points, np.zeros(len(points))]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Example:
    """The object that was clicked.

    Attributes:
        clicks_m: (1..3, 2) on the plate.
        centre_m: (2,) middle of the sub-object, on the plate (origin in its middle, y up).
        outline: the outline found on the rectified plate; None only for `nothing`.
        outline_px: (N, 2) the same in the image; (0, 2) if there is none.
        size_m: width and height of the outline on the plate.
        look: (LENGTH,) see `perception.vision.look`.
        noisy: whether the image is noisy.
    """

    clicks_m: Array
    centre_m: Array
    outline: SubObject | None
    outline_px: Array
    size_m: tuple[float, float]
    look: Array
    noisy: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lesson:
    """Result of teaching one example.

    Attributes:
        knowledge: with the new look.
        kind: the kind that was taught.
        example: the object that was clicked.
        is_new_kind: whether the kind did not exist before.
        added: False if the look was already known.
    """

    knowledge: Knowledge
    kind: TaughtKind
    example: Example
    is_new_kind: bool
    added: bool

    @property
    def centre_m(self) -> Array:
        """Position (2,) on the plate (origin in its middle, y up)."""
        return self.example.centre_m


def teach(
    image: NDArray[Any], knowledge: Knowledge, *, kind: str, clicks_px: Sequence[tuple[float, float]],
    size_m: tuple[float, float] | None = None, plate_m: tuple[float, float] = PLATE_M, view: PanelProjection | None = None,
    source: str = "",
) -> Lesson:  # fmt: skip
    """Teach that there is an object of a `kind` at the clicked position.

    Args:
        clicks_px: one click in the middle; two on opposite corners; or three, two corners and the middle, if that is
            not half way between them.
        size_m: width and height on the plate; by default those of the kind, or of the outline found.
        source: a remark for the knowledge file.

    Raises:
        InvalidRequest: no or too many clicks.
        NotFound: no plate, the click is not on it, or there is no object.
        Ambiguous: two panels are in view, or examples of another kind would be classified as this one; says which.
    """
    overview = overview_of(image, plate_m=plate_m, view=view)
    return teach_example(
        example_at(overview, clicks_px, kind=kind),
        knowledge, kind=kind, size_m=size_m, source=source,
    )  # fmt: skip


def overview_of(
    image: NDArray[Any], *, plate_m: tuple[float, float] = PLATE_M, view: PanelProjection | None = None,
    focal_px: float | None = None, corners_px: Sequence[tuple[float, float]] | None = None,
) -> Overview:  # fmt: skip
    """Rectify the image of one panel for teaching; its border is looked for if neither view nor corners are known.

    Raises:
        InvalidRequest, NotObservable: bad image, or corners that cannot be.
        NotFound, Ambiguous: no plate in it, or two.
    """
    gray = as_gray(image)
    view = view or one_plate(gray, plate_m, focal_px=focal_px, corners_px=corners_px).view
    return Overview(view=view, ground=lay_out(gray, view, plate_m), plate_m=plate_m)


def surroundings(image: NDArray[Any], view: PanelProjection, point_m: ArrayLike, centre_px: ArrayLike) -> Image | None:
    """Return the plate around an object, gray and upright, as seen from straight ahead, for `example_in`.

    Args:
        point_m: (3,) the object by the panel file.
        centre_px: (2,) where the image shows it; nothing finite if that is not known.

    Returns:
        A square image of `SURROUNDINGS_M`; None if the image does not show all of it.
    """
    point, centre = np.asarray(point_m, float), np.asarray(centre_px, float)
    foot_px, half_m = view.project([[*point[:2], 0.0]])[0], SURROUNDINGS_M / 2
    shift_px = centre - foot_px if np.isfinite(centre).all() else np.zeros(2)
    patch = rectify(as_gray(image), view, point[:2], half_width_m=half_m, half_height_m=half_m, shift_px=shift_px)
    return patch.gray if patch.inside.all() else None


def example_in(picture: Image) -> Example:
    """Return the object in the middle of its `surroundings`.

    Raises:
        InvalidRequest, NotObservable: bad image.
        NotFound: there is no object.
    """
    half_m, last_px = SURROUNDINGS_M / 2, np.array(picture.shape[1::-1], float) - 1.0
    corners_m = CORNERS * half_m
    corners_px = (CORNERS * [1.0, -1.0] + 1.0) / 2.0 * last_px
    view = PlateProjection(px_from_plate=homography(corners_m, corners_px), corners_m=corners_m)
    overview = overview_of(picture, plate_m=(SURROUNDINGS_M, SURROUNDINGS_M), view=view)
    return example_at(overview, [(float(last_px[0] / 2.0), float(last_px[1] / 2.0))])


def example_at(overview: Overview, clicks_px: Sequence[tuple[float, float]], *, kind: str = "") -> Example:
    """Return the object at one to three clicks.

    Raises:
        InvalidRequest: no or too many clicks.
        NotFound: a click is not on the plate, or there is no object.
    """
    if not 1 <= len(clicks_px) <= 3:
        raise InvalidRequest(f"{len(clicks_px)} clicks", hint="click the middle, or two opposite corners, or both")
    clicks_m = plate_points(overview.view, clicks_px, overview.plate_m)
    clicks = overview.on_ground(clicks_m)
    outline = outline_at(overview.ground, clicks) if kind != NOTHING else None
    middle = clicks[0] if len(clicks) == 1 else clicks[:2].mean(axis=0) if len(clicks) == 2 else clicks[2]
    place = snapped(middle, candidate_places(overview.ground), SNAP_M * PLATE_PX_PER_M)
    empty = np.zeros((0, 2))
    outline_px = overview.in_image(overview.on_plate(outline.polygon_px)) if outline is not None else empty
    return Example(
        clicks_m=clicks_m,
        centre_m=overview.on_plate(place[None])[0],
        outline=outline,
        outline_px=outline_px,
        size_m=_size_m(clicks_m, outline),
        look=look_at(overview.ground, place[None])[0],
        noisy=overview.ground.noisy,
    )


def teach_example(
    example: Example, knowledge: Knowledge, *, kind: str, size_m: tuple[float, float] | None = None, source: str = ""
) -> Lesson:
    """Add an example to a kind; see `teach`.

    Raises:
        Ambiguous: examples of another kind would be classified as this one; says which.
    """
    known, look = knowledge.kind(kind), example.look
    in_use = knowledge.for_image(noisy=example.noisy)
    alike = in_use.kind(kind)
    if known is not None and alike is not None and _distance(look, in_use, alike) < SAME_LOOK:
        return Lesson(knowledge=knowledge, kind=known, example=example, is_new_kind=False, added=False)
    robbed = robbed_kinds(in_use, kind, look, _reach_m(example))
    if robbed:
        raise Ambiguous(
            f"this {kind} looks so much like {', '.join(robbed)} that it would be taken for it",
            hint="take the image closer or with other light, or check what you clicked on",
            kinds=list(robbed),
        )
    size_m = size_m or (known.size_m if known is not None else example.size_m)
    grown = knowledge.grown(
        TaughtKind(name=kind, size_m=size_m, looks=look[None], taught_by=source, reach_m=np.array([_reach_m(example)]))
    )
    made = grown.kind(kind)
    if made is None:
        raise AssertionError("a look was added to it")
    return Lesson(knowledge=grown, kind=made, example=example, is_new_kind=known is None, added=True)


def _reach_m(example: Example) -> float:
    """Return how far from its middle the example's look counts; everywhere if no outline says how large it is."""
    if example.outline is None:
        return np.inf
    return max(REACH * 0.5 * max(example.size_m), LEAST_REACH_M)


def likest(overview: Overview, example: Example, knowledge: Knowledge) -> Detection | None:
    """Return what the example is recognised as now, with the reason if refused.

    None if it is unlike everything taught.
    """
    places = candidate_places(overview.ground)
    middle = overview.on_ground(example.centre_m[None])[0]
    if example.outline is not None:
        places = np.vstack([places, middle, example.outline.middle_px])
    near = places[np.linalg.norm(places - middle, axis=1) < ABOUT_M * PLATE_PX_PER_M]
    looks = look_at(overview.ground, near)
    found = chosen(overview.ground, near, looks, knowledge, overview.view, overview.plate_m)
    return found[0] if found else None


def robbed_kinds(knowledge: Knowledge, kind: str, look: Array, reach_m: float) -> tuple[str, ...]:
    """Return the kinds of which a taught look is nearer to the new look than to the other looks of its own kind."""
    new = TaughtKind(name=kind, size_m=NOTHING_SIZE_M, looks=look[None], reach_m=np.array([reach_m]))
    robbed = []
    for other in knowledge.kinds:
        if other.name == kind:
            continue
        to_new = distances(other.looks, _only(knowledge, new))[:, 0]
        for k in np.flatnonzero(to_new < ROBBED):
            if to_new[k] < _to_own_kind(knowledge, other, int(k)):
                robbed.append(other.name)
                break
    return tuple(robbed)


def _to_own_kind(knowledge: Knowledge, kind: TaughtKind, index: int) -> float:
    """Return the distance of one look of a kind from the kind's other looks; infinity if it is the only one."""
    if len(kind.looks) < 2:
        return float("inf")
    rest = kind.of(np.arange(len(kind.looks)) != index)
    return _distance(kind.looks[index], knowledge, rest)


def check(
    image: NDArray[Any],
    knowledge: Knowledge,
    *,
    plate_m: tuple[float, float] = PLATE_M,
    view: PanelProjection | None = None,
) -> tuple[Detection, ...]:
    """Return what the system finds now: objects first, then refusals with their reasons."""
    return recognise(image, knowledge, plate_m=plate_m, view=view)


def plate_points(view: PanelProjection, clicks_px: ArrayLike, plate_m: tuple[float, float]) -> Array:
    """Return the plate points (N, 2; m, origin in the middle, y up) at pixels.

    Raises:
        NotFound: a click is not on the plate.
    """
    points = under_pixels(view, clicks_px, plate_m)
    if (np.abs(points) > [plate_m[0] / 2, plate_m[1] / 2]).any():
        raise NotFound("a click lies beside the plate", hint="click on the object")
    return points


def under_pixels(view: PanelProjection, pixels: ArrayLike, plate_m: tuple[float, float]) -> Array:
    """Return the points (N, 2; m, origin in the plate's middle, y up) of its plane at pixels, also beyond the plate."""
    w, h = plate_m[0] / 2, plate_m[1] / 2
    corners = np.array([[-w, h], [w, h], [w, -h], [-w, -h]])
    plate_from_px = homography(view.project(np.column_stack([corners, np.zeros(4)])), corners)
    seen = np.asarray(pixels, float)
    u = np.column_stack([seen, np.ones(len(seen))]) @ plate_from_px.T
    return np.asarray(u[:, :2] / u[:, 2:])


def _size_m(clicks_m: Array, outline: SubObject | None) -> tuple[float, float]:
    """Return width and height of the outline, or of the box that the clicks span (`nothing`)."""
    if outline is not None:
        width, height = outline.size_px / PLATE_PX_PER_M
        return float(width), float(height)
    if len(clicks_m) < 2:
        return NOTHING_SIZE_M
    width, height = np.maximum(np.abs(clicks_m[0] - clicks_m[1]), 1e-3)
    return float(width), float(height)


def snapped(place: Array, candidates: Array, reach: float) -> Array:
    """Return the nearest of the candidate places (N, 2) if it is within reach, else the given place (2,)."""
    away = np.linalg.norm(candidates - place, axis=1)
    return np.asarray(candidates[int(away.argmin())] if len(away) and away.min() < reach else place)


def _distance(look: Array, knowledge: Knowledge, kind: TaughtKind) -> float:
    """Return the distance of a look (LENGTH,) from the nearest look of a kind."""
    return float(distances(look[None], _only(knowledge, kind))[0, 0])


def _only(knowledge: Knowledge, kind: TaughtKind) -> Knowledge:
    """Return the knowledge with that kind only."""
    return replace(knowledge, kinds=(kind,))
