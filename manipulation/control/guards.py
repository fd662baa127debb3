"""Guards, the conditions that end a motion; a quantity is computed once per tick, if a guard needs it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.motion import Guard, Quantity
from manipulation.arm import kernels as arm_kernels

RISE_WINDOW_S = 0.4
RISE_AFTER_S = 0.15  # a motion that begins under load first builds up that load; a networked arm needs 50 ms more
PADS_N_PER_M = 10_000.0  # of soft pads in contact; the rise that is measured flickers too much to foresee anything
AHEAD_SHARE = 0.4  # of the limit, from which on there is contact that can rise
STILL = np.zeros(3)
RISE_SAMPLE_S = 0.016  # the running median is updated at 62 Hz; the force of a contact rises within a few updates


@dataclass(slots=True, kw_only=True, eq=False)
class Measured:
    """The inputs of guards in one tick: contact wrench (6,) and tool pose (4, 4) measured, tip commanded (3,) m."""

    elapsed_s: float
    wrench: Array
    base_from_tool: Array
    commanded_tip_m: Array
    contacts: tuple[bool, ...]
    proximity_m: tuple[float, ...]


def _resistance(now: Measured, step_m: Array) -> float:
    """Return the contact force (N) without what pushes the tip along a commanded step (3,), base frame."""
    force = now.base_from_tool[:3, :3] @ now.wrench[:3]
    square = float(step_m @ step_m)
    along = max(0.0, float(force @ step_m))
    return math.sqrt(max(0.0, float(force @ force) - (along * along / square if square > 0.0 else 0.0)))


class GuardSet:
    """The guards of one motion, with their state."""

    def __init__(self, guards: Sequence[Guard], start_tool: Array) -> None:
        self._watches = [_GuardMonitor(guard, start_tool) for guard in guards]

    def tripped(self, now: Measured) -> Guard | None:
        """Return the first guard whose condition has held for its number of ticks, or None."""
        for watch in self._watches:
            if watch.holds(now):
                return watch.guard
        return None


class _GuardMonitor:
    """One guard, the number of ticks for which it has held, and the running median if it watches a rise."""

    def __init__(self, guard: Guard, start_tool: Array) -> None:
        self.guard = guard
        self._start = start_tool
        self._held = 0
        self._axis = None if guard.axis is None else np.asarray(guard.axis, float)
        self._recent: deque[float] = deque(maxlen=round(RISE_WINDOW_S / RISE_SAMPLE_S))
        self._next_s = RISE_AFTER_S
        self._median: float | None = None
        self._last: tuple[float, Array] | None = None
        self._wants_step = guard.ahead_s > 0.0 or guard.quantity is Quantity.RESISTANCE

    def holds(self, now: Measured) -> bool:
        elapsed_s, step_m = self._since_last(now) if self._wants_step else (0.0, STILL)
        value = self._value(now, step_m)
        if elapsed_s > 0.0 and self.guard.ahead_s > 0.0:
            value += self._ahead(value, math.sqrt(float(step_m @ step_m)) / elapsed_s)
        beyond = value <= self.guard.limit if self.guard.below else value >= self.guard.limit
        # NaN compares false, so "nothing in range" never trips a guard.
        self._held = self._held + 1 if beyond else 0
        return self._held >= self.guard.ticks

    def _since_last(self, now: Measured) -> tuple[float, Array]:
        """Return the time since the last tick, s, and the step (3,) of the tip that was commanded in it, m."""
        last, self._last = self._last, (now.elapsed_s, now.commanded_tip_m)
        if last is None or now.elapsed_s <= last[0]:
            return 0.0, STILL
        return now.elapsed_s - last[0], now.commanded_tip_m - last[1]

    def _ahead(self, value: float, speed_m_per_s: float) -> float:
        """Return what the force rises by in `ahead_s` at the speed of the last commanded step, while there is contact."""
        if value < AHEAD_SHARE * self.guard.limit:
            return 0.0
        return PADS_N_PER_M * speed_m_per_s * self.guard.ahead_s

    def _value(self, now: Measured, step_m: Array) -> float:
        match self.guard.quantity:
            case Quantity.FORCE:
                return self._along(now.wrench[:3])
            case Quantity.RESISTANCE:
                return _resistance(now, step_m)
            case Quantity.TORQUE:
                return self._along(now.wrench[3:])
            case Quantity.FORCE_RISE:
                return self._rise(now)
            case Quantity.TOUCH:
                return float(sum(now.contacts))
            case Quantity.PROXIMITY:
                seen = [m for m in now.proximity_m if not math.isnan(m)]
                return min(seen) if seen else math.nan
            case Quantity.TRAVEL:
                moved = now.base_from_tool[:3, 3] - self._start[:3, 3]
                return self._along(self._start[:3, :3].T @ moved)
            case Quantity.ROTATION:
                turn = arm_kernels.rotation_log(
                    np.ascontiguousarray(now.base_from_tool[:3, :3] @ self._start[:3, :3].T)
                )
                return math.sqrt(float(turn @ turn))
            case Quantity.TRACKING:
                gap = now.base_from_tool[:3, 3] - now.commanded_tip_m
                return math.sqrt(float(gap @ gap))

    def _along(self, vector: Array) -> float:
        if self._axis is not None:
            return float(self._axis @ vector)
        return math.sqrt(float(vector @ vector))

    def _rise(self, now: Measured) -> float:
        force = self._along(now.wrench[:3])
        if now.elapsed_s >= self._next_s:
            self._next_s = now.elapsed_s + RISE_SAMPLE_S
            self._recent.append(force)
            self._median = float(np.median(self._recent)) if len(self._recent) >= 5 else None
        return 0.0 if self._median is None else force - self._median
