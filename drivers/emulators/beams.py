"""Converts a range image into the distances that a 2-D line scanner in the same place would measure."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.devices import RangeImage, RangeScannerCapabilities


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
        range_m = _at(row, c.cx + c.fx * np.tan(safe_rad)) / np.cos(safe_rad)
    else:
        middle_m = float(np.nanmedian(row)) if np.any(np.isfinite(row)) else np.nan
        range_m = _at(row, c.cx + c.fx * middle_m * np.tan(safe_rad)) / np.cos(safe_rad)
    return np.where(is_ahead, range_m, np.nan)


def _at(row: Array, column: Array) -> Array:
    """Return the nearest pixel of `row` for each column; NaN beyond its ends."""
    nearest = np.round(column)
    is_inside = np.isfinite(nearest) & (nearest >= 0) & (nearest < len(row))
    return np.where(is_inside, row[np.where(is_inside, nearest, 0).astype(np.int64)], np.nan)
