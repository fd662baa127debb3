"""Simulates the errors of real depth sensors on exact scenes: structured light, stereo and time of flight.

White noise would be too favourable: real depth errors are correlated over the matching window, quantised in disparity
and distorted by calibration, and beside depth jumps the image is ragged or empty. Amplitudes and correlation lengths
were measured on flat patches of the development frames: structured light has 0.07 px of disparity noise correlated over
4 to 6 px, stereo less noise, over 8 px.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

Case = dict[str, Any]

SHAPE = (480, 640)
LEAST_PIXELS = 400  # of a scored surface; people who outline surfaces by hand omit smaller ones
SENSORS = ("structured", "stereo", "tof")
FINE = "fine"  # sensor with errors far smaller than the unevenness of real faces: scanned or rendered depth
TABLE_HEIGHT_MM = 720.0


def table_top(gen: ModuleType, sensor: str, seed: int) -> Case:
    """Return a case in the scorer's format: boxes, cans and balls on a table, seen closely by one of `SENSORS`."""
    rng = np.random.default_rng([seed, SENSORS.index(sensor), 77])
    surfaces = _objects(gen, rng)
    clean, labels = gen.cast(surfaces, sensor_model(sensor))
    clean = np.asarray(clean, float)
    return case_seen(clean, labels, surfaces, sensor=sensor, rng=rng, scene="table_top", seed=seed)


def case_seen(
    clean: Array,
    labels: NDArray[Any],
    surfaces: list[dict[str, Any]],
    *,
    sensor: str,
    rng: np.random.Generator,
    scene: str,
    seed: int,
) -> Case:
    """Return a case in the scorer's format: exact depth in millimetres (not finite for none), degraded by a sensor."""
    model = sensor_model(sensor)
    truth = np.where(np.isfinite(clean), labels, 0)
    depth = DEGRADE[sensor](clean, model["f"], rng)
    truth = np.where(np.isfinite(depth) | (truth > 0), truth, 0)
    kept: list[dict[str, Any]] = []
    out = np.zeros(SHAPE, np.int16)
    for k in (k for k in np.unique(truth) if k > 0):
        mine = (truth == k) & np.isfinite(depth)
        if not mine.any():
            continue
        entry = dict(surfaces[k - 1]) | {"id": len(kept) + 1, "pixels": int(mine.sum())}
        entry["scored"] = entry["pixels"] >= LEAST_PIXELS and entry["type"] != "other"
        out[mine] = entry["id"]
        kept.append(entry)
    meta = {"scene": scene, "seed": seed, "sensor": model, "unit": "mm", "surfaces": kept}
    meta = json.loads(json.dumps(meta, default=lambda o: o.tolist()))
    return {"depth": depth.astype(np.float32), "clean": clean.astype(np.float32), "labels": out, "meta": meta}


def sensor_model(sensor: str) -> dict[str, Any]:
    """Return the pinhole model of one of `SENSORS` in the case format."""
    focal = {"structured": 575.0, "stereo": 900.0, "tof": 500.0, "fine": 500.0}[sensor]
    return {"kind": "pinhole", "shape": list(SHAPE), "f": focal, "cx": 319.5, "cy": 239.5}


