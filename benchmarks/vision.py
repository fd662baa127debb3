"""Measures panel vision: `python -m benchmarks.vision INPUTS.json OUT.json [--time] [--least-confidence X]`.

Without arguments it reads the development images beside the repository and prints measured values beside the pass
lines, then each robustness axis. The README of the data folder describes the formats. Readings with a confidence below
X (default 0.5) are refused; 0 gives best guesses with their confidences.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.vision_jobs import Job, panel_of_job, view_of_job
from hal.arrays import Image
from hal.errors import CellError
from perception.vision.finding.blind import recognise
from perception.vision.image import as_gray, decode
from perception.vision.inspection import inspect_view
from perception.vision.knowledge import Knowledge
from perception.vision.knowledge_files import load_knowledge
from perception.vision.lights import assign_lights, find_lights
from perception.vision.photographs.dial import read_dial
from perception.vision.photographs.photo_display import read_photographed_display
from perception.vision.reading import ANSWER_AT, ObjectReading, PatchReading

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT.parent / "shared" / "data" / "vision"


def taught_answer(job: Job, image: Image, *, least_confidence: float = ANSWER_AT) -> dict[str, Any]:
    """Return the answer to a `taught` job."""
    panel = panel_of_job(job)
    view = view_of_job(job)
    readings = inspect_view(image, as_gray(image), view, panel, digits_taught=False, least_confidence=least_confidence)
    return {"objects": [_answer(entry, reading) for entry, reading in zip(job["layout"], readings, strict=True)]}


def _answer(entry: Job, reading: ObjectReading) -> dict[str, Any]:
    """Return the answer for one object; a refused one has no value, but a display's most likely number is reported."""
    out: dict[str, Any] = {
        "id": entry["id"],
        "cls": entry["cls"],
        "center_px": [float(v) for v in reading.centre_px],
        "confidence": reading.confidence,
        "reason": reading.reason,
    }
    if reading.possible:
        out["likeliest"] = reading.possible[0].text
    if not reading.answered:
        return out
    if reading.text is not None:
        out["text"] = reading.text
    elif reading.state is not None:
        out["state"] = reading.state.removeprefix("s") if entry["cls"] == "rotary" else reading.state
    elif reading.value is not None:
        out["reading"] = float(np.rad2deg(reading.value) % 360.0) if entry["cls"] == "handwheel" else reading.value
    return out


def blind_answer(job: Job, image: Image) -> dict[str, Any]:
    """Return the answer to a `blind` job."""
    width, height = (v / 1000 for v in job["panel_mm"])
    found = recognise(image, _knowledge(), plate_m=(width, height))
    return {"objects": [
        {"cls": c.kind, "center_px": [float(v) for v in c.centre_px], "score": c.confidence,
         "center_mm": [1000 * (float(c.centre_m[0]) + width / 2), 1000 * (height / 2 - float(c.centre_m[1]))]}
        for c in found if c.reason is None
    ]}  # fmt: skip


def lights_answer(job: Job, folder: Path) -> dict[str, Any]:
    """Return the answer to a `lights` job: the visible lights of the four."""
    off, on = (decode((folder / job[key]).read_bytes()) for key in ("off", "on"))
    blobs = find_lights(off, on)
    lights = np.array(job["lights_mm"], float) / 1000
    lights = np.column_stack([lights[:, 0] - lights[:, 0].mean(), lights[:, 1].mean() - lights[:, 1]])
    found = assign_lights(blobs, lights, image_size_px=(on.shape[1], on.shape[0]), least=2)
    return {
        "lights_px": [[float(u), float(v)] for (u, v), seen in zip(found.points_px, found.seen, strict=True) if seen]
    }


def status_answer(status: PatchReading, key: str) -> dict[str, Any]:
    """Return the answer to a `dial` or `display` job."""
    value = status.value if key == "reading" else status.text
    out = {"confidence": status.confidence, "reason": status.reason}
    return {**out, key: value} if status.answered else out


def answer(job: Job, folder: Path, *, least_confidence: float = ANSWER_AT) -> dict[str, Any]:
    """Return the answer to any job; if the whole job is refused, `refused` states the reason."""
    try:
        if job["mode"] == "lights":
            return lights_answer(job, folder)
        image = decode((folder / job["image"]).read_bytes())
        match job["mode"]:
            case "taught":
                return taught_answer(job, image, least_confidence=least_confidence)
            case "blind":
                return blind_answer(job, image)
            case "dial":
                status = read_dial(
                    image, (float(job["min"]), float(job["max"])), is_turn=bool(job["circular"]),
                    least_confidence=least_confidence,
                )  # fmt: skip
                return status_answer(status, "reading")
            case _:
                status = read_photographed_display(image, scene=bool(job["scene"]), least_confidence=least_confidence)
                return status_answer(status, "text")
    except CellError as error:
        return {"refused": error.what, "hint": error.hint}


@cache
def _knowledge() -> Knowledge:
    return load_knowledge()


def run(jobs: list[Job], folder: Path, *, timed: bool, least_confidence: float = ANSWER_AT) -> dict[str, Any]:
    """Return the answers by job id; the first job of every mode is run twice, so that compilation is not timed.

    Times are CPU times of one thread, so that other work on the machine does not count.
    """
    answers: dict[str, Any] = {}
    warm: set[str] = set()
    for job in jobs:
        if timed and job["mode"] not in warm:
            warm.add(job["mode"])
            answer(job, folder, least_confidence=least_confidence)
        started = time.process_time()
        answers[job["id"]] = answer(job, folder, least_confidence=least_confidence)
        if timed:
            answers[job["id"]]["ms"] = 1e3 * (time.process_time() - started)
    return answers


def main(arguments: list[str]) -> int:
    """Run the command line; return the exit status."""
    cv2.setNumThreads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="INPUTS.json OUT.json")
    parser.add_argument("--time", action="store_true", help="add milliseconds")
    parser.add_argument("--least-confidence", type=float, default=ANSWER_AT, metavar="X", help="0 to 1")
    asked = parser.parse_args(arguments)
    if not asked.files:
        from benchmarks.vision_report import report

        return report(DATA)
    if len(asked.files) != 2 or not 0.0 <= asked.least_confidence <= 1.0:
        parser.print_help()
        return 2
    source, target = asked.files
    try:
        jobs = json.loads(source.read_text(encoding="utf-8"))["jobs"]
    except (OSError, ValueError, KeyError) as error:
        print(f"{source} is no inputs file: {error}")
        return 2
    answers = run(jobs, _folder_of(source, jobs), timed=asked.time, least_confidence=asked.least_confidence)
    target.write_text(json.dumps(answers, indent=1), encoding="utf-8")
    return 0


def _folder_of(source: Path, jobs: list[Job]) -> Path:
    """Return the folder of the images: beside the inputs file, or in the shared data."""
    first = next((job.get("image") or job.get("on") for job in jobs), "")
    for folder in (source.parent, DATA / "synth_dev", DATA / "real"):
        if (folder / str(first)).exists():
            return folder
    return source.parent


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
