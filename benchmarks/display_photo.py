"""Turns a drawn display into a photograph: surroundings, uneven light, glare, cables, lens, sensor and file."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.display_face import Float32, write
from hal.arrays import Array

Gray = NDArray[np.uint8]


def surroundings(random: np.random.Generator, shape: tuple[int, int], photo: str, target: Array) -> Float32:
    """Draw the plate or the device around the display: uniform gray, or a scene with a case, keys and words."""
    picture = np.full(shape, random.uniform(60, 200), np.float32)
    if photo != "scene":
        return picture
    middle, half = target.mean(axis=0), np.ptp(target, axis=0) / 2
    gray = float(random.uniform(30, 220))
    for sign, grow in ((-1, random.uniform(1.2, 1.8)), (1, random.uniform(1.2, 2.4))):
        low = np.round(middle - grow * half - 12).astype(int)
        high = np.round(middle + (grow, grow * random.uniform(1.0, 2.0)) * half + 12).astype(int)
        cv2.rectangle(picture, low.tolist(), high.tolist(), gray + sign * 12.0, -1)
        break
    for _ in range(int(random.integers(3, 12))):
        x, y = random.uniform(0, shape[1]), random.uniform(0, shape[0])
        word = "".join(random.choice(list("AMPVOLTSETMODE0123")) for _ in range(random.integers(2, 7)))
        write(picture, word, (int(x), int(y)), float(random.uniform(0.5, 1.6)), gray * 0.4 + 20.0, 2)
        x, y = random.uniform(0, shape[1]), random.uniform(0, shape[0])
        w, h = random.uniform(20, 120, 2)
        cv2.rectangle(picture, (int(x), int(y)), (int(x + w), int(y + h)), float(random.uniform(20, 230)), -1)
    return picture


def disturbed(
    random: np.random.Generator, picture: Float32, lit: Float32, high: float, hard: int, photo: str, target: Array
) -> tuple[Float32, float]:  # fmt: skip
    """Add uneven light, glare and cables; return the image and the fraction of the lit area that cables cover."""
    height, width = picture.shape
    v, u = np.mgrid[:height, :width].astype(np.float32)
    lean, ratio = random.uniform(0, 2 * np.pi), (1.2, 1.7, 2.4)[hard]
    along = (np.cos(lean) * (u - width / 2) + np.sin(lean) * (v - height / 2)) / (max(width, height) / 2)
    out = picture * np.exp(0.5 * np.log(random.uniform(1.0, ratio)) * along)
    middle, half = target.mean(axis=0), np.ptp(target, axis=0) / 2
    strength = (0.0, 70.0, 190.0)[hard] * (0.6 if photo else 1.0)
    if hard and random.random() < 0.7:
        x, y = middle + random.uniform(-1.3, 1.3, 2) * half
        r = random.uniform(0.5, 1.6) * high
        out = out + random.uniform(0.3, 1.0) * strength * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * r * r))
    if photo and random.random() < 0.3:  # reflection of a window in the glass, with straight, sharp edges
        x, y = middle + random.uniform(-1.0, 1.0, 2) * half
        side = random.uniform(0.4, 1.5, 2) * high
        quad = np.array([[x, y], [x + side[0], y + 3], [x + side[0] + 5, y + side[1]], [x + 4, y + side[1]]])
        mirror = np.zeros_like(out)
        cv2.fillPoly(mirror, [np.round(quad).astype(np.int32)], float(random.uniform(5, 25)), cv2.LINE_AA)
        out = out + cv2.GaussianBlur(mirror, (0, 0), 1.5)
    if hard < 2 or random.random() < 0.55:
        return np.asarray(out, np.float32), 0.0
    mask = np.zeros_like(out)
    x0, x1 = (float(random.uniform(-0.1, 1.1)) * width for _ in range(2))
    x1 = x0 + np.clip(x1 - x0, -0.5 * height, 0.5 * height)
    bend = (0.5 * (x0 + x1) + float(random.normal(0, 0.04 * height)), float(random.uniform(0.0, 1.0)) * height)
    thick = max(2, round(float(random.uniform(0.12, 0.38)) * high))
    line = np.array([[x0, -9], bend, [x1, height + 9]])
    cv2.polylines(mask, [np.round(line * 16).astype(np.int32)], False, 1.0, thick, cv2.LINE_AA, 4)
    gray = float(random.uniform(15, 120))
    out = out * (1 - mask) + gray * mask * (0.85 + 0.3 * cv2.GaussianBlur(mask, (0, 0), thick / 3))
    return np.asarray(out, np.float32), float((lit * mask).sum() / max(float(lit.sum()), 1e-6))


def taken(random: np.random.Generator, picture: Float32, high: float, hard: int, photo: str) -> Gray:
    """Return the image after exposure, lens, sensor and file compression."""
    exposure = random.uniform(*((0.9, 1.1), (0.7, 1.25), (0.4, 1.4))[hard])
    stroke = 0.11 * high
    blur = random.uniform(0.3, (0.3, 0.45, 0.5)[hard] * stroke + 0.35)
    small = cv2.resize(picture * exposure, (picture.shape[1] // 2, picture.shape[0] // 2), interpolation=cv2.INTER_AREA)
    if random.random() < 0.5:
        radius = max(1, round(1.6 * blur))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)).astype(np.float32)
        small = cv2.filter2D(small, -1, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)
    else:
        small = cv2.GaussianBlur(small, (0, 0), blur)
    noise = random.uniform(0.5, (1.5, 3.0, 6.0)[hard])
    small = small + random.normal(0.0, 1.0, small.shape) * noise * np.sqrt(0.3 + np.maximum(small, 0) / 180)
    image = np.asarray(np.clip(np.round(small), 0, 255), np.uint8)
    if not photo:
        return image
    quality = int(random.integers(55, 96))
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 0), np.uint8)
