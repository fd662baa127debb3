"""Image pairs with lights on and off: stored ones beside the repository, and drawn ones with other lamps and cameras.

The images of a bright pair differ by the lights, exposure, noise and half a pixel of motion. Stress pairs have dim
lights, up to 3 px and 0.2 degrees of motion, moving glare, and panel lamps that switch between the images.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.errors import PerceptionError
from perception.vision.lights import assign_lights, find_lights

Gray = NDArray[np.uint8]
STORED = Path(__file__).resolve().parents[2] / "shared" / "data" / "vision" / "synth_dev"
WIDTH, HEIGHT = 640, 480
HIT_PX = 3.0
HIDDEN_PX = 6.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightPair:
    """Two images, the taught lights (4, 3) m in the panel frame, their true pixels, and which lights are visible."""

    off: NDArray[Any]
    on: NDArray[Any]
    lights_m: Array
    lights_px: Array
    visible: NDArray[np.bool_]


def stored_pairs(*, stress: bool) -> Iterator[LightPair]:
    """Yield the development pairs; none if the data do not exist."""
    truth = STORED / "truth.json"
    if not truth.exists():
        return
    for name, entry in json.loads(truth.read_text()).items():
        if not entry.get("lights_on") or name.startswith("p31") != stress:
            continue
        on, off = (cv2.imread(str(STORED / n), cv2.IMREAD_GRAYSCALE) for n in (name, name.replace("_on", "_off")))
        mm = np.array(entry["lights_mm"], float)
        flat = (mm - mm.mean(axis=0)) * [1e-3, -1e-3]  # y points down in the file
        yield LightPair(
            off=np.asarray(off), on=np.asarray(on), lights_m=np.column_stack([flat, np.zeros(4)]),
            lights_px=np.array(entry["lights_px"], float), visible=np.array(entry["lights_visible"], bool),
        )  # fmt: skip


def score_pairs(pairs: Iterable[LightPair]) -> str:
    """Return the fraction of pairs with every visible light within 3 px and no false one, with errors and times."""
    right, errors, times_ms, total = 0, [], [], 0
    for pair in pairs:
        total += 1
        started_s = time.perf_counter()
        found = seen_lights(pair)
        times_ms.append((time.perf_counter() - started_s) * 1e3)
        near = [float(np.linalg.norm(found - p, axis=1).min()) if len(found) else np.inf for p in pair.lights_px]
        hits = [d for d, v in zip(near, pair.visible, strict=True) if v]
        false = sum(
            not any(np.linalg.norm(f - p) <= (HIT_PX if v else HIDDEN_PX)
                    for p, v in zip(pair.lights_px, pair.visible, strict=True)) for f in found
        )  # fmt: skip
        errors += [d for d in hits if d <= HIT_PX]
        right += all(d <= HIT_PX for d in hits) and not false
    if not total:
        return "not found beside the repository"
    return (
        f"{right / total:.1%} of {total}; error median {np.median(errors):.3f} max {np.max(errors):.2f} px; "
        f"{np.median(times_ms):.1f} ms a pair"
    )


def seen_lights(pair: LightPair) -> Array:
    """Return the (N, 2) lights that the library finds without camera calibration; none if it refuses."""
    try:
        blobs = find_lights(pair.off, pair.on)
        lights = assign_lights(blobs, pair.lights_m, image_size_px=(pair.on.shape[1], pair.on.shape[0]), least=2)
    except PerceptionError:
        return np.empty((0, 2))
    return np.asarray(lights.points_px[lights.seen])


def drawn_pairs(count: int, *, stress: bool, seed: int = 0) -> Iterator[LightPair]:
    """Yield `count` drawn pairs with two visible lights or more; the levels easy, medium and hard alternate."""
    for k in range(count):
        rng = np.random.default_rng([seed, k, int(stress)])
        pair = _draw(rng, hard=(k % 3) / 2.0, stress=stress)
        while pair.visible.sum() < 2:
            pair = _draw(rng, hard=(k % 3) / 2.0, stress=stress)
        yield pair


def _draw(rng: np.random.Generator, *, hard: float, stress: bool) -> LightPair:
    size = np.array([rng.uniform(0.3, 0.6), rng.uniform(0.25, 0.4)])
    inset = rng.uniform(0.008, 0.02)
    corners = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * (size / 2)
    lights = corners - np.sign(corners) * inset + rng.uniform(-0.004, 0.004, (4, 2))
    radius = rng.uniform(0.004, 0.007)
    H = _homography(rng, size, np.radians(2 + 26 * hard))
    lights_px = _apply(H, lights)
    things = _things(rng, size)
    toggled = [
        k for k, panel_object in enumerate(things) if stress and panel_object[0] == "lamp" and rng.random() < 0.7
    ]
    motion = np.zeros(3) if not stress else np.array([*rng.uniform(-3, 3, 2), rng.uniform(-0.0035, 0.0035)])
    motion[:2] += rng.uniform(-0.5, 0.5, 2)
    gains = 1.0 + rng.uniform(-0.04, 0.04, 2) + (rng.uniform(-0.25, 0.25) * hard)
    glare = [_spot(rng) for _ in range(round(3 * hard))]
    cables = [rng.uniform(0, WIDTH, 2) for _ in range(round(2 * hard))]
    base = rng.uniform(90, 150)
    lit = rng.uniform(0.25, 0.4) if stress else rng.uniform(0.8, 1.2)
    blur = 0.4 + 1.2 * hard * rng.uniform(0.3, 1.0)
    levels = []
    for on in (False, True):
        scene = _scene(H if on else _shifted(H, motion), size, base, things, set(toggled) if on else set())
        lamp = (radius, 0.35 * base, 0.7 * base + (150.0 * lit if on else 0.0))
        scene = _lamps(scene, H if on else _shifted(H, motion), lights, lamp)
        moved = [(p + (rng.uniform(-25, 25, 2) if stress and on else 0.0), s, a) for p, s, a in glare]
        for place, spread, strength in moved:
            scene = scene + _bump(place, spread, strength)
        for ends in cables:
            scene = _cable(scene, ends + (0.0 if on else 1.2 * motion[0]), 6 + 4 * hard)  # moves more as it is nearer
        levels.append(gains[int(on)] * np.asarray(cv2.GaussianBlur(scene, (0, 0), blur)))
    noise = 0.7 + 5.0 * hard
    off, on_image = (_expose(level, noise, rng) for level in levels)
    return LightPair(
        off=off, on=on_image, lights_m=np.column_stack([lights, np.zeros(4)]), lights_px=lights_px,
        visible=_visible(levels, lights_px, noise),
    )  # fmt: skip


def _homography(rng: np.random.Generator, size: Array, tilt_rad: float) -> Array:
    """Return the homography from panel metres to pixels of a random camera that has the panel roughly in view."""
    focal = rng.uniform(0.9, 1.6) * WIDTH
    axis = rng.uniform(0, 2 * np.pi)
    tilt = cv2.Rodrigues(rng.uniform(0.2, 1.0) * tilt_rad * np.array([np.cos(axis), np.sin(axis), 0.0]))[0]
    roll = cv2.Rodrigues(np.array([0.0, 0.0, rng.normal(0, 0.05)]))[0]
    R = tilt @ roll @ np.diag([1.0, -1.0, -1.0])
    distance = focal * max(size[0] / WIDTH, size[1] / HEIGHT) * rng.uniform(1.02, 1.3)
    t = np.array([rng.uniform(-0.02, 0.02), rng.uniform(-0.02, 0.02), distance])
    K = np.array([[focal, 0, WIDTH / 2 - 0.5], [0, focal, HEIGHT / 2 - 0.5], [0, 0, 1]])
    return np.asarray(K @ np.column_stack([R[:, :2], t]))


def _shifted(H: Array, motion: Array) -> Array:
    c, s = np.cos(motion[2]), np.sin(motion[2])
    centre = np.array([[1, 0, WIDTH / 2], [0, 1, HEIGHT / 2], [0, 0, 1.0]])
    move = np.array([[c, -s, motion[0]], [s, c, motion[1]], [0, 0, 1.0]])
    return np.asarray(centre @ move @ np.linalg.inv(centre) @ H)


def _apply(H: Array, points_m: Array) -> Array:
    q = np.column_stack([points_m, np.ones(len(points_m))]) @ H.T
    return np.asarray(q[:, :2] / q[:, 2:])


def _things(rng: np.random.Generator, size: Array) -> list[tuple[str, Array, float, float]]:
    """Return (kind, position, radius, brightness) of objects on a loose grid."""
    things = []
    for x in np.linspace(-0.36, 0.36, 4):
        for y in np.linspace(-0.3, 0.3, 3):
            place = np.array([x, y]) * size + rng.uniform(-0.01, 0.01, 2)
            kind = str(rng.choice(["disc", "box", "lamp", "dial"]))
            things.append((kind, place, float(rng.uniform(0.05, 0.11) * size[1]), float(rng.uniform(20, 230))))
    return things


def _scene(
    H: Array, size: Array, base: float, things: list[tuple[str, Array, float, float]], lit: set[int]
) -> NDArray[np.float32]:
    canvas = np.full((2 * HEIGHT, 2 * WIDTH), 45.0, np.float32)
    _fill(canvas, H, np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * (size / 2), base)
    for k, (kind, place, radius, level) in enumerate(things):
        if kind == "box":
            box = np.array([[-1, 0.6], [1, 0.6], [1, -0.6], [-1, -0.6]]) * radius
            _fill(canvas, H, place + box, level)
            for offset in np.linspace(-0.7, 0.7, 7):
                _fill(canvas, H, place + np.array([offset * radius, 0.0]) + box * [0.03, 0.5], 255 - level)
            continue
        small = 0.45 if kind == "lamp" else 1.0
        _fill(canvas, H, place + _ring(radius * small), 40.0)
        _fill(canvas, H, place + _ring(0.85 * radius * small), min(255.0, level + 140 * (k in lit)))
        if kind == "dial":
            turn = _ring(0.7 * radius)[int(level) % 24]
            side = 0.04 * radius * np.array([-turn[1], turn[0]]) / np.linalg.norm(turn)
            _fill(canvas, H, place + np.array([side, turn, -side]), 255.0 - level)
    return np.asarray(cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))


def _lamps(
    scene: NDArray[np.float32], H: Array, lights: Array, lamp: tuple[float, float, float]
) -> NDArray[np.float32]:
    radius, rim_level, level = lamp
    canvas = np.asarray(cv2.resize(scene, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_NEAREST), np.float32)
    for place in lights:
        _fill(canvas, H, place + _ring(1.25 * radius), rim_level)
        _fill(canvas, H, place + _ring(radius), level)
    return np.asarray(cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))


def _fill(canvas: NDArray[np.float32], H: Array, outline_m: Array, level: float) -> None:
    pixels = np.round((_apply(H, outline_m) * 2.0 + 0.5) * 256.0).astype(np.int32)  # pixel centres of the doubled image
    cv2.fillPoly(canvas, [pixels.reshape(-1, 1, 2)], float(level), 8, 8)


def _ring(radius: float) -> Array:
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius


def _spot(rng: np.random.Generator) -> tuple[Array, float, float]:
    return rng.uniform([0, 0], [WIDTH, HEIGHT]), float(rng.uniform(15, 45)), float(rng.uniform(60, 200))


def _bump(place: Array, spread: float, strength: float) -> NDArray[np.float32]:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.asarray(strength * np.exp(-0.5 * ((u - place[0]) ** 2 + (v - place[1]) ** 2) / spread**2), np.float32)


def _cable(scene: NDArray[np.float32], ends: Array, width_px: float) -> NDArray[np.float32]:
    points = np.array([[ends[0], 0], [0.5 * (ends[0] + ends[1]), HEIGHT / 2], [ends[1], HEIGHT]]).astype(np.int32)
    out = scene.copy()
    cv2.polylines(out, [points.reshape(-1, 1, 2)], False, 20.0, int(width_px))
    return out


def _expose(level: NDArray[Any], noise: float, rng: np.random.Generator) -> Gray:
    shot = np.sqrt(noise**2 * (0.5 + level / 255.0))
    return np.asarray(np.clip(np.round(level + shot * rng.standard_normal(level.shape)), 0, 255), np.uint8)


def _visible(levels: list[NDArray[Any]], lights_px: Array, noise: float) -> NDArray[np.bool_]:
    """Return which lights are inside the image, not covered, and brighter when on even after the sensor saturates."""
    on = np.clip(levels[1], 0, 255)
    shown = []
    for u, v in np.round(lights_px).astype(int):
        if not (6 <= u < WIDTH - 6 and 6 <= v < HEIGHT - 6):
            shown.append(False)
            continue
        patch = on[v - 2 : v + 3, u - 2 : u + 3]
        around = np.clip(levels[0], 0, 255)[max(v - 9, 0) : v + 10, max(u - 9, 0) : u + 10]
        rise = float(patch.min() - np.median(around))
        even = float(patch.max() - patch.min())
        shown.append(rise > max(12.0, 4.0 * noise) and even < 0.35 * max(rise, 1.0) + 12.0)
    return np.array(shown)
