"""Draws a random panel from a seed: 8 controls, a lamp and 2 to 4 instruments, as built and as its file states them.

Every quantity has a stream of its own, named after it, so a new one changes no panel in any other respect.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from service.sweep.layout import HEIGHT_M, LIGHTS_M, WIDTH_M, Table, laid_out
from service.sweep.numbers import pick, radians, stream, uniform

STATED_SHARE = 0.6  # of the panels whose file states the efforts, within `STATED_RATIO`
STATED_RATIO = 0.2
NOMINAL: dict[str, dict[str, float]] = {  # what the other files state
    "lever": {"torque_nm": 2.0},
    "handwheel": {"torque_nm": 0.8},
    "slider": {"friction_n": 4.0},
    "rotary": {"torque_nm": 0.15},
    "toggle": {"force_n": 6.0},
    "button": {"spring_n_per_m": 1000.0, "preload_n": 2.0},
    "mushroom": {"spring_n_per_m": 2000.0, "preload_n": 8.0},
}
SPREAD_M, SPREAD_RAD = 0.100, math.radians(15.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnPanel:
    """A random panel: the tables of its file, of the file of the panel as built, and of the cell's `[simulation]`."""

    seed: int
    stated: Table
    built: Table
    simulation: Table


def draw_panel(seed: int) -> DrawnPanel:
    """Return the panel of a seed.

    Raises:
        ConfigError: no layout was found; does not happen for the sizes that are drawn here.
    """
    controls = [_lever(seed), _handwheel(seed), _slider(seed), _rotary(seed), _toggle(seed), _mushroom(seed)]
    controls += [_button(seed, "start", lights_lamp="run_lamp"), _button(seed, "hold", latching=True)]
    lamp = {
        "kind": "lamp",
        "name": "run_lamp",
        "label": "RUN",
        "radius_m": 0.010,
        "colour": pick(seed, "lamp", COLOURS),
    }
    objects = laid_out(seed, [*controls, lamp, *_instruments(seed)])
    built = {**_plate(seed), "objects": objects, "tolerances": {"effort_ratio": 0.0}}
    is_stated = stream(seed, "stated").uniform() < STATED_SHARE
    stated = {**_plate(seed), "objects": [_as_stated(seed, table, is_stated) for table in objects]}
    return DrawnPanel(
        seed=seed,
        stated=stated,
        built=built,
        simulation={
            "pad_friction": uniform(seed, "pad_friction", 0.3, 1.0),
            "panel_spread_m": SPREAD_M,
            "panel_spread_rad": round(SPREAD_RAD, 5),
        },
    )


COLOURS = ("red", "green", "amber", "blue", "white")


def _plate(seed: int) -> Table:
    x, y = LIGHTS_M
    corners = {"upper_left": (-x, y), "upper_right": (x, y), "lower_right": (x, -y), "lower_left": (-x, -y)}
    lights = [{"name": f"light_{name}", "position_m": [*at, 0.0005]} for name, at in corners.items()]
    return {"schema": 1, "name": f"random_{seed}", "width_m": WIDTH_M, "height_m": HEIGHT_M, "lights": lights}


def _as_stated(seed: int, table: Table, is_stated: bool) -> Table:
    """Return the table of an object with the efforts that the panel file states."""
    efforts = NOMINAL.get(table["kind"], {})
    if not is_stated:
        return {**table, **efforts}
    random = stream(seed, f"{table['name']}/stated")
    ratios = {key: 1.0 + random.uniform(-STATED_RATIO, STATED_RATIO) for key in efforts}
    return {**table, **{key: round(table[key] * ratio, 4) for key, ratio in ratios.items()}}


# -- controls ---------------------------------------------------------------------------------------------------------


def _lever(seed: int) -> Table:
    random = stream(seed, "main_valve")
    is_straight, straight, oblique = (
        random.uniform() < 0.7,
        random.choice([-90.0, 0.0, 0.0, 90.0]),
        random.integers(-11, 6),
    )
    first = float(straight if is_straight else 15.0 * oblique)
    names = ["open", "closed"] if random.uniform() < 0.5 else ["closed", "open"]
    states = [{"name": name, "angle_rad": radians(first + turn)} for name, turn in zip(names, (0.0, 90.0), strict=True)]
    return {
        "kind": "lever",
        "name": "main_valve",
        "label": "MAIN VALVE",
        "length_m": uniform(seed, "main_valve/length", 0.055, 0.095),
        "width_m": uniform(seed, "main_valve/width", 0.011, 0.017),
        "height_m": uniform(seed, "main_valve/height", 0.025, 0.036),
        "torque_nm": uniform(seed, "main_valve/torque", 0.5, 8.0),
        "states": states,
    }


def _handwheel(seed: int) -> Table:
    many = stream(seed, "bypass/turns").uniform() < 0.5
    return {
        "kind": "handwheel",
        "name": "bypass",
        "label": "BYPASS",
        "radius_m": uniform(seed, "bypass/radius", 0.026, 0.048),
        "rim_m": uniform(seed, "bypass/rim", 0.004, 0.006),
        "height_m": uniform(seed, "bypass/height", 0.026, 0.036),
        "spokes": int(pick(seed, "bypass/spokes", (2, 3, 3, 4, 5))),
        "minimum_rad": -12.5664 if many else -6.2832,
        "maximum_rad": 12.5664 if many else 6.2832,
        "torque_nm": uniform(seed, "bypass/torque", 0.3, 3.0),
    }


