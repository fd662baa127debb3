"""What the seeded panel shows when the mission begins: needle values, initial states, built positions, efforts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
    Slider,
    Toggle,
)
from simbackend.draws import Draws

WHEEL_SPREAD_RAD = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Built:
    """One object as it was built.

    Attributes:
        offset_m: where it sits beside its place in the panel file (x, y).
        effort_ratio: its friction, spring or detent over the file's.
        place: joint position at the start (rad clockwise, m along the track), needle angle of an instrument.
        is_on: lamp lit, button latched.
        text: what a display shows.
        value: the value behind `place` or `text`.
    """

    panel_object: PanelObject
    offset_m: tuple[float, float]
    effort_ratio: float
    place: float = 0.0
    is_on: bool = False
    text: str | None = None
    value: float | None = None


def build(panel: Panel, draws: Draws) -> tuple[Built, ...]:
    """All objects of the panel, drawn from the seed; the streams are named by object, so the order does not matter."""
    button_lamps = {
        panel_object.lights_lamp
        for panel_object in panel.objects
        if isinstance(panel_object, Button) and panel_object.lights_lamp
    }
    return tuple(_built(panel_object, panel, draws, button_lamps) for panel_object in panel.objects)


def _built(panel_object: PanelObject, panel: Panel, draws: Draws, button_lamps: set[str]) -> Built:  # one a kind
    random = draws.stream(f"object/{panel_object.name}")
    dx, dy = panel.tolerances.position_m * random.standard_normal(2)
    # A tenth is the least: a part without any friction would never rest.
    ratio = max(0.1, 1.0 + panel.tolerances.effort_ratio * float(random.standard_normal()))
    u = float(random.uniform())
    common: dict[str, Any] = {"panel_object": panel_object, "offset_m": (float(dx), float(dy)), "effort_ratio": ratio}
    match panel_object:
        case Gauge() | PanelMeter():
            value = panel_object.scale.minimum + (0.05 + 0.9 * u) * (
                panel_object.scale.maximum - panel_object.scale.minimum
            )
            return Built(**common, place=panel_object.scale.place_of(value), value=value)
        case Display():
            low, high = _displayable(panel_object)
            value = round(low + (0.02 + 0.96 * u) * (high - low), panel_object.decimals)
            return Built(**common, text=display_text(panel_object, value), value=value)
        case Lamp():
            return Built(**common, is_on=panel_object.name not in button_lamps and u < 0.5)
        case Button():
            return Built(**common, is_on=panel_object.latching and u < 0.5)
        case Mushroom():
            return Built(**common)
        case Toggle():
            return Built(**common, place=panel_object.tilt_rad if u < 0.5 else -panel_object.tilt_rad)
        case Rotary() | Lever():
            return Built(**common, place=panel_object.states[int(u * len(panel_object.states))].angle_rad)
        case Slider():
            value = panel_object.scale.minimum + (0.1 + 0.8 * u) * (
                panel_object.scale.maximum - panel_object.scale.minimum
            )
            return Built(**common, place=panel_object.scale.place_of(value), value=value)
        case Handwheel():
            low = max(panel_object.minimum_rad, -WHEEL_SPREAD_RAD)
            high = min(panel_object.maximum_rad, WHEEL_SPREAD_RAD)
            return Built(**common, place=low + u * (high - low))


def _displayable(panel_object: Display) -> tuple[float, float]:
    """The file's range, cut to what its digits can show; a minus sign takes one of them."""
    unit = 10.0**-panel_object.decimals
    highest = (10**panel_object.digits - 1) * unit
    lowest = -(10 ** (panel_object.digits - 1) - 1) * unit
    return min(max(panel_object.minimum, lowest), highest), max(min(panel_object.maximum, highest), lowest)


def display_text(panel_object: Display, value: float) -> str:
    """The characters on the display, right-justified; a point does not take a digit's place."""
    text = f"{value:.{panel_object.decimals}f}"
    width = panel_object.digits + (1 if panel_object.decimals else 0)
    return text.rjust(width)
