"""What a cell needs of the machine, checked before anything starts, so that the message is about the cause."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from scipy.spatial.transform import RigidTransform

from hal.config import Cell
from hal.errors import ConfigError
from hal.frames import frame_tree
from hal.registry import device_factory

PYTHON = (3, 11)


def check_machine(cell: Cell) -> None:
    """Python's version, the simulator's engine, and that every driver and frame of the cell exists.

    Raises:
        ConfigError: names what is missing and how to get it.
    """
    check_python()
    frame_tree(cell, RigidTransform.identity())  # a mount on a frame that is not there would show at the first look
    for name, section in cell.file.devices.items():
        if section.driver.startswith("sim:"):
            check_simulator(f"devices.{name}")
        try:
            device_factory(section.driver)
        except ConfigError as error:
            key = f"devices.{name}.driver"
            raise ConfigError(
                f"{cell.path}: {key}: {error.what}", hint=error.hint, file=str(cell.path), key=key
            ) from None


def check_python() -> None:
    """Raise `ConfigError` unless this is the Python that all our wheels exist for."""
    if sys.version_info[:2] != PYTHON:
        raise ConfigError(
            f"this is Python {sys.version_info[0]}.{sys.version_info[1]}; panelwright needs {PYTHON[0]}.{PYTHON[1]}",
            hint="install Python 3.11 and run `make setup`",
        )


def check_simulator(key: str) -> None:
    """Raise `ConfigError` unless PyBullet is installed; it is looked for, not imported."""
    if find_spec("pybullet") is None:
        raise ConfigError(
            f"{key} is simulated, but PyBullet is not installed",
            hint="run `make setup` (it installs pybullet 3.2.7, which needs Python 3.11)",
            key=key,
        )
