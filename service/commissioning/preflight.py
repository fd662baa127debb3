"""Checks what a cell needs from the machine and the wires before anything starts, so that errors name the cause."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib.util import find_spec
from itertools import combinations

from scipy.spatial.transform import RigidTransform

from hal.config import Cell, DeviceSection
from hal.errors import REINSTALL, ConfigError
from hal.frames import frame_tree
from hal.wires import claims_of, clash
from service.commissioning.cell_check import check_cell

PYTHON = (3, 11)


def check_machine(cell: Cell) -> None:
    """Check Python's version, the simulator's engine, the cell file's plausibility, and that no two devices use one wire.

    Raises:
        ConfigError: names what is missing and how to get it.
    """
    check_python()
    frame_tree(cell, RigidTransform.identity())  # finds mounts on frames that do not exist
    for name, section in cell.file.devices.items():
        if section.driver.startswith("sim:"):
            check_simulator(f"devices.{name}")
    check_cell(cell)
    check_wires(cell)


def check_wires(cell: Cell, others: Mapping[str, DeviceSection] | None = None) -> None:
    """Raise `ConfigError` when two devices use the same port or connection, or the same address on a shared bus.

    Args:
        others: sections that replace those of the cell file.
    """
    others = others or {}
    emulated = cell.file.emulators.keys() - others.keys()  # their wires are created later
    sections = {**cell.file.devices, **others}
    isolated = {name: section.isolate for name, section in sections.items()}
    takes = [
        (name, claim)
        for name, section in sections.items()
        if name not in emulated
        for claim in claims_of(section.driver, section.options)
    ]
    for (name, one), (other_name, other) in combinations(takes, 2):
        found = clash(one, other, apart=isolated[name] or isolated[other_name])
        if found is not None and name != other_name:
            what, hint = found
            raise ConfigError(
                f"{cell.path}: devices.{name} and devices.{other_name} {what}",
                hint=hint,
                file=str(cell.path),
                key=f"devices.{other_name}.options",
            )


def check_python() -> None:
    """Raise `ConfigError` unless this is the Python version for which all required wheels exist."""
    if sys.version_info[:2] != PYTHON:
        raise ConfigError(
            f"this is Python {sys.version_info[0]}.{sys.version_info[1]}; panelwright needs {PYTHON[0]}.{PYTHON[1]}",
            hint=f"{REINSTALL}, with Python 3.11",
        )


def check_simulator(key: str) -> None:
    """Raise `ConfigError` unless PyBullet is installed, without importing it."""
    if find_spec("pybullet") is None:
        raise ConfigError(
            f"{key} is simulated, but PyBullet is not installed",
            hint=f"{REINSTALL}; pybullet 3.2.7 comes with it and needs Python 3.11",
            key=key,
        )
