"""Reads all motion devices once per control tick, and computes the contact wrench from the raw one."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import ToolLoad
from hal.clock import Clock, Deadline, PacedClock, SimClock
from hal.devices import Arm, ForceTorque, Gripper, JointState, Proximity, Touch
from hal.errors import CellError, DeviceError, DeviceTimeout, StaleReading
from hal.geometry import orthonormal
from hal.motion import RobotState
from hal.readings import Cause, Quality, Stamped
from manipulation.arm.kernels import frames
from manipulation.control import kernels
from manipulation.plausibility.finding import Finding
from manipulation.plausibility.hand import Pads
from manipulation.plausibility.repetition import RepeatedWrench

T = TypeVar("T")
log = logging.getLogger(__name__)

GRAVITY_M_PER_S2 = 9.80665
RANGE_WAIT_S = 0.004
READ_WAIT_S = 0.02  # longest wait of one tick for a device; a tick itself lasts 2 to 8 ms
PACED_WAIT_S = 1.0  # the same on a clock that stops while waiting, because a busy computer is not a broken device
STALE_WAIT_S, STALE_STEP_S = 0.1, 0.002
COMMAND_WAIT_S = 0.25  # for commands sent over a slow bus once per motion, not every tick


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """The readings of one tick; `raw_wrench` (6,) is in sensor axes and still contains bias and weight.

    `unheard` gives the failures that a retreat tolerates, and `is_felt` is False when the wrench is one of them.
    """

    stamp_s: float
    position_rad: Array
    velocity_rad_per_s: Array
    raw_wrench: Array
    contacts: tuple[bool, ...]
    proximity_m: tuple[float, ...]
    gripper_width_m: float
    gripper_is_moving: bool
    gripper_is_holding: bool = False
    is_felt: bool = True
    unheard: tuple[DeviceFailure, ...] = ()
    slow_unheard: tuple[DeviceFailure, ...] = ()  # of the sensors that are read every fourth tick

    @property
    def pads(self) -> Pads:
        """State of the pads as the gripper reported it."""
        return Pads(width_m=self.gripper_width_m, is_moving=self.gripper_is_moving, is_holding=self.gripper_is_holding)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionDevices:
    """The devices of a cell that the control loop works with. All but the arm and its gripper may be absent."""

    arm: Arm
    gripper: Gripper
    force_torque: ForceTorque | None = None
    touch: Touch | None = None
    proximities: Sequence[Proximity] = ()


class DeviceFailure(Exception):
    """A device could not be used in this tick; `device` names it."""

    def __init__(self, device: str, cause: str) -> None:
        # The messages of some drivers begin with the name of the device.
        super().__init__(cause if cause.startswith(device) else f"{device}: {cause}")
        self.device = device
        self.cause = cause


def refuse(finding: Finding | None) -> None:
    """End the motion if there is a finding, that is, if a device is not plausible.

    Raises:
        DeviceFailure: there is a finding; carries its cause.
    """
    if finding is not None:
        raise DeviceFailure(finding.device, finding.cause)


class RangeReader:
    """Reads the newest distance of a proximity sensor in the control loop; NaN when nothing is within range.

    A range sensor on a slow bus misses a reading now and then, so it is a failure only when nothing has come for
    `patience_s`.
    """

    def __init__(self, sensor: Proximity, clock: Clock, *, max_age_s: float, patience_s: float) -> None:
        self._sensor = sensor
        self._clock = clock
        self._max_age_s = max_age_s
        self._patience_s = patience_s
        self._value_m = float("nan")
        self._good_s: float | None = None

    @property
    def name(self) -> str:
        """Name in the cell file."""
        return self._sensor.name

    def read(self, now_s: float) -> float:
        """Return the distance, m.

        Raises:
            CellError: the sensor has been silent or stale for longer than `patience_s`, or is broken.
        """
        try:
            self._value_m = self._fresh(now_s)
            self._good_s = now_s
        except (DeviceTimeout, StaleReading):
            if self._good_s is None or now_s - self._good_s > self._patience_s:
                raise
        return self._value_m

    def _fresh(self, now_s: float) -> float:
        reading = self._sensor.read_distance_m(deadline=Deadline(now_s + RANGE_WAIT_S, self._clock))
        is_empty = reading.quality is Quality.INVALID and reading.cause is Cause.OUT_OF_RANGE
        if is_empty and reading.age_s(now_s) <= self._max_age_s:
            return float("nan")
        return reading.usable(now_s=now_s, max_age_s=self._max_age_s, device=self.name)


def range_readers(sensors: Sequence[Proximity], clock: Clock, *, max_age_s: float) -> tuple[RangeReader, ...]:
    """Return a reader of each sensor; in lockstep a late reading is never an accident of timing."""
    patience_s = (1.0 if isinstance(clock, SimClock) else 3.0) * max_age_s
    return tuple(RangeReader(sensor, clock, max_age_s=max_age_s, patience_s=patience_s) for sensor in sensors)


def read_wait_s(clock: Clock) -> float:
    """Return how long one tick may wait for a device."""
    return PACED_WAIT_S if isinstance(clock, PacedClock) else READ_WAIT_S


def command_wait_s(clock: Clock) -> float:
    """Return how long a motion may wait, at its begin or end, for a device to accept a command."""
    return 2.0 * PACED_WAIT_S if isinstance(clock, PacedClock) else COMMAND_WAIT_S


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Devices:
    """The devices of the control loop. All but the arm and its gripper may be absent."""

    arm: Arm
    gripper: Gripper
    force_torque: ForceTorque | None
    touch: Touch | None
    proximities: Sequence[RangeReader]
    clock: Clock
    max_age_s: float
    repeated_wrench: RepeatedWrench = field(default_factory=lambda: RepeatedWrench(None))

    def read(self, before: Sample | None = None, *, without: Sample | None = None) -> Sample:
        """Read the devices once; with the sample `before`, gripper and proximity are taken over from it.

        Gripper and proximity sensors are slow: the caller reads them every fourth tick, which leaves time for the
        others.

        Args:
            without: the readings that take the place of those of sensors that fail; with None a failure is raised.

        Raises:
            DeviceFailure: the first device that is silent, broken, stale or invalid. "Nothing in range" is a valid
                proximity reading.
        """
        joints = self._joints()
        now_s = self.clock.now_s()
        deadline = Deadline(now_s + read_wait_s(self.clock), self.clock)
        unheard: list[DeviceFailure] = []
        slow_unheard: list[DeviceFailure] = [] if before is None else [*before.slow_unheard]

        def ask(read: Callable[[], T], otherwise: T, failed: list[DeviceFailure] = unheard) -> T:
            try:
                return read()
            except DeviceFailure as failure:
                if without is None:
                    raise
                failed.append(failure)
                return otherwise

        raw = ask(lambda: self._raw_wrench(now_s, deadline), np.zeros(6))
        is_felt = not unheard
        untouched: tuple[bool, ...] = ()
        contacts = ask(lambda: self._contacts(now_s, deadline), untouched)
        if before is None:
            last_pads, last_seen = (Pads(width_m=0.0), ()) if without is None else (without.pads, without.proximity_m)
            pads = ask(lambda: self._pads(now_s, deadline), last_pads, slow_unheard)
            seen = ask(lambda: self._ranges_m(now_s), last_seen, slow_unheard)
        else:
            pads, seen = before.pads, before.proximity_m
        _check_finite(self.arm.name, joints.position_rad)
        return Sample(
            stamp_s=now_s,
            position_rad=joints.position_rad,
            velocity_rad_per_s=joints.velocity_rad_per_s,
            raw_wrench=raw,
            contacts=contacts,
            proximity_m=seen,
            gripper_width_m=pads.width_m,
            gripper_is_moving=pads.is_moving,
            gripper_is_holding=pads.is_holding,
            is_felt=is_felt,
            unheard=(*unheard, *slow_unheard),
            slow_unheard=tuple(slow_unheard),
        )

    def _raw_wrench(self, now_s: float, deadline: Deadline) -> Array:
        """Return the raw wrench (6,); zero in a cell that does not measure it."""
        raw = np.zeros(6)
        if self.force_torque is not None:
            wrench = self._ask(self.force_torque.name, self.force_torque.read_wrench, now_s, deadline)
            raw[:3], raw[3:] = wrench.force_n, wrench.torque_nm
            _check_finite(self.force_torque.name, raw)
            refuse(self.repeated_wrench.note(raw, stamp_s=now_s))
        return raw

    def _contacts(self, now_s: float, deadline: Deadline) -> tuple[bool, ...]:
        return () if self.touch is None else self._ask(self.touch.name, self.touch.read_contacts, now_s, deadline)

    def _pads(self, now_s: float, deadline: Deadline) -> Pads:
        grip = self._ask(self.gripper.name, self.gripper.read_state, now_s, deadline)
        return Pads(width_m=grip.width_m, is_moving=grip.is_moving, is_holding=grip.is_holding)

    def _joints(self) -> JointState:
        """Return the arm's newest state; on a wall clock, wait a moment if it is old.

        No set-point goes out while waiting, so nothing moves unobserved. A failed arm latches the stop, which would be
        too strict for a computer that only paused for a tenth of a second.
        """
        began_s = self.clock.now_s()
        while True:
            now_s = self.clock.now_s()
            deadline = Deadline(now_s + read_wait_s(self.clock), self.clock)
            try:
                reading = self.arm.read_state(deadline=deadline)
                is_old = reading.quality is not Quality.INVALID and reading.age_s(now_s) > self.max_age_s
                if not (is_old and self._may_wait(now_s - began_s)):
                    return reading.usable(now_s=now_s, max_age_s=self.max_age_s, device=self.arm.name)
            except Exception as error:
                raise failure_of(self.arm.name, error) from error
            self.clock.sleep(STALE_STEP_S)

    def _may_wait(self, waited_s: float) -> bool:
        """Return whether to wait for a newer reading; never in lockstep, where waiting would move the world."""
        return not isinstance(self.clock, SimClock) and waited_s < STALE_WAIT_S

    def _ask(self, device: str, read: Callable[..., Stamped[T]], now_s: float, deadline: Deadline) -> T:
        try:
            return read(deadline=deadline).usable(now_s=now_s, max_age_s=self.max_age_s, device=device)
        except Exception as error:
            raise failure_of(device, error) from error

    def _ranges_m(self, now_s: float) -> tuple[float, ...]:
        ranges = []
        for reader in self.proximities:
            try:
                ranges.append(reader.read(now_s))
            except Exception as error:
                raise failure_of(reader.name, error) from error
        return tuple(ranges)


def failure_of(device: str, error: Exception) -> DeviceFailure:
    """Return the failure for an error, with the name of the device in the error if it has one.

    The name in the error takes precedence, because a device may represent others. A defect of a driver counts as a failure
    of its device, because it must end a motion as gently as a loose cable does.
    """
    if not isinstance(error, CellError):
        log.error("%s: its driver failed", device, exc_info=error)
        return DeviceFailure(device, f"its driver failed: {type(error).__name__}: {error}")
    named = error.details.get("device") if isinstance(error, DeviceError) else None
    return DeviceFailure(str(named or device), error.what)


def _check_finite(device: str, values: Array) -> None:
    if not math.isfinite(values @ values):  # a sum of squares keeps NaN and infinity
        raise DeviceFailure(device, "a reading is not finite")


class ContactWrench:
    """Removes bias and tool weight from the raw wrench: contact = raw - bias - weight, sensor axes.

    weight: f = m R^T g, t = c x f, with R the rotation base_from_sensor and c the centre of mass in sensor axes.
    """

    def __init__(self, load: ToolLoad, flange_from_sensor: RigidTransform) -> None:
        self.mass_kg = load.mass_kg
        self.centre_m = np.asarray(load.centre_of_mass_m, float)
        self.flange_from_sensor = np.ascontiguousarray(flange_from_sensor.as_matrix())
        self.bias = np.asarray(load.bias, float)

    def weight(self, base_from_flange: Array) -> Array:
        """Return the wrench (6,) that gravity alone causes at the sensor."""
        # The third row of base_from_sensor is the "up" direction in sensor axes.
        up = base_from_flange[2, :3] @ self.flange_from_sensor[:3, :3]
        return np.asarray(kernels.weight_at(GRAVITY_M_PER_S2 * up, self.mass_kg, self.centre_m))

    def in_flange(self, raw_wrench: Array, base_from_flange: Array) -> Array:
        """Return the contact wrench (6,) in flange axes about the flange."""
        contact = raw_wrench - self.bias - self.weight(base_from_flange)
        return np.asarray(kernels.wrench_at(contact, self.flange_from_sensor))


def state_of(
    sample: Sample, contact: ContactWrench, dh: Array, *, is_moving: bool, is_stopped: bool, faults: tuple[str, ...]
) -> RobotState:
    """Return the snapshot that readers of the state get."""
    flange = frames(dh, sample.position_rad)[-1]
    return RobotState(
        stamp_s=sample.stamp_s,
        position_rad=sample.position_rad,
        velocity_rad_per_s=sample.velocity_rad_per_s,
        base_from_flange=orthonormal(flange),
        wrench=contact.in_flange(sample.raw_wrench, flange) if sample.is_felt else np.zeros(6),
        contacts=sample.contacts,
        proximity_m=sample.proximity_m,
        gripper_width_m=sample.gripper_width_m,
        is_moving=is_moving,
        is_stopped=is_stopped,
        faults=faults,
    )


@dataclass(frozen=True, slots=True, eq=False)
class ToolReading:
    """One tick seen from a tool: measured pose (4, 4), commanded tip (3,) m, contact wrench (6,) in tool axes.

    `force_n` is the size of the contact force in this tick alone, not averaged with the tick before.
    """

    base_from_tool: Array
    commanded_tip_m: Array
    wrench: Array
    force_n: float = 0.0


class ToolView:
    """Computes what samples mean for one tool, with the wrench as the mean of two ticks.

    In sliding contact the friction changes its sign from tick to tick, by 30 N in the physics engine and by ringing in
    a stiff wrist. The mean of two ticks cancels that and costs half a tick of delay.
    """

    def __init__(self, dh: Array, contact: ContactWrench, flange_from_tool: Array) -> None:
        self._dh = dh
        self._contact = contact
        self._tool = flange_from_tool
        self._tool_from_sensor = np.ascontiguousarray(np.linalg.inv(flange_from_tool) @ contact.flange_from_sensor)
        self._before: Array | None = None

    def look(self, sample: Sample, commanded_rad: Array) -> ToolReading:
        """Return the pose and the contact wrench of the tool in this tick."""
        contact = self._contact
        pose, tip, now = kernels.tick_view(
            self._dh,
            sample.position_rad,
            commanded_rad,
            self._tool,
            contact.flange_from_sensor,
            self._tool_from_sensor,
            sample.raw_wrench,
            contact.bias,
            contact.mass_kg,
            contact.centre_m,
            GRAVITY_M_PER_S2,
        )
        if not sample.is_felt:
            now = np.zeros(6)
        before, self._before = self._before, now
        force_n = math.sqrt(float(now[:3] @ now[:3]))
        return ToolReading(pose, tip, now if before is None else 0.5 * (now + before), force_n)
