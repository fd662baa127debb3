"""Devices in memory with predictable values, which back emulators without a simulator.

The value rises by one step per read, so it reveals the index of its sample, and a test can tell true, stale and wrong
values apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.clock import Clock, Deadline, WallClock
from hal.devices import (
    ArmCapabilities,
    DeviceKind,
    DhLink,
    ForceTorqueCapabilities,
    GripperCapabilities,
    GripperState,
    Health,
    JointState,
    LightsCapabilities,
    ProximityCapabilities,
    RangeImage,
    RangeScannerCapabilities,
    TouchCapabilities,
    Wrench,
)
from hal.errors import DeviceTimeout, MotionRefused
from hal.readings import Cause, Quality, Stamped

LIGHT_NAMES = ("top_left", "top_right", "bottom_right", "bottom_left")


class Scripted:
    """Base of the scripted devices: a name, a count of reads, and time stamps from a clock."""

    kind: ClassVar[DeviceKind]

    def __init__(self, name: str = "scripted", clock: Clock | None = None) -> None:
        self.name = name
        self.reads = 0
        self._clock = clock or WallClock()

    def health(self) -> Health:
        """Return that the device is connected and its data are valid."""
        return Health(connected=True, quality=Quality.VALID, cause=Cause.NONE, samples=self.reads)

    def close(self) -> None:
        """Do nothing, because there is nothing to release."""

    def count(self, deadline: Deadline) -> tuple[int, float]:
        """Count one read and return its index and its time in seconds.

        Raises:
            DeviceTimeout: the deadline is past.
        """
        if deadline.is_past():
            what = f"{self.name} was read after the deadline of the call"
            raise DeviceTimeout(what, hint="give the call a later deadline", device=self.name)
        self.reads += 1
        return self.reads, self._clock.now_s()


class ScriptedProximity(Scripted):
    """Distance that rises by 1 mm per read from `first_m` and restarts after 1000 reads, or the constant `fixed_m`."""

    kind = DeviceKind.PROXIMITY

    def __init__(self, *, first_m: float = 0.1, fixed_m: float | None = None) -> None:
        super().__init__("scripted_proximity")
        self.first_m = first_m
        self.fixed_m = fixed_m

    def capabilities(self) -> ProximityCapabilities:
        """Return a range of 0 to 12 m."""
        return ProximityCapabilities(min_range_m=0.0, max_range_m=12.0, sigma_m=0.001, rate_hz=100.0)

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Return the next distance; an invalid sample if `fixed_m` is NaN."""
        index, now_s = self.count(deadline)
        value = self.first_m + 0.001 * (index % 1000) if self.fixed_m is None else self.fixed_m
        is_seen = math.isfinite(value)
        return Stamped(
            value=value,
            host_time_s=now_s,
            sequence=index,
            quality=Quality.VALID if is_seen else Quality.INVALID,
            cause=Cause.NONE if is_seen else Cause.OUT_OF_RANGE,
        )


