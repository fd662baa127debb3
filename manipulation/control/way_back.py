"""The way back: what an arm does that has lost its client, a device or the service and is to go back the way it came."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hal.arrays import Array
from hal.clock import Clock
from hal.errors import CellError
from hal.motion import CellSignals, JointTrajectory, MotionLimits, MotionReport

BACK_M = 0.10  # of the tip; further away nothing is touched any more
BACK_M_PER_S = 0.05
BACK_RAD_PER_S = 0.3
LONGEST_S = 8.0  # without a service, whose processes end soon
THIN_RAD = 0.01  # between two points of the way back
GAP_RAD = 0.05  # between two motions: somebody has moved the arm
TRAIL_MOTIONS = 20
log = logging.getLogger(__name__)


class Trail:
    """The way of the arm in its newest motions, the newest last."""

    def __init__(self) -> None:
        self._logs: deque[tuple[Array, Array]] = deque(maxlen=TRAIL_MOTIONS)
        self._here_rad: Array | None = None

    def add(self, report: MotionReport) -> None:
        """Note the way of a motion; the way before it counts no more if it began elsewhere."""
        positions_rad = report.log.positions_rad
        is_gap = self._here_rad is not None and len(positions_rad) > 0
        if is_gap and float(np.abs(positions_rad[0] - self._here_rad).max()) > GAP_RAD:
            self._logs.clear()
        self._logs.append((positions_rad, report.log.tip_m))
        self._here_rad = report.position_rad

    def way_back(self, limits: MotionLimits) -> JointTrajectory | None:
        """Return a slow motion back along the trail, at most `BACK_M` of the tip; None when the arm has not moved.

        It needs the arm only, and the force limit of a transfer ends it.

        Args:
            limits: of the motion that was lost, which hold on the way back, too.
        """
        speeds = (BACK_M_PER_S, limits.speed_m_per_s)
        limits = replace(limits, speed_m_per_s=min(speed for speed in speeds if speed is not None))
        path, times_s = [np.asarray(self._here_rad, float)], [0.0]
        gone_m = 0.0
        last_m: Array | None = None
        for positions_rad, tips_m in reversed(self._logs):
            for q, tip_m in zip(positions_rad[::-1], tips_m[::-1], strict=True):
                far_rad = float(np.abs(q - path[-1]).max())
                if last_m is None:
                    last_m = tip_m
                if far_rad < THIN_RAD:
                    continue
                step_m = float(np.linalg.norm(tip_m - last_m))
                gone_m, last_m = gone_m + step_m, tip_m
                if gone_m > BACK_M:
                    return _slowly(path, times_s, limits)
                path.append(np.asarray(q, float))
                times_s.append(times_s[-1] + max(step_m / BACK_M_PER_S, far_rad / BACK_RAD_PER_S))
        return _slowly(path, times_s, limits)


def _slowly(path: list[Array], times_s: list[float], limits: MotionLimits) -> JointTrajectory | None:
    if len(path) < 2:
        return None
    positions, times = np.array(path), np.array(times_s)
    velocities = np.zeros_like(positions)
    velocities[1:-1] = (positions[2:] - positions[:-2]) / (times[2:] - times[:-2])[:, None]
    return JointTrajectory(
        name="back the way it came",
        times_s=times,
        positions_rad=positions,
        velocities_rad_per_s=velocities,
        is_retreat=True,
        limits=limits,
    )


class WayBack:
    """Lets the control thread take the arm back by itself, when the service that commanded it is lost.

    Args:
        signals: with the question whether the latched stop lets the arm go back.
        perform: makes a motion.

    Attributes:
        is_going: whether the running motion is the way back, which nothing but the stop ends.
    """

    def __init__(self, signals: CellSignals, clock: Clock, perform: Callable[[JointTrajectory], MotionReport]) -> None:
        self._signals = signals
        self._clock = clock
        self._perform = perform
        self._trail = Trail()
        self._ends_s = 0.0
        self.is_going = False

    def note(self, report: MotionReport) -> None:
        """Note the way of a motion."""
        self._trail.add(report)

    def must_end(self) -> bool:
        """Return whether the way back must end: its time is over, or the latched stop does not ask for it any more."""
        return self._clock.now_s() > self._ends_s or not self._signals.goes_back()

    def go(self, limits: MotionLimits) -> None:
        """Go back within the limits of the motion that was ended, if the latched stop asks for it; raises nothing."""
        motion = self._trail.way_back(limits) if self._signals.goes_back() else None
        if motion is None:
            return
        self.is_going, self._ends_s = True, self._clock.now_s() + LONGEST_S
        try:
            report = self._perform(motion)
            log.warning("without the service the arm went back the way it had come: %s", report.cause)
        except CellError as error:
            log.warning("without the service the arm does not go back the way it came: %s", error)
        finally:
            self.is_going = False
            self._trail = Trail()
