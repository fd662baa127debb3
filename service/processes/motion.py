"""Connects the cell's devices to the control thread of `manipulation`."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import ToolLoad
from hal.clock import Clock, Deadline, SimClock, WallClock
from hal.config import Cell
from hal.devices import DeviceKind
from hal.errors import CellError, ConfigError, MotionRefused
from hal.geometry import identity
from hal.motion import CellSignals, DeclaredMotion, MotionReport, RobotState
from hal.readings import Quality
from service.processes.control_watch import Commanded, ControlWatch
from service.processes.device_slots import IN_MOTION, DeviceSlot, UnavailableDevice

if TYPE_CHECKING:
    from manipulation import Controller

STATE_WAIT_S = 2.0
T = TypeVar("T")


class Standstill:
    """Replaces the control thread while a device that it needs is not connected; every request raises the cause."""

    def __init__(self, why: CellError) -> None:
        self._why = why

    def execute(self, motion: DeclaredMotion) -> MotionReport:  # noqa: ARG002 - an interface
        """Raise the error that says which device is not connected."""
        raise self._why

    def tare(self) -> Array:
        """Raise the error that says which device is not connected."""
        raise self._why

    def state(self) -> RobotState:
        """Raise the error that says which device is not connected."""
        raise self._why

    def cancel(self) -> None:
        """Do nothing, because no motion runs."""

    def ticking(self) -> int | None:
        """Return None, because there is no control thread."""
        return None

    def not_stopped(self) -> tuple[str, ...]:
        """Return nothing, because nothing moves."""
        return ()

    def close(self) -> None:
        """Do nothing, because there is no control thread."""


class MotionPort:
    """The mover for several clients; reading the state never interrupts or refuses a motion.

    Args:
        start: starts the control thread, whose commands it tells to the watch, or raises why it cannot be started yet.
        failing: returns which of its devices do not answer, and why.

    In the controller, reading the state from the devices and a motion exclude each other. Here a motion waits for such a
    read to end, and readers get the newest snapshot while a motion runs.
    """

    def __init__(
        self,
        start: Callable[[ControlWatch], Controller | Standstill],
        *,
        clock: Clock,
        is_latched: Callable[[], bool],
        failing: Callable[[], tuple[str, ...]],
    ) -> None:
        self._start = start
        self._clock = clock
        self._failing = failing
        self._is_latched = is_latched
        self._newest: RobotState | None = None
        self._is_restarting = True
        self.watch = ControlWatch(self._ticking)
        self._controller = start(self.watch)
        self._is_restarting = False
        self._is_executing = threading.Lock()
        self._devices_in_use = threading.Lock()

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        """Run the motion; see `hal.motion.Mover`."""
        return self._alone(f"motion {motion.name!r}", lambda: self._controller.execute(motion))

    def tare(self) -> Array:
        """Zero the contact wrench; see `hal.motion.Mover`."""
        return self._alone("tare", lambda: self._controller.tare())  # noqa: PLW0108  # looked up at the time of the call

    def cancel(self) -> None:
        """End the running motion."""
        self._controller.cancel()

    def state(self) -> RobotState:
        """Return the newest snapshot of the robot's state.

        While the simulated time stands still, the last snapshot is returned again: another read would draw numbers from
        the sensors' noise generators, and the same seed would no longer give the same mission.
        """
        newest = self._newest
        is_still = isinstance(self._clock, SimClock) and newest is not None and newest.stamp_s == self._clock.now_s()
        if newest is not None and (is_still or self._is_restarting):
            return replace(newest, is_stopped=self._is_latched(), faults=self._failing())
        self._newest = self._read()
        return self._newest

    def not_stopped(self, *, deadline: Deadline) -> tuple[str, ...]:  # noqa: ARG002 - of the caller's waiting
        """Return which devices did not obey the last stop, and why; asks no device."""
        return self._controller.not_stopped()

    def _read(self) -> RobotState:
        is_free = self._devices_in_use.acquire(blocking=False)
        try:
            return self._controller.state()
        finally:
            if is_free:
                self._devices_in_use.release()

    def _ticking(self) -> int | None:
        is_real = isinstance(
            self._clock, WallClock
        )  # otherwise the thread waits for the world, which is watched itself
        return self._controller.ticking() if is_real and not self._is_restarting else None

    def at_rest(self, work: Callable[[], None]) -> None:
        """Run `work` while no motion runs and none can begin; without a control thread, try to start one afterwards.

        Raises:
            MotionRefused: a motion runs.
        """
        if isinstance(self._controller, Standstill):
            self.restart(work)
        else:
            self._alone("exchange of a device", work)

    def restart(self, between: Callable[[], None]) -> None:
        """End the control thread (this stops the arm), run `between`, and start a new thread with the drives off.

        Raises:
            MotionRefused: a motion runs.
        """

        def work() -> None:
            self._is_restarting = True
            self._controller.close()
            try:
                between()
            finally:
                try:
                    self._controller, self._newest = self._start(self.watch), None
                finally:
                    self._is_restarting = False

        self._alone("exchange of a device", work)

    def close(self) -> None:
        """Stop the arm and end the control thread."""
        self._controller.close()

    def _alone(self, what: str, work: Callable[[], T]) -> T:
        if not self._is_executing.acquire(blocking=False):
            raise MotionRefused(f"{what} refused: another motion runs", hint="wait for it or cancel it")
        try:
            if not self._devices_in_use.acquire(timeout=STATE_WAIT_S):
                raise MotionRefused(
                    f"{what} refused: the state cannot be read", hint="a device hangs; see GET /v1/devices"
                )
            try:
                return work()
            finally:
                self._devices_in_use.release()
        finally:
            self._is_executing.release()


def start_controller(
    cell: Cell,
    devices: Mapping[str, DeviceSlot],
    *,
    clock: Clock,
    is_latched: Callable[[], bool],
    signals: CellSignals | None = None,
) -> MotionPort:
    """Start the control thread for the cell's devices and return its port; errors as for `controller_of`."""
    used = {name: devices[name] for name, section in cell.file.devices.items() if section.kind in IN_MOTION}

    def start(watch: ControlWatch) -> Controller | Standstill:
        for slot in used.values():
            if isinstance(absent := slot.installed(), UnavailableDevice):
                return Standstill(absent.why)
        return controller_of(cell, devices, clock=clock, is_latched=is_latched, signals=signals, watch=watch)

    def failing() -> tuple[str, ...]:
        healths = {name: device.health() for name, device in used.items()}
        return tuple(
            f"{name}: {health.detail or health.cause}"
            for name, health in healths.items()
            if not health.connected or health.quality is Quality.INVALID
        )

    return MotionPort(start, clock=clock, is_latched=is_latched, failing=failing)


