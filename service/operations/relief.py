"""Objects of the panel file found by their surfaces in a range image: the emergency mushroom and the valve wheel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hal.errors import Unsupported
from hal.geometry import UncertainPose, compose
from hal.panel import Handwheel, Mushroom, Panel, PanelObject
from perception.range import PinholeSensor, RangeScene, Surface, analyse
from perception.range.match import Match, match_models
from perception.range.models import ComponentModel, models_from
from service.operations.eyes import Scan
from service.operations.locate import pose_json

NEAR_M = 0.02  # a match further from where the file has its object is another thing
HUB_RADIUS_M = 0.009
SPOKE_RADIUS_M = 0.003


def models_of(panel: Panel) -> tuple[ComponentModel, ...]:
    """A model for each mushroom and handwheel of the panel file, under the object's name."""
    tables = {thing.name: table for thing in panel.objects if (table := _table(thing)) is not None}
    return models_from({"model": tables}, where=f"panel {panel.name}") if tables else ()


def surfaces_in(image: Scan) -> RangeScene:
    """The range image analysed.

    Raises:
        Unsupported: a scanner that is no pinhole.
        InvalidRequest, NotFound: see `analyse`.
    """
    c = image.capabilities
    if c.projection != "pinhole":
        raise Unsupported(f"{image.scanner} has {c.projection} projection", hint="use a pinhole range scanner")
    sensor = PinholeSensor(width_px=c.width, height_px=c.height, fx_px=c.fx, fy_px=c.fy, cx_px=c.cx, cy_px=c.cy)
    return analyse(image.depth_m, sensor)


def find_by_surfaces(
    scene: RangeScene, image: Scan, panel: Panel, base_from_panel: UncertainPose, plate: Surface
) -> list[dict[str, Any]]:
    """Where the scan shows the panel's mushrooms and handwheels: a row for each, with what is seen of it.

    Args:
        plate: the plane that they stand on, in the scanner's frame.
        base_from_panel: where the panel is believed to be; it tells two of a kind apart.
    """
    depth = np.asarray(image.depth_m, float)
    matches = match_models(scene, depth, models_of(panel), panel=plate)
    rows = [_row(thing, matches, image, base_from_panel) for thing in panel.objects]
    return [row for row in rows if row is not None]


def _row(
    thing: PanelObject, matches: Sequence[Match], image: Scan, base_from_panel: UncertainPose
) -> dict[str, Any] | None:
    if not isinstance(thing, Mushroom | Handwheel):
        return None
    expected = base_from_panel.parent_from_child.apply([*thing.position_m, 0.0])
    found: list[tuple[float, UncertainPose, Match]] = []
    for match in matches:
        pose = compose(image.base_from_scanner, match.sensor_from_object)
        off_m = float(np.linalg.norm(pose.parent_from_child.translation - expected))
        if off_m < NEAR_M and match.model == thing.name:
            found.append((off_m, pose, match))
    if not found:
        return {"name": thing.name, "kind": thing.kind, "found": False}
    off_m, pose, match = min(found, key=lambda f: f[0])
    return {
        "name": thing.name,
        "kind": thing.kind,
        "found": True,
        "base_from_object": pose_json(pose),
        "off_panel_file_m": off_m,
        "state": match.state,
        "state_sigma": match.state_sigma,
        "seen": match.seen,
        "score": match.score,
        "surfaces": match.labels,
    }


def _table(thing: PanelObject) -> dict[str, Any] | None:
    match thing:
        case Mushroom():
            return _mushroom(thing)
        case Handwheel():
            return _handwheel(thing)
    return None


def _mushroom(thing: Mushroom) -> dict[str, Any]:
    """A head, the upper half of its height, on a stem half as wide."""
    up, head_m = [0.0, 0.0, 1.0], 0.5 * thing.height_m
    cap = {"type": "plane", "point_m": [0, 0, thing.height_m], "direction": up, "size_m": thing.radius_m}
    wall = {
        "type": "cylinder",
        "point_m": [0, 0, thing.height_m - 0.5 * head_m],
        "direction": up,
        "size_m": thing.radius_m,
        "length_m": head_m,
    }
    return {
        "turns": 0,
        "motion": "slide",
        "motion_axis": up,
        "low": -thing.travel_m,
        "high": 0.0,
        "surfaces": [{"name": n, "moves": True, **s} for n, s in (("cap", cap), ("wall", wall))],
    }


def _handwheel(thing: Handwheel) -> dict[str, Any]:
    """A ring and spokes at the height of its tube's middle, on a hub."""
    up, ring_m = [0.0, 0.0, 1.0], thing.height_m - thing.rim_m
    rows: list[dict[str, Any]] = [
        {
            "name": "rim",
            "type": "torus",
            "point_m": [0, 0, ring_m],
            "direction": up,
            "size_m": thing.radius_m,
            "tube_m": thing.rim_m,
        },
        {"name": "hub", "type": "plane", "point_m": [0, 0, thing.height_m], "direction": up, "size_m": HUB_RADIUS_M},
    ]
    for k in range(thing.spokes):
        angle = 0.5 * np.pi - 2.0 * np.pi * k / thing.spokes  # the first points up, as the file counts angles
        along = np.array([np.cos(angle), np.sin(angle)])
        rows.append(
            {
                "name": f"spoke_{k + 1}",
                "type": "cylinder",
                "point_m": [*(0.5 * thing.radius_m * along), ring_m],
                "direction": [*along, 0.0],
                "size_m": SPOKE_RADIUS_M,
                "length_m": thing.radius_m,
            }
        )
    half_turn = np.pi / thing.spokes
    return {
        "turns": thing.spokes,
        "motion": "turn",
        "low": -half_turn,
        "high": half_turn,
        "surfaces": [{"tolerance_m": 0.001, **row} for row in rows],
    }
