"""Models of a panel file's mushrooms and handwheels, as range images show them."""

from __future__ import annotations

from typing import Any

import numpy as np

from hal.panel import Handwheel, Mushroom, Panel, PanelObject
from perception.range import ComponentModel, models_from

HUB_RADIUS_M = 0.009
SPOKE_RADIUS_M = 0.003


def models_of(panel: Panel) -> dict[str, ComponentModel]:
    """A model for each mushroom and handwheel of the panel file, by the object's name."""
    tables = {panel_object.name: table for panel_object in panel.objects if (table := _table(panel_object)) is not None}
    models = models_from({"model": tables}, where=f"panel {panel.name}") if tables else ()
    return {model.name: model for model in models}


def _table(panel_object: PanelObject) -> dict[str, Any] | None:
    match panel_object:
        case Mushroom():
            return _mushroom(panel_object)
        case Handwheel():
            return _handwheel(panel_object)
    return None


def _mushroom(panel_object: Mushroom) -> dict[str, Any]:
    """A head, the upper half of its height, on a stem half as wide."""
    up, head_m = [0.0, 0.0, 1.0], 0.5 * panel_object.height_m
    cap = {"type": "plane", "point_m": [0, 0, panel_object.height_m], "direction": up, "size_m": panel_object.radius_m}
    wall = {
        "type": "cylinder",
        "point_m": [0, 0, panel_object.height_m - 0.5 * head_m],
        "direction": up,
        "size_m": panel_object.radius_m,
        "length_m": head_m,
    }
    return {
        "turns": 0,
        "motion": "slide",
        "motion_axis": up,
        "low": -panel_object.travel_m,
        "high": 0.0,
        "surfaces": [{"name": n, "moves": True, **s} for n, s in (("cap", cap), ("wall", wall))],
    }


def _handwheel(panel_object: Handwheel) -> dict[str, Any]:
    """A ring and spokes at the height of its tube's middle, on a hub."""
    up, ring_m = [0.0, 0.0, 1.0], panel_object.height_m - panel_object.rim_m
    rows: list[dict[str, Any]] = [
        {
            "name": "rim",
            "type": "torus",
            "point_m": [0, 0, ring_m],
            "direction": up,
            "size_m": panel_object.radius_m,
            "tube_m": panel_object.rim_m,
        },
        {
            "name": "hub",
            "type": "plane",
            "point_m": [0, 0, panel_object.height_m],
            "direction": up,
            "size_m": HUB_RADIUS_M,
        },
    ]
    for k in range(panel_object.spokes):
        angle = 0.5 * np.pi - 2.0 * np.pi * k / panel_object.spokes  # the first points up, as the file counts angles
        along = np.array([np.cos(angle), np.sin(angle)])
        rows.append(
            {
                "name": f"spoke_{k + 1}",
                "type": "cylinder",
                "point_m": [*(0.5 * panel_object.radius_m * along), ring_m],
                "direction": [*along, 0.0],
                "size_m": SPOKE_RADIUS_M,
                "length_m": panel_object.radius_m,
            }
        )
    half_turn = np.pi / panel_object.spokes
    return {
        "turns": panel_object.spokes,
        "motion": "turn",
        "low": -half_turn,
        "high": half_turn,
        "surfaces": [{"tolerance_m": 0.001, **row} for row in rows],
    }
