"""Draws a panel file as seen by a camera, in any state and with any disturbance, for tests with known truth.

Flat shapes at their heights are painted from the plate upwards at four times the resolution, without shading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.vision_disturbance import Disturbance, disturbed
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.panel import (
    Button,
    Display,
    Gauge,
    Handwheel,
    Lamp,
    Lever,
    Mushroom,
    Panel,
    PanelMeter,
    PanelObject,
    Rotary,
    Scale,
    Slider,
    Toggle,
)
from perception.vision.projection import PanelProjection

SUPERSAMPLING = 3
WALL, PLATE, INK, FACE, KNOB, WHITE, STEEL = 40, 150, 35, 240, 45, 240, 205
SEGMENTS = {
    "0": "abcdef",
    "1": "bc",
    "2": "abged",
    "3": "abgcd",
    "4": "fgbc",
    "5": "afgcd",
    "6": "afgedc",
    "7": "abc",
    "8": "abcdefg",
    "9": "abcdfg",
    "-": "g",
    " ": "",
}

Shown = float | str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Brush:
    """Paints shapes of the panel frame into an image by a projection."""

    image: NDArray[np.float32]
    view: PanelProjection

    def fill(self, points_m: ArrayLike, gray: float) -> None:
        """Fill a polygon of (N, 3) panel points."""
        px = (self.view.project(points_m) + 0.5) * SUPERSAMPLING - 0.5
        if np.isfinite(px).all():
            cv2.fillPoly(self.image, [np.round(px * 16).astype(np.int32)], gray, shift=4)

    def disc(self, x: float, y: float, z: float, radius_m: float, gray: float) -> None:
        """Fill a circle parallel to the plate."""
        a = np.linspace(0, 2 * np.pi, 60, endpoint=False)
        self.fill(np.column_stack([x + radius_m * np.sin(a), y + radius_m * np.cos(a), np.full(60, z)]), gray)

    def box(self, x: float, y: float, z: float, size: tuple[float, float], gray: float, turn_rad: float = 0.0) -> None:
        """Fill a rectangle parallel to the plate, rotated counter-clockwise."""
        w, h = size[0] / 2, size[1] / 2
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        corners = np.array([[-w, h], [w, h], [w, -h], [-w, -h]]) @ np.array([[c, s], [-s, c]])
        self.fill(np.column_stack([corners + np.array([x, y]), np.full(4, z)]), gray)

    def bar(self, start: ArrayLike, end: ArrayLike, width_m: float, gray: float) -> None:
        """Draw a straight bar between two (3,) points, with its width parallel to the plate."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        along = (b - a)[:2]
        n = np.array([-along[1], along[0], 0.0]) / max(float(np.linalg.norm(along)), 1e-9) * width_m / 2
        self.fill(np.array([a + n, b + n, b - n, a - n]), gray)


def draw_panel(
    panel: Panel,
    view: PanelProjection,
    shape: tuple[int, int],
    shown: Mapping[str, Shown],
    disturbance: Disturbance | None = None,
) -> NDArray[np.uint8]:
    """Return a gray image (H, W) of the panel in which every object shows `shown[name]`: a value, a state or a text."""
    height, width = shape
    image = np.full((height * SUPERSAMPLING, width * SUPERSAMPLING), WALL, np.float32)
    brush = Brush(image=image, view=view)
    brush.box(0, 0, 0, (panel.width_m, panel.height_m), PLATE)
    for light in panel.lights:
        brush.disc(*light.position_m, light.radius_m, 110)
    for panel_object in panel.objects:
        _draw(brush, panel_object, shown[panel_object.name])
    small = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    return disturbed(small, disturbance or Disturbance())


def _draw(brush: Brush, panel_object: PanelObject, shown: Shown) -> None:
    match panel_object:
        case Gauge():
            _gauge(brush, panel_object, float(shown))
        case PanelMeter():
            _meter(brush, panel_object, float(shown))
        case Display():
            _display(brush, panel_object, str(shown))
        case Lamp():
            x, y = panel_object.position_m
            brush.disc(x, y, 0.0, panel_object.radius_m + 0.0025, INK)
            brush.disc(x, y, panel_object.height_m, panel_object.radius_m, 75)
            if shown == "on":
                for share, gray in ((1.0, 200), (0.7, 235), (0.4, 255)):
                    brush.disc(x, y, panel_object.height_m, share * panel_object.radius_m, gray)
        case Button() | Mushroom():
            x, y = panel_object.position_m
            z = panel_object.height_m - (panel_object.pressed_depth_m if shown == "pressed" else 0.0)
            brush.disc(x, y, 0.0, panel_object.radius_m + 0.003, INK if isinstance(panel_object, Button) else 215)
            for k in range(8):
                brush.disc(x, y, z * k / 8, panel_object.radius_m, 90)
            brush.disc(x, y, z, panel_object.radius_m, 185 if isinstance(panel_object, Button) else 120)
        case _:
            _draw_moving(brush, panel_object, shown)


