"""Detection of cables in front of an object: bands that enter over its border at one place and leave at another.

Where a cable crosses a dark window it may be as gray as the window, but it stands out on the plate just outside; where
it is as gray as the plate, it stands out in the window. So a closed path around the object and one just inside its
border are searched for contrasting places. Every two places on one path that match in gray and width are joined by a
band, which must have one gray throughout and be straight or have one bend.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.vision.patch import Patch, sample_at
from perception.vision.status.occluders import OUTSIDE, Crossing, border_crossings, followed_in, smoothed

SAME_GRAY = 16.0  # gray levels; largest variation along a band, because real cables are slightly glossy
GROUND_SHARE = 0.5  # share of the contrast of a band within the window
WHOLLY = 0.97  # share of the band's axis above which no refinement is needed
ALONG_SHARE = 0.72  # share of the band's axis that must have its gray
INSET = 0.09  # share of the smaller side, from the border to the inner path; inside a frame, and outside the digits
MOST_WIDTH = 0.5  # share of the object's smaller side; wider occluders are not handled here
BENDS = (
    0.0,
    -0.3,
    0.3,
    -0.6,
    0.6,
    -1.0,
    1.0,
    -1.6,
    1.6,
    -2.3,
    2.3,
    -3.3,
    3.3,
    -4.5,
    4.5,
)  # of the band's width, sideways
INK_EDGE_PX = 4.0
MOST_COVERED = 0.3  # share of a face; a larger followed region is the face itself, or glare on it
WITHIN = np.linspace(-0.9, 0.9, 48)  # in half widths and heights
# In band widths from the object's middle; angle from one of its own directions
OWN_ASIDE, OWN_RAD = 0.6, np.deg2rad(12.0)
BENT_AT = (0.5, 0.3, 0.7)  # tried places of the bend, as shares of the length
CORE = 0.2  # half width of the strip about the axis in which a band's gray is measured, in band widths
CENTRED = ((0.1, 0.3), (0.1, 0.15), (0.05, 0.08), (0.05, 0.04))  # steps of place and size when the bend is centred
FINER = ((0.14, 0.3), (0.07, 0.15))  # steps of place and size about the best bend
MERGED = 1.7  # ratio of the widths of the two ends from which something beside the cable has merged with it


def hidden_by_bands(
    patch: Patch, *, half_width_m: float, half_height_m: float, dark_ink: bool
) -> NDArray[np.bool_] | None:
    """Return a mask (H, W) of the cables that cross a display in the patch; None if there are none.

    Args:
        dark_ink: whether segments are darker than their background. The blurred edge of a cable with the polarity of
            the segments could be taken for ink, so it is hidden, too; the other edges are left visible.
    """
    smooth = smoothed(patch)
    inset = INSET * 2 * min(half_width_m, half_height_m)
    paths = [
        border_crossings(
            patch, half_width_m=half_width_m - less, half_height_m=half_height_m - less, is_round=False, beyond=beyond,
            smooth=smooth,
        )
        for less, beyond in ((0.0, OUTSIDE), (inset, 0.0))
    ]  # fmt: skip
    if max(len(ends) for ends in paths) < 2:
        return None
    least_side = 2 * min(half_width_m, half_height_m) * patch.px_per_m
    mask = np.zeros(patch.gray.shape, np.uint8)
    ground = _ground(patch, half_width_m, half_height_m)
    for (a, b), within in (
        (pair, within) for ends, within in zip(paths, (False, True), strict=True) for pair in combinations(ends, 2)
    ):
        # Within the window the band must differ from the window's background.
        tolerance = min(SAME_GRAY, GROUND_SHARE * min(a.by, b.by)) if within else SAME_GRAY
        line = None if a.side == b.side else _joined(smooth, a, b, least_side, tolerance)
        if line is not None:
            width = line.width_px + (
                INK_EDGE_PX if ((a.gray + b.gray) / 2 < ground - SAME_GRAY / 2) == dark_ink else 0.0
            )
            cv2.polylines(
                mask, [np.round(line.points_px * 16).astype(np.int32)], False, 1, max(1, round(width)), cv2.LINE_8, 4
            )
    return mask > 0 if mask.any() else None


def lying_across(
    patch: Patch, *, half_width_m: float, half_height_m: float, is_round: bool, through: bool = False, most: float = 1.0
) -> NDArray[np.bool_] | None:
    """Return a mask (H, W) of the occluders of an object in the patch; None if there are none.

    Cables are searched for first, as bands of one gray. Anything else that enters over the border is followed by its
    gray (`covered`); unlike the band search, this leaks into a frame or a pointer of the same gray.

    Args:
        half_width_m, half_height_m, is_round, through: as for `followed_in`.
        most: largest share of the object that a followed region may cover; a larger one is part of the object
            (see `MOST_COVERED`).
    """
    smooth = smoothed(patch)
    ends = border_crossings(
        patch, half_width_m=half_width_m, half_height_m=half_height_m, is_round=is_round, smooth=smooth
    )
    if not ends:
        return None
    least_side = 2 * min(half_width_m, half_height_m) * patch.px_per_m
    bands, rest = _bands_between(smooth, ends, least_side, is_round=is_round)
    leaked = followed_in(
        patch, rest, smooth=smooth, half_width_m=half_width_m, half_height_m=half_height_m, is_round=is_round,
        through=through,
    )  # fmt: skip
    found = _drawn(bands, patch.gray.shape)
    if leaked is not None and _share(patch, leaked, half_width_m, half_height_m, is_round=is_round) <= most:
        found |= leaked
    return found if found.any() else None


def _share(
    patch: Patch, mask: NDArray[np.bool_], half_width_m: float, half_height_m: float, *, is_round: bool
) -> float:
    """Return the share of an object's face, without its frame, that a mask covers."""
    x, y = np.meshgrid(WITHIN, WITHIN)
    face = np.hypot(x, y) < WITHIN[-1] + 1e-9 if is_round else np.ones(x.shape, bool)
    u, v = patch.pixel_of(x[face] * half_width_m, y[face] * half_height_m)
    return float((sample_at(mask.astype(np.uint8), u, v) > 0.5).mean())


