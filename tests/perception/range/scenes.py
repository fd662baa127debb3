"""Small synthetic range images with known truth, so that no test needs external data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.range import OrthographicSensor, PinholeSensor

PINHOLE = PinholeSensor(width_px=160, height_px=120, fx_px=180.0, fy_px=180.0, cx_px=79.5, cy_px=59.5)
PARALLEL = OrthographicSensor(width_px=160, height_px=120, pixel_pitch_m=0.0015)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture:
    """Depth (H, W) in metres, and the true labels (H, W)."""

    depth_m: Array
    labels: NDArray[np.int64]


def rays(sensor: PinholeSensor | OrthographicSensor) -> tuple[Array, Array]:
    """Return origins and directions (H, W, 3), implemented independently of the code under test."""
    v, u = np.mgrid[: sensor.height_px, : sensor.width_px].astype(float)
    one = np.ones_like(u)
    if isinstance(sensor, PinholeSensor):
        direction = np.stack([(u - sensor.cx_px) / sensor.fx_px, (v - sensor.cy_px) / sensor.fy_px, one], -1)
        return np.zeros_like(direction), direction
    p = sensor.pixel_pitch_m
    origin = np.stack([(u - (sensor.width_px - 1) / 2) * p, (v - (sensor.height_px - 1) / 2) * p, 0 * u], -1)
    return origin, np.broadcast_to(np.array([0.0, 0.0, 1.0]), origin.shape)


def plane_depth(sensor: PinholeSensor | OrthographicSensor, normal: Array, point: Array) -> Array:
    """Return the depth of the plane through `point` at each pixel."""
    origin, direction = rays(sensor)
    return np.asarray(((point - origin) @ normal) / (direction @ normal))


def sphere_depth(sensor: PinholeSensor | OrthographicSensor, centre: Array, radius: float) -> Array:
    """Return the nearer depth of a sphere; infinite where the ray misses it."""
    origin, direction = rays(sensor)
    return _near_root(direction, origin - centre, np.eye(3), radius**2)


def cylinder_depth(sensor: PinholeSensor | OrthographicSensor, point: Array, axis: Array, radius: float) -> Array:
    """Return the nearer depth of an infinite cylinder; infinite where the ray misses it."""
    origin, direction = rays(sensor)
    a = np.asarray(axis) / np.linalg.norm(axis)
    return _near_root(direction, origin - point, np.eye(3) - np.outer(a, a), radius**2)


def _near_root(D: Array, W: Array, M: Array, level: float) -> Array:
    a = np.einsum("...i,ij,...j", D, M, D)
    b = np.einsum("...i,ij,...j", D, M, W)
    c = np.einsum("...i,ij,...j", W, M, W) - level
    disc = b * b - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(disc > 0, (-b - np.sqrt(disc)) / a, np.inf)


def nearest(*depths: Array) -> Picture:
    """Return the sensor's view of several surfaces, with labels from 1 in the given order."""
    stack = np.stack(depths)
    return Picture(depth_m=stack.min(axis=0), labels=stack.argmin(axis=0) + 1)


def noisy(depth_m: Array, sigma_m: float, seed: int, gross: float = 0.0) -> Array:
    """Add white noise, and a fraction of gross errors at the nearest and the farthest depth of the image."""
    rng = np.random.default_rng(seed)
    out = depth_m + rng.normal(0.0, sigma_m, depth_m.shape)
    hit = rng.random(depth_m.shape)
    out[hit < gross / 2] = np.nanmin(depth_m)
    out[hit > 1 - gross / 2] = np.nanmax(depth_m)
    return np.asarray(out)


def ball_on_table(sensor: PinholeSensor | OrthographicSensor = PINHOLE) -> Picture:
    """Return a tilted table with a ball of 40 mm radius and a pipe of 25 mm radius."""
    table = plane_depth(sensor, np.array([0.0, -0.5, -0.85]), np.array([0.0, 0.0, 0.62]))
    ball = sphere_depth(sensor, np.array([-0.07, 0.0, 0.58]), 0.04)
    pipe = cylinder_depth(sensor, np.array([0.08, 0.0, 0.56]), np.array([0.15, 1.0, -0.6]), 0.025)
    return nearest(table, ball, pipe)
