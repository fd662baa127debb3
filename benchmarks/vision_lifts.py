"""Teaches the buttons of two lift panels by five clicks each and finds the others: `python -m benchmarks.vision_lifts [SEED]`.

The photographs lie beside the repository; both were looked at. Four clicks give the plate, whose size is guessed from the round
buttons and then varied. Prints recall and precision per photograph and guess, and what is named before anything is taught.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hal.arrays import Array, Image
from hal.errors import CellError
from perception.vision.image import decode
from perception.vision.knowledge import Knowledge
from perception.vision.knowledge_files import load_knowledge
from perception.vision.projection import PlateProjection, homography
from perception.vision.teaching.lesson import check, teach

REAL = Path(__file__).resolve().parents[2] / "shared" / "data" / "vision" / "real"
KIND = "lift_button"
CLICKS, ROUNDS = 5, 4
SCALES = (0.6, 0.8, 1.0, 1.25, 1.5)
NEAR_PX, MARGIN_PX = 25.0, 8.0
SURE = 0.8
RECALL, PRECISION = 0.90, 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Lift:
    """A photographed panel: the corners of its plate (upper left first and clockwise), and its size by the round buttons."""

    name: str
    corners_px: tuple[tuple[int, int], ...]
    plate_m: tuple[float, float]
    buttons_px: tuple[tuple[int, int], ...] = ()

    def image(self) -> Image:
        """Return the photograph."""
        return decode((REAL / self.name).read_bytes())

    def middles_px(self) -> Array:
        """Return the middles (N, 2) of the buttons on the plate."""
        labelled = json.loads((REAL / "truth.json").read_text(encoding="utf-8"))[self.name].get(
            "buttons_px", self.buttons_px
        )
        middles = np.array([button[:2] for button in labelled], float)
        outline = np.array(self.corners_px, np.float32)
        return middles[[cv2.pointPolygonTest(outline, (float(u), float(v)), True) > MARGIN_PX for u, v in middles]]

    def view(self, scale: float) -> tuple[PlateProjection, tuple[float, float]]:
        """Return the view of the plate, and its size, for a guess that is wrong by a scale."""
        width, height = self.plate_m[0] * scale, self.plate_m[1] * scale
        corners_m = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * [width / 2, height / 2]
        H = homography(corners_m, np.array(self.corners_px, float))
        return PlateProjection(px_from_plate=H, corners_m=corners_m), (width, height)


LIFTS = (
    Lift(
        name="elevator_0.jpg",
        corners_px=((326, 18), (713, 18), (766, 607), (387, 607)),
        plate_m=(0.184, 0.24),
        buttons_px=(
            (451, 118), (604, 103), (466, 223), (613, 205), (481, 323), (622, 299), (495, 416), (633, 390), (505, 505), (640, 478),
            (648, 560),
        ),
    ),
    Lift(name="elevator_2.jpg", corners_px=((60, 20), (1640, 20), (1480, 1075), (190, 1075)), plate_m=(0.30, 0.24)),
)  # fmt: skip


def taught(lift: Lift, scale: float, clicks_px: Array) -> Knowledge:
    """Return the shipped knowledge with the clicked buttons; a click without an outline teaches nothing."""
    knowledge = load_knowledge()
    view, plate_m = lift.view(scale)
    for u, v in clicks_px:
        try:
            lesson = teach(lift.image(), knowledge, kind=KIND, clicks_px=[(u, v)], plate_m=plate_m, view=view)
        except CellError:
            continue
        knowledge = lesson.knowledge
    return knowledge


def found(lift: Lift, scale: float, knowledge: Knowledge) -> tuple[int, int, int]:
    """Return how many buttons are found, how many there are, and how many other things are named."""
    view, plate_m = lift.view(scale)
    named = [one for one in check(lift.image(), knowledge, plate_m=plate_m, view=view) if one.reason is None]
    middles = lift.middles_px()
    away = np.array([np.linalg.norm(middles - one.centre_px, axis=1) for one in named]).reshape(-1, len(middles))
    right = np.array([one.kind == KIND for one in named], bool) & (away.min(axis=1, initial=np.inf) < NEAR_PX)
    return len(set(away.argmin(axis=1)[right].tolist())), len(middles), int((~right).sum())


def surely_named(lift: Lift, scale: float) -> list[str]:
    """Return what is named with a confidence of `SURE` or more while no button is taught."""
    view, plate_m = lift.view(scale)
    seen = check(lift.image(), load_knowledge(), plate_m=plate_m, view=view)
    return [f"{one.kind} {one.confidence:.2f}" for one in seen if one.reason is None and one.confidence >= SURE]


def main(arguments: list[str]) -> int:
    """Print a row per photograph and guess; return 1 if a pass line is missed."""
    random = np.random.default_rng(int(arguments[0]) if arguments else 5)
    print("| photograph | size | found | recall | others | precision | surely named before |")
    print(f"|{' --- |' * 7}")
    total = np.zeros(3, int)
    before: list[str] = []
    for lift in LIFTS:
        for scale in SCALES:
            clicks = [random.choice(lift.middles_px(), CLICKS, replace=False) for _ in range(ROUNDS)]
            hits, there, others = np.sum([found(lift, scale, taught(lift, scale, one)) for one in clicks], axis=0)
            sure = surely_named(lift, scale)
            before, total = before + sure, total + np.array((hits, there, others))
            print(
                f"| {lift.name} | {scale:g} | {hits} of {there} | {hits / there:.3f} | {others} |"
                f" {hits / max(hits + others, 1):.3f} | {', '.join(sure) or '-'} |", flush=True,
            )  # fmt: skip
    recall, precision = total[0] / total[1], total[0] / max(total[0] + total[2], 1)
    print(f"recall {recall:.3f} (pass: {RECALL}), precision {precision:.3f} (pass: {PRECISION})")
    print(f"surely named before anything is taught: {len(before)} (pass: 0)")
    return int(recall < RECALL or precision < PRECISION or bool(before))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