def cables_across(patch: Patch, *, radius_m: float, own_rad: Array) -> NDArray[np.bool_] | None:
    """Return a mask (H, W) of the cables that cross a disc around the object's middle; None if there are none.

    Args:
        radius_m: radius of the disc, clear of the object's ends.
        own_rad: (N,) directions, clockwise from up, in which the object itself has bands through its middle.
    """
    smooth = smoothed(patch)
    ends = border_crossings(
        patch, half_width_m=radius_m, half_height_m=radius_m, is_round=True, beyond=0.0, smooth=smooth
    )
    if len(ends) < 2:
        return None
    least_side = 2 * radius_m * patch.px_per_m
    found, _ = _bands_between(smooth, ends, least_side, is_round=True)
    middle = np.array(patch.pixel_of(0.0, 0.0))
    bands = [band for band in found if not _is_own(band, middle, own_rad)]
    return _drawn(bands, patch.gray.shape) if bands else None


def _is_own(band: _Band, middle_px: Array, own_rad: Array) -> bool:
    """Return whether a band may be a part of the object: through its middle, in one of its own directions."""
    first, last = band.points_px[0], band.points_px[-1]
    along = (last - first) / max(float(np.linalg.norm(last - first)), 1e-9)
    to_middle = middle_px - first
    aside = abs(float(along[0] * to_middle[1] - along[1] * to_middle[0]))
    turn = np.arctan2(along[0], -along[1]) - own_rad
    near = np.abs((turn + np.pi / 2) % np.pi - np.pi / 2).min(initial=np.pi)
    return bool(aside < OWN_ASIDE * band.width_px and near < OWN_RAD)


def _bands_between(
    smooth: NDArray[np.uint8], ends: Sequence[Crossing], least_side_px: float, *, is_round: bool
) -> tuple[list[_Band], list[Crossing]]:
    """Return the bands that join crossings, surest first, and the crossings that no band uses.

    Every crossing belongs to at most one band, unless it is much wider than the band.
    """
    found = []
    for (i, a), (k, b) in combinations(enumerate(ends), 2):
        if a.side != b.side or is_round:
            tolerance = min(SAME_GRAY, GROUND_SHARE * min(a.by, b.by))  # lower than the contrast to the plate
            tried = (_joined(smooth, *pair, least_side_px, tolerance) for pair in _narrowed(a, b))
            found += [(band.share, i, k, band) for band in tried if band is not None]
    joined: set[int] = set()
    bands = []
    for _, i, k, band in sorted(found, key=lambda item: -item[0]):
        if joined.isdisjoint((i, k)):
            bands.append(band)
            joined |= {n for n in (i, k) if ends[n].length_px <= MERGED * band.width_px}
    return bands, [end for n, end in enumerate(ends) if n not in joined]


