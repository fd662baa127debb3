"""Paints the ten kinds of objects on a canvas in panel millimetres, in the style that the README of the data describes.

Nothing is copied from the development images; they have only the kinds, their proportions and the layout grid in
common. Gray levels are gamma-encoded; light, glare and exposure are applied to linear values (see `panel_scene`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.display_face import Face, face_ink, write

WINDOW_FRAME_MM = 3.0  # both sides of the frame around the window of a display
PX_PER_MM = 4.0
DARK, WHITE = 32.0, 232.0
SCALES = (("bar", 0, 4), ("bar", 0, 10), ("bar", -1, 5), ("MPa", 0, 16), ("%", 0, 100), ("psi", 0, 250))
METERS = (("V", 0, 5), ("V", 0, 300), ("A", 0, 50), ("mA", -10, 10))
SPAN_DEG = {2: 90.0, 3: 120.0, 4: 150.0, 5: 180.0}

Truth = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Canvas:
    """Canvas of (H, W) gray levels in panel millimetres, x right and y down; `plate` is the gray level of the plate."""

    gray: NDArray[np.float32]
    plate: float = 0.0

    def polygon(self, points_mm: Any, gray: float) -> None:
        """Fill a polygon of (N, 2) points."""
        px = np.round(np.asarray(points_mm, float) * PX_PER_MM * 16).astype(np.int32)
        cv2.fillPoly(self.gray, [px], gray, cv2.LINE_AA, 4)

    def disc(self, x: float, y: float, radius_mm: float, gray: float) -> None:
        """Fill a circle."""
        a = np.linspace(0, 2 * np.pi, 72, endpoint=False)
        self.polygon(np.column_stack([x + radius_mm * np.cos(a), y + radius_mm * np.sin(a)]), gray)

    def box(self, x: float, y: float, width_mm: float, height_mm: float, gray: float) -> None:
        """Fill an upright rectangle, given by its centre."""
        w, h = width_mm / 2, height_mm / 2
        self.polygon([[x - w, y - h], [x + w, y - h], [x + w, y + h], [x - w, y + h]], gray)

    def ray(
        self, x: float, y: float, angle_deg: float, span: tuple[float, float], width: tuple[float, float], gray: float
    ) -> None:  # fmt: skip
        """Draw a tapered stroke on a ray from (x, y), at an angle clockwise from up, between two distances, in mm."""
        a = np.deg2rad(angle_deg)
        along, across = np.array([np.sin(a), -np.cos(a)]), np.array([np.cos(a), np.sin(a)])
        p, q = (np.array([x, y]) + r * along for r in span)
        u, v = (w / 2 * across for w in width)
        self.polygon([p - u, q - v, q + v, p + u], gray)

    def text(self, x: float, y: float, words: str, height_mm: float, gray: float) -> None:
        """Write text, given by its centre."""
        scale, thick = height_mm * PX_PER_MM / 22.0, max(1, round(0.15 * height_mm * PX_PER_MM))
        (w, h), _ = cv2.getTextSize(words, 0, scale, thick)
        at = (round(x * PX_PER_MM - w / 2), round(y * PX_PER_MM + h / 2))
        write(self.gray, words, at, scale, gray, thick)


def paint(canvas: Canvas, random: np.random.Generator, kind: str, x: float, y: float) -> Truth:
    """Paint an object of a kind at (x, y) mm and return its entry of the truth file."""
    painters = {
        "gauge": _gauge, "panel_meter": _meter, "display": _display, "toggle": _toggle, "rotary": _rotary, "button": _button,
        "lamp": _lamp, "slider": _slider, "handwheel": _handwheel, "lever": _lever,
    }  # fmt: skip
    said = painters[kind](canvas, random, x, y)
    low = y + said["size"][1] / 2 + (3.0 if kind != "gauge" else 5.0)
    canvas.text(x, low, str(random.choice(["MAIN", "PUMP", "FLOW", "TEMP", "LEVEL", "VENT"])), 3.6, DARK)
    return {"cls": kind, "center_mm": [x, y], **said}


def _ticks(canvas: Canvas, at: tuple[float, float], ends_deg: tuple[float, float], reach: tuple[float, float], gray: float,
           numbers: tuple[float, float], numeral_r: float, parts: int) -> None:  # fmt: skip
    outer, inner = reach
    for k in range(5 * parts + 1):
        a = ends_deg[0] + (ends_deg[1] - ends_deg[0]) * k / (5 * parts)
        major = k % 5 == 0
        canvas.ray(*at, a, (inner if major else 0.5 * (outer + inner), outer), (0.9 if major else 0.6,) * 2, gray)
        if major:
            value = numbers[0] + (numbers[1] - numbers[0]) * k / (5 * parts)
            r = np.deg2rad(a)
            canvas.text(at[0] + numeral_r * np.sin(r), at[1] - numeral_r * np.cos(r), f"{value:g}", 3.2, gray)


def _gauge(canvas: Canvas, random: np.random.Generator, x: float, y: float) -> Truth:
    w = float(random.uniform(58, 80))
    unit, low, high = SCALES[int(random.integers(len(SCALES)))]
    end = float(random.choice([120.0, 135.0]))
    value = float(random.uniform(low + 0.02 * (high - low), high - 0.02 * (high - low)))
    angle = -end + 2 * end * (value - low) / (high - low)
    is_white = bool(random.random() < 0.7)
    face, ink = (WHITE, DARK) if is_white else (DARK, 225.0)
    canvas.disc(x + 1.0, y + 1.2, 0.5 * w, 55.0)
    canvas.disc(x, y, 0.5 * w, 75.0)
    canvas.disc(x, y, 0.46 * w, face)
    parts = 4 if high == 4 else 8 if high == 16 else 6 if low else 5
    _ticks(canvas, (x, y), (-end, end), (0.42 * w, 0.355 * w), ink, (low, high), 0.28 * w, parts)
    canvas.text(x, y + 0.23 * w, unit, 3.4, ink)
    pointer = ink if random.random() < 0.75 else 85.0
    canvas.ray(x, y, angle, (-0.1 * w, 0.36 * w), (0.06 * w, 0.012 * w), pointer)
    canvas.disc(x, y, 0.05 * w, 75.0 if is_white else 110.0)
    return {
        "size": [w, w],
        "reading": value,
        "min": low,
        "max": high,
        "unit": unit,
        "angle_min": -end,
        "angle_max": end,
    }


def _meter(canvas: Canvas, random: np.random.Generator, x: float, y: float) -> Truth:
    w, h = float(random.uniform(64, 80)), float(random.uniform(54, 62))
    unit, low, high = METERS[int(random.integers(len(METERS)))]
    value = float(random.uniform(low, high))
    angle = -45.0 + 90.0 * (value - low) / (high - low)
    canvas.box(x + 1.2, y + 1.2, w, h, 50.0)
    canvas.box(x, y, w, h, DARK)
    canvas.box(x, y - 0.093 * h, w - 5.0, 0.686 * h, WHITE)
    pivot = (x, y + 0.253 * h)  # the screw below it has no function
    _ticks(canvas, pivot, (-45.0, 45.0), (0.6 * h, 0.54 * h), DARK, (low, high), 0.67 * h, 5 if unit != "mA" else 4)
    canvas.text(x, y - 0.06 * h, unit, 4.0, DARK)
    canvas.ray(*pivot, angle, (0.0, 0.555 * h), (0.8, 0.6), DARK)
    canvas.disc(x, y + 0.337 * h, 2.2, 75.0)
    return {
        "size": [w, h],
        "reading": value,
        "min": low,
        "max": high,
        "unit": unit,
        "angle_min": -45.0,
        "angle_max": 45.0,
    }


def _display(canvas: Canvas, random: np.random.Generator, x: float, y: float) -> Truth:
    digits = int(random.integers(3, 6))
    decimals = int(random.integers(0, digits))
    is_negative = bool(random.random() < 0.2) and decimals < digits - 1
    whole = digits - is_negative
    number = int(random.integers(10 ** (whole - 1), 10**whole))
    text = f"{number}" if not decimals else f"{number / 10**decimals:.{decimals}f}"
    text = "-" + text if is_negative else text
    h = float(random.uniform(33, 39))
    w = (0.36 * digits + 0.43) * h
    style = str(random.choice(["lcd", "led_red", "led_green"], p=[0.4, 0.3, 0.3]))
    face = Face(
        text=text, digits=digits, decimals=decimals, is_dark=style == "lcd", cell=0.52, pitch=1.25, stroke=0.12,
        slant=float(np.tan(np.deg2rad(6.0))), gap=0.035, shape="hexagon", ghost=0.1, dot=0.07, room=(0.4, 0.38),
    )  # fmt: skip
    ink, ghosts = face_ink(face)
    back, lit = {"lcd": (150.0, 38.0), "led_red": (22.0, 165.0), "led_green": (22.0, 205.0)}[style]
    window = back + (lit - back) * np.maximum(ink, 0.1 * ghosts)
    canvas.box(x, y, w, h, 50.0)
    size = (round((w - WINDOW_FRAME_MM) * PX_PER_MM), round((h - WINDOW_FRAME_MM) * PX_PER_MM))
    small = cv2.resize(window, size, interpolation=cv2.INTER_AREA)
    u, v = round(x * PX_PER_MM - size[0] / 2), round(y * PX_PER_MM - size[1] / 2)
    canvas.gray[v : v + size[1], u : u + size[0]] = small
    truth = {"size": [w, h], "text": text, "reading": float(text), "style": style, "min": 0, "max": 10.0**whole}
    return {**truth, "face": face}


def _toggle(canvas: Canvas, random: np.random.Generator, x: float, y: float) -> Truth:
    is_on = bool(random.random() < 0.5)
    canvas.box(x, y, 30.0, 46.0, float(np.clip(canvas.plate + random.uniform(-25, 50), 60, 215)))
    canvas.text(x, y - 19.0, "ON", 3.6, DARK)
    canvas.text(x, y + 19.0, "OFF", 3.6, DARK)
    canvas.disc(x, y, 7.5, 70.0)
    canvas.disc(x, y, 6.0, 125.0)
    angle, bat = (0.0, float(random.uniform(190, 228))) if is_on else (180.0, float(random.uniform(190, 228)))
    canvas.ray(x + 1.2, y + 1.2, angle, (0.0, 13.5), (4.6, 5.4), 60.0)
    canvas.ray(x, y, angle, (0.0, 12.5), (4.6, 5.4), bat)
    canvas.disc(x, y + (-12.5 if is_on else 12.5), 3.4, bat + 12.0)
    return {"size": [30.0, 46.0], "state": "on" if is_on else "off"}


def _rotary(canvas: Canvas, random: np.random.Generator, x: float, y: float) -> Truth:
    w, n = float(random.uniform(48, 58)), int(random.integers(2, 6))
    state, span = int(random.integers(n)), SPAN_DEG[n]
    knob = float(random.uniform(38, 65))
    for k in range(n):
        a = -span / 2 + span * k / (n - 1)
        canvas.ray(x, y, a, (0.33 * w, 0.37 * w), (0.9, 0.9), DARK)
        r = np.deg2rad(a)
        canvas.text(x + 0.43 * w * float(np.sin(r)), y - 0.43 * w * float(np.cos(r)), str(k), 3.4, DARK)
    angle = -span / 2 + span * state / (n - 1) + float(random.normal(0, 1.5))
    canvas.disc(x + 0.8, y + 0.8, 0.31 * w, 30.0)
    canvas.disc(x, y, 0.31 * w, knob)
    canvas.ray(x, y, angle, (-0.29 * w, 0.29 * w), (0.17 * w, 0.17 * w), knob + 22.0)
    canvas.ray(x, y, angle, (0.08 * w, 0.28 * w), (1.6, 1.6), 240.0)
    return {"size": [w, w], "state": str(state), "positions": n}


def _button(canvas: Canvas, random: np.random.Generator, x: float, y: float) -> Truth:
    w, is_pressed = float(random.uniform(27, 34)), bool(random.random() < 0.5)
    cap = float(random.choice([38.0, 98.0, 172.0, 215.0]))
    canvas.disc(x, y, 0.5 * w, 167.0)
    if is_pressed:
        canvas.disc(x, y, 0.425 * w, 30.0)
        canvas.disc(x, y, 0.375 * w, 0.8 * cap)
    else:
        canvas.disc(x, y, 0.425 * w, 46.0)
        canvas.disc(x + 0.05 * w, y + 0.06 * w, 0.41 * w, 44.0)
        canvas.disc(x, y, 0.385 * w, cap)
        canvas.disc(x - 0.1 * w, y - 0.11 * w, 0.13 * w, min(cap + 60.0, 245.0))
    return {"size": [w, w], "state": "pressed" if is_pressed else "released"}


def _lamp(canvas: Canvas, random: np.random.Generator, x: float, y: float) -> Truth:
    w, is_on = float(random.uniform(18, 23)), bool(random.random() < 0.5)
    canvas.disc(x, y, 0.5 * w, float(np.clip(canvas.plate + random.uniform(-15, 35), 0, 200)))
    canvas.disc(x, y, 0.41 * w, 52.0)
    lens = float(random.choice([90.0, 150.0, 190.0]))
    if is_on:
        for share, gray in ((0.37, lens), (0.24, 0.5 * (lens + 255.0)), (0.12, 255.0)):
            canvas.disc(x, y, share * w, gray)
    else:
        canvas.disc(x, y, 0.37 * w, 0.4 * lens)
        canvas.disc(x - 0.1 * w, y - 0.1 * w, 0.07 * w, 130.0)
    return {"size": [w, w], "state": "on" if is_on else "off", "colour": str(random.choice(["red", "green", "amber"]))}


def _slider(canvas: Canvas, random: np.random.Generator, x: float, y: float) -> Truth:
    long, is_flat = float(random.uniform(64, 78)), bool(random.random() < 0.5)
    travel, value = long - 16.0, float(random.uniform(2, 98))
    at = travel * (value / 100.0 - 0.5)
    light = float(np.clip(canvas.plate + random.uniform(-10, 60), 60, 220))

    def put(along: float, across: float, a_mm: float, c_mm: float, gray: float) -> None:
        u, v = (along, across) if is_flat else (across, -along)
        canvas.box(x + u, y + v, *((a_mm, c_mm) if is_flat else (c_mm, a_mm)), gray)

    put(0.0, 0.0, long, 26.0, light)
    for k in range(11):
        put(travel * (k / 10 - 0.5), 9.0, 0.8, 3.6 if k % 5 else 5.0, DARK)
    put(0.0, 0.0, travel + 4.0, 3.2, 25.0)
    put(at - 1.0 if not is_flat else at + 1.0, 1.0, 0.13 * long, 19.5, 35.0)
    put(at, 0.0, 0.13 * long, 19.5, 55.0)
    put(at, 0.0, 1.2, 17.0, 225.0)
    size = [long, 26.0] if is_flat else [26.0, long]
    return {"size": size, "reading": value, "min": 0, "max": 100, "unit": "%", "horizontal": is_flat}


def _handwheel(canvas: Canvas, random: np.random.Generator, x: float, y: float) -> Truth:
    w, spokes, angle = float(random.uniform(60, 76)), int(random.integers(3, 6)), float(random.uniform(0, 360))
    gray = float(random.uniform(65, 95))
    inside = canvas.gray.copy()
    canvas.disc(x, y, 0.5 * w, gray)
    hole = np.zeros_like(canvas.gray)
    Canvas(gray=hole).disc(x, y, 0.406 * w, 1.0)
    canvas.gray[:] = canvas.gray * (1 - hole) + inside * hole
    for k in range(spokes):
        canvas.ray(x, y, angle + 360.0 * k / spokes, (0.0, 0.43 * w), (0.09 * w, 0.09 * w), gray)
    canvas.disc(x, y, 0.1 * w, gray)
    canvas.disc(x, y, 0.045 * w, 160.0)
    a = np.deg2rad(angle)
    canvas.disc(x + 0.453 * w * float(np.sin(a)), y - 0.453 * w * float(np.cos(a)), 0.04 * w, 240.0)
    return {"size": [w, w], "reading": angle, "min": 0, "max": 360, "unit": "deg", "spokes": spokes, "circular": True}


def _lever(canvas: Canvas, random: np.random.Generator, x: float, y: float) -> Truth:
    is_flat, is_open = bool(random.random() < 0.5), bool(random.random() < 0.5)
    handle, along = float(random.choice([76.0, 182.0], p=[0.75, 0.25])), float(random.choice([0.0, 180.0]))
    pipe = 90.0 if is_flat else 0.0
    canvas.ray(x, y, pipe, (-39.0, 39.0), (14.0, 14.0), 118.0)
    for r in (-20.0, 20.0):
        canvas.ray(x, y, pipe, (r - 4.0, r + 4.0), (20.0, 20.0), 99.0)
    angle = pipe + along + (0.0 if is_open else 90.0) + float(random.uniform(-4, 4))
    canvas.ray(x + 1.3, y + 1.3, angle, (4.0, 33.0), (8.2, 8.2), 70.0)
    canvas.ray(x, y, angle, (4.0, 32.0), (8.2, 8.2), handle)
    canvas.disc(x, y, 6.5, 148.0)
    canvas.disc(x, y, 3.2, 75.0)
    return {"size": [78.0, 78.0], "state": "open" if is_open else "closed", "pipe_horizontal": is_flat}
