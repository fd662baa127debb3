"""Draws photographs of single dials of many designs with known readings: faces, pointers, sizes, glare, JPEG.

They test the reader where no photographs with known values exist; the reader was not tuned on them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.arrays import Array, Image
from perception.vision.photographs.dial import read_dial

CANVAS_PX = 800
SMALLEST_PX, LARGEST_PX = 40.0, 300.0
FACES = ((235, 235, 230), (200, 215, 190), (150, 200, 160), (225, 215, 180), (30, 30, 35))
COLOURS = ((185, 40, 40), (40, 60, 170), (220, 110, 30))
SHAPES = ("drop", "needle", "tailed", "arrow", "line")
SPAN_RAD = np.deg2rad(270.0)

Colour = tuple[int, int, int]
Rng = np.random.Generator


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnDial:
    """Image (H, W, 3) uint8 of a dial from 0 to 10, its reading, and whether its scale is a full turn from the top.

    `red` is the reading of a second, red pointer, or None if there is none; `full` is the largest value of a gauge's numerals.
    """

    image: Image
    reading: float
    circular: bool
    shape: str
    red: float | None = None
    full: float = 10.0


def draw_dial(seed: int, *, falls: bool = False, circular: bool | None = None, numeral: float = 0.0022) -> DrawnDial:
    """Draw a dial of random design, the same for the same seed.

    Args:
        falls: whether the numerals run counter-clockwise.
        circular: whether the scale is a full turn; None: by the seed.
        numeral: size of the numerals, as OpenCV's font scale over the radius in px; 0.007 is usual on water meters.
    """
    rng = np.random.default_rng(seed)
    by_seed, share = bool(rng.random() < 0.5), float(rng.uniform(0.02, 0.98))
    circular = by_seed if circular is None else circular
    face = FACES[int(rng.integers(len(FACES)))]
    ink = (230, 230, 230) if sum(face) < 200 else (35, 35, 40)
    pen = Pen.on(rng, face)
    way = -1.0 if falls else 1.0
    _scale(pen, rng, ink, circular, way, numeral)
    angle = way * (share * 2 * np.pi if circular else (share - 0.5) * SPAN_RAD)
    colour = ink if rng.random() < 0.35 else COLOURS[int(rng.integers(len(COLOURS)))]
    shape = str(rng.choice(SHAPES))
    _pointer(pen, rng, angle, shape, colour, ink)
    return DrawnDial(image=_photographed(pen.canvas, rng), reading=10 * share, circular=circular, shape=shape)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pen:
    """Draws in units of a dial's radius from its centre; coordinates are (up, right), along and across a direction."""

    canvas: NDArray[np.uint8]
    middle: Array
    radius: float

    @staticmethod
    def on(rng: Rng, face: Colour) -> Pen:
        ground = tuple(int(c) for c in rng.integers(20, 220, 3)) if rng.random() < 0.5 else face
        canvas = np.full((CANVAS_PX, CANVAS_PX, 3), ground, np.uint8)
        middle = CANVAS_PX / 2 + rng.normal(0.0, 0.01 * CANVAS_PX, 2)
        pen = Pen(canvas=canvas, middle=middle, radius=float(rng.uniform(0.40, 0.49)) * CANVAS_PX)
        pen.disc(0.0, (0.0, 0.0), 1.0, face)
        rim = tuple(int(c) for c in rng.integers(0, 255, 3)) if rng.random() < 0.5 else (35, 35, 40)
        cv2.circle(
            canvas, pen.place(0.0, (0.0, 0.0)), round(pen.radius * 16), rim, int(rng.integers(4, 30)), cv2.LINE_AA, 4
        )
        return pen

    def place(self, angle_rad: float, at: ArrayLike) -> tuple[int, int]:
        """Return the canvas pixels, times 16, of (up, right) for a direction."""
        up, right = np.asarray(at, float) * self.radius
        s, c = np.sin(angle_rad), np.cos(angle_rad)
        x, y = self.middle + np.array([up * s + right * c, -up * c + right * s])
        return round(float(x) * 16), round(float(y) * 16)

    def disc(self, angle_rad: float, at: ArrayLike, radius: float, colour: Colour) -> None:
        cv2.circle(self.canvas, self.place(angle_rad, at), round(radius * self.radius * 16), colour, -1, cv2.LINE_AA, 4)

    def fill(self, angle_rad: float, corners: list[tuple[float, float]], colour: Colour) -> None:
        cv2.fillPoly(self.canvas, [np.array([self.place(angle_rad, c) for c in corners])], colour, cv2.LINE_AA, 4)


