"""Contrast of bars that extend from a hub (knob marks, lever handles, toggle bats) to both of their sides."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.arrays import Array
from perception.vision.patch import Patch, sample_at

CORE = (-0.5, 0.0, 0.5)  # places across the bar, in half widths
FLANK = (1.7, 2.1)  # the same for the flanks
LEAST_KNOWN = 0.35  # share of a bar's stations that must be visible


def bar_contrast(
    patch: Patch,
    angles_rad: ArrayLike,
    *,
    along_m: tuple[float, float],
    half_width_m: float,
    height_m: ArrayLike | None = None,
    quantile: float = 0.3,
    flank: tuple[float, float] = FLANK,
    beside_m: ArrayLike = 0.0,
    hidden: NDArray[np.bool_] | None = None,
) -> Array:
    """Return the signed contrast (N,), gray levels, of a bar from the object's middle towards each angle.

    Angles are clockwise from up. At every station along the bar the core is compared with both flanks. The station
    counts with the smaller of the two differences, and with 0 if their signs differ (an edge, not a bar). The result is
    a low
    quantile over the stations, with the sign of the bar: positive for bars brighter than their surroundings.

    Args:
        along_m, half_width_m: distances of the bar's ends from the middle, and half its width.
        height_m: height above the plate of the bar's ends (inner, outer), or one height, or None for the patch's plane.
        flank: distances of the flanks from the axis, in half widths.
        hidden: (H, W) mask of occluded pixels. Occluded stations are ignored; a bar that is mostly occluded has no
            contrast.
        beside_m: offset of the bars, or (N,) of each, to the right of the line from the middle, parallel to it.
    """
    angle = np.atleast_1d(np.asarray(angles_rad, float))
    ends_z = [None, None] if height_m is None else list(np.broadcast_to(np.asarray(height_m, float), (2,)))
    ends = [np.column_stack(patch.pixel_of(r * np.sin(angle), r * np.cos(angle), z))
            for r, z in zip(along_m, ends_z, strict=True)]  # fmt: skip
    along = ends[1] - ends[0]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    # Direction across the bar as it appears, because bars may lean
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(length, 1e-9)
    count = max(6, round(float(length.max())))
    share = np.linspace(0.0, 1.0, count)[None, :, None, None]
    offsets = np.array([*CORE, -flank[0], -flank[1], flank[0], flank[1]]) * half_width_m
    offsets = (offsets + np.reshape(beside_m, (-1, 1))) * patch.px_per_m
    place = ends[0][:, None, None, :] + share * along[:, None, None, :]
    place = place + offsets[:, None, :, None] * across[:, None, None, :]
    shape = (len(angle) * count, offsets.shape[1])
    values = sample_at(patch.gray, place[..., 0].reshape(shape), place[..., 1].reshape(shape))
    values = values.reshape(len(angle), count, -1).astype(float)
    core = values[:, :, :3].mean(axis=2)
    left = core - values[:, :, 3:5].mean(axis=2)
    right = core - values[:, :, 5:7].mean(axis=2)
    if hidden is not None and hidden.any():
        lost = sample_at(hidden.astype(np.uint8), place[..., 0].reshape(shape), place[..., 1].reshape(shape)) > 0.2
        lost = lost.reshape(len(angle), count, -1)
        no_core, no_left, no_right = (lost[:, :, part].any(axis=2) for part in (slice(3), slice(3, 5), slice(5, 7)))
        # If one flank is hidden, the other is used alone
        left, right = np.where(no_left, right, left), np.where(no_right, left, right)
        left = np.where(no_core | no_left & no_right, np.nan, left)
    bright = np.maximum(np.minimum(left, right), 0.0)
    dark = np.maximum(np.minimum(-left, -right), 0.0)
    b, d = _low(bright, quantile), _low(dark, quantile)
    return np.where(b >= d, b, -d)


def _low(stations: Array, quantile: float) -> Array:
    """Return the mean of the lower half around a quantile of the known stations.

    It is smoother than the quantile itself.
    """
    ordered = np.sort(stations, axis=1)  # NaN (unknown) sorts last
    count = np.count_nonzero(~np.isnan(ordered), axis=1)
    top = np.minimum(np.maximum(np.round(count * 2 * quantile), 2), count)
    first = np.arange(stations.shape[1]) < top[:, None]
    mean = np.where(first, ordered, 0.0).sum(axis=1) / np.maximum(top, 1)
    return np.where(count >= LEAST_KNOWN * stations.shape[1], mean, 0.0)