def _slider(seed: int) -> Table:
    travel_m = uniform(seed, "setpoint/travel", 0.060, 0.120)
    end = travel_m / 2 if stream(seed, "setpoint/direction").uniform() < 0.8 else -travel_m / 2
    highest, unit = pick(seed, "setpoint/scale", ((100.0, "%"), (100.0, "%"), (10.0, "bar"), (60.0, "Hz")))
    random = stream(seed, "setpoint/angle")
    angle = float(random.choice([0.0, 0.0, 90.0])) if random.uniform() < 0.8 else 15.0 * float(random.integers(-5, 6))
    scale = {"minimum": 0.0, "maximum": float(highest), "unit": unit, "at_min": -end, "at_max": end, "major_ticks": 6}
    return {
        "kind": "slider",
        "name": "setpoint",
        "label": "SETPOINT",
        "angle_rad": radians(angle),
        "travel_m": travel_m,
        "cap_size_m": [
            uniform(seed, "setpoint/cap_along", 0.010, 0.016),
            uniform(seed, "setpoint/cap_across", 0.018, 0.028),
            uniform(seed, "setpoint/cap_out", 0.014, 0.020),
        ],
        "friction_n": uniform(seed, "setpoint/friction", 1.0, 15.0),
        "scale": scale,
    }


def _rotary(seed: int) -> Table:
    count = int(pick(seed, "mode/count", (2, 3, 3, 4, 5, 6)))
    step = float(pick(seed, "mode/step", (30.0, 45.0, 45.0, 60.0) if count <= 5 else (30.0, 45.0)))
    names = ["off", "manual", "auto", "local", "remote", "test"][:count]
    angles = [step * (k - (count - 1) / 2) for k in range(count)]
    states = [{"name": name, "angle_rad": radians(angle)} for name, angle in zip(names, angles, strict=True)]
    return {
        "kind": "rotary",
        "name": "mode",
        "label": "MODE",
        "radius_m": uniform(seed, "mode/radius", 0.014, 0.021),
        "height_m": uniform(seed, "mode/height", 0.016, 0.021),
        "torque_nm": uniform(seed, "mode/torque", 0.08, 0.30),
        "states": states,
    }


def _toggle(seed: int) -> Table:
    return {
        "kind": "toggle",
        "name": "pump",
        "label": "PUMP",
        "bat_length_m": uniform(seed, "pump/length", 0.017, 0.023),
        "force_n": uniform(seed, "pump/force", 3.0, 10.0),
    }


def _mushroom(seed: int) -> Table:
    return {
        "kind": "mushroom",
        "name": "emergency",
        "label": "EMERGENCY",
        "radius_m": uniform(seed, "emergency/radius", 0.016, 0.024),
        "travel_m": uniform(seed, "emergency/travel", 0.005, 0.007),
        "spring_n_per_m": uniform(seed, "emergency/spring", 500.0, 2000.0),
        "preload_n": uniform(seed, "emergency/preload", 4.0, 9.0),
    }


def _button(seed: int, name: str, **more: Any) -> Table:
    return {
        "kind": "button",
        "name": name,
        "label": name.upper(),
        "radius_m": uniform(seed, f"{name}/radius", 0.010, 0.016),
        "height_m": uniform(seed, f"{name}/height", 0.007, 0.010),
        "travel_m": uniform(seed, f"{name}/travel", 0.004, 0.006),
        "spring_n_per_m": uniform(seed, f"{name}/spring", 500.0, 2000.0),
        "preload_n": uniform(seed, f"{name}/preload", 1.0, 4.0),
        "colour": pick(seed, f"{name}/colour", (*COLOURS, "black")),
        **more,
    }


# -- instruments ------------------------------------------------------------------------------------------------------


def _instruments(seed: int) -> list[Table]:
    count = int(stream(seed, "instruments").integers(2, 5))
    kinds = [_gauge, _display, _meter, _gauge]
    first = int(stream(seed, "instruments/first").integers(0, 4))
    return [kinds[(first + k) % 4](seed, f"instrument_{k + 1}") for k in range(count)]


def _gauge(seed: int, name: str) -> Table:
    highest = float(pick(seed, f"{name}/scale", (1.0, 6.0, 10.0, 100.0)))
    scale = {"minimum": 0.0, "maximum": highest, "unit": "bar", "at_min": -2.3562, "at_max": 2.3562, "major_ticks": 11}
    radius_m = uniform(seed, f"{name}/radius", 0.030, 0.040)
    return {"kind": "gauge", "name": name, "label": name.upper(), "radius_m": radius_m, "scale": scale}


def _display(seed: int, name: str) -> Table:
    return {
        "kind": "display",
        "name": name,
        "label": name.upper(),
        "width_m": 0.076,
        "height_m": 0.032,
        "digits": 4,
        "decimals": int(stream(seed, f"{name}/decimals").integers(0, 3)),
        "minimum": 0.0,
        "maximum": 99.0,
    }


def _meter(seed: int, name: str) -> Table:  # noqa: ARG001 - one interface for all instruments
    scale = {"minimum": 0.0, "maximum": 5.0, "unit": "A", "at_min": -0.7854, "at_max": 0.7854, "major_ticks": 6}
    shape = {"width_m": 0.076, "height_m": 0.064, "pivot_below_m": 0.022, "needle_m": 0.042}
    return {"kind": "panel_meter", "name": name, "label": name.upper(), **shape, "scale": scale}
