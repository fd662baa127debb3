"""Joins the cell's devices to the control thread of `manipulation`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hal.clock import Clock
from hal.config import Cell
from hal.devices import DeviceKind
from hal.errors import CellError, ConfigError


def start_controller(cell: Cell, devices: Mapping[str, Any], *, clock: Clock, is_latched: Callable[[], bool]) -> Any:
    """The control thread over the first arm, gripper, force/torque and touch sensor and all proximity sensors.

    Raises:
        ConfigError: a part that motion needs is missing from the cell file.
    """
    from manipulation.control import Controller

    wrist = _one(cell, devices, DeviceKind.FORCE_TORQUE)
    record = cell.calibration_of(wrist.name)
    if record.mount is None or record.load is None:
        raise ConfigError(
            f"the calibration record of {wrist.name} has no mount or no load",
            hint="add [mount] and [load] (tool mass and centre) to it",
            key=f"devices.{wrist.name}.mount.calibration",
        )
    controller = Controller(
        _one(cell, devices, DeviceKind.ARM),
        _one(cell, devices, DeviceKind.GRIPPER),
        wrist,
        _one(cell, devices, DeviceKind.TOUCH),
        tuple(devices[name] for name in cell.names_of(DeviceKind.PROXIMITY)),
        clock=clock,
        safety=cell.file.safety,
        load=record.load.load(),
        flange_from_sensor=record.mount.pose().parent_from_child,
        is_latched=is_latched,
    )
    try:
        controller.start()
    except CellError:
        controller.close()
        raise
    return controller


def _one(cell: Cell, devices: Mapping[str, Any], kind: DeviceKind) -> Any:
    names = cell.names_of(kind)
    if not names:
        raise ConfigError(
            f"{cell.path}: a cell with an arm needs a device of kind {kind}",
            hint=f"add [devices.NAME] with kind = {str(kind)!r}",
            file=str(cell.path),
            key="devices",
        )
    return devices[names[0]]
