"""Draws the panel as SVG from its file, each object with its newest value; and its outlines over a camera's picture."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.panel import Panel, PanelObject
from service.console.texts import say
from service.console.values import Reading, attribute, label_of, shown

PX_PER_M = 1600.0
LARGE_PX = 80.0  # so large that its words stand inside
COLOURS = {
    "red": "#d33a32",
    "green": "#2e9e62",
    "amber": "#d98a00",
    "blue": "#2f6fd0",
    "white": "#e8edf2",
    "black": "#2b2f33",
}
OUTLINE = "#ff9f1c"


def panel_svg(panel: Panel, readings: Mapping[str, Reading], alarms: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the drawing as an SVG element; each object is a button that carries its name in `data-object`."""
    width, height = panel.width_m * PX_PER_M, panel.height_m * PX_PER_M
    parts = [
        f'<svg viewBox="{-width / 2:.0f} {-height / 2:.0f} {width:.0f} {height:.0f}" role="group" '
        f'aria-label="{attribute(say("panel.drawing", name=panel.name))}" font-family="inherit">',
        f'<rect x="{-width / 2:.1f}" y="{-height / 2:.1f}" width="{width:.1f}" height="{height:.1f}" rx="12" fill="var(--plate)"/>',
    ]
    for light in panel.lights:
        x, y = _px(light.position_m)
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{light.radius_m * PX_PER_M:.1f}" fill="none" stroke="var(--quiet)"/>'
        )
    large_first = sorted(panel.objects, key=lambda one: -max(one.half_footprint_m))
    parts += [_object(one, readings.get(one.name), alarms.get(one.name)) for one in large_first]
    return "".join([*parts, "</svg>"])


def _object(one: PanelObject, reading: Reading | None, alarm: Mapping[str, Any] | None) -> str:
    x, y = _px(one.position_m)
    half_w, half_h = (size * PX_PER_M for size in one.half_footprint_m)
    label, value = label_of(one), shown(one, reading)
    seen = "–" if reading is None else value  # the list below says in words that nobody has read it
    mark = "var(--bad)" if alarm is not None and alarm["is_active"] and not is_off(alarm) else "var(--ink)"
    refused = reading is not None and reading["quality"] != "valid"
    words = "var(--warn)" if refused else mark
    row = f'data-row="{reading["utc_s"]:.1f}"' if reading is not None else ""
    text = '<text y="{y:.1f}" text-anchor="middle" {style}>{words}</text>'
    above, below = -half_h - 8, half_h + 22
    if min(half_w, half_h) > LARGE_PX:
        above, below = 0.3 * half_h, 0.55 * half_h
    elif hasattr(one, "digits"):
        below = 7.0  # a display shows its digits in its window
    name = text.format(y=above, style='font-size="15" fill="var(--quiet)"', words=attribute(label))
    style = f'class="value" font-size="21" font-weight="600" fill="{words}"'
    return (
        f'<g transform="translate({x:.1f} {y:.1f})" data-object="{one.name}" {row} role="button" tabindex="0" '
        f'aria-label="{attribute(say("open", label=label, value=value))}">'
        f"{_foot(one, half_w, half_h, mark)}{_limits(one, alarm, half_w, half_h)}"
        f"{_pointer(one, reading, half_w, half_h, mark)}{name}"
        f"{text.format(y=below, style=style, words=attribute(seen))}</g>"
    )


def is_off(alarm: Mapping[str, Any]) -> bool:
    """Return whether an alarm calls for nobody, whatever its condition."""
    return alarm["state"] in ("shelved", "out-of-service")


def _limits(one: PanelObject, alarm: Mapping[str, Any] | None, half_w: float, half_h: float) -> str:
    """Return a line across the scale at each limit; that of the alarm that calls is marked."""
    scale = getattr(one, "scale", None)
    if one.limits is None or scale is None:
        return ""
    parts = []
    for kind, limit in one.limits.given.items():
        calls = alarm is not None and alarm["kind"] == kind and alarm["is_active"] and not is_off(alarm)
        style = f'class="limit" stroke="var({"--bad" if calls else "--warn"})" stroke-width="{5 if calls else 3}"'
        place = float(scale.place_of(limit))
        if one.places_are_lengths:
            turn, along = float(getattr(one, "angle_rad", 0.0)), place * PX_PER_M
            x, y, across = along * math.cos(turn), -along * math.sin(turn), (math.sin(turn) * 12, math.cos(turn) * 12)
            ends = (x - across[0], y - across[1], x + across[0], y + across[1])
        else:
            x, y = math.sin(place), -math.cos(place)
            ends = (0.86 * half_w * x, 0.86 * half_h * y, half_w * x, half_h * y)
        parts.append(f'<path d="M{ends[0]:.1f} {ends[1]:.1f}L{ends[2]:.1f} {ends[3]:.1f}" {style}/>')
    return "".join(parts)


