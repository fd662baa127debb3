"""Detection of drop-shaped dial pointers: a wide hub with one tip, in a colour or gray of its own.

The outline gives the axis if nothing of the same gray touches it. If numerals do (a gray picture of a coloured pointer,
a black pointer), the sides give it: two straight edges from the hub to the tip, symmetric to the left and right.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from perception.vision.image import WHITE_LEVEL, as_gray
from perception.vision.reading import probability
from perception.vision.status.pointer import PointerFit, wrapped

FACE = 0.86  # of the radius; a drop is searched for inside
LEAST_SEPARATION = 3.2  # spreads of the face; two halves of one blurred gray are 2.7 apart
LEAST_CONTRAST = 12.0  # between the face and the brightest or darkest part of a channel
LEAST_HUB, MOST_HUB = 0.18, 0.46  # of the radius; a drop's hub is wider than that of any needle
NUMERAL = 0.09  # of the radius; wider than the strokes of numerals
HALO = 0.24  # of the radius, by which a saturated spot is widened

TURNS = np.deg2rad(np.arange(0.0, 360.0, 2.0))
NEAR = np.deg2rad(np.arange(-6.0, 6.1, 0.5))
REACHES = np.arange(0.7, 1.0, 0.05)  # of the radius: tried distances of the tip
# Of the hub's radius: tried distances at which the sides touch the hub.
HUBS, FINE_HUBS = (0.8, 1.0), (0.7, 0.8, 0.9, 1.0)
ALONG = np.linspace(0.12, 0.92, 14)  # shares of a side at which it is sampled
BESIDE = 0.06  # of the radius: distance of the samples on either side of it
PEAK = 0.1  # directions whose score is this near to the best one determine the axis
APART_RAD = np.deg2rad(35.0)  # least angle to another direction
SAME_RAD, NEAR_RAD = (
    np.deg2rad(5.0),
    np.deg2rad(20.0),
)  # largest angles between outline and sides if they agree, and if a numeral on one side is part of the outline
SIDES_SIGMA_RAD = 0.02
SCORE, LEAD = (0.5, 0.02), (0.06, 0.02)  # half and scale of the evidence, see `probability`
MOST_BY_SIDES = 0.85  # largest confidence of a direction from the sides alone
LEAST_LEAD = 0.1  # of sides that are used although the outline contradicts
DOUBTFUL = 0.45  # confidence if outline and sides contradict each other


@dataclass(frozen=True, slots=True, kw_only=True)
class Drop:
    """A drop and the largest confidence that it justifies."""

    fit: PointerFit
    most: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Sides:
    """The direction whose two sides stand out most, by how much (0 to 1), and the lead over other directions."""

    angle_rad: float
    score: float
    lead: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ColourPlane:
    """One channel and polarity of the picture, (H, W), within a dial: `part` is high where a pointer may be.

    `mask` is where it is above a threshold, `disc` the inside of the dial.
    """

    part: NDArray[np.float32]
    mask: NDArray[np.bool_]
    disc: NDArray[np.bool_]


def find_drop(image: Image, u: float, v: float, radius: float) -> tuple[Drop | None, Drop | None]:
    """Return the drop that stands out with its whole outline, and the one whose two sides stand out.

    None if there is none. The axis is found without the dial's middle, so an oblique view does not falsify the reading.
    """
    middle = (u, v)
    planes = list(_planes(image, u, v, radius))
    sides = [found for plane in planes if (found := _sides(plane, plane.mask, middle, radius)) is not None]
    best = max(sides, key=lambda found: found.score, default=None)
    by_sides = None if best is None else Drop(fit=_fit_of(best), most=_worth(best))
    outlined: tuple[float, NDArray[np.bool_], ColourPlane] | None = None
    for plane in planes:
        region, separation = _region(plane, (round(u), round(v)))
        if region is not None and (outlined is None or separation > outlined[0]):
            outlined = separation, region, plane
    if outlined is None:
        return None, by_sides
    separation, region, plane = outlined
    region |= _glare_within(as_gray(image), region, radius)
    fit = _axis(region, middle, radius, separation)
    if fit is None:
        return None, by_sides
    return _agreed(fit, _sides(plane, region, middle, radius), sides), by_sides


def _agreed(fit: PointerFit, own: Sides | None, others: list[Sides]) -> Drop:
    """Return the drop with the outline's axis, corrected by the sides.

    Sides in any plane with a similar direction correct it; if those of its own plane contradict it clearly, they
    replace it.
    """
    clear = [sides for sides in (own, *others) if sides is not None and sides.score > SCORE[0]]
    near = [sides for sides in clear if _off(sides, fit) < NEAR_RAD]
    if near:
        best = max(near, key=lambda sides: sides.score)
        share = 0.5 if _off(best, fit) < SAME_RAD else 1.0
        angle = fit.angle_rad + share * float(wrapped(np.array(best.angle_rad - fit.angle_rad)))
        return Drop(fit=replace(fit, angle_rad=angle), most=1.0)
    if own is None or own not in clear:
        return Drop(fit=fit, most=1.0)
    if own.lead > LEAST_LEAD:
        return Drop(fit=_fit_of(own), most=_worth(own))
    return Drop(fit=fit, most=DOUBTFUL)


def _off(sides: Sides, fit: PointerFit) -> float:
    """Return the angle between two directions."""
    return float(abs(wrapped(np.array(sides.angle_rad - fit.angle_rad))))


def _fit_of(sides: Sides) -> PointerFit:
    """Return a `PointerFit` of which only the direction is known; its confidence comes from the sides."""
    return PointerFit(
        angle_rad=sides.angle_rad, sigma_rad=SIDES_SIGMA_RAD, strength=20.0, contrast=20.0, rival_ratio=0.3,
        rival_rad=sides.angle_rad + np.pi, supported=1.0, shown=1.0, is_dark=True, unknown=0.0,
    )  # fmt: skip


def _worth(sides: Sides) -> float:
    """Return the confidence of a direction from its sides alone.

    It is never high, because marks on both sides of a needle look similar.
    """
    return MOST_BY_SIDES * probability([(sides.score, *SCORE), (sides.lead, *LEAD)])


def _planes(image: Image, u: float, v: float, radius: float) -> Iterator[ColourPlane]:
    """Yield lightness and both colour axes, bright and dark, each divided into the face and what stands out of it."""
    planes: list[NDArray[Any]] = [as_gray(image)]
    if image.ndim == 3:
        lab = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_RGB2LAB)
        planes += [lab[:, :, 1], lab[:, :, 2]]
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    disc = np.hypot(x - u, y - v) < FACE * radius
    for plane in planes:
        smooth = cv2.GaussianBlur(plane.astype(np.float32), (0, 0), 1.5)
        for sign in (1.0, -1.0):
            part = np.asarray(sign * smooth, np.float32)
            low, high = np.percentile(part[disc], [1, 99])
            if high - low < LEAST_CONTRAST:
                continue
            coded = np.clip((part - low) / (high - low) * 255, 0, 255).astype(np.uint8)
            threshold, _ = cv2.threshold(coded[disc][None], 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
            yield ColourPlane(part=part, mask=(coded > threshold) & disc, disc=disc)


def _region(plane: ColourPlane, middle: tuple[int, int]) -> tuple[NDArray[np.bool_] | None, float]:
    """Return the region of a plane at the middle, and by how many spreads of the face it stands out.

    None if it is no pointer.
    """
    disc = plane.disc
    mask = _opened(plane.mask, 3)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count < 2:
        return None, 0.0
    biggest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    region = labels == biggest
    share = float(region.sum() / disc.sum())
    near = region[max(0, middle[1] - 12) : middle[1] + 13, max(0, middle[0] - 12) : middle[0] + 13].any()
    face = plane.part[disc & ~region]
    spread = 1.4826 * float(np.median(np.abs(face - np.median(face)))) + 1.0
    separation = (float(np.median(plane.part[region])) - float(np.median(face))) / spread
    return (region, separation) if 0.03 < share < 0.4 and near and separation > LEAST_SEPARATION else (None, 0.0)


def _opened(mask: NDArray[np.bool_], size: int) -> NDArray[np.bool_]:
    """Return a mask without parts narrower than `size`."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0)


