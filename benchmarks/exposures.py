"""Reads the simulated panel in light that changes: `python -m benchmarks.exposures [FIRST [COUNT]]`.

The light changes by a factor, which is simulated by an exposure that is wrong by as much. The panel is located, and every object
is read from close by: as it is seen, and with the further looks at other exposures that the service takes of what it does not
find, or cannot read. Results are judged by the simulator's truth. Prints a row for each factor.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.behind_cables import ANSWERS, BENCH, open_session, verdict
from hal.config import load_cell
from hal.devices import DeviceKind
from hal.errors import PerceptionError
from hal.simulated import ObjectTruth
from perception.vision import viewpoints
from perception.vision.reading import ObjectReading
from service.operations.acquisition import exposed
from service.operations.inspect import Inspection, inspect_here, look_close
from service.operations.locate import go_to_overview, locate_from_overview
from service.operations.session import Session

FIRST, COUNT = 11_000, 5
OFF_M = 0.004  # from where a panel counts as found in a wrong place
FACTORS = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)


def main(arguments: list[str]) -> int:
    """Print the table."""
    first = int(arguments[0]) if arguments else FIRST
    count = int(arguments[1]) if len(arguments) > 1 else COUNT
    straight, after, located = ({factor: Counter[str]() for factor in FACTORS} for _ in range(3))
    for seed in range(first, first + count):
        cell = load_cell(BENCH, seed=seed)
        with tempfile.TemporaryDirectory() as folder, open_session(cell, Path(folder)) as session:
            for factor in FACTORS:
                located[factor][_located(session, factor)] += 1
                for name, before, last in _judged(session, factor):
                    straight[factor][before] += 1
                    after[factor][last] += 1
                    if last != "right":
                        print(f"{seed}, light {factor:g}: {name} is {before}, then {last}", flush=True)
    print("| light | panel located: right, wrong, refused | objects as they are | with further looks |")
    print("| --- | --- | --- | --- |")
    for factor in FACTORS:
        told = (", ".join(str(counts[factor][one]) for one in ANSWERS) for counts in (located, straight, after))
        print(f"| {factor:g} | {' | '.join(told)} |")
    return 0


def _located(session: Session, factor: float) -> str:
    """Return the verdict on the place of the panel, which is located in light that is changed by a factor."""
    camera = session.first(DeviceKind.CAMERA)
    true = session.connection.device("arm").truth().base_from_panel_matrix
    before = session.known_panel()
    try:
        with exposed(session, camera, factor * session.connection.device(camera).capabilities().settings.exposure_s):
            go_to_overview(session)
            found = locate_from_overview(session).base_from_panel.parent_from_child
    except PerceptionError:
        session.world.believe_panel(before)
        return "refused"
    return "right" if np.linalg.norm(found.translation - true[:3, 3]) < OFF_M else "wrong"


def _judged(session: Session, factor: float) -> list[tuple[str, str, str]]:
    """Return name and verdicts of all objects, read in light that is changed by a factor, and with further looks."""
    camera = session.first(DeviceKind.CAMERA)
    right_s = session.connection.device(camera).capabilities().settings.exposure_s
    truth = {one.name: one for one in session.connection.device("arm").truth().objects}
    distance_m = viewpoints.reading_distance_m(session.lens())
    judged: list[tuple[str, str, str]] = []
    for centre_m, group in viewpoints.close_up_groups(session.panel.objects, session.lens(), distance_m):
        with exposed(session, camera, factor * right_s):
            last = _readings(session, group, partial(look_close, session, centre_m, group, distance_m=distance_m))
            before = _readings(session, group, partial(inspect_here, session, group))
        for name in group:
            seen, seen_last = (_verdict(session, truth[name], readings.get(name)) for readings in (before, last))
            judged.append((name, seen, seen_last))
    return judged


def _verdict(session: Session, truth: ObjectTruth, reading: ObjectReading | None) -> str:
    return "refused" if reading is None else verdict(reading, session.panel.object(truth.name), truth)


def _readings(session: Session, names: tuple[str, ...], read: Callable[[], Inspection]) -> dict[str, ObjectReading]:
    """Return what is read of objects without memory of earlier looks; nothing in a picture that does not show the panel."""
    for name in names:
        session.world.forget_reading(name)
    try:
        return read().readings
    except PerceptionError:
        return {}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
