"""Points, as a scanner that the wrist sweeps gives them (`drivers/sweep.py`), made into one depth image."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import NotFound
from perception.range.sensor import PinholeSensor, RangeSensorModel

FILL_NEIGHBOURS = 3  # an empty pixel between this many measured ones of one surface is filled by their mean
FILL_SWEEPS = 2


def depth_image(points_base_m: Array, base_from_view: RigidTransform, sensor: RangeSensorModel) -> Array:
    """(H, W) depth seen from a virtual sensor at `base_from_view`: the nearest point of each pixel, small gaps filled.

    Raises:
        NotFound: no point falls into the view.
    """
    P = base_from_view.inv().apply(points_base_m) if len(points_base_m) else points_base_m
    perspective, fx, fy, cx, cy = sensor.packed()
    P = P[P[:, 2] > 1e-6] if perspective and len(P) else P
    scale = P[:, 2] if perspective else np.ones(len(P))
    u, v = np.rint(P[:, 0] / scale * fx + cx).astype(int), np.rint(P[:, 1] / scale * fy + cy).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < sensor.width_px) & (v < sensor.height_px)
    if not inside.any():
        raise NotFound("none of the points falls into the view", hint="check the arm poses and the virtual sensor")
    depth = np.full((sensor.height_px, sensor.width_px), np.inf)
    np.minimum.at(depth, (v[inside], u[inside]), P[inside, 2])
    depth[~np.isfinite(depth)] = np.nan
    for _ in range(FILL_SWEEPS):
        depth = _filled_once(depth, 4.0 * sensor.pitch_m(float(np.nanmedian(depth))))
    return depth


def fitting_view(
    points_base_m: Array, base_from_view: RigidTransform, *, width_px: int, height_px: int
) -> PinholeSensor:
    """A pinhole at `base_from_view` whose image just holds the points, with square pixels.

    Raises:
        NotFound: no point lies before the view.
    """
    P = base_from_view.inv().apply(points_base_m) if len(points_base_m) else np.empty((0, 3))
    P = P[P[:, 2] > 1e-6]
    if not len(P):
        raise NotFound("no point lies before the view", hint="let z of the view point at the scene")
    low, high = (np.quantile(P[:, :2] / P[:, 2:], q, axis=0) for q in (0.005, 0.995))
    span = np.maximum(high - low, 1e-6)
    f = 0.95 * min(width_px / span[0], height_px / span[1])
    middle = 0.5 * (low + high)
    return PinholeSensor(
        width_px=width_px,
        height_px=height_px,
        fx_px=f,
        fy_px=f,
        cx_px=(width_px - 1) / 2 - f * middle[0],
        cy_px=(height_px - 1) / 2 - f * middle[1],
    )


def _filled_once(depth: Array, tolerance_m: float) -> Array:
    padded = np.pad(depth, 1, constant_values=np.nan)
    h, w = depth.shape
    around = np.stack(
        [padded[1 + i : 1 + i + h, 1 + j : 1 + j + w] for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    )
    known = np.isfinite(around).sum(axis=0)
    spread = np.nan_to_num(around, nan=-np.inf).max(axis=0) - np.nan_to_num(around, nan=np.inf).min(axis=0)
    fill = np.isnan(depth) & (known >= FILL_NEIGHBOURS) & (spread < tolerance_m)
    total = np.nan_to_num(around).sum(axis=0)
    return np.where(fill, total / np.maximum(known, 1), depth)
