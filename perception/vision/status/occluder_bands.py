"""Detection of cables in front of an object: bands that enter over its border at one place and leave at another.

A closed path around the object, and one just inside the border of a window, are searched for contrasting places. Every
two on one path that match in gray and width are joined by a band, which must be straight and have one gray throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.arrays import Array
from perception.vision.patch import Patch, sample_at
from perception.vision.status.occluders import OUTSIDE, Crossing, border_crossings, smoothed

SAME_GRAY = 16.0  # gray levels; largest variation along a band, because real cables are slightly glossy
GROUND_SHARE = 0.5  # the same as a share of the band's contrast to the plate
ALONG_SHARE = 0.72  # share of the band's axis that must have its gray
INSET = (
    0.09  # share of the smaller side, from a window's border to the inner path; inside a frame, and outside the digits
)
INK_EDGE_PX = 2.0  # width of a band's blurred edges together
# In band widths from the object's middle; angle from one of its own directions
OWN_ASIDE, OWN_RAD = 0.6, np.deg2rad(12.0)
CORE = 0.2  # half width of the strip about the axis in which a band's gray is measured, in band widths
MERGED = 1.7  # ratio of the widths of the two ends from which something beside the cable has merged with it


def lying_across(
    patch: Patch, *, half_width_m: float, half_height_m: float, is_round: bool, dark_ink: bool | None = None
) -> NDArray[np.bool_] | None:
    """Return a mask (H, W) of the cables across an object in the patch; None if there are none.

    Args:
        half_width_m, half_height_m, is_round: as for `border_crossings`.
        dark_ink: whether the segments of a display are darker than their background; None for anything else. In its
            window a cable as gray as the plate stands out, too. The blurred edge of a cable with the polarity of the
            segments could be taken for ink, so it is hidden widely; the other edges are left visible.
    """
    smooth, inset_m = smoothed(patch), INSET * 2 * min(half_width_m, half_height_m)
    bands = _bands(patch, smooth, half_width_m, half_height_m, is_round=is_round, beyond=OUTSIDE)
    if dark_ink is not None:
        bands += _bands(patch, smooth, half_width_m - inset_m, half_height_m - inset_m, is_round=False, beyond=0.0)
        x, y = np.meshgrid(np.linspace(-0.8, 0.8, 24) * half_width_m, np.linspace(-0.8, 0.8, 12) * half_height_m)
        ground = float(np.median(patch.sample(x, y, 0.0)))
        wider = [INK_EDGE_PX if (band.gray < ground - SAME_GRAY / 2) == dark_ink else -INK_EDGE_PX for band in bands]
        bands = [replace(band, width_px=band.width_px + by) for band, by in zip(bands, wider, strict=True)]
    return _drawn(bands, patch.gray.shape)


def cables_across(patch: Patch, *, radius_m: float, own_rad: ArrayLike = ()) -> NDArray[np.bool_] | None:
    """Return a mask (H, W) of the cables that cross a disc around the object's middle; None if there are none.

    Args:
        radius_m: radius of the disc, clear of the object's ends.
        own_rad: (N,) directions, clockwise from up, in which the object itself has bands through its middle.
    """
    middle = np.array(patch.pixel_of(0.0, 0.0))
    bands = _bands(patch, smoothed(patch), radius_m, radius_m, is_round=True, beyond=0.0)
    return _drawn([band for band in bands if not _is_own(band, middle, own_rad)], patch.gray.shape)


def _is_own(band: _Band, middle_px: Array, own_rad: ArrayLike) -> bool:
    """Return whether a band may be a part of the object: through its middle, in one of its own directions."""
    first, last = band.points_px[0], band.points_px[-1]
    along = (last - first) / max(float(np.linalg.norm(last - first)), 1e-9)
    to_middle = middle_px - first
    aside = abs(float(along[0] * to_middle[1] - along[1] * to_middle[0]))
    turn = np.arctan2(along[0], -along[1]) - np.asarray(own_rad, float)
    near = np.abs((turn + np.pi / 2) % np.pi - np.pi / 2).min(initial=np.pi)
    return bool(aside < OWN_ASIDE * band.width_px and near < OWN_RAD)


def _bands(
    patch: Patch, smooth: NDArray[np.uint8], half_width_m: float, half_height_m: float, *, is_round: bool, beyond: float
) -> list[_Band]:
    """Return the bands that join crossings, surest first; arguments as for `border_crossings`.

    Every crossing belongs to at most one band, unless it is much wider than the band.
    """
    ends = border_crossings(
        patch, smooth, half_width_m=half_width_m, half_height_m=half_height_m, is_round=is_round, beyond=beyond
    )
    least_side_px = 2 * min(half_width_m, half_height_m) * patch.px_per_m
    found = []
    for (i, a), (k, b) in combinations(enumerate(ends), 2):
        if a.side != b.side or is_round:
            tolerance = min(SAME_GRAY, GROUND_SHARE * min(a.by, b.by))  # lower than the contrast to the plate
            tried = (_joined(smooth, *pair, least_side_px, tolerance) for pair in _narrowed(a, b))
            found += [(band.share, i, k, band) for band in tried if band is not None]
    joined: set[int] = set()
    bands: list[_Band] = []
    for _, i, k, band in sorted(found, key=lambda item: -item[0]):
        if joined.isdisjoint((i, k)):
            bands.append(band)
            joined |= {n for n in (i, k) if ends[n].length_px <= MERGED * band.width_px}
    return bands


def _drawn(bands: Sequence[_Band], shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    """Return a mask (H, W) of bands with their blurred edges; None without bands."""
    if not bands:
        return None
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
    if min(widths) < 1.0 or width > 2.2 * min(widths):
        return None
    t = np.linspace(0.0, 1.0, max(12, round(length / 1.5)))[:, None]
    axis, wanted = a.middle_px + t * (b.middle_px - a.middle_px), a.gray + t * (b.gray - a.gray)
    aside = CORE * min(widths) * np.array([-along[1], along[0]])
    u, v = np.stack([axis - aside, axis, axis + aside], axis=1).transpose(2, 0, 1)
    share = float((np.abs(sample_at(smooth, u, v) - wanted) < tolerance).mean())
    if share < ALONG_SHARE:
        return None
    ends = np.stack([a.middle_px, b.middle_px])
    return _Band(points_px=ends, width_px=width, share=share, gray=(a.gray + b.gray) / 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Band:
    """A cable: the ends (2, 2) of its axis, its width, the share of it that has its gray, and that gray."""

    points_px: Array
    width_px: float
    share: float
    gray: float
