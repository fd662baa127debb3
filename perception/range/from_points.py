"""Rendering of a depth image from points, such as those of a line scanner that the arm sweeps."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array, Indices
from hal.errors import NotFound
from perception.range.sensor import RangeSensorModel

SAME_SURFACE_M = 0.004  # points so near the nearest one in a pixel are averaged, because the nearest alone is biased
NEIGHBOUR_PX = 2  # a slope is taken over at most so many pixels to each side
FILL_NEIGHBOURS = 3  # an empty pixel with so many measured neighbours on one surface is filled
FILL_PASSES = 2
NEIGHBOURS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (1, 1), (1, 0), (1, -1), (0, 1))  # the last four opposite the first


def image_from_points(points_base_m: Array, base_from_view: RigidTransform, sensor: RangeSensorModel) -> Array:
    """Return the depth image (H, W) in metres of points (N, 3), seen from a virtual sensor at `base_from_view`.

    A pixel holds the mean of its points on the nearest surface, corrected to the pixel's centre by the slope of the
    surface. Small gaps are filled; other pixels without points are NaN.

    Raises:
        NotFound: no point falls into the view.
    """
    P = base_from_view.inv().apply(points_base_m) if len(points_base_m) else points_base_m
    perspective, fx, fy, cx, cy = sensor.packed()
    P = P[P[:, 2] > 1e-6] if perspective and len(P) else P
    scale = P[:, 2] if perspective else np.ones(len(P))
    place = np.stack([P[:, 1] / scale * fy + cy, P[:, 0] / scale * fx + cx], axis=1)  # row, column
    pixel = np.rint(place).astype(int)
    shape = (sensor.height_px, sensor.width_px)
    inside = np.all((pixel >= 0) & (pixel < shape), axis=1)
    if not inside.any():
        raise NotFound("none of the points falls into the view", hint="check the arm poses and the virtual sensor")
    # On a plane, inverse depth (perspective) or depth (orthographic) is linear over the image.
    value = 1.0 / P[inside, 2] if perspective else P[inside, 2]
    index = np.ravel_multi_index(tuple(pixel[inside].T), shape)
    centred = _at_centres(_means(index, P[inside, 2], value, place[inside] - pixel[inside], shape))
    depth = 1.0 / centred if perspective else centred
    for _ in range(FILL_PASSES):
        depth = _filled_once(depth, 4.0 * sensor.pitch_m(float(np.nanmedian(depth))))
    return depth


def _means(index: Indices, depth_m: Array, value: Array, offset_px: Array, shape: tuple[int, int]) -> Array:
    """Return per pixel the mean value of its points on the nearest surface and their mean offset, (3, H, W).

    The offset (rows, columns) is from the pixel's centre. `index`: flat pixel index of each point.
    """
    nearest = np.full(shape[0] * shape[1], np.inf)
    np.minimum.at(nearest, index, depth_m)
    chosen = depth_m <= nearest[index] + SAME_SURFACE_M
    columns = np.column_stack([np.ones(len(value)), value, offset_px])[chosen]
    count, *sums = (np.bincount(index[chosen], weights=column, minlength=len(nearest)) for column in columns.T)
    with np.errstate(invalid="ignore"):
        return np.stack([total / count for total in sums]).reshape(3, *shape)


def _at_centres(means: Array) -> Array:
    """Return the values (H, W) at the pixels' centres, using the slope between the neighbours on both sides.

    A sweep leaves whole rows empty. Without a slope the rows beside them would be off by the slope of half a pixel.
    """
    value, *offsets = means
    out = value.copy()
    for axis, offset in enumerate(offsets):
        (before, at_before), (after, at_after) = (_beside(value, offset, axis, side) for side in (-1, 1))
        slope = (after - before) / (at_after - at_before)
        is_smooth = np.abs(after + before - 2.0 * value) < np.abs(after - before) + 0.01 * np.abs(value)
        is_smooth &= np.abs(slope) < 0.02 * np.abs(value)  # no jump: at most 1 cm per pixel at half a metre
        out = out - np.where(is_smooth, slope * offset, 0.0)
    return np.asarray(out)


def _beside(value: Array, offset_px: Array, axis: int, side: int) -> tuple[Array, Array]:
    """Return value and place in pixels, (H, W) each, of the nearest measured neighbour before (-1) or after (1).

    The place is relative to the centre of the pixel whose neighbour it is; both are NaN where no neighbour is near.
    """
    found = np.full((2, *value.shape), np.nan)
    for far in range(NEIGHBOUR_PX, 0, -1):
        inner, outer = slice(far, None), slice(None, -far)
        to, of = (_along(axis, part) for part in ((inner, outer) if side < 0 else (outer, inner)))
        seen = np.stack([value[of], offset_px[of] + side * far])
        found[0][to], found[1][to] = np.where(np.isfinite(seen), seen, [found[0][to], found[1][to]])
    return found[0], found[1]


def _along(axis: int, part: slice) -> tuple[slice, slice]:
    return (part, slice(None)) if axis == 0 else (slice(None), part)


def _filled_once(depth: Array, tolerance_m: float) -> Array:
    """Return the image with those empty pixels filled whose known neighbours are enough and lie on one surface.

    A pixel gets the mean of the neighbours that are opposite each other, which is right on an inclined surface, too. Beyond
    the edge of a surface nothing is filled in: there the mean of all neighbours would be off by the slope of the surface.

    `tolerance_m`: largest difference in depth between neighbours on one surface.
    """
    padded = np.pad(depth, 1, constant_values=np.nan)
    h, w = depth.shape
    around = np.stack([padded[1 + i : 1 + i + h, 1 + j : 1 + j + w] for i, j in NEIGHBOURS])
    known = np.isfinite(around).sum(axis=0)
    spread = np.nan_to_num(around, nan=-np.inf).max(axis=0) - np.nan_to_num(around, nan=np.inf).min(axis=0)
    opposite = 0.5 * (around[: len(NEIGHBOURS) // 2] + around[len(NEIGHBOURS) // 2 :])
    pairs = np.isfinite(opposite).sum(axis=0)
    fill = np.isnan(depth) & (known >= FILL_NEIGHBOURS) & (pairs > 0) & (spread < tolerance_m)
    total = np.nan_to_num(opposite).sum(axis=0)
    return np.where(fill, total / np.maximum(pairs, 1), depth)