def _sides(plane: ColourPlane, mask: NDArray[np.bool_], middle: tuple[float, float], radius: float) -> Sides | None:
    """Return the direction in which two edges run from a hub at the middle to a tip; None without such a hub.

    Args:
        mask: (H, W) the pointer, possibly with things that touch it.
    """
    inner = cv2.distanceTransform(_opened(mask, round(NUMERAL * radius) | 1).astype(np.uint8), cv2.DIST_L2, 5)
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    inner[np.hypot(x - middle[0], y - middle[1]) > 0.35 * radius] = 0.0
    hub_radius = float(inner.max())
    if not LEAST_HUB * radius < hub_radius < MOST_HUB * radius:
        return None
    hub = np.argwhere(inner > 0.93 * hub_radius).mean(axis=0)[::-1]
    face = float(np.median(plane.part[plane.disc & ~plane.mask]))
    own = float(np.median(plane.part[np.hypot(x - hub[0], y - hub[1]) < 0.7 * hub_radius]))
    if own - face < 0.3 * LEAST_CONTRAST:
        return None
    ink = np.clip((plane.part - face) / (own - face), 0.0, 1.0)
    scores = _scores(ink, hub, hub_radius, radius, TURNS, HUBS)
    best = float(TURNS[int(scores.argmax())])
    near = _scores(ink, hub, hub_radius, radius, best + NEAR, FINE_HUBS)
    weight = np.maximum(near - (near.max() - PEAK), 0.0)
    angle = best + float((weight * NEAR).sum() / weight.sum())
    elsewhere = scores[np.abs(wrapped(TURNS - angle)) > APART_RAD]
    most = float(scores.max())
    return Sides(angle_rad=angle, score=most, lead=most - float(elsewhere.max()))


