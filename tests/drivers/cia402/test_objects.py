"""Tests of the objects of a drive: checks against its EDS, objects by name, and canopen's own server as the drive."""

import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from uuid import uuid4

import can
import canopen
import pytest

from drivers.cia402.options import Cia402Options
from drivers.cia402.setup import Parameter, SdoClient, SetUp
from drivers.emulators import cia402 as emulator
from drivers.emulators.scripted import ScriptedArm
from drivers.kinds.arms import kinematics_of
from drivers.tfmini_i import CanTfminiOptions
from drivers.transport.canbus import can_opener
from drivers.transport.link import Refused
from drivers.transport.options import read_options
from hal.errors import CellError, ConfigError
from hal.registry import Context
from tests.drivers.rigs import soon, wired

U8, U16, U32, I8, I16, I32, F32, TEXT = 5, 6, 7, 2, 3, 4, 8, 9
Object = tuple[str, int, str, bool, str]  # name, data type, access, mappable, further lines
OBJECTS: dict[tuple[int, int | None], Object] = {
    (0x1000, None): ("Device type", U32, "ro", False, "DefaultValue=0x20192"),
    (0x1016, 1): ("Consumer heartbeat time 1", U32, "rw", False, "DefaultValue=0"),
    (0x1017, None): ("Producer heartbeat time", U16, "rw", False, "DefaultValue=0"),
    (0x1600, 1): ("Mapping 1", U32, "rw", False, "DefaultValue=0x60400010"),
    (0x1600, 2): ("Mapping 2", U32, "rw", False, "DefaultValue=0x607A0020"),
    (0x1A00, 1): ("Mapping 1", U32, "rw", False, "DefaultValue=0x60410010"),
    (0x1A00, 2): ("Mapping 2", U32, "rw", False, "DefaultValue=0x60640020"),
    (0x6040, None): ("Controlword", U16, "rww", True, ""),
    (0x6041, None): ("Statusword", U16, "ro", True, ""),
    (0x6060, None): ("Modes of operation", I8, "rw", True, "DefaultValue=0"),
    (0x6064, None): ("Position actual value", I32, "ro", True, ""),
    (0x6065, None): ("Following error window", U32, "rw", False, "DefaultValue=1000"),
    (0x606C, None): ("Velocity actual value", I32, "ro", True, ""),
    (0x6077, None): ("Torque actual value", I16, "ro", True, ""),
    (0x607A, None): ("Target position", I32, "rww", True, ""),
    (0x60C2, 1): ("Interpolation time period value", U8, "rw", False, "DefaultValue=1\nLowLimit=1\nHighLimit=100"),
    (0x60C2, 2): ("Interpolation time index", I8, "rw", False, "DefaultValue=-3"),
    (0x2000, None): ("Gain", F32, "rw", False, "DefaultValue=1.0"),
    (0x2001, None): ("Label", TEXT, "rw", False, "DefaultValue=x"),
}
RECORDS = {0x1016: "Consumer heartbeat time", 0x1600: "RPDO1", 0x1A00: "TPDO1", 0x60C2: "Interpolation time period"}


def eds(path: Path, changes: dict[tuple[int, int | None], Object | None] | None = None, rates: str = "") -> Path:
    """Write an EDS of a drive, with some objects changed or, by None, left out."""
    objects = {key: entry for key, entry in {**OBJECTS, **(changes or {})}.items() if entry is not None}
    parts = [f"[DeviceInfo]\nVendorName=nobody\n{rates}\n"]
    for index, name in RECORDS.items():
        count = sum(key[0] == index for key in objects)
        parts.append(f"[{index:04X}]\nParameterName={name}\nObjectType=0x9\nSubNumber={count}\n")
    for (index, sub), (name, data_type, access, is_mappable, more) in objects.items():
        section = f"{index:04X}" + ("" if sub is None else f"sub{sub:X}")
        parts.append(
            f"[{section}]\nParameterName={name}\nObjectType=0x7\nDataType=0x{data_type:04X}\n"
            f"AccessType={access}\nPDOMapping={is_mappable:d}\n{more}\n"
        )
    path.write_text("\n".join(parts), encoding="ascii")
    return path


@pytest.fixture
def sheet(tmp_path: Path) -> Path:
    return eds(tmp_path / "drive.eds")


def options(**given: Any) -> Cia402Options:
    kinematics = kinematics_of(ScriptedArm().capabilities())
    return read_options(Context(name="arm"), {"channel": "can0", "kinematics": kinematics, **given}, Cia402Options)


def test_objects_are_named_as_in_the_eds_or_numbered(sheet: Path) -> None:
    given = {
        "Following error window": 5000,
        "Interpolation time period.Interpolation time period value": 4,
        "0x60C2:2": -3,
        "Gain": 0.5,
    }
    assert options(eds=str(sheet), parameters=given).written() == [
        Parameter(0x6065, 0, 5000, struct.pack("<I", 5000)),
        Parameter(0x60C2, 1, 4, b"\x04"),
        Parameter(0x60C2, 2, -3, b"\xfd"),
        Parameter(0x2000, 0, 0, struct.pack("<f", 0.5)),
    ]
    assert options(parameters={"6065": 5000, "60C2h:1": 4}).written() == [
        Parameter(0x6065, 0, 5000, None),
        Parameter(0x60C2, 1, 4, None),
    ]


