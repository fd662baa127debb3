"""Held-out panels: blind recognition and taught reading of drawn overviews not used for teaching or tuning, by class.

`python -m benchmarks.vision_held_out [FIRST [COUNT [LEVEL]]]` also lists every wrong reading of a level; the benchmark
is part of `benchmarks.vision`. The drawings follow the data's README (see `panel_scene`) but differ from its files in
proportions, letters, values and disturbances, so the shipped appearance data do not contain them. The hard seeds 0 to
199 were used while developing the readers.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from benchmarks.panel_scene import LEVELS, PANEL_MM, Scene, draw_scene
from benchmarks.vision import blind_answer, taught_answer
from hal.errors import CellError

FIRST, COUNT = 1000, 12
SURE = 0.8
POINTERS = ("gauge", "panel_meter")
STATES = ("toggle", "rotary", "button", "lamp", "lever")
PASS = {"pointer": (0.98, 0.95, 0.85), "display": (0.95, 0.90, 0.75), "state": (0.97, 0.95, 0.85)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """Readable object of a drawn panel and its reading; `error` in % of full scale, 100 for a wrong text or state.

    `undecidable`: cables hide every difference to another number, so that a refusal is right, as in the data's README.
    """

    kind: str
    truth: str
    given: str
    error: float
    answered: bool
    confidence: float
    reason: str
    undecidable: bool

    @property
    def is_right(self) -> bool:
        """Whether the value is within 2 % of full scale, or the state or text is exact."""
        return self.error <= 2.0 if self.answered else self.undecidable


def read_scene(scene: Scene) -> list[Judged]:
    """Read the readable objects of a scene as those of a taught panel."""
    try:
        answers = {entry["id"]: entry for entry in taught_answer(scene.taught, scene.image)["objects"]}
    except CellError as error:
        answers = {panel_object["id"]: {"reason": error.what} for panel_object in scene.truth["objects"]}
    return [
        _judged(panel_object, answers[panel_object["id"]])
        for panel_object in scene.truth["objects"]
        if panel_object["readable"]
    ]


def _judged(panel_object: dict[str, Any], answer: dict[str, Any]) -> Judged:
    key = "text" if "text" in panel_object else "state" if "state" in panel_object else "reading"
    error = 100.0
    if key in answer and key == "reading":
        span = panel_object["max"] - panel_object["min"]
        off = abs(answer[key] - panel_object[key])
        error = 100.0 * (min(off % span, span - off % span) if panel_object.get("circular") else off) / span
    elif key in answer:
        error = 0.0 if str(answer[key]) == str(panel_object[key]) else 100.0
    return Judged(
        kind=panel_object["cls"], truth=str(panel_object[key]), given=str(answer.get(key, "")), error=error, answered=key in answer,
        confidence=float(answer.get("confidence", 0.0)), reason=answer.get("reason") or "",
        undecidable=panel_object.get("undecidable", False),
    )  # fmt: skip


def found_blind(scene: Scene) -> tuple[int, int, int]:
    """Recognise a scene blind; return the numbers of objects found, of objects reported, and of those half visible."""
    there = [panel_object for panel_object in scene.truth["objects"] if panel_object["visible"] >= 0.5]
    hidden = [panel_object for panel_object in scene.truth["objects"] if panel_object["visible"] < 0.5]
    try:
        given = blind_answer({"panel_mm": list(PANEL_MM)}, scene.image)["objects"]
    except CellError:
        return 0, 0, len(there)
    given = [entry for entry in given if not any(_is_near(entry, panel_object) for panel_object in hidden)]
    right = [
        any(_is_near(entry, panel_object) and entry["cls"] == panel_object["cls"] for entry in given)
        for panel_object in there
    ]
    return sum(right), len(given), len(there)


def _is_near(entry: dict[str, Any], panel_object: dict[str, Any]) -> bool:
    off = np.linalg.norm(np.subtract(entry["center_px"], panel_object["center_px"]))
    return bool(off <= 0.5 * max(panel_object["bbox_px"][2:]))


def held_out_lines(first: int = FIRST, count: int = COUNT) -> list[str]:
    """Return the fractions on drawn panels of all levels, one line each with its pass line."""
    scenes = {level: [draw_scene(seed, level) for seed in range(first, first + count)] for level in LEVELS}
    rows = {level: [row for scene in drawn for row in read_scene(scene)] for level, drawn in scenes.items()}
    blind = {level: np.sum([found_blind(scene) for scene in drawn], axis=0) for level, drawn in scenes.items()}
    lines = [
        f"drawn panels, {count} of each level, seeds from {first}; nothing was taught on them (easy / medium / hard)"
    ]
    lines.append(_line("blind recall", [blind[x][0] / blind[x][2] for x in LEVELS], (0.95, 0.90, 0.75)))
    lines.append(_line("blind precision", [blind[x][0] / max(blind[x][1], 1) for x in LEVELS], (0.97, 0.95, 0.90)))
    for what, kinds, key in (
        ("gauge and panel meter within 2 % FS", POINTERS, "pointer"), ("displays exact", ("display",), "display"),
        ("states right", STATES, "state"),
    ):  # fmt: skip
        shares = [float(np.mean([r.is_right for r in rows[level] if r.kind in kinds])) for level in LEVELS]
        lines.append(_line(what, shares, PASS[key]))
    wrong = [_sure_wrong(rows[level]) for level in LEVELS]
    return [*lines, f"  {'sure (> 0.8) and wrong':38s} {' / '.join(f'{share:.3f}' for share in wrong)}"]


def _line(what: str, shares: list[float], passes: tuple[float, ...]) -> str:
    good = "pass" if all(s >= p for s, p in zip(shares, passes, strict=True)) else "below"
    return f"  {what:38s} {' / '.join(f'{s:.3f}' for s in shares)}  (>= {' / '.join(f'{p:g}' for p in passes)}) {good}"


def _sure_wrong(rows: Iterable[Judged]) -> float:
    return float(np.mean([r.answered and not r.is_right and r.confidence > SURE for r in rows]))


def by_kind(rows: list[Judged]) -> list[str]:
    """Return one line per kind (count, right, wrong, confidently wrong), then one line per wrong reading."""
    lines = []
    for kind in sorted({row.kind for row in rows}):
        of_kind = [row for row in rows if row.kind == kind]
        right = float(np.mean([row.is_right for row in of_kind]))
        wrong = float(np.mean([row.answered and not row.is_right for row in of_kind]))
        lines.append(
            f"  {kind:12s} {len(of_kind):4d}  right {right:.3f}  wrong {wrong:.3f}  sure {_sure_wrong(of_kind):.3f}"
        )
    return lines + [
        f"  {row.kind} {row.truth} read {row.given or '-'} at {row.confidence:.2f} {row.reason}"
        for row in rows
        if not row.is_right
    ]


def main(arguments: list[str]) -> int:
    """Run the command line; return the exit status."""
    cv2.setNumThreads(1)
    first, count = int(arguments[0]) if arguments else FIRST, int(arguments[1]) if len(arguments) > 1 else COUNT
    if len(arguments) > 2:
        rows = [row for seed in range(first, first + count) for row in read_scene(draw_scene(seed, arguments[2]))]
        print("\n".join(by_kind(rows)))
    else:
        print("\n".join(held_out_lines(first, count)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
