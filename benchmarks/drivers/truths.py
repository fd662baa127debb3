"""Backing devices whose values identify the reading, and checks that a value is one of the latest true ones."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.emulators import scripted
from drivers.emulators.beams import line_m
from hal.clock import Deadline
from hal.devices import JointState, RangeImage, Wrench
from hal.readings import Stamped

SAME_MOMENT_S = 0.008  # two counts of a servo at the speed of `MovingArm` are 6 ms


class MovingArm(scripted.ScriptedArm):
    """Arm whose joints encode the time: all rise at the same speed and restart every `TURN_S` seconds."""

    SPEED_RAD_PER_S, TURN_S = 0.5, 4.0

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Return the present position."""
        stamped = super().read_state(deadline=deadline)
        moved_rad = self.SPEED_RAD_PER_S * (time.monotonic() % self.TURN_S)
        return replace(stamped, value=replace(stamped.value, position_rad=self.position_rad + moved_rad))

    def seconds(self, value: JointState) -> Any:
        """Return the seconds since the last restart that each joint encodes."""
        return (value.position_rad - self.position_rad) / self.SPEED_RAD_PER_S

    def taken_s(self, value: JointState) -> float:
        """Return when the oldest joint was read, within the last `TURN_S`; rounding may give a slightly later time."""
        now_s = time.monotonic() + SAME_MOMENT_S
        return now_s - float(np.max((now_s - self.seconds(value)) % self.TURN_S))


class TimedForceTorque(scripted.ScriptedForceTorque):
    """Force/torque device that stores when each reading was taken."""

    def __init__(self) -> None:
        super().__init__()
        self._read_s: deque[float] = deque(maxlen=4096)

    def count(self, deadline: Deadline) -> tuple[int, float]:
        """Count one read; return its index and time."""
        self._read_s.append(time.monotonic())
        return super().count(deadline)

    def taken_s(self, value: Wrench) -> float:
        """Return when a value was taken, by the index that its force encodes."""
        ago = self.reads - round(value.force_n[0] / 0.01)
        return self._read_s[-1 - ago]


class TimedProximity(scripted.ScriptedProximity):
    """Distance that rises by 1 cm per read, the resolution of some sensors, and the time of each of the last reads."""

    KEPT = 1000

    def __init__(self) -> None:
        super().__init__()
        self._read_s: deque[float] = deque(maxlen=self.KEPT)

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Return the next distance."""
        self._read_s.append(time.monotonic())
        stamped = super().read_distance_m(deadline=deadline)
        return replace(stamped, value=self.first_m + 0.01 * (self.reads % self.KEPT))

    def _ago(self, value: float) -> int:
        return (self.reads - round((value - self.first_m) / 0.01)) % self.KEPT

    def is_true(self, value: float) -> bool:
        """Return whether the value equals one of the last 100 readings."""
        steps = (value - self.first_m) / 0.01
        return abs(steps - round(steps)) < 1e-6 and self._ago(value) <= 100

    def taken_s(self, value: float) -> float:
        """Return when a value was read."""
        return self._read_s[-1 - self._ago(value)]


class TimedTouch(scripted.ScriptedTouch):
    """Touch pads whose four patterns follow each other, each for `STEP_S`."""

    STEP_S = 0.25

    def pattern(self, at_s: float) -> tuple[bool, bool]:
        """Return the contacts at a time of the monotonic clock."""
        index = int(at_s / self.STEP_S) % 4
        return bool(index & 1), bool(index & 2)

    def read_contacts(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Return the contacts of this moment."""
        self.contacts = self.pattern(time.monotonic())
        return super().read_contacts(deadline=deadline)


def taken_s(value: Any, backing: Any) -> float:
    """Return when a value was taken, as the backing device stored it."""
    when_s: float = backing.taken_s(value)
    return when_s


def true_wrench(value: Any, backing: Any) -> bool:
    """Return whether all six components equal one of the last 100 readings."""
    index = round(value.force_n[0] / 0.01)
    true = scripted.scripted_wrench(index)
    got, want = [*value.force_n, *value.torque_nm], [*true.force_n, *true.torque_nm]
    return backing.reads - 100 <= index <= backing.reads and bool(np.allclose(got, want, atol=0.0052))


