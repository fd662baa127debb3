"""Points of a range image, as a drawing needs them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

MOST_POINTS = 6000  # more would cost a browser more than they show


def points_of(depth_m: NDArray[np.float32], scanner: dict[str, Any]) -> Array:
    """Return points (N, 3) m of a range image in the scanner's axes, at most `MOST_POINTS`, evenly taken.

    Args:
        depth_m: (height, width), NaN where nothing was measured; along the beam for `polar`, else along the view.
        scanner: capabilities of the scanner, as the API gives them; `hal.devices.RangeScannerCapabilities` has the equations.
    """
    rows, columns = np.nonzero(np.isfinite(depth_m))
    kept = slice(None, None, max(1, -(-len(rows) // MOST_POINTS)))
    rows, columns = rows[kept], columns[kept]
    depth = depth_m[rows, columns].astype(float)
    if scanner["projection"] == "polar":
        angle_rad = scanner["first_angle_rad"] + columns * scanner["step_angle_rad"]
        return np.column_stack([depth * np.sin(angle_rad), np.zeros(len(depth)), depth * np.cos(angle_rad)])
    x, y = (columns - scanner["cx"]) / scanner["fx"], (rows - scanner["cy"]) / scanner["fy"]
    scale = depth if scanner["projection"] == "pinhole" else 1.0
    return np.column_stack([x * scale, y * scale, depth])
