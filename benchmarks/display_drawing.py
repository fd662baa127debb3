"""Draws synthetic images of seven-segment displays, for tests and for the benchmark.

A face (segment shapes, ghosts of unlit segments, bloom, window, bezel) is painted upright and large, projected into the
image by a homography, and then degraded by uneven light, glare, cables, lens, sensor and JPEG. Nothing is taken from
the development images.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.display_face import HIGH_PX, Face, face_gray, face_ink, random_face
from benchmarks.display_photo import Gray, disturbed, surroundings, taken
from hal.arrays import Array
from perception.vision.projection import homography

LEVELS = ("easy", "medium", "hard")
PHOTOGRAPHS = ("cropped", "scene", "low contrast")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DisplayCase:
    """Drawn display with its true text.

    Attributes:
        image: (H, W) uint8.
        text: the displayed text without leading blanks.
        corners_px: (4, 2) outer corners of the window (inside the bezel), clockwise from the upper left.
        size: width and height of the window, in units of the digit height.
        is_dark: dark segments on a bright ground (LCD).
        digits, decimals: number of digits, and of decimal places.
        hidden: fraction of the lit segments' area that cables cover.
    """

    image: Gray
    text: str
    corners_px: Array
    size: tuple[float, float]
    is_dark: bool
    digits: int
    decimals: int
    hidden: float


def draw_taught(seed: int, level: str) -> DisplayCase:
    """Draw a display on a plate as in images of a taught panel: strokes of 1.2 to 3 px, degraded by `level`."""
    random = np.random.default_rng((seed, LEVELS.index(level)))
    face = random_face(random, is_dark=bool(random.random() < 0.4), thin=True)
    hard = LEVELS.index(level)
    high = float(random.uniform(19, 34) if hard < 2 else random.uniform(17, 30))
    return _pictured(random, face, high, tilt=(0.03, 0.12, 0.28)[hard], hard=hard, span=(150, 250))


def draw_photograph(seed: int, kind: str) -> DisplayCase:
    """Draw a photograph of an LCD or LED device: cropped to its display, with the device, or of low contrast."""
    random = np.random.default_rng((seed, 7 + PHOTOGRAPHS.index(kind)))
    face = random_face(random, is_dark=bool(random.random() < 0.75), thin=False)
    high = float(np.exp(random.uniform(np.log(28), np.log(110))))
    if kind == "scene":
        return _pictured(random, face, min(high, 70.0), tilt=0.15, hard=1, span=(640, 480), photo=kind)
    return _pictured(random, face, high, tilt=0.08, hard=1, span=(0, 0), photo=kind)


def _pictured(
    random: np.random.Generator, face: Face, high: float, *, tilt: float, hard: int, span: tuple[int, int], photo: str = ""
) -> DisplayCase:  # fmt: skip
    """Draw the face in an image: digits `high` px tall, `span` rows of plate around it (0: cropped)."""
    k = 2  # drawn at twice the final resolution
    ink, ghosts = face_ink(face)
    shading = face_gray(random, face, ink, ghosts, low=photo == "low contrast")
    bezel = round((0.08 if not photo else random.uniform(0.03, 0.3)) * HIGH_PX)
    scale = k * high / HIGH_PX
    rows, columns = ink.shape
    framed = cv2.copyMakeBorder(
        shading, bezel, bezel, bezel, bezel, cv2.BORDER_CONSTANT,
        value=float(random.uniform(20, 70) if not photo or random.random() < 0.6 else random.uniform(90, 190)))  # fmt: skip
    crop = round(random.uniform(-0.3 * bezel, 1.2 * bezel)) if photo and photo != "scene" else 0
    height, width = (round(n * scale + 2 * (crop * scale if photo and photo != "scene" else 0.35 * high * k + 20))
                     for n in (rows, columns))  # fmt: skip
    if photo == "scene":
        width, height = (k * max(n, round(m / k * 1.15)) for n, m in zip(span, (width, height), strict=True))
    corners = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], float)
    target = (corners - corners.mean(axis=0)) * scale
    turned_rad = random.normal(0.0, np.deg2rad(2.5)) if photo else 0.0  # held by hand
    target = _tilted(random, target, tilt * (0.35 if photo else 1.0), turned_rad) + np.array([width / 2, height / 2])
    if photo == "scene":
        room = np.maximum(np.array([width, height]) / 2 - np.ptp(target, axis=0) / 2 - 20, 0)
        target = target + random.uniform(-0.9, 0.9, 2) * room
    matrix = homography(corners + bezel, target)
    picture = surroundings(random, (height, width), photo, target)
    cover = cv2.warpPerspective(np.ones_like(framed), matrix, (width, height), flags=cv2.INTER_AREA)
    face_px = cv2.warpPerspective(framed, matrix, (width, height), flags=cv2.INTER_AREA)
    picture = np.asarray(np.where(cover > 0.5, face_px, picture), np.float32)
    lit = np.asarray(
        cv2.warpPerspective(ink, homography(corners, target), (width, height), flags=cv2.INTER_AREA), np.float32
    )
    picture, hidden = disturbed(random, picture, lit, high * k, hard, photo, target)
    image = taken(random, picture, high, hard, photo)
    return DisplayCase(
        image=image, text=face.text, corners_px=target / k, is_dark=face.is_dark, digits=face.digits,
        size=(columns / HIGH_PX, rows / HIGH_PX), decimals=face.decimals, hidden=hidden,
    )  # fmt: skip


def _tilted(random: np.random.Generator, points: Array, tilt: float, turned_rad: float) -> Array:
    """Return points as seen at an angle: foreshortened, with perspective, and slightly rotated."""
    turn = turned_rad + random.normal(0.0, 0.35 * tilt)
    lean = random.uniform(0, 2 * np.pi)
    n = np.array([np.cos(lean), np.sin(lean)])
    reach = float(np.abs(points).max())
    depth = 1.0 + 0.5 * np.sin(tilt * 1.5) * (points @ n) / reach
    squeezed = points - (1 - np.cos(tilt * 1.5)) * np.outer(points @ n, n)
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray((squeezed / depth[:, None]) @ np.array([[c, s], [-s, c]]))
