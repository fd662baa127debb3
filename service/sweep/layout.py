"""Places the parts of a random panel on its plate, uniformly, with a least distance between them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hal.errors import ConfigError
from hal.panel import Panel, PanelObject
from hal.strict import validate
from service.sweep.numbers import stream

WIDTH_M, HEIGHT_M = 0.62, 0.46
GAP_M = 0.022  # least distance between the rectangles around any two parts
EDGE_M = 0.006  # least distance to the edge of the plate
LIGHTS_M = (0.28, 0.20)  # of the border lights from the middle
LIGHT_RADIUS_M = 0.008
TRIES, LAYOUTS = 60, 400

Table = dict[str, Any]


def laid_out(seed: int, tables: list[Table]) -> list[Table]:
    """Return the tables with positions: uniform over the plate, apart by at least `GAP_M`."""
    halves = {table["name"]: _half_m(table) for table in tables}
    by_size = sorted(tables, key=lambda table: -math.prod(halves[table["name"]]))
    random = stream(seed, "layout")
    for _ in range(LAYOUTS):
        places = _attempt(random, by_size, halves)
        if places is not None:
            return [{**table, "position_m": places[table["name"]]} for table in tables]
    raise ConfigError(f"no layout found for the random panel of seed {seed}", hint="take another seed")


def _attempt(
    random: np.random.Generator, tables: list[Table], halves: dict[str, tuple[float, float]]
) -> dict[str, list[float]] | None:
    """Return a place for every part, or None if one of them finds no room."""
    light = LIGHT_RADIUS_M
    taken = [(sx * LIGHTS_M[0], sy * LIGHTS_M[1], light, light) for sx in (-1.0, 1.0) for sy in (-1.0, 1.0)]
    places: dict[str, list[float]] = {}
    for table in tables:
        half_x, half_y = halves[table["name"]]
        room_x, room_y = WIDTH_M / 2 - EDGE_M - half_x, HEIGHT_M / 2 - EDGE_M - half_y
        for x, y in random.uniform(-1.0, 1.0, (TRIES, 2)) * (room_x, room_y):
            if all(abs(x - u) >= half_x + a + GAP_M or abs(y - v) >= half_y + b + GAP_M for u, v, a, b in taken):
                taken.append((x, y, half_x, half_y))
                places[table["name"]] = [round(float(x), 4), round(float(y), 4)]
                break
        else:
            return None
    return places


def _half_m(table: Table) -> tuple[float, float]:
    """Return half the sides of the rectangle that the object needs in any state."""
    alone = {"name": "alone", "width_m": 2.0, "height_m": 2.0}
    lone = {key: value for key, value in table.items() if key != "lights_lamp"}
    panel = validate({**alone, "objects": [{**lone, "position_m": [0.0, 0.0]}]}, Panel, source="a random panel")
    drawn: PanelObject = panel.objects[0]
    return drawn.half_footprint_m