def _draw_moving(brush: Brush, panel_object: PanelObject, shown: Shown) -> None:
    x, y = panel_object.position_m
    match panel_object:
        case Toggle():
            tilt = panel_object.tilt_rad if shown == "on" else -panel_object.tilt_rad
            tip = (x, y + panel_object.bat_length_m * np.sin(tilt), 0.004 + panel_object.bat_length_m * np.cos(tilt))
            brush.box(x, y, 0.0, (0.026, 0.044), INK)
            brush.disc(x, y, 0.004, 1.8 * panel_object.bat_radius_m, 120)
            brush.bar((x, y, 0.004), tip, 1.4 * panel_object.bat_radius_m, STEEL)
            brush.disc(*tip, panel_object.bat_radius_m, WHITE)
        case Rotary():
            angle = next(s.angle_rad for s in panel_object.states if s.name == shown)
            r, h = panel_object.radius_m, panel_object.height_m
            brush.disc(x, y, 0.0, r, 30)
            brush.disc(x, y, h / 2, r, KNOB)
            brush.bar(_at(x, y, angle, -r, h), _at(x, y, angle, r, h), 0.45 * r, 60)
            brush.bar(_at(x, y, angle, 0.22 * r, h), _at(x, y, angle, 0.97 * r, h), 0.12 * r, WHITE)
        case Slider():
            _slider(brush, panel_object, float(shown))
        case Lever():
            angle = next(s.angle_rad for s in panel_object.states if s.name == shown)
            h = panel_object.height_m
            for z in np.linspace(h - 0.016, h, 4):
                brush.bar((x, y, z), _at(x, y, angle, panel_object.length_m, z), panel_object.width_m, 70)
            brush.bar((x, y, h), _at(x, y, angle, panel_object.length_m, h), panel_object.width_m, 85)
            brush.disc(x, y, h, 0.75 * panel_object.width_m, 80)
        case Handwheel():
            _handwheel(brush, panel_object, float(shown))


def _at(x: float, y: float, angle_rad: float, r: float, z: float) -> tuple[float, float, float]:
    return (x + r * float(np.sin(angle_rad)), y + r * float(np.cos(angle_rad)), z)


def _gauge(brush: Brush, panel_object: Gauge, value: float) -> None:
    (x, y), r = panel_object.position_m, panel_object.radius_m
    brush.disc(x, y, 0.001, r, INK)
    brush.disc(x, y, 0.001, 0.91 * r, FACE)
    _ticks(brush, panel_object.scale, (x, y), 0.86 * r, 0.0008)
    angle, z = panel_object.scale.place_of(value), panel_object.depth_m
    brush.bar(_at(x, y, angle, -0.22 * r, z), _at(x, y, angle, 0.76 * r, z), 0.055 * r, INK)
    brush.disc(x, y, z, 0.1 * r, INK)


def _meter(brush: Brush, panel_object: PanelMeter, value: float) -> None:
    (x, y), n = panel_object.position_m, panel_object.needle_m
    brush.box(x, y, 0.001, (panel_object.width_m, panel_object.height_m), INK)
    brush.box(x, y, 0.001, (panel_object.width_m - 0.006, panel_object.height_m - 0.006), FACE)
    pivot = (x, y - panel_object.pivot_below_m)
    _ticks(brush, panel_object.scale, pivot, 1.02 * n, 0.0006)
    angle, z = panel_object.scale.place_of(value), panel_object.depth_m
    brush.bar(_at(*pivot, angle, -0.12 * n, z), _at(*pivot, angle, n, z), 0.0016, INK)


def _ticks(brush: Brush, scale: Scale, centre: tuple[float, float], outer_m: float, width_m: float) -> None:
    for value in np.linspace(scale.minimum, scale.maximum, scale.major_ticks):
        angle = scale.place_of(float(value))
        brush.bar(_at(*centre, angle, 0.84 * outer_m, 0.001), _at(*centre, angle, outer_m, 0.001), width_m, INK)