def _scores(
    ink: NDArray[np.float32], hub: Array, hub_radius: float, radius: float, turns: Array, hubs: tuple[float, ...]
) -> Array:
    """Return for each direction (turns,) how much more ink is inside than outside the sides of the best drop in it.

    `ink`: (H, W) 0 on the face to 1 on the pointer; `hubs`: see `HUBS`.
    """
    best = np.zeros(len(turns))
    sines, cosines = np.sin(turns)[:, None], np.cos(turns)[:, None]
    for reach in REACHES * radius:
        for share in hubs:
            sin = share * hub_radius / reach  # of half the angle at the tip
            cos = np.sqrt(1.0 - sin**2)
            foot = share * hub_radius * np.array([sin, cos])
            up, right = foot[0] + (reach - foot[0]) * ALONG, foot[1] * (1.0 - ALONG)
            off = BESIDE * radius
            out, within = (up + off * sin, right + off * cos), (up - off * sin, np.maximum(right - off * cos, 0.0))
            ups = np.concatenate([within[0], within[0], out[0], out[0]])
            rights = np.concatenate([within[1], -within[1], out[1], -out[1]])
            x = hub[0] + ups * sines + rights * cosines
            y = hub[1] - ups * cosines + rights * sines
            seen = cv2.remap(ink, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR,
                             borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
            inside, outside = seen.reshape(len(turns), 2, 2, -1).mean(axis=3).transpose(1, 0, 2)
            left_right = np.maximum(inside - outside, 0.0)
            best = np.maximum(best, np.sqrt(left_right[:, 0] * left_right[:, 1]))  # small for a needle
    return np.asarray(best)


def _axis(
    region: NDArray[np.bool_], middle: tuple[float, float], radius: float, separation: float
) -> PointerFit | None:
    """Return the axis of a drop: a wide hub at the dial's middle with one tip; None for any other pointer."""
    inner = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, 5)
    core = np.argwhere(inner > 0.93 * inner.max())
    hub = core.mean(axis=0)[::-1]
    points = np.argwhere(region)[:, ::-1] - hub
    away = np.hypot(points[:, 0], points[:, 1])
    hub_radius, reach = float(inner.max()), float(np.percentile(away, 99.7))
    if reach < 1.4 * hub_radius or reach < 0.4 * radius:
        return None  # a disc has no direction
    if hub_radius < LEAST_HUB * radius or np.hypot(*(hub - middle)) > 0.25 * radius:
        return None  # a wide part away from the middle is a counterweight or a letter
    far = points[away > max(1.15 * hub_radius, 0.55 * reach)]
    direction = far.mean(axis=0)
    angle = float(np.arctan2(direction[0], -direction[1]))
    spread = np.abs((np.arctan2(far[:, 0], -far[:, 1]) - angle + np.pi) % (2 * np.pi) - np.pi)
    stray = float((spread > np.deg2rad(35.0)).mean())
    return PointerFit(
        angle_rad=angle,
        sigma_rad=float(np.arctan(1.0 / reach)),
        strength=3.0 * separation,
        contrast=separation,
        rival_ratio=min(1.0, stray * 2),
        rival_rad=angle + np.pi,
        supported=1.0 - stray,
        shown=1.0 - stray,
        is_dark=False,
        unknown=0.0,
    )


def _glare_within(gray: NDArray[Any], region: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """Return a mask (H, W) of glare inside the pointer's outline, which belongs to the pointer."""
    corners = cv2.convexHull(np.argwhere(region)[:, ::-1].astype(np.int32))
    hull = cv2.fillConvexPoly(np.zeros(region.shape, np.uint8), corners, 1) > 0
    count, labels = cv2.connectedComponents((gray >= WHITE_LEVEL).astype(np.uint8))
    beyond = np.unique(labels[~hull])
    inside = [k for k in range(1, count) if k not in beyond]
    thick = float(cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, 5).max())
    if not inside or thick < 0.6 * LEAST_HUB * radius:  # glare beside a needle does not make it a drop
        return np.zeros(region.shape, bool)
    return hull & with_halo(np.isin(labels, inside), radius)


def with_halo(spots: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """Return the spots (H, W) of glare widened by the halo around them."""
    size = round(HALO * radius) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.dilate(spots.astype(np.uint8), kernel) > 0)
