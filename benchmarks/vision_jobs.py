"""Jobs of the vision benchmark as panels and views of panels, in metres."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from hal.panel import Lever, Light, Panel, PanelObject
from hal.panel.kinds import kind_model
from hal.strict import validate
from perception.vision.projection import PlateProjection

ROOT = Path(__file__).resolve().parent.parent
PROPORTIONS = tomllib.loads(
    (ROOT / "perception" / "vision" / "knowledge" / "proportions.toml").read_text(encoding="utf-8")
)

Job = dict[str, Any]


def panel_of_job(job: Job) -> Panel:
    """Return a job's layout as a panel: metres, y up, origin in the centre."""
    width, height = (v / 1000 for v in job["panel_mm"])
    reach = 0.45
    light = [
        {"name": f"light_{k}", "position_m": [sx * reach * width, sy * reach * height, 0.0]}
        for k, (sx, sy) in enumerate(((-1, 1), (1, 1), (1, -1), (-1, -1)))
    ]
    tables = [_object(entry, job["panel_mm"]) for entry in job["layout"]]
    source = str(job["id"])
    objects = (validate(table, kind_model(table["kind"]), source=source) for table in tables)
    # Not validated as a whole, because in drawings objects may overlap or cover a nominal light.
    return Panel.model_construct(
        name="job",
        width_m=width,
        height_m=height,
        lights=tuple(validate(one, Light, source=source) for one in light),
        objects=tuple(_by_meaning(panel_object) for panel_object in objects),
    )


def _by_meaning(panel_object: PanelObject) -> PanelObject:
    """Return a lever whose opposite stops have the same state name, as in a job; in a panel file their names differ."""
    if not isinstance(panel_object, Lever):
        return panel_object
    states = tuple(state.model_copy(update={"name": state.name.split("_")[0]}) for state in panel_object.states)
    return panel_object.model_copy(update={"states": states})


def view_of_job(job: Job) -> PlateProjection:
    """Return the job's approximate homography, as a projection of panel metres."""
    w, h = job["panel_mm"]
    mm_from_m = np.array([[1000.0, 0, w / 2], [0, -1000.0, h / 2], [0, 0, 1]])
    corners = np.array([[-w / 2, h / 2], [w / 2, h / 2], [w / 2, -h / 2], [-w / 2, -h / 2]]) / 1000
    return PlateProjection(px_from_plate=np.asarray(job["H_guess"], float) @ mm_from_m, corners_m=corners, sigma_px=2.0)


def _object(entry: Job, panel_mm: list[float]) -> dict[str, Any]:
    w, h = (float(v) / 1000 for v in entry["size"])
    x, y = entry["center_mm"]
    kind = entry["cls"]
    base = {
        "kind": kind,
        "name": f"o{entry['id']}",
        "label": entry.get("label", ""),
        "position_m": [(x - panel_mm[0] / 2) / 1000, (panel_mm[1] / 2 - y) / 1000],
    }
    part = PROPORTIONS.get(kind, {})
    match kind:
        case "gauge":
            return {**base, "radius_m": part["radius"] * w, "scale": _scale(entry)}
        case "panel_meter":
            return {
                **base,
                "width_m": w,
                "height_m": h,
                "pivot_below_m": part["pivot_below"] * h,
                "needle_m": part["needle"] * h,
                "scale": _scale(entry),
            }
        case "display":
            return {
                **base,
                "width_m": w,
                "height_m": h,
                "digits": 4,
                "style": "lcd" if entry.get("style", "led").startswith("lcd") else "led",
                "minimum": -1e9,
                "maximum": 1e9,
            }
        case "lamp":
            return {**base, "radius_m": part["radius"] * w, "colour": entry.get("colour", "green")}
        case "button":
            return {**base, "radius_m": part["radius"] * w}
        case "toggle":
            reach = part["reach"] * h
            return {
                **base,
                "bat_length_m": reach * 2**0.5,
                "tilt_rad": float(np.pi / 4),
                "bat_radius_m": part["bat_radius"] * w,
            }
        case "rotary":
            return {
                **base,
                "radius_m": part["radius"] * w,
                "states": _states((f"s{name}", a) for name, a in entry["state_angles_deg"].items()),
            }
        case "slider":
            return {**base, **_slider(entry, w, h, part)}
        case "lever":
            along = (90.0, 270.0) if entry["pipe_horizontal"] else (0.0, 180.0)
            states = _states((f"{'open' if a in along else 'closed'}_{a:g}", a) for a in (0.0, 90.0, 180.0, 270.0))
            return {**base, "length_m": part["length"] * w, "width_m": part["width"] * w, "states": states}
        case "handwheel":
            return {**base, "radius_m": part["radius"] * w, "rim_m": part["rim"] * w, "spokes": entry["spokes"]}
    raise ValueError(f"unknown class {kind!r}")


def _states(angles_deg: Iterable[tuple[str, float]]) -> list[dict[str, Any]]:
    return [{"name": name, "angle_rad": float(np.deg2rad(a))} for name, a in angles_deg]


def _scale(entry: Job) -> dict[str, Any]:
    return {
        "minimum": float(entry["min"]),
        "maximum": float(entry["max"]),
        "unit": entry.get("unit", ""),
        "at_min": float(np.deg2rad(entry["angle_min"])),
        "at_max": float(np.deg2rad(entry["angle_max"])),
    }


def _slider(entry: Job, w: float, h: float, part: dict[str, float]) -> dict[str, Any]:
    travel = entry["travel_mm"] / 1000
    long, short = max(w, h), min(w, h)
    scale = {
        "minimum": float(entry["min"]),
        "maximum": float(entry["max"]),
        "unit": entry.get("unit", ""),
        "at_min": -travel / 2,
        "at_max": travel / 2,
    }
    return {
        "angle_rad": 0.0 if entry["horizontal"] else float(np.pi / 2),
        "travel_m": travel,
        "scale": scale,
        "cap_size_m": [part["cap_along"] * long, part["cap_across"] * short, 0.01],
    }