def true_distance(value: float, backing: Any) -> bool:
    """Return whether the value equals one of the last 100 readings."""
    steps = (value - backing.first_m) / 0.001
    index = backing.reads % 1000
    return bool(abs(steps - round(steps)) < 1e-6 and (index - round(steps)) % 1000 <= 100)


def true_centimetres(value: float, backing: Any) -> bool:
    """Return whether the value equals one of the last 100 readings, rounded to a centimetre."""
    true_m = backing.first_m + 0.001 * (np.arange(backing.reads - 100, backing.reads + 1) % 1000)
    return bool(np.min(np.abs(np.round(true_m, 2) - value)) < 1e-6)


def true_reading(value: float, backing: TimedProximity) -> bool:
    """Return whether the value equals one of the last 100 readings."""
    return backing.is_true(value)


def true_express(value: RangeImage, backing: Any) -> bool:
    """Return whether the value is one of the last 60 scans, where each beam may have a neighbour's distance.

    The 384 measurements of a scan fall into 360 sectors.
    """
    c, seen_m = backing.capabilities(), value.depth_m[0]
    seen = np.isfinite(seen_m)
    for index in range(max(1, backing.reads - 60), backing.reads + 1):
        line = line_m(RangeImage(depth_m=scripted.scripted_scan(index)), c, turn_angles(len(seen_m)))
        near = np.stack([np.roll(line, shift) for shift in (-2, -1, 0, 1, 2)])[:, seen]
        low, high = np.fmin.reduce(near), np.fmax.reduce(near)
        if np.all((seen_m[seen] >= low - 1e-3) & (seen_m[seen] <= high + 1e-3)):
            return True
    return False


def true_scan(angles: Callable[[int], Any]) -> Callable[[RangeImage, Any], bool]:
    """Return a check that all measured beams of a value equal those of one of the last 60 scans, at least half of them."""

    def is_true(value: RangeImage, backing: Any) -> bool:
        angle_rad = angles(value.depth_m.shape[1])
        c = backing.capabilities()
        for index in range(max(1, backing.reads - 60), backing.reads + 1):
            true = line_m(RangeImage(depth_m=scripted.scripted_scan(index)), c, angle_rad)
            seen = np.isfinite(value.depth_m[0])
            if 2 * seen.sum() >= len(seen) and np.allclose(value.depth_m[0][seen], true[seen], atol=6e-4):
                return True
        return False

    return is_true


def scip_angles(count: int) -> Any:
    """Return the beam angles of the URG-04LX, in radians."""
    return (np.arange(count) + 44.0 - 384.0) * (2 * np.pi / 1024)


def sick_angles(count: int) -> Any:
    """Return beam angles over 180 degrees, in radians."""
    return np.radians(np.linspace(-90.0, 90.0, count))


def turn_angles(count: int) -> Any:
    """Return beam angles over a full turn, from -pi to pi."""
    return (np.arange(count) * (2 * np.pi / count) + np.pi) % (2 * np.pi) - np.pi


def true_joints(value: Any, backing: Any) -> bool:
    """Return whether all joints were read at the same time, to the resolution of the servos."""
    seconds = backing.seconds(value)
    apart_s = (seconds - seconds[0] + backing.TURN_S / 2.0) % backing.TURN_S - backing.TURN_S / 2.0
    return bool(np.ptp(apart_s) < SAME_MOMENT_S)


def true_width(value: Any, backing: Any) -> bool:
    """Return whether the jaws rest on the object of 40 mm."""
    return bool(abs(value.width_m - 0.04) < 4e-4 and backing.reads > 0)


def true_lights(value: Any, backing: Any) -> bool:
    """Return whether the value equals the lights that are on."""
    return bool(value == backing.on)


def true_contacts(value: Any, backing: Any) -> bool:
    """Return whether the value was true at a time within the last two patterns."""
    now_s = time.monotonic()
    return any(value == backing.pattern(now_s - steps * backing.STEP_S) for steps in range(3))


def is_near(value: float, backing: Any) -> bool:  # noqa: ARG001  # the switch knows one distance only
    """Return whether a closed switch gives its switching distance."""
    return abs(value - 0.02) < 1e-9
