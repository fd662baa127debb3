"""Cells with real drivers differ from the simulated ones in the backends only, and the drivers find their emulators."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from drivers.emulators import modbus_io, scripted, tfmini
from hal.config import load_cell
from hal.devices import DeviceKind
from hal.registry import Context, connect, emulator_factory
from tests.drivers.rigs import soon

CELLS = Path(__file__).parents[2] / "cells"
WIRED = {
    "mixed.toml": "bench.toml",
    "wire-ur.toml": "ur10e.toml",
    "wire-cia402.toml": "bench.toml",
    "wire-dynamixel.toml": "bench.toml",
    "wire-ros2.toml": "ur10e.toml",
}
STAND_INS: dict[DeviceKind, Any] = {
    DeviceKind.ARM: scripted.ScriptedArm,
    DeviceKind.GRIPPER: scripted.ScriptedGripper,
    DeviceKind.LIGHTS: scripted.ScriptedLights,
    DeviceKind.PROXIMITY: scripted.ScriptedProximity,
    DeviceKind.TOUCH: scripted.ScriptedTouch,
    DeviceKind.FORCE_TORQUE: scripted.ScriptedForceTorque,
}


def table(name: str) -> dict[str, Any]:
    return tomllib.loads((CELLS / name).read_text())


def without_backend(cell: dict[str, Any]) -> dict[str, Any]:
    """Return a cell file without the parts that may differ between backends."""
    cell.pop("emulators", None)
    cell["cell"].pop("mode")
    cell["cell"].pop("name")
    for device in cell["devices"].values():
        device.pop("driver")
        device.pop("options", None)
    return cell


@pytest.mark.parametrize("name", WIRED)
def test_only_mode_drivers_options_and_emulators_differ(name: str) -> None:
    mixed, simulated = table(name), table(WIRED[name])
    assert mixed["cell"]["mode"] == "mixed"
    wired = {name for name, device in mixed["devices"].items() if not device["driver"].startswith("sim:")}
    assert wired == set(mixed["emulators"])
    assert without_backend(mixed) == without_backend(simulated)


@pytest.mark.parametrize("name", WIRED)
def test_wired_devices_connect_to_their_emulators(name: str) -> None:
    """Connect as the cell process does, with scripted devices instead of the simulator."""
    cell = load_cell(CELLS / name)
    for device_name, section in cell.file.emulators.items():
        wanted = cell.file.devices[device_name]
        far_side = emulator_factory(section.emulator)(STAND_INS[wanted.kind](), section.emulator_options)
        device: Any = None
        try:
            context = Context(name=device_name, cell=cell)
            device = connect(context, wanted.driver, {**wanted.options, **far_side.address})
            assert device.kind is wanted.kind
            assert device.health().connected
            if wanted.kind is DeviceKind.LIGHTS:
                assert device.capabilities().channels == tuple(light.name for light in cell.panel.lights)
                assert device.set_on([True] * 4, deadline=soon()) == (True,) * 4
        finally:
            if device is not None:
                device.close()
            far_side.close()


def test_the_emulators_are_registered() -> None:
    assert emulator_factory("modbus_io") is modbus_io.start
    assert emulator_factory("tfmini") is tfmini.start


@pytest.mark.parametrize("mode", ["mixed", "real"])
def test_only_a_real_cell_takes_older_states_than_the_driver_would(mode: str) -> None:
    """With a simulated world the age limit is short, because the arm would be 25 mm away from a state 0.1 s old."""
    cell = load_cell(CELLS / "wire-ur.toml")
    parts = cell.file.model_copy(update={"cell": cell.file.cell.model_copy(update={"mode": mode})})
    far_side = emulator_factory("ur")(scripted.ScriptedArm(), {"rate_hz": 125.0})
    device: Any = None
    try:
        context = Context(name="arm", cell=cell.model_copy(update={"file": parts}))
        device = connect(context, "ur:rtde", {"rate_hz": 125.0, **far_side.address})
        oldest_s = cell.file.safety.max_reading_age_s
        assert device.max_age_s == (oldest_s if mode == "real" else pytest.approx(2.5 / 125.0))
    finally:
        if device is not None:
            device.close()
        far_side.close()