def test_every_fault_of_a_drive_is_told_at_once(tmp_path: Path) -> None:
    changes: dict[tuple[int, int | None], Object | None] = {
        (0x607A, None): ("Target position", I16, "ro", False, ""),
        (0x6077, None): None,
        (0x6064, None): ("Position actual value", I32, "wo", True, ""),
        (0x1A00, 2): ("Mapping 2", U32, "const", False, "DefaultValue=0x606C0020"),
    }
    path = eds(tmp_path / "odd.eds", changes, rates="BaudRate_250=1\nBaudRate_500=1")
    with pytest.raises(ConfigError) as caught:
        options(eds=str(path), parameters={"Following eror window": 1, "6040": 6})
    for told in (
        "the drive does not have the bit rate 1000000",
        "607Ah is INTEGER16, not INTEGER32",
        "607Ah cannot be written",
        "607Ah cannot be mapped into a PDO",
        "there is no object 6077h",
        "6064h cannot be read",
        "1A00h:2 always maps 606C0020, not 60640020",
        "'Following eror window' is no object of the EDS; is it 'Following error window'?",
        "'6040' is 6040h, which the driver sets itself",
    ):
        assert told in caught.value.what


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("Interpolation time period.Interpolation time period value", 101, "must be from 1 to 100, not 101"),
        ("Following error window", -1, "must be from 0 to 4294967295"),
        ("Following error window", 0.5, "is UNSIGNED32, so 0.5 is no value of it"),
        ("6064", 1, "(6064h) cannot be written"),
        ("Label", 1, "which is not a number of up to 32 bits"),
        ("3000", 1, "it has no object 3000h"),
    ],
)
def test_a_value_that_does_not_fit_is_refused(sheet: Path, key: str, value: float, told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        options(eds=str(sheet), parameters={key: value})
    assert told in caught.value.what


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"parameters": {"Gain": 1}}, "names need `eds`"),
        ({"parameters": {"6065": 0.5}}, "only whole numbers"),
        ({"eds": "nowhere.eds"}, "cannot be read as an EDS"),
    ],
)
def test_names_need_an_eds_that_can_be_read(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        options(**given)


@pytest.mark.filterwarnings("ignore:The 'warn' method is deprecated")  # in canopen
@pytest.mark.parametrize("text", ["", "[607A]\n", "not an EDS"])
def test_a_file_that_is_no_eds_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "drive.eds"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"drive\.eds"):
        options(eds=str(path))


@pytest.fixture
def canopen_drive(sheet: Path) -> Iterator[tuple[str, Any]]:
    """Yield a channel and the drive on it: canopen's own SDO server with the objects of the EDS."""
    channel = uuid4().hex
    network = canopen.Network(can.Bus(channel, "virtual"))
    network.connect()
    try:
        yield channel, network.create_node(1, str(sheet))
    finally:
        network.disconnect()


def test_canopens_server_is_configured_and_its_objects_are_written(canopen_drive: tuple[str, Any], sheet: Path) -> None:
    channel, drive = canopen_drive
    parameters = options(
        eds=str(sheet), parameters={"Following error window": 70_000, "Gain": 2.5, "60C2:2": -4}
    ).written()
    parameters.append(Parameter(0x60C2, 1, 8, None))
    opener, _ = can_opener(CanTfminiOptions(channel=channel, interface="virtual"), "arm")
    with closing(opener()) as link:
        SetUp([1], consumer=127 << 16 | 100, producer_ms=50, parameters=parameters).run(SdoClient(link))
        with pytest.raises(Refused, match="300 does not fit into object 60C2h:1"):
            SetUp([1], consumer=1, producer_ms=50, parameters=[Parameter(0x60C2, 1, 300, None)]).run(SdoClient(link))
    assert drive.sdo[0x6065].raw == 70_000
    assert drive.sdo[0x2000].raw == 2.5
    assert (drive.sdo[0x60C2][1].raw, drive.sdo[0x60C2][2].raw) == (8, -4)
    assert drive.sdo[0x6060].raw == 8


def test_parameters_reach_every_drive_before_it_starts(sheet: Path) -> None:
    far_side = emulator.start(ScriptedArm(), {})
    for drive in far_side.drives.values():
        drive.objects[(0x6065, 0)] = bytes(4)
    with wired(far_side, "can:cia402", {"eds": str(sheet), "parameters": {"Following error window": 77}}) as device:
        device.newest(soon())
        assert {drive.objects[(0x6065, 0)] for drive in far_side.drives.values()} == {struct.pack("<I", 77)}


def test_a_drive_that_lacks_an_object_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.cia402.arm.CONNECT_S", 3.0)
    far_side = emulator.start(ScriptedArm(), {})
    with (
        pytest.raises(CellError, match=r"node 1: object 6065h: .*no such object"),
        wired(far_side, "can:cia402", {"parameters": {"6065": 5}}),
    ):
        raise AssertionError("it connected")
