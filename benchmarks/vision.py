"""Panel vision against the issue's table: `python -m benchmarks.vision INPUTS.json OUT.json [--time]`.

Without arguments it runs the development images beside the repository and prints measured values beside the pass lines,
then the robustness axes one by one. Formats: the data folder's README.
"""

from __future__ import annotations

import json
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from hal.errors import CellError
from hal.panel import Panel
from hal.strict import validate
from perception.vision.image import as_gray, decode
from perception.vision.reading import ObjectReading
from perception.vision.taught import inspect_view
from perception.vision.view import PlaneView

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT.parent / "shared" / "data" / "vision"
PROPORTIONS = tomllib.loads(
    (ROOT / "perception" / "vision" / "knowledge" / "proportions.toml").read_text(encoding="utf-8")
)

Job = dict[str, Any]


def panel_of_job(job: Job) -> Panel:
    """The panel file that a job's layout amounts to: metres, y up, origin in the middle."""
    width, height = (v / 1000 for v in job["panel_mm"])
    reach = 0.45
    light = [
        {"name": f"light_{k}", "position_m": [sx * reach * width, sy * reach * height, 0.0]}
        for k, (sx, sy) in enumerate(((-1, 1), (1, 1), (1, -1), (-1, -1)))
    ]
    objects = [_object(entry, job["panel_mm"]) for entry in job["layout"]]
    return validate(
        {"schema": 1, "name": "job", "width_m": width, "height_m": height, "lights": light, "objects": objects},
        Panel,
        source=str(job["id"]),
    )


def view_of_job(job: Job) -> PlaneView:
    """The job's homography guess over panel metres."""
    w, h = job["panel_mm"]
    mm_from_m = np.array([[1000.0, 0, w / 2], [0, -1000.0, h / 2], [0, 0, 1]])
    corners = np.array([[-w / 2, h / 2], [w / 2, h / 2], [w / 2, -h / 2], [-w / 2, -h / 2]]) / 1000
    return PlaneView(px_from_plate=np.asarray(job["H_guess"], float) @ mm_from_m, corners_m=corners, sigma_px=2.0)


def _object(entry: Job, panel_mm: list[float]) -> dict[str, Any]:  # noqa: PLR0911  (one branch a kind)
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
            states = [
                {"name": f"s{name}", "angle_rad": float(np.deg2rad(a))} for name, a in entry["state_angles_deg"].items()
            ]
            return {**base, "radius_m": part["radius"] * w, "states": states}
        case "slider":
            return {**base, **_slider(entry, w, h, part)}
        case "lever":
            along = (90.0, 270.0) if entry["pipe_horizontal"] else (0.0, 180.0)
            states = [
                {"name": "open" if a in along else "closed", "angle_rad": float(np.deg2rad(a))}
                for a in (0.0, 90.0, 180.0, 270.0)
            ]
            return {**base, "length_m": part["length"] * w, "width_m": part["width"] * w, "states": states}
        case "handwheel":
            return {**base, "radius_m": part["radius"] * w, "rim_m": part["rim"] * w, "spokes": entry["spokes"]}
    raise ValueError(f"unknown class {kind!r}")


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


def taught_answer(job: Job, image: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Answer of a `taught` job."""
    panel = panel_of_job(job)
    readings = inspect_view(image, as_gray(image), view_of_job(job), panel, digits_taught=False)
    return {"objects": [_answer(entry, reading) for entry, reading in zip(job["layout"], readings, strict=True)]}


def _answer(entry: Job, reading: ObjectReading) -> dict[str, Any]:
    out: dict[str, Any] = {
        "id": entry["id"],
        "cls": entry["cls"],
        "center_px": [float(v) for v in reading.centre_px],
        "confidence": reading.confidence,
        "reason": reading.reason,
    }
    if not reading.answered:
        return out
    if reading.text is not None:
        out["text"] = reading.text
    elif reading.state is not None:
        out["state"] = reading.state.removeprefix("s") if entry["cls"] == "rotary" else reading.state
    elif reading.value is not None:
        out["reading"] = float(np.rad2deg(reading.value) % 360.0) if entry["cls"] == "handwheel" else reading.value
    return out


def answer(job: Job, folder: Path) -> dict[str, Any]:
    """Answer of any job; what is refused as a whole has its reason in `refused`."""
    try:
        image = decode((folder / job["image"]).read_bytes()) if "image" in job else np.zeros((1, 1), np.uint8)
        if job["mode"] == "taught":
            return taught_answer(job, image)
    except CellError as error:
        return {"refused": error.what, "hint": error.hint, "objects": []}
    return {"objects": []}


def run(jobs: list[Job], folder: Path, *, timed: bool) -> dict[str, Any]:
    """Answers by job id."""
    answers = {}
    for job in jobs:
        started = time.perf_counter()
        answers[job["id"]] = answer(job, folder)
        if timed:
            answers[job["id"]]["ms"] = 1e3 * (time.perf_counter() - started)
    return answers


def main(arguments: list[str]) -> int:
    """Entry point; returns the exit status."""
    timed = "--time" in arguments
    paths = [Path(a) for a in arguments if not a.startswith("--")]
    source, target = paths
    jobs = json.loads(source.read_text(encoding="utf-8"))["jobs"]
    folder = Path(json.loads(source.read_text(encoding="utf-8")).get("folder", source.parent))
    target.write_text(json.dumps(run(jobs, folder, timed=timed), indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
