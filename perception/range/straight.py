"""Whether flat faces come out straight under the sensor model that was given, or only under another one.

A plane is linear over the image in 1/z for a pinhole, in z for parallel rays, and in r/z, where r is the length of the
ray (x, y, 1), when what is stored is the distance along each ray. Under a wrong one every tilted face is bent. Only
windows that some model makes straight vote, each with the log-likelihood that a quadratic gains over a line.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from perception.range.noise import quadratics, window_rms
from perception.range.sensor import RangeSensorModel

SIDE = 9  # samples across a window
WINDOWS_ACROSS = 3  # of the shorter side; windows overlap by half
STRAIGHT_GAIN = 8.0  # of three parameters more; noise alone gives 1.5
MARGIN = 40.0
SHARE = 0.5  # the other model must leave no more bend than this
PRECISION = 1e-6  # of the depth: what is straighter is straight
BASIS = quadratics(SIDE)

PARALLEL = "flat faces are straight in depth as rays in parallel give them (or the image holds disparities)"
PINHOLE = "flat faces are straight in inverse depth as a pinhole gives them"
DISTANCE = "flat faces are straight once depth is taken as the distance along each ray, not along the axis"


def doubt_about(depth_m: Array, sensor: RangeSensorModel) -> str | None:
    """A sentence that names a sensor model under which the (H, W) image's flat faces are straight, if not under this.

    None when they are straight under the one given, or when the image does not tell. A wrong focal length keeps planes
    straight and is not seen.
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
    """Length of the ray (x, y, 1) through every so manieth pixel."""
    _, fx, fy, cx, cy = sensor.packed()
    x, y = (np.arange(0, sensor.width_px, few) - cx) / fx, (np.arange(0, sensor.height_px, few) - cy) / fy
    return np.asarray(np.sqrt(x**2 + y[:, None] ** 2 + 1.0))


def _bends(g: Array, is_inverse: bool) -> Array:
    """For each complete window the log-likelihood that a quadratic gains over a plane, in the linear quantity g."""
    if min(g.shape) < SIDE:
        return np.zeros(0)
    z, flat, bent = window_rms(g, BASIS, 3, 1, SIDE // 2, is_inverse)
    floor = (PRECISION * z) ** 2
    return np.asarray(0.5 * SIDE * SIDE * np.log((flat**2 + floor) / (bent**2 + floor)))
