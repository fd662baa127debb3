"""Reads the simulated panel with cables in front of it, from straight ahead and with views from the sides.

`python -m benchmarks.behind_cables [FIRST [COUNT]]`: each cell has two random cables drawn from its seed. Every object
is viewed from close by, and those that cannot be read also from the sides. Results are judged by the simulator's truth.
The last line counts the objects that cannot be read from straight ahead, and those of them that are right after at most two
further looks.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.config import CableSection, Cell, SimulationSection, load_cell
from hal.errors import CellError
from hal.panel import PanelObject, Shown
from hal.simulated import ObjectTruth
from perception.vision.reading import ObjectReading
from service.evaluate import shown_of
from service.operations.inspect import close_ups, look_past
from service.operations.locate import ensure_space_is_known, go_to_overview, locate_from_overview
from service.operations.session import OperationContext, Session
from service.processes.cell import CellRuntime
from service.processes.connection import LocalConnection
from service.tasks.model import Task
from service.tasks.store import TaskContext
from service.world_model import WorldModel

BENCH = Path(__file__).resolve().parents[1] / "cells" / "bench.toml"
FIRST, COUNT = 1000, 10
ANSWERS = ("right", "wrong", "refused")
MOST_LOOKS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """The verdicts of a cell.

    Attributes:
        straight, after: from straight ahead, and after the looks from the sides.
        soon: of the objects that were refused at first, how many were `right` within `MOST_LOOKS`, and the others.
        told: a line for each wrong answer, and for each object that was refused at first.
    """

    straight: Counter[str]
    after: Counter[str]
    soon: Counter[str]
    told: list[str]


def with_cables(cell: Cell, *cables: CableSection) -> Cell:
    """Return the same cell with cables in front of its panel."""
    return cell.model_copy(
        update={"file": cell.file.model_copy(update={"simulation": SimulationSection(cables=cables)})}
    )


def drawn_cable(random: np.random.Generator, panel_half_m: tuple[float, float]) -> CableSection:
    """Draw a cable from border to border with one bend, random radius and gray, 28 to 60 mm in front of the plate."""
    w, h = panel_half_m
    across = random.uniform(-0.85, 0.85, 3)
    along = [-1.35, float(random.uniform(-0.6, 0.6)), 1.35]
    radius_m = float(random.uniform(0.002, 0.007))
    heights = np.maximum(random.uniform(0.012, 0.060, 3), 0.028 + radius_m)
    upright = random.random() < 0.6
    points = [
        (w * (a if upright else b), h * (b if upright else a), z)
        for a, b, z in zip(across, along, heights, strict=True)
    ]
    return CableSection(
        path_m=tuple((float(x), float(y), float(z)) for x, y, z in points),
        radius_m=radius_m,
        gray=float(random.choice([0.05, 0.1, 0.3, 0.6])),
    )


@contextmanager
def open_session(cell: Cell, folder: Path) -> Iterator[Session]:
    """Yield a session of a cell that runs in this process, after its panel has been located.

    Raises:
        CellError: the panel was not found.
    """
    runtime = CellRuntime.start(cell, is_latched=lambda: False)
    try:
        session = Session(
            context=OperationContext(
                connection=LocalConnection(cell, runtime.objects, close=runtime.close),
                task=TaskContext(Task(id="cables", verb="inspect", request={}, moves=True), folder / "artefacts"),
                runs_dir=folder / "runs",
                world=WorldModel(),
            )
        )
        go_to_overview(session)
        locate_from_overview(session)
        yield session
    finally:
        runtime.close()


def verdict(reading: ObjectReading, spec: PanelObject, truth: ObjectTruth) -> str:
    """Return `right`, `wrong` or `refused`."""
    if not reading.answered:
        return "refused"
    is_right = spec.is_right(Shown(value=reading.value, state=reading.state, text=reading.text), shown_of(truth))
    return "right" if is_right else "wrong"


def judge_cell(seed: int, folder: Path) -> Judged:
    """Read a cell behind cables from straight ahead, then from the sides."""
    cell = load_cell(BENCH, seed=seed)
    random = np.random.default_rng(seed)
    half = (cell.panel.width_m / 2, cell.panel.height_m / 2)
    cell = with_cables(cell, drawn_cable(random, half), drawn_cable(random, half))
    judged = Judged(straight=Counter(), after=Counter(), soon=Counter(), told=[])
    with open_session(cell, folder) as session:
        ensure_space_is_known(session)  # as in every mission that touches the panel
        first = close_ups(session, [panel_object.name for panel_object in cell.panel.objects])
        found = look_past(session, first)
        truth = {panel_object.name: panel_object for panel_object in session.connection.device("arm").truth().objects}
        for spec in cell.panel.objects:
            last = found.readings[spec.name]
            before = first.readings[spec.name]
            judged.straight[ahead := verdict(before, spec, truth[spec.name])] += 1
            judged.after[told := verdict(last, spec, truth[spec.name])] += 1
            if told == "wrong":
                shown = truth[spec.name]
                said = last.text or last.state or last.value
                judged.told.append(
                    f"{spec.name} is {shown.text or shown.state or shown.value}, read {said} at {last.confidence:.2f}"
                )
            if ahead == "refused":
                looks = [
                    one.title
                    for one in found.pictures[len(first.pictures) :]
                    if spec.name in {r.name for r in one.readings}
                ]
                judged.soon["right" if told == "right" and len(looks) <= MOST_LOOKS else "others"] += 1
                sides = ", ".join(title.rpartition(" from ")[2] for title in looks) or "no look"
                judged.told.append(f"{spec.name}: {before.reason}; then {sides}: {told} ({last.reason})")
    return judged


def main(arguments: list[str]) -> int:
    """Entry point; returns the exit status."""
    first = int(arguments[0]) if arguments else FIRST
    count = int(arguments[1]) if len(arguments) > 1 else COUNT
    straight, after, soon = Counter[str](), Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(first, first + count):
            try:
                judged = judge_cell(seed, Path(folder) / str(seed))
            except CellError as error:  # a cable covers a border light, or the arm ran into one
                print(f"{seed}: {error}")
                continue
            straight, after, soon = straight + judged.straight, after + judged.after, soon + judged.soon
            told = f"{judged.straight['right']} right, then {judged.after['right']} of {judged.after.total()}"
            print(f"{seed}: from ahead {told}", *judged.told, sep="\n  ", flush=True)
    for name, counts in (("from straight ahead", straight), ("with looks from the sides", after)):
        print(f"{name:26s} " + ", ".join(f"{what} {counts[what] / max(counts.total(), 1):.3f}" for what in ANSWERS))
    print(f"{straight.total()} objects of {count} cells from seed {first}")
    print(f"right within {MOST_LOOKS} further looks: {soon['right']} of {soon.total()}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
