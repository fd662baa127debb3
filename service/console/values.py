"""Readings and targets in the words of the object: its unit, its states, degrees for angles."""

from __future__ import annotations

import math
from html import escape
from typing import Any

from hal.panel import NumberGoal, PanelObject
from service.console.texts import say

STALE_S = 900.0  # a value that nobody has looked at for a quarter of an hour is dimmed
Reading = dict[str, Any]


def label_of(panel_object: PanelObject) -> str:
    """Return the object's label as people read it on the panel, or its name."""
    return panel_object.label or panel_object.name.replace("_", " ")


def shown(panel_object: PanelObject, reading: Reading | None) -> str:
    """Return what the object shows, with its unit; a refused reading shows no value."""
    if reading is None:
        return say("value.none")
    if reading["quality"] != "valid":
        return say("value.refused")
    if reading["state"] is not None:
        return str(reading["state"])
    if reading["text"] is not None:
        return f"{reading['text'].strip()} {unit_of(panel_object, reading)}".rstrip()
    return "–" if reading["value"] is None else number(panel_object, reading["value"], reading)


def number(panel_object: PanelObject, value: float, reading: Reading) -> str:
    """Return a value with its unit, to as many digits as its scale or its standard deviation supports."""
    if panel_object.value_is_angle:
        return f"{math.degrees(value):.0f}°"
    step = reading.get("sigma") or 0.01 * (panel_object.full_scale or 1.0)
    digits = max(0, min(4, math.ceil(-math.log10(step)))) if step > 0 else 2
    return f"{value:.{digits}f} {unit_of(panel_object, reading)}".rstrip()


def sigma(panel_object: PanelObject, reading: Reading | None) -> str:
    """Return one standard deviation of the value as text; empty if there is none."""
    if reading is None or reading["quality"] != "valid" or reading["sigma"] is None or reading["state"] is not None:
        return ""
    size = math.degrees(reading["sigma"]) if panel_object.value_is_angle else reading["sigma"]
    return say("value.sigma", sigma=f"{size:.2g}" + ("°" if panel_object.value_is_angle else ""))


def unit_of(panel_object: PanelObject, reading: Reading) -> str:
    """Return the unit for people."""
    return "°" if panel_object.value_is_angle else str(reading["unit"] or "").replace("degC", "°C")


def age(reading: Reading | None) -> str:
    """Return an HTML element that shows the age of the reading; the page's script keeps it up to date."""
    return "" if reading is None else f'<time data-utc="{reading["utc_s"]:.2f}"></time>'


def confidence(reading: Reading | None) -> str:
    """Return the confidence as a percentage; empty for a refused reading."""
    return "" if reading is None or reading["quality"] != "valid" else f"{100 * reading['confidence']:.0f} %"


def limits_for_people(goal: NumberGoal) -> tuple[float, float, str]:
    """Return the lowest and highest target and the unit, in degrees for an angle."""
    if goal.key == "angle_rad":
        return round(math.degrees(goal.low)), round(math.degrees(goal.high)), "°"
    return goal.low, goal.high, goal.unit.replace("degC", "°C")


def target_for_api(goal: NumberGoal, value: float) -> float:
    """Return the target as the API takes it, from what a person gave."""
    return min(goal.high, max(goal.low, math.radians(value))) if goal.key == "angle_rad" else value


def attribute(text: str) -> str:
    """Return text for an HTML attribute or body."""
    return escape(text, quote=True)
