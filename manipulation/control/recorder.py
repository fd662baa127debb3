"""Samples what a motion did, and sums up its contact force, for its report."""

from __future__ import annotations

import math

import numpy as np

from hal.arrays import Array
from hal.motion import ContactForce, MotionLog

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
