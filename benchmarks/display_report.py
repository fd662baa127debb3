"""Reads drawn seven-segment displays: `python -m benchmarks.display_report [CASES]`; also part of `benchmarks.vision`.

Photographs of displays may not be published, so the lines on photographs are measured on drawings that imitate them;
real photographs may give other results. The readers were tuned on seeds from 1000 on; this benchmark uses seeds from 0.
"""

from __future__ import annotations

import sys
from functools import partial

import numpy as np

from benchmarks.display_drawing import LEVELS, PHOTOGRAPHS, DisplayCase, draw_photograph, draw_taught
from hal.panel import Display
from perception.vision.photographs.photo_display import read_photographed_display
from perception.vision.projection import PlateProjection, homography
from perception.vision.reading import PatchReading
from perception.vision.status.display import read_display
from perception.vision.status.reader import patch_of

CASES = 40
SURE = 0.8
PASS = {"cropped": 0.70, "scene": 0.50, "low contrast": 0.30}


def read_case(case: DisplayCase, *, known: bool) -> PatchReading:
    """Read a drawn display at its known place; `known`: the numbers of digits and decimals are taught."""
    w, h = 0.02 * case.size[0], 0.02 * case.size[1]
    plate = np.array([[-w / 2, h / 2], [w / 2, h / 2], [w / 2, -h / 2], [-w / 2, -h / 2]])
    view = PlateProjection(px_from_plate=homography(plate, case.corners_px), corners_m=plate)
    spec = Display(
        name="d", position_m=(0.0, 0.0), width_m=w + 0.002, height_m=h + 0.002, digits=case.digits,
        decimals=case.decimals, style="lcd" if case.is_dark else "led", minimum=-1e9, maximum=1e9,
    )  # fmt: skip
    return read_display(patch_of(case.image, case.image, view, spec, np.zeros(2)), spec, digits_taught=known)


def display_lines(count: int = CASES) -> None:
    """Print the fractions read exactly and of confident answers that are wrong, for every kind of drawing."""
    print("\ndisplays on OWN RENDERINGS (no photographs of displays can be given out): exact / sure (> 0.8) and wrong")
    for known in (True, False):
        for level in LEVELS:
            cases = (draw_taught(seed, level) for seed in range(count))
            _line(f"taught, {'digits known' if known else 'digits unknown'}, {level}",
                  [(case.text, read_case(case, known=known)) for case in cases])  # fmt: skip
    for kind in PHOTOGRAPHS:
        read = partial(read_photographed_display, scene=kind == "scene")
        drawn = (draw_photograph(seed, kind) for seed in range(count))
        _line(f"photograph-like, {kind}", [(case.text, read(case.image)) for case in drawn], PASS[kind])


def _line(what: str, answers: list[tuple[str, PatchReading]], least: float | None = None) -> None:
    right = float(np.mean([status.text == text for text, status in answers]))
    bad = float(
        np.mean([status.answered and status.text != text and status.confidence > SURE for text, status in answers])
    )
    wanted = "" if least is None else f" (real photographs: >= {least:g})"
    print(f"  {what:44s} {right:.3f} / {bad:.3f}{wanted}")


if __name__ == "__main__":
    display_lines(int(sys.argv[1]) if len(sys.argv) > 1 else CASES)