def _scale(pen: Pen, rng: Rng, ink: Colour, circular: bool, way: float, numeral: float) -> None:
    numerals, size = float(rng.uniform(0.62, 0.70)), numeral * pen.radius
    thick = max(6, round(2.5 * size))
    for k in range(10 if circular else 11):
        angle = way * (k / 10 * 2 * np.pi if circular else (k / 10 - 0.5) * SPAN_RAD)
        pen.fill(angle, [(0.80, -0.012), (0.80, 0.012), (0.93, 0.012), (0.93, -0.012)], ink)
        x, y = pen.place(angle, (numerals, 0.0))
        (w, h), _ = cv2.getTextSize(str(k), cv2.FONT_HERSHEY_SIMPLEX, size, thick)
        at = (x // 16 - w // 2, y // 16 + h // 2)
        cv2.putText(pen.canvas, str(k), at, cv2.FONT_HERSHEY_SIMPLEX, size, ink, thick, cv2.LINE_AA)


def _pointer(pen: Pen, rng: Rng, angle: float, shape: str, colour: Colour, ink: Colour) -> None:
    reach, tail = float(rng.uniform(0.72, 0.92)), float(rng.uniform(0.15, 0.4))
    w = float(rng.uniform(0.02, 0.045))
    match shape:
        case "drop":
            hub = float(rng.uniform(0.28, 0.38))
            pen.fill(angle, [(reach, 0), (0.3 * hub, 0.97 * hub), (0.3 * hub, -0.97 * hub)], colour)
            pen.disc(angle, (0, 0), hub, colour)
        case "needle":
            pen.fill(angle, [(reach, 0), (0, 1.3 * w), (0, -1.3 * w)], colour)
            pen.disc(angle, (0, 0), 0.09, colour)
        case "tailed":
            pen.fill(angle, [(reach, 0.3 * w), (-tail, 1.6 * w), (-tail, -1.6 * w), (reach, -0.3 * w)], colour)
            pen.disc(angle, (0, 0), 0.08, ink)
        case "arrow":
            pen.fill(angle, [(0.8 * reach, w), (-tail, w), (-tail, -w), (0.8 * reach, -w)], colour)
            pen.fill(angle, [(reach, 0), (0.76 * reach, 0.07), (0.76 * reach, -0.07)], colour)
            pen.disc(angle, (-tail, 0), 0.07, colour)
            pen.disc(angle, (0, 0), 0.06, ink)
        case _:
            pen.fill(angle, [(reach, 0.6 * w), (-tail, 0.6 * w), (-tail, -0.6 * w), (reach, -0.6 * w)], colour)
            pen.disc(angle, (0, 0), 0.07, ink)


def _photographed(canvas: NDArray[np.uint8], rng: Rng) -> Image:
    """Return the canvas seen slightly at an angle, at its final size, after light, lens, noise and JPEG."""
    azimuth = float(rng.uniform(0, 2 * np.pi))
    aslant = seen_aslant(canvas, azimuth, float(rng.uniform(0, 0.06)))
    side = round(np.exp(rng.uniform(np.log(SMALLEST_PX), np.log(LARGEST_PX))))
    picture = np.asarray(cv2.resize(aslant, (side, side), interpolation=cv2.INTER_AREA), np.float32)
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.3, 0.4 + 0.008 * side))), np.float32)
    y, x = np.mgrid[:side, :side] / side
    light = (1 + rng.uniform(-0.3, 0.3) * (x - 0.5) + rng.uniform(-0.3, 0.3) * (y - 0.5)) * rng.uniform(0.4, 1.05)
    light = light[..., None] * (np.array([0.75, 1.0, 0.8]) if rng.random() < 0.3 else np.ones(3))
    lit = picture * light
    if rng.random() < 0.3:
        gx, gy, spread = rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.9), rng.uniform(0.03, 0.08)
        lit += 260.0 * np.exp(-((x - gx) ** 2 + (y - gy) ** 2) / (2 * spread**2))[..., None]
    noisy = lit + rng.normal(0.0, float(rng.uniform(0.5, 6.0)), lit.shape)
    out: Image = np.asarray(np.clip(noisy, 0, 255), np.uint8)
    if rng.random() < 0.5:
        coded = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(50, 95))])[1]
        out = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
    return out


def seen_aslant(canvas: Image, azimuth_rad: float, depth: float) -> Image:
    """Return the canvas in perspective: one side is smaller and the opposite side larger by the same amount."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * CANVAS_PX
    from_middle = corners - CANVAS_PX / 2
    away = from_middle @ np.array([np.cos(azimuth_rad), np.sin(azimuth_rad)]) * 2 / CANVAS_PX
    seen = CANVAS_PX / 2 + from_middle * (1 - depth * away[:, None])
    warp = cv2.getPerspectiveTransform(corners, seen.astype(np.float32))
    return np.asarray(cv2.warpPerspective(canvas, warp, canvas.shape[:2], borderMode=cv2.BORDER_REPLICATE), np.uint8)


def error_of(dial: DrawnDial) -> tuple[float | None, float]:
    """Return the reader's error in % of the scale (None if it refuses) and its confidence."""
    status = read_dial(dial.image, (0.0, 10.0), is_turn=dial.circular)
    if status.value is None:
        return None, status.confidence
    error = status.value - dial.reading
    return 10 * abs((error + 5) % 10 - 5 if dial.circular else error), status.confidence


@dataclass(frozen=True, slots=True, kw_only=True)
class DialResult:
    """Result of one drawn dial; see `error_of`."""

    shape: str
    error: float | None
    confidence: float


def read_drawn(seeds: range, draw: Callable[[int], DrawnDial] = draw_dial) -> list[DialResult]:
    """Read the dials of all seeds."""
    results = []
    for seed in seeds:
        dial = draw(seed)
        error, confidence = error_of(dial)
        results.append(DialResult(shape=dial.shape, error=error, confidence=confidence))
    return results


def summary(results: list[DialResult]) -> list[str]:
    """Return the fractions within 2 %, refused, and wrong by more than 5 %, in total and per shape of pointer."""
    lines = []
    for group in ("all", *dict.fromkeys(sorted(r.shape for r in results))):
        errors = [r.error for r in results if group in ("all", r.shape)]
        given = np.array([e for e in errors if e is not None])
        shares = (np.sum(given <= 2.0), len(errors) - len(given), np.sum(given > 5.0))
        lines.append(f"  {group:8s} {' / '.join(f'{n / max(1, len(errors)):.3f}' for n in shares)}")
    return lines


def right_wrong_sure(results: list[DialResult]) -> tuple[int, int, int]:
    """Return how many are within 2 %, how many are not, and how many of the latter have a confidence of 0.8 or more."""
    wrong = [r for r in results if r.error is not None and r.error > 2.0]
    right = sum(r.error is not None and r.error <= 2.0 for r in results)
    return right, len(wrong), sum(r.confidence >= 0.8 for r in wrong)