def _drawn(bands: Sequence[_Band], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return a mask (H, W) of bands with their blurred edges."""
    mask = np.zeros(shape, np.uint8)
    for band in bands:
        points, thick = np.round(band.points_px * 16).astype(np.int32), max(1, round(band.width_px + INK_EDGE_PX))
        cv2.polylines(mask, [points], False, 1, thick, cv2.LINE_8, 4)
    return mask > 0


def _narrowed(a: Crossing, b: Crossing) -> list[tuple[Crossing, Crossing]]:
    """Return the pair itself or, if one end is much wider, pairs with parts of that end.

    A word or another cable is then beside the cable.
    """
    a, b = (a, b) if a.length_px <= b.length_px else (b, a)
    if b.length_px <= MERGED * a.length_px:
        return [(a, b)]
    room = b.length_px / 2
    return [
        (a, replace(b, middle_px=b.middle_px + shift * b.tangent, length_px=a.length_px, gray=a.gray))
        for shift in np.arange(-room, room + 1e-6, 0.4 * a.length_px)
    ]


def _ground(patch: Patch, half_width_m: float, half_height_m: float) -> float:
    """Return the typical gray of the window."""
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 24) * half_width_m, np.linspace(-0.8, 0.8, 12) * half_height_m)
    return float(np.median(patch.sample(x, y, 0.0)))


def _joined(
    smooth: NDArray[np.uint8], a: Crossing, b: Crossing, least_side_px: float, tolerance: float
) -> _Band | None:
    """Return the band between two places on the border; None if there is none."""
    if abs(a.gray - b.gray) > 2 * SAME_GRAY or a.is_darker != b.is_darker:
        return None
    along = b.middle_px - a.middle_px
    length = float(np.linalg.norm(along))
    if length < 0.4 * least_side_px:
        return None
    along = along / length
    widths = [end.length_px * abs(float(along[0] * end.tangent[1] - along[1] * end.tangent[0])) for end in (a, b)]
    width = max(widths)
    if min(widths) < 1.0 or width > MOST_WIDTH * least_side_px or width > 2.2 * min(widths):
        return None
    across = np.array([-along[1], along[0]]) * width
    t = np.linspace(0.0, 1.0, max(12, round(length / 1.5)))
    core = CORE * min(widths)
    band = _Search(smooth=smooth, a=a, b=b, across=across, t=t, half_px=core, tolerance=tolerance)
    at, bend, share = band.best(list(product(BENT_AT, BENDS)))
    for step, size in FINER if share < WHOLLY else ():
        near = [(at + i * step, bend + k * size) for i, k in product((0, -1, 1), repeat=2)]
        at, bend, share = band.best([(place, by) for place, by in near if 0.1 < place < 0.9])
    if share < ALONG_SHARE:
        return None
    if bend == 0.0:
        return _Band(points_px=band.points([(at, bend)])[0], width_px=width, share=share)
    # A bent band is narrower across its legs than across the chord. The core of a thick cable fits many bends, but the
    # whole cable only one.
    width = min(_width(a, band, at, bend), _width(b, band, at, bend))
    whole = replace(band, half_px=max(CORE * width, width / 2 - INK_EDGE_PX))
    for step, size in CENTRED:
        near = [(at + i * step, bend + k * size) for i, k in product((0, -1, 1), repeat=2)]
        at, bend, _ = whole.best([(place, by) for place, by in near if 0.1 < place < 0.9])
    return _Band(points_px=band.points([(at, bend)])[0], width_px=width, share=share)


def _width(end: Crossing, band: _Search, at: float, bend: float) -> float:
    """Return the width of a bent band at one of its ends, perpendicular to its leg there."""
    _, knee, _ = band.points([(at, bend)])[0]
    leg = (knee - end.middle_px) / max(float(np.linalg.norm(knee - end.middle_px)), 1e-9)
    return end.length_px * abs(float(leg[0] * end.tangent[1] - leg[1] * end.tangent[0]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Band:
    """A cable: its axis (3, 2), its width, and the share of it that has its gray."""

    points_px: Array
    width_px: float
    share: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Search:
    """Search for straight and bent bands between two crossings, by the share of the band with the crossings' gray.

    Attributes:
        smooth: smoothed gray image.
        a, b: the crossings.
        across: (2,) perpendicular to the chord, as long as the band seems wide; the unit of bends.
        t: (N,) places at which the band is sampled, 0 to 1.
        half_px: distance from the axis of the samples on either side.
        tolerance: largest difference from the crossings' gray.
    """

    smooth: NDArray[np.uint8]
    a: Crossing
    b: Crossing
    across: Array
    t: Array
    half_px: float
    tolerance: float

    def points(self, shapes: list[tuple[float, float]]) -> Array:
        """Return the axes (N, 3, 2) of bands with a bend at a share of their length, by a number of widths."""
        a, b = self.a.middle_px, self.b.middle_px
        return np.array([[a, a + at * (b - a) + bend * self.across, b] for at, bend in shapes])

    def best(self, shapes: list[tuple[float, float]]) -> tuple[float, float, float]:
        """Return place and size of the best bend, and the share of that band; straight unless a bend is better."""
        t, axes = self.t, self.points(shapes)
        knots = np.array([at for at, _ in shapes])[:, None]
        # Positions along either leg.
        first, second = np.minimum(t / knots, 1.0), np.maximum((t - knots) / (1.0 - knots), 0.0)
        axis = (
            axes[:, :1]
            + first[..., None] * (axes[:, 1] - axes[:, 0])[:, None]
            + second[..., None] * (axes[:, 2] - axes[:, 1])[:, None]
        )
        legs = axes[:, 1:] - axes[:, :-1]  # shapes, 2, 2
        normals = np.stack([-legs[..., 1], legs[..., 0]], axis=-1) / np.linalg.norm(legs, axis=-1, keepdims=True)
        aside = self.half_px * np.where((t < knots)[..., None], normals[:, :1], normals[:, 1:])
        flat = np.concatenate([axis - aside, axis, axis + aside], axis=1)
        wanted = self.a.gray + t * (self.b.gray - self.a.gray)
        off = np.abs(sample_at(self.smooth, flat[..., 0], flat[..., 1]) - np.tile(wanted, 3))
        shares = np.count_nonzero(off < self.tolerance, axis=1) / off.shape[1]
        k = int((shares + 0.01 * np.array([bend == 0.0 for _, bend in shapes])).argmax())
        return (*shapes[k], float(shares[k]))
