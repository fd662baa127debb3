"""The mixed cell is the bench cell with two devices on real wires."""

import tomllib
from pathlib import Path
from typing import Any

from drivers.emulators import modbus_io, tfmini
from drivers.emulators.scripted import ScriptedLights, ScriptedProximity
from hal.config import load_cell
from hal.devices import DeviceKind
from hal.registry import Context, connect, emulator_factory
from tests.drivers.rigs import soon

CELLS = Path(__file__).parents[2] / "cells"


def table(name: str) -> dict[str, Any]:
    return tomllib.loads((CELLS / name).read_text())


def without_backend(cell: dict[str, Any]) -> dict[str, Any]:
    """A cell file without what may differ between backends."""
    cell.pop("emulators", None)
    cell["cell"].pop("mode")
    cell["cell"].pop("name")
    for device in cell["devices"].values():
        device.pop("driver")
        device.pop("options", None)
    return cell


def test_only_mode_drivers_options_and_emulators_differ_from_the_bench() -> None:
    mixed, bench = table("mixed.toml"), table("bench.toml")
    assert mixed["cell"]["mode"] == "mixed"
    wired = {name for name, device in mixed["devices"].items() if not device["driver"].startswith("sim:")}
    assert wired == set(mixed["emulators"])
    assert without_backend(mixed) == without_backend(bench)


def test_its_wired_devices_connect_to_its_emulators() -> None:
    """As the cell process does it, with scripted devices in the simulator's place."""
    cell = load_cell(CELLS / "mixed.toml")
    stand_ins = {DeviceKind.LIGHTS: ScriptedLights, DeviceKind.PROXIMITY: ScriptedProximity}
    for name, section in cell.file.emulators.items():
        device_section = cell.file.devices[name]
        far_side = emulator_factory(section.emulator)(stand_ins[device_section.kind](), section.emulator_options)
        context = Context(name=name, cell=cell)
        device = connect(context, device_section.driver, {**device_section.options, **far_side.address})
        try:
            assert device.health().connected
            if device_section.kind is DeviceKind.LIGHTS:
                assert device.capabilities().channels == tuple(light.name for light in cell.panel.lights)
                assert device.set_on([True] * 4, deadline=soon()) == (True,) * 4
        finally:
            device.close()
            far_side.close()


def test_the_emulators_are_registered() -> None:
    assert emulator_factory("modbus_io") is modbus_io.start
    assert emulator_factory("tfmini") is tfmini.start
