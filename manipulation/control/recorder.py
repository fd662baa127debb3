"""Samples what a motion did, and sums up its contact force, for its report."""

from __future__ import annotations

import math

import numpy as np

from hal.arrays import Array
from hal.geometry import identity, orthonormal
from hal.motion import ContactForce, DeclaredMotion, MotionLog, MotionReport
from manipulation.control.sensing import Sample, ToolReading
from manipulation.control.termination import Termination

LOG_RATE_HZ = 125.0
CONTACT_N = 3.0  # a smaller force may be noise, drift or the inertia of the hand


class Recorder:
    """Keeps every n-th tick, and the peak, impulse and chatter of the contact force over all ticks."""

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self._impulse_n_s = 0.0
        self._changes = 0
        self._squares_n2 = 0.0
        self._last_n = 0.0
        self._stride = max(1, round(1.0 / (LOG_RATE_HZ * dt_s)))
        self._ticks = 0
        self._rows: list[tuple[float, Array, Array, Array]] = []
        self.peak_force_n = 0.0
        self.started_s = 0.0  # time of the first sample on the cell clock

    def note(self, elapsed_s: float, q_rad: Array, wrench: Array, tip_m: Array, *, force_n: float = 0.0) -> None:
        """Record one tick; `force_n` is the contact force of this tick alone, `wrench` the mean with the one before."""
        if force_n >= CONTACT_N:
            self._impulse_n_s += force_n * self._dt_s
            if self._last_n >= CONTACT_N:
                self._changes += 1
                self._squares_n2 += (force_n - self._last_n) ** 2
        self._last_n = force_n
        force = math.sqrt(float(wrench[:3] @ wrench[:3]))
        self.peak_force_n = max(self.peak_force_n, force)
        if self._ticks % self._stride == 0:
            self._rows.append((elapsed_s, q_rad, wrench, tip_m))
        self._ticks += 1

    @property
    def force(self) -> ContactForce:
        """Impulse and chatter so far."""
        return ContactForce(impulse_n_s=self._impulse_n_s, changes=self._changes, squares_n2=self._squares_n2)

    def log(self, joints: int) -> MotionLog:
        """Return the samples so far; empty arrays of the right shape when nothing ran."""
        if not self._rows:
            return MotionLog(
                times_s=np.empty(0),
                positions_rad=np.empty((0, joints)),
                wrench=np.empty((0, 6)),
                tip_m=np.empty((0, 3)),
            )
        times, positions, wrenches, tips = zip(*self._rows, strict=True)
        return MotionLog(
            times_s=np.array(times),
            positions_rad=np.array(positions),
            wrench=np.array(wrenches),
            tip_m=np.array(tips),
            started_s=self.started_s,
        )

    def report(
        self,
        motion: DeclaredMotion,
        end: Termination,
        sample: Sample | None,
        look: ToolReading | None,
        *,
        span_s: tuple[float, float],
        without: tuple[str, ...],
        joints: int,
    ) -> MotionReport:
        """Return what really happened.

        Args:
            sample, look: the newest ones, if there are any.
            span_s: start and end of the motion on the cell's clock.
            without: the sensors that failed in it and did not end it.
            joints: number of the arm's joints.
        """
        return MotionReport(
            name=motion.name,
            outcome=end.outcome,
            tripped=end.tripped,
            cause="; ".join((end.cause, *(f"without {one}" for one in without))),
            started_s=span_s[0],
            ended_s=span_s[1],
            position_rad=np.zeros(joints) if sample is None else sample.position_rad,
            base_from_tool=identity() if look is None else orthonormal(look.base_from_tool),
            wrench=np.zeros(6) if look is None else look.wrench,
            peak_force_n=self.peak_force_n,
            gripper_width_m=None if sample is None else sample.gripper_width_m,
            log=self.log(joints),
            device=end.device,
            force=self.force,
        )
