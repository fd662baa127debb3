"""Finds all implausible values of a cell file before anything is connected, and reports them together."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from hal.config import Cell, DeviceSection
from hal.devices import ArmCapabilities, DeviceKind
from hal.errors import ConfigError
from hal.geometry import transform_rpy
from hal.registry import KnowsItsArm, device_factory, kinds_of, options_model
from hal.strict import FieldFault, faults_in, refusal, validate
from manipulation import Kinematics, is_in_reach

FULL_TURN_RAD = math.tau + 1e-3
LARGEST_M = 20.0  # largest plausible length in a cell; more was probably given in millimetres
JOINT_LIMITS = ("lower_rad", "upper_rad")  # excluded from the check of angles, because a joint may turn more than once
LOOKING = (DeviceKind.CAMERA, DeviceKind.RANGE_SCANNER)


def check_cell(cell: Cell) -> None:
    """Raise an error that lists everything implausible in a cell file.

    Raises:
        ConfigError: names key, value and remedy of each fault.
    """
    faults = [*unit_faults(cell.file.model_dump(mode="json", by_alias=True)), *device_faults(cell)]
    if not faults:
        faults = reach_faults(cell)  # only with plausible units, because otherwise nothing would be in reach
    if faults:
        raise refusal(faults, source=str(cell.path))


def unit_faults(data: Any, key: str = "") -> list[FieldFault]:
    """Return faults for angles beyond a full turn and for lengths beyond any cell, in nested tables."""
    if isinstance(data, dict):
        below = [unit_faults(value, f"{key}.{name}".lstrip(".")) for name, value in data.items()]
        return [fault for faults in below for fault in faults]
    if isinstance(data, list | tuple) and data and isinstance(data[0], dict):
        return [fault for k, value in enumerate(data) for fault in unit_faults(value, f"{key}.{k}")]
    numbers = _numbers(data)
    name = key.rpartition(".")[2]
    if name.endswith("_rad") and name not in JOINT_LIMITS and any(abs(n) > FULL_TURN_RAD for n in numbers):
        as_rad = ", ".join(f"{math.radians(n):.4g}" for n in numbers)
        return [
            FieldFault(key, f"{_short(data)} is more than a full turn", f"if these are degrees, write {as_rad} rad")
        ]
    if name.endswith("_m") and not name.endswith("_per_m") and any(abs(n) > LARGEST_M for n in numbers):
        as_m = ", ".join(f"{n / 1e3:.4g}" for n in numbers)
        return [FieldFault(key, f"{_short(data)} is larger than a cell", f"if these are millimetres, write {as_m} m")]
    return []


def device_faults(cell: Cell) -> list[FieldFault]:
    """Return faults for a missing arm, unknown or wrong drivers, options that a driver refuses, and missing mounts."""
    faults = []
    if not cell.names_of(DeviceKind.ARM):
        hint = 'add [devices.arm] with kind = "arm" and its driver; `panelwright doctor` lists them'
        faults.append(FieldFault("devices", "the cell has no arm", hint))
    for name, section in cell.file.devices.items():
        faults += [fault.below(f"devices.{name}") for fault in _faults_of(cell, name, section)]
    return faults


def reach_faults(cell: Cell) -> list[FieldFault]:
    """Return a fault if the panel is out of the arm's reach; needs a driver that knows its kinematics unconnected."""
    reached = objects_in_reach(cell)
    if reached is None or any(reached.values()) or not reached:
        return []
    position_m = list(cell.file.workspace.panel_position_m)
    distance_m = float(np.linalg.norm(position_m))
    return [
        FieldFault(
            "workspace.panel_position_m",
            f"{position_m} is {distance_m:.2f} m from the arm's foot, and the arm reaches none of the panel's objects there",
            "give the place of the panel's middle in the base frame, and panel_rpy_rad so that its z axis points to the arm",
        )
    ]


def objects_in_reach(cell: Cell) -> dict[str, bool] | None:
    """Return for each object whether the gripper can touch it at the panel's nominal pose; None when that is unknown."""
    arm = _known_arm(cell)
    grippers = cell.names_of(DeviceKind.GRIPPER)
    if arm is None or not grippers or cell.file.devices[grippers[0]].mount is None:
        return None
    mount = cell.calibration_of(grippers[0]).mount
    if mount is None:
        return None
    flange_from_grip = transform_rpy(mount.position_m, mount.rpy_rad)
    w = cell.file.workspace
    base_from_panel = transform_rpy(w.panel_position_m, w.panel_rpy_rad)
    kinematics = Kinematics.of(arm, cell.file.safety.joint_limits_rad)
    return {
        each.name: is_in_reach(kinematics, base_from_panel, flange_from_grip, each.point_m)
        for each in cell.panel.objects
    }


def _faults_of(cell: Cell, name: str, section: DeviceSection) -> Iterator[FieldFault]:
    """Yield the faults of one device, with keys relative to its table."""
    try:
        factory = device_factory(section.driver)
    except ConfigError as error:
        yield FieldFault("driver", error.what, error.hint)
        return
    kinds = kinds_of(factory)
    if kinds is not None and section.kind not in kinds:
        are = " and ".join(f"a {kind}" for kind in kinds)
        yield FieldFault(
            "driver", f"{section.driver!r} is {are}, and kind is {section.kind}", _other_driver(section, kinds[0])
        )
    model = options_model(factory)
    if model is not None:
        of_options = faults_in(section.options, model)
        if name in cell.file.emulators:  # the emulator adds the missing options
            of_options = [fault for fault in of_options if fault.is_unknown_key]
        yield from (fault.below("options") for fault in of_options)
    if section.kind in LOOKING and section.mount is None:
        hint = f'add mount = {{ parent = "flange", calibration = "{name}" }} and that calibration record'
        yield FieldFault("mount", f"is missing, so the pose of the {section.kind} is not known", hint)


def _other_driver(section: DeviceSection, is_kind: DeviceKind) -> str:
    return f'give a driver of kind {section.kind} (`panelwright doctor` lists them), or write kind = "{is_kind}"'


def _known_arm(cell: Cell) -> ArmCapabilities | None:
    for name in cell.names_of(DeviceKind.ARM):
        section = cell.file.emulators.get(name) or cell.file.devices[name]
        try:
            model = options_model(device_factory(section.driver))
            options = None if model is None else validate(section.options, model, source="options")
        except ConfigError:
            return None
        if isinstance(options, KnowsItsArm):
            return options.known_arm()
    return None


def _numbers(data: Any) -> list[float]:
    values = data if isinstance(data, list | tuple) else [data]
    flat = [n for value in values for n in (_numbers(value) if isinstance(value, list | tuple) else [value])]
    return [float(n) for n in flat if isinstance(n, int | float) and not isinstance(n, bool)]


def _short(data: Any) -> str:
    text = str(list(data) if isinstance(data, tuple) else data)
    return text if len(text) <= 60 else text[:57] + "..."
