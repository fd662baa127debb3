"""Converts a range image into the distances that a 2-D line scanner in the same place would measure."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.devices import RangeImage, RangeScannerCapabilities

SAME_SURFACE_RATIO = 0.02  # of the distance; neighbours further apart are at the edge of something


def line_m(image: RangeImage, c: RangeScannerCapabilities, angle_rad: Array) -> Array:
    """Return the distance along each beam at `angle_rad` about the sensor's y axis, in metres.

    The distances come from the image's middle row; beams outside the image are NaN.

    Pinhole: u = cx + fx tan(a), distance = z / cos(a). The beams of an orthographic image do not start at one point, so
    its column is found from the row's median depth, which is exact for a plane at a right angle to the view.
    """
    row = image.depth_m[c.height // 2].astype(np.float64)
    if c.projection == "polar":
        column = (angle_rad - c.first_angle_rad) / c.step_angle_rad
        return _at(row, column)
    is_ahead = np.abs(angle_rad) < 0.5 * np.pi - 1e-3
    safe_rad = np.where(is_ahead, angle_rad, 0.0)
    if c.projection == "pinhole":
        range_m = _at(row, c.cx + c.fx * np.tan(safe_rad), is_pinhole=True) / np.cos(safe_rad)
    else:
        middle_m = float(np.nanmedian(row)) if np.any(np.isfinite(row)) else np.nan
        range_m = _at(row, c.cx + c.fx * middle_m * np.tan(safe_rad)) / np.cos(safe_rad)
    return np.where(is_ahead, range_m, np.nan)


def _at(row: Array, column: Array, *, is_pinhole: bool = False) -> Array:
    """Return the row's value at each column; NaN beyond its ends.

    Between two neighbours on one surface it is interpolated, in inverse depth for a pinhole image, which is exact on a
    plane; elsewhere it is the nearer column's.
    """
    nearest = np.round(column)
    is_inside = np.isfinite(nearest) & (nearest >= 0) & (nearest < len(row))
    safe = np.where(is_inside, np.clip(column, 0, len(row) - 1), 0.0)
    low = np.minimum(safe.astype(np.int64), max(len(row) - 2, 0))
    left, right, fraction = row[low], row[np.minimum(low + 1, len(row) - 1)], safe - low
    with np.errstate(invalid="ignore", divide="ignore"):
        linear = (1.0 - fraction) * left + fraction * right
        between = left * right / ((1.0 - fraction) * right + fraction * left) if is_pinhole else linear
        one = np.where(fraction < 0.5, left, right)
        is_one_surface = np.abs(left - right) < SAME_SURFACE_RATIO * one
    return np.where(is_inside, np.where(is_one_surface, between, one), np.nan)