def _foot(one: PanelObject, half_w: float, half_h: float, mark: str) -> str:
    """Return the fixed outline of an object."""
    style = f'class="foot" fill="var(--card)" stroke="{mark}" stroke-width="1.5"'
    if one.resting_angles and half_w > LARGE_PX:  # the room that a bar sweeps, in which other objects may stand
        style = f'class="foot" fill="transparent" stroke="{mark}" stroke-dasharray="3 6"'
    if one.is_round or abs(half_w - half_h) < 0.5:
        return f'<circle r="{max(half_w, half_h):.1f}" {style}/>'
    return (
        f'<rect x="{-half_w:.1f}" y="{-half_h:.1f}" width="{2 * half_w:.1f}" height="{2 * half_h:.1f}" rx="6" {style}/>'
    )


def _pointer(one: PanelObject, reading: Reading | None, half_w: float, half_h: float, mark: str) -> str:
    """Return what moves or lights on the object, as it was read: a needle, a bar, a cap, a lamp; nothing if unknown."""
    if reading is None or reading["quality"] != "valid":
        return ""
    colour = COLOURS.get(str(getattr(one, "colour", "")), "")
    if reading["state"] is not None and one.can_be_lit:
        is_lit = reading["state"] == "on"
        return f'<circle r="{0.75 * half_w:.1f}" fill="{colour if is_lit else "none"}" stroke="{colour}" stroke-width="3"/>'
    angle = _angle(one, reading)
    if angle is not None:
        x, y = 0.85 * half_w * math.sin(angle), -0.85 * half_h * math.cos(angle)
        needle = f'<line x2="{x:.1f}" y2="{y:.1f}" stroke="{mark}" stroke-width="4" stroke-linecap="round"/>'
        return f'{needle}<circle r="4" fill="{mark}"/>'
    scale = getattr(one, "scale", None)
    if scale is not None and one.places_are_lengths and reading["value"] is not None:
        along = scale.place_of(reading["value"]) * PX_PER_M
        turn = float(getattr(one, "angle_rad", 0.0))
        x, y = along * math.cos(turn), -along * math.sin(turn)
        return f'<rect x="{x - 8:.1f}" y="{y - 14:.1f}" width="16" height="28" rx="3" fill="{mark}"/>'
    return ""


def _angle(one: PanelObject, reading: Reading) -> float | None:
    """Return the angle of needle or bar, clockwise from up; None if it has none or it is not known."""
    state, value = reading["state"], reading["value"]
    if state in one.resting_angles:
        return one.resting_angles[state]
    if value is None or one.places_are_lengths:
        return None
    if one.value_is_angle:
        return float(value)
    scale = getattr(one, "scale", None)
    return None if scale is None else float(scale.place_of(value))


def overlay_svg(
    panel: Panel, camera_from_panel: RigidTransform, lens: CameraIntrinsics, readings: Mapping[str, Reading]
) -> str:
    """Return the outlines of plate and objects over the camera's picture, with the objects' values beside them."""
    x, y = panel.width_m / 2, panel.height_m / 2
    plate = _polygon(_box(0.0, 0.0, x, y), camera_from_panel, lens)
    parts = [
        f'<svg viewBox="0 0 {lens.width_px} {lens.height_px}" preserveAspectRatio="none" aria-hidden="true">',
        f'<polygon points="{plate}" fill="none" stroke="{OUTLINE}" stroke-width="1.5" stroke-dasharray="6 4"/>'
        if plate
        else "",
    ]
    for one in panel.objects:
        half_w, half_h = one.half_footprint_m
        points = _polygon(_box(*one.position_m, half_w, half_h), camera_from_panel, lens)
        if not points:
            continue
        below = project(camera_from_panel.apply([[one.position_m[0], one.position_m[1] - half_h, 0.0]]), lens)[0]
        text = shown(one, readings[one.name]) if one.name in readings else ""
        parts.append(
            f'<g data-object="{one.name}" style="cursor:pointer">'
            f'<polygon points="{points}" fill="transparent" stroke="{OUTLINE}" stroke-width="1.5"/>'
            f'<text x="{below[0]:.1f}" y="{below[1] + 14:.1f}" text-anchor="middle" font-size="13" fill="#fff" stroke="#000" '
            f'stroke-width="3" paint-order="stroke">{attribute(text)}</text></g>'
        )
    return "".join([*parts, "</svg>"])


def _box(x: float, y: float, half_w: float, half_h: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], float) * [half_w, half_h] + [x, y]
    fine = [a + (b - a) * f for a, b in itertools.pairwise(corners) for f in np.linspace(0, 1, 8, endpoint=False)]
    return np.column_stack([np.array(fine), np.zeros(len(fine))])


def _polygon(points_m: Any, camera_from_panel: RigidTransform, lens: CameraIntrinsics) -> str:
    """Return projected points as an SVG list; empty if a point is behind the camera or far outside of the picture."""
    pixels = project(camera_from_panel.apply(points_m), lens)
    if not np.isfinite(pixels).all() or np.abs(pixels).max() > 4 * lens.width_px:
        return ""
    return " ".join(f"{u:.1f},{v:.1f}" for u, v in pixels)


def _px(position_m: tuple[float, ...]) -> tuple[float, float]:
    return position_m[0] * PX_PER_M, -position_m[1] * PX_PER_M