class ScriptedLights(Scripted):
    """Four lights whose feedback equals the command."""

    kind = DeviceKind.LIGHTS

    def __init__(self) -> None:
        super().__init__("scripted_lights")
        self.on: tuple[bool, ...] = (False,) * len(LIGHT_NAMES)

    def capabilities(self) -> LightsCapabilities:
        """Return four channels that settle in 10 ms."""
        return LightsCapabilities(channels=LIGHT_NAMES, settle_s=0.01)

    def set_on(self, on: Sequence[bool], *, deadline: Deadline) -> tuple[bool, ...]:
        """Store the command and return it."""
        self.count(deadline)
        self.on = tuple(on)
        return self.on

    def read_on(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Return the last command as feedback."""
        index, now_s = self.count(deadline)
        return Stamped(value=self.on, host_time_s=now_s, sequence=index)


class ScriptedTouch(Scripted):
    """Two touch pads; tests set `contacts`."""

    kind = DeviceKind.TOUCH

    def __init__(self) -> None:
        super().__init__("scripted_touch")
        self.contacts: tuple[bool, ...] = (False, False)

    def capabilities(self) -> TouchCapabilities:
        """Return the channels left and right."""
        return TouchCapabilities(channels=("left", "right"), threshold_n=1.0, rate_hz=100.0)

    def read_contacts(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Return `contacts` as set."""
        index, now_s = self.count(deadline)
        return Stamped(value=self.contacts, host_time_s=now_s, sequence=index)


class ScriptedForceTorque(Scripted):
    """Wrench whose Fx rises by 0.01 N per read up to 250 N; the other five components are fixed functions of Fx."""

    kind = DeviceKind.FORCE_TORQUE

    def __init__(self) -> None:
        super().__init__("scripted_ft")

    def capabilities(self) -> ForceTorqueCapabilities:
        """Return ranges of 300 N and 30 N m."""
        return ForceTorqueCapabilities(
            force_range_n=300.0, torque_range_nm=30.0, force_sigma_n=0.1, torque_sigma_nm=0.005, rate_hz=100.0
        )

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        """Return the next wrench."""
        index, now_s = self.count(deadline)
        return Stamped(value=scripted_wrench(index), host_time_s=now_s, sequence=index)


def scripted_wrench(index: int) -> Wrench:
    """Return the wrench of read number `index`."""
    fx_n = 0.01 * (index % 25_000)
    return Wrench(
        force_n=np.array([fx_n, 100.0 - fx_n / 2.5, -0.5 * fx_n]),
        torque_nm=np.array([0.01 * fx_n, -0.02 * fx_n, 5.0 - 0.01 * fx_n]),
    )


class ScriptedGripper(Scripted):
    """Gripper whose jaws move at the commanded speed; `object_m` is the width of the object between them."""

    kind = DeviceKind.GRIPPER

    def __init__(self, *, object_m: float = 0.0) -> None:
        super().__init__("scripted_gripper")
        self.object_m = object_m
        self._from_m = self._goal_m = 0.04
        self._speed_m_per_s = 0.1
        self._since_s = 0.0

    def capabilities(self) -> GripperCapabilities:
        """Return a stroke of 85 mm, 100 N and 0.15 m/s."""
        return GripperCapabilities(min_width_m=0.0, max_width_m=0.085, max_force_n=100.0, max_speed_m_per_s=0.15)

    def read_state(self, *, deadline: Deadline) -> Stamped[GripperState]:
        """Return width, force and motion of the jaws at this time."""
        index, now_s = self.count(deadline)
        width_m = self._width_m(now_s)
        is_holding = self.object_m > 0.0 and width_m <= self.object_m + 1e-9
        state = GripperState(
            width_m=width_m,
            force_n=20.0 if is_holding else 0.0,
            is_moving=not is_holding and abs(width_m - self._goal_m) > 1e-6,
            is_holding=is_holding,
        )
        return Stamped(value=state, host_time_s=now_s, sequence=index)

    def command(self, *, width_m: float, force_n: float, speed_m_per_s: float, deadline: Deadline) -> float:  # noqa: ARG002 - no wait
        """Start a motion and return the goal width, limited to the stroke, in metres."""
        _, now_s = self.count(deadline)
        self._from_m, self._since_s = self._width_m(now_s), now_s
        self._goal_m, self._speed_m_per_s = min(max(width_m, 0.0), 0.085), speed_m_per_s
        return self._goal_m

    def _width_m(self, now_s: float) -> float:
        way_m = self._goal_m - self._from_m
        moved_m = min(abs(way_m), self._speed_m_per_s * (now_s - self._since_s))
        return max(self.object_m, self._from_m + math.copysign(moved_m, way_m))


class ScriptedScanner(Scripted):
    """Full turn of 721 beams, half a degree apart: beam i of read k measures 0.5 m + i / 2 mm + (k mod 100) mm."""

    kind = DeviceKind.RANGE_SCANNER

    def __init__(self) -> None:
        super().__init__("scripted_scanner")

    def capabilities(self) -> RangeScannerCapabilities:
        """Return the geometry of a polar scan from -180 to 180 degrees."""
        return RangeScannerCapabilities(
            projection="polar",
            width=721,
            height=1,
            fx=1.0,
            fy=1.0,
            cx=0.0,
            cy=0.0,
            min_range_m=0.02,
            max_range_m=4.0,
            sigma_m=0.001,
            rate_hz=10.0,
            first_angle_rad=-math.pi,
            step_angle_rad=math.radians(0.5),
        )

    def read_range(self, *, deadline: Deadline) -> Stamped[RangeImage]:
        """Return the next scan."""
        index, now_s = self.count(deadline)
        return Stamped(value=RangeImage(depth_m=scripted_scan(index)), host_time_s=now_s, sequence=index)


def scripted_scan(index: int) -> NDArray[np.float32]:
    """Return the (1, 721) distances of read number `index`, in metres."""
    return (0.5 + 0.0005 * np.arange(721) + 0.001 * (index % 100)).astype(np.float32)[np.newaxis, :]


class ScriptedArm(Scripted):
    """Arm of six joints that, while enabled, reaches each commanded position at once."""

    kind = DeviceKind.ARM

    def __init__(self, *, device_s: float | None = None) -> None:
        super().__init__("scripted_arm")
        self.device_s = device_s  # time on the arm's own clock, advanced by tests; None: it has no clock
        self.position_rad = np.array([0.1, -1.2, 1.3, -0.4, 0.5, 0.6])
        self.is_enabled = False
        self.commands = 0
        self.stops = 0

    def capabilities(self) -> ArmCapabilities:
        """Return the capabilities of a simple six-joint arm."""
        return ArmCapabilities(
            model="scripted",
            links=tuple(DhLink(d_m=0.1, a_m=0.2, alpha_rad=0.5) for _ in range(6)),
            lower_rad=(-3.0,) * 6,
            upper_rad=(3.0,) * 6,
            velocity_rad_per_s=(2.0,) * 6,
            acceleration_rad_per_s2=(10.0,) * 6,
            tip_speed_m_per_s=1.0,
            command_rate_hz=125.0,
            link_radius_m=(0.05,) * 6,
        )

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Return the present position."""
        index, now_s = self.count(deadline)
        state = JointState(
            position_rad=self.position_rad.copy(), velocity_rad_per_s=np.zeros(6), is_enabled=self.is_enabled
        )
        return Stamped(value=state, host_time_s=now_s, sequence=index, device_time_s=self.device_s)

    def command_position(self, position_rad: Array, *, deadline: Deadline) -> Array:
        """Jump to the position.

        Raises:
            MotionRefused: the arm is not enabled.
        """
        self.count(deadline)
        if not self.is_enabled:
            raise MotionRefused("the scripted arm is off", hint="call enable first", device=self.name)
        self.commands += 1
        self.position_rad = np.array(position_rad, dtype=float)
        return self.position_rad

    def enable(self, *, deadline: Deadline) -> None:
        """Enable the arm."""
        self.count(deadline)
        self.is_enabled = True

    def stop(self, *, deadline: Deadline) -> None:
        """Disable the arm."""
        self.count(deadline)
        self.stops += 1
        self.is_enabled = False
