"""Measures blind recognition of the simulated cell's panel, and teaches the looks that ship with that cell.

`python -m benchmarks.vision_simulated [FIRST LAST]` sends POST /v1/recognise (blind) for every seed, before and after
the panel is located, compares the answers with the simulator's truth, and prints recall, precision and reliability.
With `--teach FOLDER` every seed teaches by POST /v1/learn, and the looks that are not shipped yet are written into
FOLDER. `cells/knowledge/bench` was made in this way from seeds 1 to 6.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cell import clear_stop, run_to_end
from hal.config import Cell, load_cell
from perception.vision.knowledge_files import load_knowledge, write_kind
from service.client import Client
from service.serve import Options, Panelwright
from simbackend.draws import Draws
from simbackend.panel_state import build

ROOT = Path(__file__).resolve().parents[1]
FIRST, LAST = 13, 18
BINS = 8
BLIND = {"mode": "blind"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """Accepted candidate: its kind, its confidence, the object that is there (None if none), and its distance."""

    kind: str
    confidence: float
    there: str | None
    is_right: bool
    off_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Overview:
    """One blind overview with its judged candidates."""

    answers: tuple[Answer, ...]
    missed: tuple[str, ...]
    objects: int


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge or teach."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=int, nargs="?", default=FIRST)
    parser.add_argument("last", type=int, nargs="?", default=LAST)
    parser.add_argument("--cell", type=Path, default=ROOT / "cells/bench.toml")
    parser.add_argument("--shipped", action="store_true", help="with the shipped looks alone")
    parser.add_argument("--teach", type=Path, metavar="FOLDER")
    given = parser.parse_args(arguments)
    seeds = range(given.first, given.last + 1)
    if given.teach is not None:
        teach(given.cell, seeds, given.teach)
        return 0
    seen = []
    for seed in seeds:
        cell = load_cell(given.cell, seed=seed)
        seen += look(without_looks(cell) if given.shipped else cell, seed)
    print("\n".join(lines(seen)))
    return 0


def look(cell: Cell, seed: int) -> list[Overview]:
    """Return the blind overviews of a seed before and after the panel is located."""
    with tempfile.TemporaryDirectory() as folder, running(cell, Path(folder)) as client:
        before = run_to_end(client, "/v1/recognise", BLIND)["result"]["candidates"]
        run_to_end(client, "/v1/panel-pose", {})
        after = run_to_end(client, "/v1/recognise", BLIND)["result"]["candidates"]
    return [judged(cell, seed, candidates) for candidates in (before, after)]


def judged(cell: Cell, seed: int, candidates: Sequence[dict[str, Any]]) -> Overview:
    """Compare candidates with the simulator's objects: the kind must be right, and the distance within half a side."""
    built = {each.panel_object.name: each for each in build(cell.panel, Draws(seed))}
    places = {name: np.add(each.panel_object.position_m, each.offset_m) for name, each in built.items()}
    answers, found = [], set()
    for candidate in candidates:
        if candidate["reason"] is not None:
            continue
        away = {name: float(np.linalg.norm(place - candidate["centre_m"])) for name, place in places.items()}
        name = min(away, key=lambda key: away[key])
        face = built[name].panel_object.face
        is_there = away[name] < max(face.half_width_m, face.half_height_m)
        is_right = is_there and built[name].panel_object.kind == candidate["kind"]
        if is_right:
            found.add(name)
        answers.append(
            Answer(
                kind=candidate["kind"],
                confidence=candidate["confidence"],
                there=name if is_there else None,
                is_right=is_right,
                off_m=away[name],
            )
        )
    missed = tuple(name for name in built if name not in found)
    return Overview(answers=tuple(answers), missed=missed, objects=len(built))


def lines(seen: Sequence[Overview]) -> list[str]:
    """Return recall, precision, reliability, and which kinds were missed or confused."""
    answers = [answer for overview in seen for answer in overview.answers]
    objects = sum(overview.objects for overview in seen)
    recall = 1.0 - sum(len(overview.missed) for overview in seen) / objects
    precision = float(np.mean([answer.is_right for answer in answers]))
    pairs = np.array(sorted((answer.confidence, answer.is_right) for answer in answers), float)
    parts = np.array_split(pairs, BINS)
    error = sum(len(part) / len(pairs) * abs(float(part[:, 0].mean() - part[:, 1].mean())) for part in parts)
    off_mm = [1e3 * answer.off_m for answer in answers if answer.is_right]
    missed = Counter(name for overview in seen for name in overview.missed)
    wrong = Counter(f"{answer.kind} at {answer.there or 'nothing'}" for answer in answers if not answer.is_right)
    return [
        f"{len(seen)} blind overviews of the simulated panel, {objects} objects",
        f"recall {recall:.3f}  precision {precision:.3f}  expected calibration error {error:.3f}",
        f"middles off by {np.median(off_mm):.1f} mm (median), {np.quantile(off_mm, 0.95):.1f} mm (95 %)",
        f"missed: {_counts(missed)}",
        f"wrong: {_counts(wrong)}",
    ]


def teach(cell_path: Path, seeds: Sequence[int], folder: Path) -> None:
    """Learn from two overviews of every seed, and write the looks that are not shipped."""
    with tempfile.TemporaryDirectory() as runs:
        for seed in seeds:
            with running(without_looks(load_cell(cell_path, seed=seed)), Path(runs)) as client:
                run_to_end(client, "/v1/panel-pose", {})
                for body in (
                    {"move": False},
                    {"move": True},
                ):  # from the distance for an unknown panel, then from nearer
                    learned = run_to_end(client, "/v1/learn", body)["result"]
                    print(f"seed {seed}: {sum(learned['added'].values())} looks; left out: {learned['left_out']}")
        taught, shipped = load_knowledge(Path(runs) / "knowledge"), load_knowledge()
    folder.mkdir(parents=True, exist_ok=True)
    for kind in taught.kinds:
        known = shipped.kind(kind.name)
        own = kind if known is None else kind.of(np.arange(len(known.looks), len(kind.looks)))
        write_kind(replace(own, taught_by="benchmarks/vision_simulated"), folder)


def without_looks(cell: Cell) -> Cell:
    """Return the cell with the shipped looks only."""
    section = cell.file.cell.model_copy(update={"knowledge": None})
    return cell.model_copy(update={"file": cell.file.model_copy(update={"cell": section})})


@contextmanager
def running(cell: Cell, runs: Path) -> Iterator[Client]:
    """Yield a client of a service that runs the cell."""
    panelwright = Panelwright(cell, Options(port=0, runs_dir=runs))
    panelwright.start()
    try:
        client = Client(url=panelwright.url, timeout_s=120.0)
        clear_stop(client)
        yield client
    finally:
        panelwright.close()


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counter.most_common()) or "nothing"


if __name__ == "__main__":
    raise SystemExit(main())
