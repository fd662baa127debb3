"""Writes a mission's report folder: `report.json`, `report.html` and the pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from hal.atomic_write import write_atomically
from service.jsonable import jsonable
from service.report.plots import joints_picture, wrench_picture
from service.report.record import MissionRecord, Picture

TEMPLATES = Path(__file__).parent


def write_report(record: MissionRecord, folder: Path) -> Path:
    """Write the report into `folder`, created if missing; returns the path of `report.html`."""
    folder.mkdir(parents=True, exist_ok=True)
    if record.motions:
        wrench, joints = wrench_picture(record.motions), joints_picture(record.motions)
        record.pictures.append(Picture(name="wrench", title="contact wrench over the mission", png=wrench))
        record.pictures.append(Picture(name="joints", title="joint angles over the mission", png=joints))
    for picture in record.pictures:
        (folder / f"{picture.name}.png").write_bytes(picture.png)
    summary: dict[str, Any] = jsonable(record.summary())
    write_json(folder, summary)
    titles = {f"{picture.name}.png": picture.title for picture in record.pictures}
    (folder / "titles.json").write_text(json.dumps(titles), encoding="utf-8")
    return render(folder)


def write_json(folder: Path, summary: dict[str, Any]) -> None:
    """Replace `report.json` atomically, so that a reader never sees an incomplete file."""
    write_atomically(folder / "report.json", json.dumps(summary, indent=1, allow_nan=False))


def render(folder: Path) -> Path:
    """Write `report.html` from the folder's `report.json`; called again after the evaluation has been added."""
    summary = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    titles = json.loads((folder / "titles.json").read_text(encoding="utf-8"))
    environment = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined)
    environment.filters["mm"] = lambda metres: f"{1e3 * metres:.2f}"
    environment.filters["deg"] = lambda radians: f"{57.29577951308232 * radians:.3f}"
    environment.filters["seconds"] = lambda s: f"{s:.2f}"
    html = environment.get_template("report.html.jinja").render(r=summary, titles=titles)
    return write_atomically(folder / "report.html", html)