def _objects(gen: ModuleType, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Draw surfaces in the camera frame, millimetres: floor, wall, table and four to eight things on it."""
    up = np.array([0.0, 0.0, 1.0])
    floor = dict(type="plane", name="floor", n=up, c=np.array([0.0, 0.0, -TABLE_HEIGHT_MM]))
    wall = dict(type="plane", name="wall", n=np.array([0.0, -1.0, 0.0]), c=np.array([0.0, rng.uniform(900, 1600), 0.0]))
    edge = dict(kind="rect", u=np.array([1.0, 0.0, 0.0]), a=rng.uniform(400, 800), b=rng.uniform(300, 600))
    table = dict(type="plane", name="table", n=up, c=np.zeros(3), clip=edge)
    out = [floor, wall, table]
    for k, at in enumerate(stands(rng)):
        out += _thing(gen, rng, at, k)
    tilt, distance = rng.uniform(0.6, 1.1), rng.uniform(800, 1350)
    R, t = gen.look(tilt, rng.uniform(-0.5, 0.5), distance, (0, 40, 30))
    roll = gen.rot([0, 0, 1], rng.uniform(-0.1, 0.1))
    return list(gen.to_camera(out, roll @ R, roll @ t))


def stands(rng: np.random.Generator) -> Iterator[Array]:
    """Yield four to eight positions (3,) on a table at z = 0 where things stand without touching."""
    cells = [(x, y) for x in (-260, -90, 90, 260) for y in (-140, 60, 240)]
    rng.shuffle(cells)
    for x, y in cells[: rng.integers(4, 9)]:
        yield np.array([x + rng.uniform(-30, 30), y + rng.uniform(-30, 30), 0.0])


def _thing(gen: ModuleType, rng: np.random.Generator, at: Array, k: int) -> list[dict[str, Any]]:
    turn, up = gen.Rz(rng.uniform(0, np.pi)), np.array([0.0, 0.0, 1.0])
    choice = rng.random()
    if choice < 0.6:
        size = rng.uniform([60, 60, 40], [170, 150, 230])
        out = list(gen.box(at + up * (size[2] / 2), size, turn, f"box{k}"))
        if rng.random() < 0.25:  # a second box on top
            top = rng.uniform([40, 40, 40], [100, 90, 120])
            out += gen.box(at + up * (size[2] + top[2] / 2), top, gen.Rz(rng.uniform(0, np.pi)), f"upper{k}")
        return out
    if choice < 0.85:
        half, r = rng.uniform(40, 110), rng.uniform(28, 62)
        return list(gen.cyl(at + up * half, up, r, half, f"can{k}"))
    if choice < 0.93:
        half, r = rng.uniform(50, 110), rng.uniform(28, 50)
        return list(gen.cyl(at + up * r, turn @ [1.0, 0, 0], r, half, f"tube{k}"))
    r = rng.uniform(40, 85)
    return list(gen.sphere(at + up * r, r, f"ball{k}"))


def structured_light(clean_mm: Array, focal_px: float, rng: np.random.Generator) -> Array:
    """Simulate a pattern projector 75 mm beside the camera, with disparity in 1/8 px (Khoshelham and Elberink 2012)."""
    return _triangulated(
        clean_mm,
        rng,
        base_px_mm=focal_px * 75.0,
        step_px=1 / 8,
        noise_px=0.065,
        window_px=1.9,
        bend_px=0.12,
        ragged_px=1.2,
    )


def stereo(clean_mm: Array, focal_px: float, rng: np.random.Generator) -> Array:
    """Simulate two cameras 90 mm apart, with disparity in 1/16 px, smoothed by a large matching window."""
    return _triangulated(
        clean_mm,
        rng,
        base_px_mm=focal_px * 90.0,
        step_px=1 / 16,
        noise_px=0.09,
        window_px=3.5,
        bend_px=0.15,
        ragged_px=2.0,
    )


def time_of_flight(clean_mm: Array, focal_px: float, rng: np.random.Generator) -> Array:
    """Simulate modulated light: noise grows with z^2, flying pixels at jumps, periodic errors of a few millimetres."""
    del focal_px
    z = np.nan_to_num(clean_mm, posinf=0.0)
    mixed = cv2.blur(z, (3, 3))
    jump = np.abs(mixed - z) > 8.0
    seen = np.where(jump & (rng.random(z.shape) < 0.6), mixed, z)
    wiggle = 2.5 * np.sin(2 * np.pi * seen / 470.0 + rng.uniform(0, 6)) + 2.0 * _field(rng, 60.0)
    sigma = 0.8 + 1.2e-6 * seen**2
    noise = sigma * (0.8 * rng.normal(size=z.shape) + 0.6 * _field(rng, 1.0))
    out = np.rint(seen + wiggle + noise)
    out[(z <= 0) | (z > 4500.0)] = np.nan
    return np.asarray(out)


def fine(clean_mm: Array, focal_px: float, rng: np.random.Generator) -> Array:
    """Simulate a slow scanner or a rendering: 1/3 mm of white noise, rounded to millimetres."""
    del focal_px
    out = np.rint(clean_mm + rng.normal(0.0, 0.3, clean_mm.shape))
    out[~np.isfinite(clean_mm)] = np.nan
    return np.asarray(out)


def _triangulated(
    clean_mm: Array,
    rng: np.random.Generator,
    *,
    base_px_mm: float,
    step_px: float,
    noise_px: float,
    window_px: float,
    bend_px: float,
    ragged_px: float,
) -> Array:
    """Return depth from noisy, distorted, quantised disparity, ragged at jumps, empty where hidden from one view."""
    H, W = clean_mm.shape
    v, u = np.mgrid[:H, :W].astype(np.float32)
    shift = [np.asarray(ragged_px * _field(rng, 3.0), np.float32) for _ in range(2)]
    z = np.where(np.isfinite(clean_mm), clean_mm, 1e5).astype(np.float32)
    moved = cv2.remap(z, u + shift[0], v + shift[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    # Only jumps are ragged; on a slanted face the matching window averages.
    z_mm = np.asarray(np.where(np.abs(moved - z) > 0.02 * z, moved, z), np.float64)
    disparity = np.asarray(base_px_mm / z_mm, np.float64)
    x, y = u / W - 0.5, v / H - 0.5
    bend = rng.normal(size=3) * bend_px
    slow = bend[0] * (x * x + y * y) * 2 + bend[1] * x * y * 2 + bend[2] * x * np.abs(x) * 2 + 0.025 * _field(rng, 30.0)
    bands = 0.02 * rng.normal(size=9)[np.minimum((u / W * 8 + 0.3).astype(int), 8)]
    noisy = disparity + slow + bands + noise_px * _field(rng, window_px)
    coded = np.rint(noisy / step_px) * step_px
    depth = np.rint(base_px_mm / np.maximum(coded, 1e-3))
    blind = _unseen_by_second(disparity) | _grazing(z_mm, rng) | (z_mm > 5000.0)
    blind[:, :8] = True
    blind[:, -8:] = True
    depth[blind] = np.nan
    return np.asarray(depth)


def _field(rng: np.random.Generator, sigma_px: float) -> Array:
    """Return a smooth random field of unit standard deviation, correlated by a Gaussian of `sigma_px`."""
    scale = max(1, int(sigma_px / 3))
    small = rng.normal(size=(SHAPE[0] // scale + 16, SHAPE[1] // scale + 16))
    smooth = cv2.GaussianBlur(small, (0, 0), sigma_px / scale)
    large = cv2.resize(smooth, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)[: SHAPE[0], : SHAPE[1]]
    return np.asarray(large / large.std())


def _unseen_by_second(disparity_px: Array) -> NDArray[np.bool_]:
    """Return the pixels that a nearer surface, further right in the image, hides from the second viewpoint."""
    H, W = disparity_px.shape
    column = np.arange(W)[None, :] - disparity_px
    # A pixel is hidden if one to its right maps at or left of it, hence a running minimum from the right.
    least = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros((H, W), bool)
    hidden[:, :-1] = least[:, 1:] < column[:, :-1] - 0.7
    return cv2.dilate(hidden.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)


def _grazing(z_mm: Array, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return the pixels that reflect no pattern: surfaces slanted by more than about 75 degrees, some dark patches."""
    du, dv = np.abs(np.gradient(z_mm, axis=1)), np.abs(np.gradient(z_mm, axis=0))
    steep = cv2.medianBlur((np.maximum(du, dv) > 0.007 * z_mm).astype(np.uint8), 5) > 0
    return np.asarray(steep | (_field(rng, 6.0) > 3.6))


DEGRADE = {"structured": structured_light, "stereo": stereo, "tof": time_of_flight, FINE: fine}