def _display(brush: Brush, panel_object: Display, text: str) -> None:
    x, y = panel_object.position_m
    back, ink = (18, 200) if panel_object.style == "led" else (150, 30)
    brush.box(x, y, 0.001, (panel_object.width_m, panel_object.height_m), INK)
    brush.box(x, y, 0.001, (panel_object.width_m - 0.004, panel_object.height_m - 0.004), back)
    pitch = (panel_object.width_m - 0.008) / panel_object.digits
    high = min(0.68 * panel_object.height_m, 1.7 * pitch)
    column = panel_object.digits - 1 - sum(c != "." for c in text)
    for character in text:
        middle = (column - (panel_object.digits - 1) / 2) * pitch
        if character == ".":
            brush.disc(x + middle + pitch / 2, y - high / 2, 0.001, 0.07 * high, ink)
            continue
        column += 1
        middle += pitch
        for segment in SEGMENTS[character]:
            _segment(brush, (x + middle, y), segment, high, ink)


def _segment(brush: Brush, middle: tuple[float, float], segment: str, high: float, ink: float) -> None:
    w, h, gap = 0.195 * high, 0.435 * high, 0.05 * high
    ends = {
        "a": (-w, h, w, h),
        "g": (-w, 0, w, 0),
        "d": (-w, -h, w, -h),
        "f": (-w, h, -w, 0),
        "b": (w, h, w, 0),
        "e": (-w, 0, -w, -h),
        "c": (w, 0, w, -h),
    }[segment]
    a, b = np.array(ends[:2]), np.array(ends[2:])
    along = (b - a) / np.linalg.norm(b - a)
    a, b = a + gap * along, b - gap * along
    lean = np.tan(np.deg2rad(6.0))
    points = [np.array([middle[0] + p[0] + lean * p[1], middle[1] + p[1], 0.001]) for p in (a, b)]
    brush.bar(points[0], points[1], 0.12 * high, ink)


def _slider(brush: Brush, panel_object: Slider, value: float) -> None:
    x, y = panel_object.position_m
    turn = panel_object.angle_rad
    along = np.array([np.cos(turn), np.sin(turn)])
    sx, sy, sz = panel_object.cap_size_m
    brush.box(x, y, 0.0, (panel_object.travel_m + sx, 0.004), INK, turn)
    px, py = np.array([x, y]) + panel_object.scale.place_of(value) * along
    for z in np.linspace(0, sz, 5):
        brush.box(px, py, float(z), (sx, sy), 35, turn)
    brush.box(px, py, sz, (sx, sy), KNOB, turn)
    brush.box(px, py, sz, (0.0016, sy), WHITE, turn)


def _handwheel(brush: Brush, panel_object: Handwheel, angle_rad: float) -> None:
    (x, y), r, z = panel_object.position_m, panel_object.radius_m, panel_object.height_m - panel_object.rim_m
    a = np.linspace(0, 2 * np.pi, 61)
    for a0, a1 in pairwise(a):
        brush.bar(_at(x, y, float(a0), r, z), _at(x, y, float(a1), r, z), 2 * panel_object.rim_m, 75)
    for k in range(panel_object.spokes):
        gray, half = (WHITE, 0.0036) if k == 0 else (75, 0.003)
        spoke = angle_rad + 2 * np.pi * k / panel_object.spokes
        brush.bar((x, y, z), _at(x, y, spoke, r, z), 2 * half, gray)
    brush.disc(x, y, z, 0.009, 80)


def looking_at(
    *,
    distance_m: float,
    tilt_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    target_m: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """Return (4, 4) camera_from_panel of a camera `distance_m` from `target_m`, tilted from the plate's normal."""
    axis = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    turn = cv2.Rodrigues(axis * tilt_rad)[0]
    frontal = np.diag([1.0, -1.0, -1.0])  # camera y is down and z goes into the plate
    R = turn @ frontal
    out = np.eye(4)
    out[:3, :3] = R
    out[:3, 3] = np.array([0, 0, distance_m]) - R @ np.array([*target_m, 0.0])
    return out


def camera(width_px: int = 640, height_px: int = 480, focal_px: float = 640.0) -> CameraIntrinsics:
    """Return the intrinsics of a wrist camera without distortion."""
    return CameraIntrinsics(
        width_px=width_px,
        height_px=height_px,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=(width_px - 1) / 2,
        cy_px=(height_px - 1) / 2,
    )
