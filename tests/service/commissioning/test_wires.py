"""Two devices of a cell that claim one link are distinguished from those that share a bus before a port is opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from drivers.emulators.scripted import ScriptedArm
from drivers.kinds.arms import kinematics_of
from hal.config import Cell, DeviceSection, load_cell
from hal.devices import DeviceKind
from hal.errors import ConfigError
from service.commissioning.preflight import check_wires

CELL = load_cell(Path(__file__).parents[3] / "cells" / "bench.toml")
KINEMATICS = kinematics_of(ScriptedArm().capabilities())
USB = {"port": "/dev/ttyUSB0"}
TCP = {"host": "10.0.0.5", "port": 502}
LAN_CAN = {"channel": "tcp://10.0.0.7:3333"}
Device = tuple[str, dict[str, Any]]


def cell_of(*devices: Device, names: tuple[str, ...] = ("first", "second")) -> Cell:
    sections = {
        name: DeviceSection(kind=DeviceKind.PROXIMITY, driver=driver, options=options)  # only driver and options matter
        for name, (driver, options) in zip(names, devices, strict=True)
    }
    return CELL.model_copy(update={"file": CELL.file.model_copy(update={"devices": sections})})


@pytest.mark.parametrize(
    ("one", "other", "says"),
    [
        (("serial:tfmini", USB), ("serial:bota", USB), "both use serial /dev/ttyUSB0"),
        (("serial:tfmini", USB), ("serial:tfmini", {"port": "/dev/../dev/ttyUSB0"}), "/dev/ttyUSB0"),
        (("serial:rplidar", USB), ("modbus:touch", USB), "both use serial /dev/ttyUSB0"),
        (("scip:scanner", {"host": "10.0.0.9"}), ("scip:scanner", {"host": "10.0.0.9"}), "tcp 10.0.0.9:10940"),
        (("udp:netft", {"host": "10.0.0.9"}), ("udp:netft", {"host": "10.0.0.9"}), "udp 10.0.0.9:49152"),
        (("v4l2:camera", {}), ("v4l2:camera", {}), "camera /dev/video0"),
        (("modbus:ft300", TCP), ("modbus:robotiq_2f", TCP), "both are unit 9 on tcp 10.0.0.5:502 (Modbus TCP)"),
        (("modbus:lights", TCP), ("modbus:tfmini", TCP), "both are unit 1"),
        (("modbus:ft300", USB), ("modbus:robotiq_2f", {**USB, "unit": 3}), "Modbus RTU at 19200 baud"),
        (("can:tfmini", LAN_CAN), ("can:tfmini", LAN_CAN), "both are identifier 0x003 on CAN tcp://10.0.0.7:3333"),
        (("can:tfmini", {"channel": "can0"}), ("can:tfmini", {"channel": "can0", "bitrate": 500_000}), "bit/s"),
        (("can:tfmini", {"channel": "/dev/ttyACM0"}), ("can:tfmini", {"channel": "/dev/ttyACM0", "id": 4}), "ttyACM0"),
        (
            ("can:cia402", {"channel": "can0", "kinematics": KINEMATICS, "nodes": (1, 2, 3, 4, 5, 6)}),
            ("can:cia402", {"channel": "can0", "kinematics": KINEMATICS, "nodes": (6, 7, 8, 9, 10, 11)}),
            "both are node 6 on CAN can0",
        ),
        (
            ("serial:dynamixel", {**USB, "kinematics": KINEMATICS}),
            ("serial:dynamixel_gripper", {**USB, "id": 4}),
            "both are servo 4 on serial /dev/ttyUSB0",
        ),
        (("ur:rtde", {"host": "ur"}), ("ur:rtde", {"host": "UR"}), "both are the arm on tcp ur:30004"),
        (("ur:lights", {"host": "ur"}), ("ur:lights", {"host": "ur"}), "the digital outputs"),
    ],
)
def test_one_wire_wanted_twice_is_refused_by_both_names(one: Device, other: Device, says: str) -> None:
    with pytest.raises(ConfigError) as refused:
        check_wires(cell_of(one, other))
    assert "bench.toml: devices.first and devices.second " in refused.value.what
    assert says in refused.value.what and refused.value.hint
    check_wires(cell_of(one, (other[0], {**other[1], "replay": "scan.jsonl"})))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (("serial:tfmini", USB), ("serial:tfmini", {"port": "/dev/ttyUSB1"})),
        (("modbus:lights", TCP), ("modbus:touch", TCP)),  # the functions of one I/O box
        (("modbus:lights", TCP), ("modbus:ft300", TCP)),
        (("modbus:ft300", USB), ("modbus:robotiq_2f", {**USB, "unit": 3, "baud": 19_200})),
        (("can:tfmini", {"channel": "can0"}), ("can:tfmini", {"channel": "can0", "id": 4})),
        (("serial:dynamixel", {**USB, "kinematics": KINEMATICS}), ("serial:dynamixel_gripper", USB)),
        (("ur:rtde", {"host": "ur"}), ("ur:lights", {"host": "ur"})),
        (("udp:netft", {"host": "10.0.0.5", "port": 502}), ("modbus:touch", TCP)),
        (("sim:proximity", {}), ("sim:proximity", {})),
        (("serial:tfmini", USB), ("serial:tfmini", {**USB, "baud": "fast"})),  # connecting reports the error
    ],
)
def test_a_bus_that_is_meant_to_be_shared_is(one: Device, other: Device) -> None:
    check_wires(cell_of(one, other))


def test_another_name_of_the_same_port_does_not_hide_it(tmp_path: Path) -> None:
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB0")
    names = [{"port": str(tmp_path / name)} for name in ("ttyUSB0", "by-id")]
    with pytest.raises(ConfigError, match="both use serial"):
        check_wires(cell_of(("serial:tfmini", names[0]), ("serial:tfmini", names[1])))


def test_an_isolated_device_shares_no_serial_bus() -> None:
    """An isolated device's process opens the port itself; a gateway accepts several connections."""
    for wire, is_fine in ((USB, False), (TCP, True)):
        cell = cell_of(("modbus:ft300", wire), ("modbus:robotiq_2f", {**wire, "unit": 3, "baud": 19_200}))
        alone = cell.file.devices["first"].model_copy(update={"isolate": True})
        if is_fine:
            check_wires(cell, {"first": alone})
            continue
        with pytest.raises(ConfigError, match="one of them is isolated"):
            check_wires(cell, {"first": alone})


def test_a_swap_is_checked_against_the_others_only() -> None:
    cell = cell_of(("serial:tfmini", USB), ("serial:bota", {"port": "/dev/ttyUSB1"}))
    same = cell.file.devices["first"]
    check_wires(cell, {"first": same})
    with pytest.raises(ConfigError, match="second both use serial /dev/ttyUSB0"):
        check_wires(cell, {"second": same})


def test_an_emulated_device_gets_its_wire_later() -> None:
    cell = load_cell(Path(__file__).parents[3] / "cells" / "wire-cia402.toml")
    sections = {
        name: section.model_copy(update={"options": {**section.options, **USB}})
        for name, section in cell.file.devices.items()
    }
    check_wires(cell.model_copy(update={"file": cell.file.model_copy(update={"devices": sections})}))
