"""Reads the simulated panel in light that changes: `python -m benchmarks.exposures [FIRST [COUNT]]`.

The panel of each cell is located in the right light. Then the light changes by a factor, which is simulated by an exposure that
is wrong by as much. Every object is read from close by: as it is seen, and with the further looks at other exposures that the
service takes of what it cannot read. Results are judged by the simulator's truth. Prints a row for each factor, and the share
of the refused objects that are right after the further looks.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks.behind_cables import ANSWERS, BENCH, open_session, verdict
from hal.config import load_cell
from hal.devices import DeviceKind
from hal.errors import NotObservable
from hal.simulated import ObjectTruth
from perception.vision import viewpoints
from perception.vision.reading import ObjectReading
from service.operations.acquisition import exposed
from service.operations.inspect import Inspection, inspect_here, look_close
from service.operations.session import Session

FIRST, COUNT = 11_000, 5
FACTORS = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)


def main(arguments: list[str]) -> int:
    """Print the table."""
    first = int(arguments[0]) if arguments else FIRST
    count = int(arguments[1]) if len(arguments) > 1 else COUNT
    straight, after = ({factor: Counter[str]() for factor in FACTORS} for _ in range(2))
    for seed in range(first, first + count):
        cell = load_cell(BENCH, seed=seed)
        with tempfile.TemporaryDirectory() as folder, open_session(cell, Path(folder)) as session:
            for factor in FACTORS:
                for name, before, last in _judged(session, factor):
                    straight[factor][before] += 1
                    after[factor][last] += 1
                    if last != "right":
                        print(f"{seed}, light {factor:g}: {name} is {before}, then {last}", flush=True)
    print("| light | as it is: right, wrong, refused | with further looks |\n| --- | --- | --- |")
    for factor in FACTORS:
        told = (", ".join(str(counts[factor][one]) for one in ANSWERS) for counts in (straight, after))
        print(f"| {factor:g} | {' | '.join(told)} |")
    return 0


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
    """Return what is read of objects without memory of earlier looks; nothing in a picture that is black or saturated."""
    for name in names:
        session.world.forget_reading(name)
    try:
        return read().readings
    except NotObservable:
        return {}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
