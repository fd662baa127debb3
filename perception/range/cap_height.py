"""Height of a round, flat cap above the plate around it, in a range image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.panel import Cap
from perception.range.sensor import RangeSensorModel

INSIDE = 0.7  # share of the cap's radius that certainly shows the cap, though the pose errs by some millimetres
AROUND, AROUND_M = 1.4, 0.02  # the plate is measured from this multiple of the radius on, over this width
PLATE_M = 0.004  # what stands out further is something else; poses err by less
LEAST_CAP, LEAST_PLATE = 6, 24  # pixels
MEDIAN_TO_SIGMA = 1.4826
ALIKE_PIXELS = 4.0  # neighbours share their errors, so that many of them count as one


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredCap:
    """Height of a cap above the plate, and one standard deviation, m."""

    height_m: float
    sigma_m: float


def measure_cap(
    depth_m: Array, sensor: RangeSensorModel, cap: Cap, *, foot_from_sensor: RigidTransform, sensor_sigma_m: float
) -> MeasuredCap | None:
    """Measure the height of a cap; None if too little of it is seen, or if what is seen cannot be this cap.

    Args:
        depth_m: (H, W), NaN where nothing was measured.
        foot_from_sensor: pose of the sensor in the axes of the panel, with the origin at the cap's centre on the plate.
        sensor_sigma_m: standard deviation of one pixel, as the sensor states it.
    """
    points = sensor.points(depth_m).reshape(-1, 3)
    x, y, z = foot_from_sensor.apply(points[np.isfinite(points).all(axis=1)]).T
    r = np.hypot(x, y)
    on_cap = z[r < INSIDE * cap.radius_m]
    inner_m = AROUND * cap.radius_m
    on_plate = z[(r > inner_m) & (r < inner_m + AROUND_M) & (np.abs(z) < PLATE_M)]
    if len(on_cap) < LEAST_CAP or len(on_plate) < LEAST_PLATE:
        return None
    (top_m, top_sigma_m), (plate_m, plate_sigma_m) = (_middle(values, sensor_sigma_m) for values in (on_cap, on_plate))
    height_m, sigma_m = top_m - plate_m, float(np.hypot(top_sigma_m, plate_sigma_m))
    slack_m = cap.pressed_depth_m / 2 + 3.0 * sigma_m
    if not cap.height_m - cap.pressed_depth_m - slack_m < height_m < cap.height_m + slack_m:
        return None  # a cable in front of it, or a hole
    return MeasuredCap(height_m=height_m, sigma_m=sigma_m)


def _middle(values: Array, sigma_m: float) -> tuple[float, float]:
    """Return the median and its standard deviation."""
    middle = float(np.median(values))
    spread = max(MEDIAN_TO_SIGMA * float(np.median(np.abs(values - middle))), sigma_m)
    return middle, spread * float(np.sqrt(np.pi / 2 * ALIKE_PIXELS / len(values)))
