"""Runs the real control thread over fake devices beside a service and notes when each set-point is sent.

`python -m benchmarks.control_probe LATCH_FILE RATE_HZ` is the process of its own; `ControlProbe` starts and asks it. The thread,
its filter, its guards and its latch are those of a cell; only the devices answer at once and have no physics. It reads the stop
latch of the service, so that it brakes when that is stopped.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.config import load_cell
from hal.gc_freeze import freeze_loaded
from hal.motion import Hold, JointTrajectory
from service.processes.cell import SWITCH_S, CellRuntime
from service.processes.latch import Latch

SPAN_RAD = 1.0
MOTION_S = 20.0
MISSED = 1.5  # periods: a set-point that comes later was missed
REALTIME = ("chrt", "-r", "10")
LEAST_RAD = 1e-9
SHRINKS = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Ticks:
    """Ticks of a loop: how many, the share that was missed, and the quantiles of the time by which they were off."""

    count: int
    missed: float
    p50_s: float
    p99_s: float
    p999_s: float

    @classmethod
    def of(cls, stamps_s: Sequence[float], period_s: float) -> Ticks:
        """Return the figures of the times at which the ticks came."""
        gaps = np.diff(stamps_s)
        off = np.abs(gaps - period_s)
        missed = float(np.mean(gaps > MISSED * period_s))
        p50, p99, p999 = (float(x) for x in np.quantile(off, (0.5, 0.99, 0.999)))
        return cls(count=len(gaps), missed=missed, p50_s=p50, p99_s=p99, p999_s=p999)


class ControlProbe:
    """The process of the probe, asked by lines."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def _told(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def _ask(self, line: str) -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        return self._told()

    def begin_motion(self) -> None:
        """Begin a motion and wait until the arm moves."""
        assert self._ask("move") == "moving"

    def braking_s(self, after_s: float) -> float:
        """Wait for the end of the motion by the stop; returns the monotonic time of its first set-point that brakes."""
        return next(float(at_s) for at_s in self._told() if at_s > after_s)

    def ticks(self, seconds: float) -> Ticks:
        """Hold still for some seconds and return the ticks of the loop."""
        return Ticks(**self._ask(f"ticks {seconds}"))


@contextlib.contextmanager
def control_probe(latch: Path, *, rate_hz: float, prefix: Sequence[str] = ()) -> Iterator[ControlProbe]:
    """Start a probe, and end it.

    Args:
        prefix: command before that of the probe, such as `REALTIME`.
    """
    from tests.service.conftest import FAKES

    root = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join([str(FAKES), root])
    command = [*prefix, sys.executable, "-m", "benchmarks.control_probe", str(latch), str(rate_hz)]
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    # In the session of its parent, as a cell process is.
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, process_group=0
    ) as process:
        probe = ControlProbe(process)
        assert probe._told() == "ready"
        try:
            yield probe
        finally:
            assert process.stdin is not None
            process.stdin.close()


class _Notes:
    """What the fake arm is sent: time and first joint of each set-point."""

    def __init__(self) -> None:
        self.stamps_s: list[float] = []
        self.joint_rad: list[float] = []

    def clear(self) -> None:
        """Forget everything."""
        self.stamps_s, self.joint_rad = [], []


def braking_stamps_s(stamps_s: Sequence[float], joint_rad: Sequence[float]) -> Sequence[float]:
    """Return the times of the last set-points of a joint, whose steps only shrink, and of those at rest behind them."""
    steps = np.abs(np.diff(joint_rad))
    first = len(steps) - 1
    while first > 0 and steps[first] < LEAST_RAD:
        first -= 1  # at rest
    while first > 0 and steps[first] < SHRINKS * steps[first - 1]:
        first -= 1  # braking; a late tick before the stop may look like it
    return stamps_s[first + 2 :]


def long_motion(begin_rad: NDArray[np.float64]) -> JointTrajectory:
    """Return a motion of the first joint that goes on until something ends it."""
    end_rad = begin_rad.copy()
    end_rad[0] += SPAN_RAD if begin_rad[0] < 0.0 else -SPAN_RAD
    return JointTrajectory(
        name="until the stop",
        times_s=np.array([0.0, MOTION_S]),
        positions_rad=np.array([begin_rad, end_rad]),
        velocities_rad_per_s=np.zeros((2, 6)),
    )


def main() -> None:
    """Run the probe until its input ends."""
    import panelwright_fakes  # type: ignore[import-not-found]  # on the path that `control_probe` sets

    from tests.service.conftest import _write

    notes = _Notes()
    send = panelwright_fakes.FakeArm.command_position

    def noted(self: Any, position_rad: Any, *, deadline: Any) -> Any:
        notes.stamps_s.append(time.monotonic())
        notes.joint_rad.append(float(position_rad[0]))
        return send(self, position_rad, deadline=deadline)

    panelwright_fakes.FakeArm.command_position = noted
    sys.setswitchinterval(SWITCH_S)
    out = sys.stdout
    rate_hz = float(sys.argv[2])
    with tempfile.TemporaryDirectory() as folder, Latch(Path(sys.argv[1])) as latch:
        cell = load_cell(_write(Path(folder), robot=True, mode="real"))
        cell.file.cell.__dict__["control_rate_hz"] = rate_hz
        runtime = CellRuntime.start(cell, is_latched=latch.is_set)
        mover = runtime.objects["cell.mover"]
        try:
            freeze_loaded()
            print(json.dumps("ready"), file=out, flush=True)
            for line in sys.stdin:
                word, _, rest = line.strip().partition(" ")
                notes.clear()
                if word == "ticks":
                    mover.execute(Hold(name="ticks", duration_s=float(rest)))
                    told = Ticks.of(notes.stamps_s, 1.0 / rate_hz)
                    print(json.dumps({name: getattr(told, name) for name in Ticks.__slots__}), file=out, flush=True)
                else:
                    _move(mover, notes, out)
        finally:
            runtime.close()


def _move(mover: Any, notes: _Notes, out: Any) -> None:
    """Move until the stop; tell when the motion runs, and when it began to brake."""
    run = threading.Thread(target=mover.execute, args=(long_motion(mover.state().position_rad),))
    run.start()
    while len(notes.stamps_s) < 100:
        time.sleep(0.01)
    print(json.dumps("moving"), file=out, flush=True)
    run.join()
    print(json.dumps(braking_stamps_s(notes.stamps_s, notes.joint_rad)), file=out, flush=True)


if __name__ == "__main__":
    main()
