"""Test of the sensor model: flat faces are straight only under the right one.

Over the image of a plane the inverse depth 1/z is linear for a pinhole, z for parallel rays, and r/z if the distance
along each ray is stored instead of the depth, with r the length of the ray (x, y, 1). Under a wrong model every tilted
face appears bent. Only windows that are straight under some model count, each with the log-likelihood that a quadratic
gains over a plane.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from perception.range.quadratics import quadratics, window_rms
from perception.range.sensor import RangeSensorModel

SIDE = 9  # samples across a window
WINDOWS_ACROSS = 3  # windows side by side along the shorter side; neighbouring windows overlap by half
STRAIGHT_GAIN = 8.0  # largest gain in a straight window, from three more parameters; noise alone gives 1.5
MARGIN = 40.0  # by which the total gain under the given model must exceed that under the other model
SHARE = 0.5  # largest total gain under the other model, relative to that under the given one
PRECISION = 1e-6  # of the depth; smaller residuals do not count
BASIS = quadratics(SIDE)

PARALLEL = "flat faces are straight in depth as rays in parallel give them (or the image holds disparities)"
PINHOLE = "flat faces are straight in inverse depth as a pinhole gives them"
DISTANCE = "flat faces are straight once depth is taken as the distance along each ray, not along the axis"


def doubt_about(depth_m: Array, sensor: RangeSensorModel) -> str | None:
    """Return a sentence that names another sensor model if flat faces are straight under that one only.

    None if they are straight under the given model, or if the (H, W) image does not tell. A wrong focal length keeps
    planes straight and is not detected.
    """
    is_pinhole = bool(sensor.packed()[0] > 0)
    few = max(1, min(depth_m.shape) // (WINDOWS_ACROSS * (SIDE - 1)))
    z = np.ascontiguousarray(depth_m[::few, ::few])
    inverse = 1.0 / z
    mine, others = (inverse, {PARALLEL: z}) if is_pinhole else (z, {PINHOLE: inverse})
    if is_pinhole:
        others[DISTANCE] = _ray_lengths(sensor, few) * inverse
    gains = np.stack([_bends(g, g is not z) for g in (mine, *others.values())])
    votes = gains[:, gains.min(axis=0) < STRAIGHT_GAIN].sum(axis=1)
    best = int(votes[1:].argmin()) + 1
    if votes[0] - votes[best] < MARGIN or votes[best] > SHARE * votes[0]:
        return None
    return f"{list(others)[best - 1]}, but bent under the {'pinhole' if is_pinhole else 'orthographic'} model given"


def _ray_lengths(sensor: RangeSensorModel, few: int) -> Array:
    """Return the lengths of the rays (x, y, 1) through every `few`-th pixel of every `few`-th row."""
    _, fx, fy, cx, cy = sensor.packed()
    x, y = (np.arange(0, sensor.width_px, few) - cx) / fx, (np.arange(0, sensor.height_px, few) - cy) / fy
    return np.asarray(np.sqrt(x**2 + y[:, None] ** 2 + 1.0))


def _bends(g: Array, is_inverse: bool) -> Array:
    """Return for each complete window the log-likelihood that a quadratic gains over a plane, in the linear quantity g.

    `is_inverse`: whether g is an inverse depth.
    """
    if min(g.shape) < SIDE:
        return np.zeros(0)
    z, flat, bent = window_rms(g, BASIS, 3, spacing_px=1, stride_px=SIDE // 2, perspective=is_inverse)
    floor = (PRECISION * z) ** 2
    return np.asarray(0.5 * SIDE * SIDE * np.log((flat**2 + floor) / (bent**2 + floor)))