def controller_of(
    cell: Cell,
    devices: Mapping[str, Any],
    *,
    clock: Clock,
    is_latched: Callable[[], bool],
    signals: CellSignals | None = None,
    watch: ControlWatch | None = None,
) -> Controller:
    """Start a control thread for the first arm, gripper, force/torque and touch sensor and for all proximity sensors.

    Raises:
        ConfigError: a part that motion needs is missing from the cell file.
    """
    from manipulation import Controller, MotionDevices

    arm, gripper = _first(cell, devices, DeviceKind.ARM), _first(cell, devices, DeviceKind.GRIPPER)
    if gripper is None:
        raise ConfigError(
            f"{cell.path}: a cell with an arm needs a gripper",
            hint='add [devices.gripper] with kind = "gripper"',
            file=str(cell.path),
            key="devices",
        )
    if watch is not None:
        arm, gripper = Commanded(arm, watch, "enable", "stop"), Commanded(gripper, watch, "command")
    wrist = _first(cell, devices, DeviceKind.FORCE_TORQUE)
    _check_joints(cell, arm)
    controller = Controller(
        MotionDevices(
            arm=arm,
            gripper=gripper,
            force_torque=wrist,
            touch=_first(cell, devices, DeviceKind.TOUCH),
            proximities=tuple(devices[name] for name in cell.names_of(DeviceKind.PROXIMITY)),
        ),
        clock=clock,
        safety=cell.file.safety,
        load=_load(cell, wrist),
        flange_from_sensor=flange_from(cell, wrist),
        is_latched=is_latched,
        signals=signals,
        flange_from_grip=flange_from(cell, gripper),
        rate_hz=cell.file.cell.control_rate_hz,
    )
    try:
        controller.start()
    except CellError:
        controller.close()
        raise
    return controller


def _check_joints(cell: Cell, arm: Any) -> None:
    joints, parked = len(arm.capabilities().links), len(cell.file.workspace.park_rad)
    if joints != parked:
        raise ConfigError(
            f"{arm.name} has {joints} joints, workspace.park_rad has {parked}",
            hint="give one angle a joint",
            key="workspace.park_rad",
        )


def _first(cell: Cell, devices: Mapping[str, Any], kind: DeviceKind) -> Any:
    names = cell.names_of(kind)
    return devices[names[0]] if names else None


def flange_from(cell: Cell, device: Any) -> RigidTransform:
    """Return `flange_from_device` from the calibration record; the identity for a device without a mount."""
    if device is None or cell.file.devices[device.name].mount is None:
        return identity()
    mount = cell.calibration_of(device.name).mount
    return identity() if mount is None else mount.pose().parent_from_child


def _load(cell: Cell, wrist: Any) -> ToolLoad:
    """Return the tool load below the force/torque sensor.

    Raises:
        ConfigError: the sensor's calibration record has no load.
    """
    if wrist is None:
        return ToolLoad(mass_kg=0.0, centre_of_mass_m=(0.0, 0.0, 0.0), bias=(0.0,) * 6)
    record = cell.calibration_of(wrist.name)
    if record.load is None:
        raise ConfigError(
            f"the calibration record of {wrist.name} has no load",
            hint="add [load] with mass_kg and centre_of_mass_m of the tool",
            key=f"devices.{wrist.name}.mount.calibration",
        )
    return record.load.load()
