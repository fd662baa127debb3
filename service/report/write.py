"""Writes a mission's report folder: `report.json`, `report.html` with its pictures inside, the pictures; and a PDF."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from hal.atomic_write import write_atomically
from hal.errors import ConfigError
from service.jsonable import jsonable
from service.report.document import Report, blocks_of
from service.report.pdf import pdf_of
from service.report.plots import joints_picture, small_picture, wrench_picture
from service.report.record import MissionRecord, Picture

TEMPLATES = Path(__file__).parent


def write_report(record: MissionRecord, folder: Path) -> Path:
    """Write the report into `folder`, created if missing; returns the path of `report.html`."""
    folder.mkdir(parents=True, exist_ok=True)
    if record.motions:
        wrench, joints = wrench_picture(record.motions), joints_picture(record.motions)
        record.pictures.append(Picture(name="wrench", title="contact force and torque over the mission", png=wrench))
        record.pictures.append(Picture(name="joints", title="joint angles over the mission", png=joints))
    for picture in record.pictures:
        (folder / f"{picture.name}.png").write_bytes(picture.png)
    for name, png in record.crops.items():
        (folder / f"crop-{name}.png").write_bytes(png)
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
    blocks = list(blocks_of(_report_in(folder)))
    environment = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined)
    environment.filters["data"] = lambda name: _data_url(folder / name)
    html = environment.get_template("report.html.jinja").render(blocks=blocks, title=blocks[0])
    return write_atomically(folder / "report.html", html)


def write_pdf(folder: Path, path: Path) -> Path:
    """Write the report of a mission's folder as a PDF.

    Raises:
        ConfigError: there is no report in that folder, or the file cannot be written.
    """
    data = pdf_of(blocks_of(_report_in(folder)), folder)
    try:
        path.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}", hint="name another file") from error
    return path


def _report_in(folder: Path) -> Report:
    try:
        summary = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        captions = json.loads((folder / "titles.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{folder} has no report: {error}", hint="name the folder of a finished mission") from error
    return Report(summary=summary, captions=captions)


def _data_url(path: Path) -> str:
    return f"data:image/jpeg;base64,{base64.b64encode(small_picture(path)).decode()}"
