"""Checks the code of the drivers against every frame of the shared test vectors."""

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from drivers.cia402.states import state_of
from drivers.dynamixel import protocol
from drivers.robotiq_2f import decode_status, encode_command
from drivers.rplidar.scanner import descriptor
from drivers.scip import checked, decode_number
from drivers.tfmini import command
from drivers.transport.checks import crc_modbus, xor_byte
from drivers.transport.link import NoAnswer, Refused, now_s
from drivers.transport.modbus import ModbusMaster, ModbusRtu, ModbusTcp
from drivers.ur import rtde
from tests.drivers.vendor_frames import cola_a, cola_b, cola_b_framer, decode_cola_a, decode_xarm, xarm

FILE = Path(__file__).parents[3] / "shared" / "data" / "drivers" / "vectors.json"
VECTORS: list[dict[str, Any]] = json.loads(FILE.read_text())["vectors"] if FILE.exists() else []
pytestmark = pytest.mark.skipif(not VECTORS, reason="the shared test vectors are not beside this repository")


def of_kind(kind: str) -> Any:
    return pytest.mark.parametrize("v", [pytest.param(v, id=v["id"]) for v in VECTORS if v["kind"] == kind])


class OneAnswer:
    """Link that stores what is written and gives one answer."""

    name = "vector"
    byte_s = 0.0

    def __init__(self, answer: bytes = b"") -> None:
        self.written = b""
        self._answer, self._ready = answer, b""

    def read(self, until_s: float) -> bytes:
        chunk, self._ready = self._ready, b""
        return chunk

    def write(self, data: bytes, until_s: float) -> None:
        self.written += data
        self._ready, self._answer = self._answer, b""

    def is_present(self) -> bool:
        return True

    def close(self) -> None:
        self._ready = b""


def rtu(link: OneAnswer) -> ModbusRtu:
    return ModbusRtu(link, timeout_s=0.01, gap_s=0.0, is_clear=True)


def ask(master: ModbusMaster, e: dict[str, Any]) -> None:
    """Send the request that a vector describes, without an answer."""
    unit, address, until_s = e["unit"], e["address"], now_s()  # one attempt
    with pytest.raises(NoAnswer):
        if e["fc"] == 16:
            master.write_registers(unit=unit, address=address, values=e["registers"], until_s=until_s)
        elif e["fc"] in (3, 4):
            master.read_registers(unit=unit, address=address, count=e["count"], until_s=until_s, function=e["fc"])
        else:
            master.read_bits(unit=unit, address=address, count=e["count"], until_s=until_s, function=e["fc"])


@of_kind("modbus_rtu")
def test_modbus_rtu(v: dict[str, Any]) -> None:
    frame, e = bytes.fromhex(v["hex"]), v["expect"]
    assert crc_modbus(frame[:-2]) == frame[-2] | frame[-1] << 8
    if v.get("partial"):
        assert frame[-2:].hex() == e["crc_bytes_on_wire"]
        return
    is_request = v["id"].endswith("-req")
    if is_request:
        link = OneAnswer()
        ask(rtu(link), e)
        assert link.written == frame
    elif e["fc"] in (3, 4):
        words = rtu(OneAnswer(frame)).read_registers(
            unit=e["unit"], address=0, count=len(e["registers"]), until_s=now_s() + 1.0, function=e["fc"]
        )
        assert list(words) == e["registers"]
    elif v["id"].endswith("-ans") and e["fc"] == 16:
        rtu(OneAnswer(frame)).write_registers(
            unit=e["unit"], address=e["address"], values=[0] * e["count"], until_s=now_s() + 1.0
        )
    elif e["fc"] == 6:
        assert frame[:-2] == struct.pack(">BBHH", e["unit"], 6, e["address"], e["value"])
    else:
        assert frame[2] == 2 * len(e["registers"])
        assert list(struct.unpack(f">{len(e['registers'])}H", frame[3:-2])) == e["registers"]


@of_kind("modbus_rtu")
def test_gripper_fields(v: dict[str, Any]) -> None:
    e = v["expect"]
    if "rPR" in e:
        action = e["rACT"] | e["rGTO"] << 3
        words = encode_command(action=action, position=e["rPR"], speed=e["rSP"], force=e["rFR"])
        assert list(words) == e["registers"]
    if "gSTA" in e:
        status = decode_status((*e["registers"], 0, 0)[:3])
        assert (status.is_activated, status.goes_to) == (bool(e["gACT"]), bool(e["gGTO"]))
        assert (status.state, status.object) == (e["gSTA"], e["gOBJ"])
    if "gPO" in e:
        assert (status.fault, status.echo, status.position) == (e["gFLT"], e["gPR"], e["gPO"])
        assert status.current_ma == e["current_mA"]


@of_kind("modbus_tcp")
def test_modbus_tcp(v: dict[str, Any]) -> None:
    frame, e = bytes.fromhex(v["hex"]), v["expect"]
    until_s = now_s() + 1.0
    if "exception" in e:
        with pytest.raises(Refused) as caught:
            _tcp(frame).read_bits(unit=1, address=0, count=16, until_s=until_s, function=e["fc"] & 0x7F)
        assert caught.value.code == e["exception"]
    elif "bits_low" in e:
        bits = _tcp(frame).read_bits(unit=e["unit"], address=0, count=16, until_s=until_s, function=e["fc"])
        assert sum(1 << i for i, bit in enumerate(bits[:8]) if bit) == e["bits_low"]
    elif e["fc"] == 5:  # the drivers never send it (see drivers.transport.modbus), but the emulator understands it
        assert frame[6:] == struct.pack(">BBHH", e["unit"], 5, e["address"], 0xFF00 * e["value"])
    else:
        link = OneAnswer()
        ask(ModbusTcp(link, timeout_s=0.01), e)
        assert link.written == frame


def _tcp(answer: bytes) -> ModbusTcp:
    return ModbusTcp(OneAnswer(answer), timeout_s=0.01)


@of_kind("dxl2")
def test_dynamixel(v: dict[str, Any]) -> None:
    frame, e = bytes.fromhex(v["hex"]), v["expect"]
    assert protocol.framer().feed(frame) == [frame]
    packet = protocol.decode(frame)
    assert packet.id == e["id"]
    assert protocol.encode(packet.id, packet.instruction, packet.parameters) == frame
    if "error" in e:
        assert (packet.instruction, packet.parameters[0]) == (protocol.STATUS, e["error"])
        data = packet.parameters[1:]
        if "value" in e:
            assert int.from_bytes(data, "little") == e["value"]
        if "model" in e:
            assert struct.unpack("<HB", data) == (e["model"], e["firmware"])
        return
    assert packet.instruction == e["inst"]
    if "ids" in e:
        assert protocol.sync_read(e["address"], e["length"], e["ids"]) == frame
    elif "values" in e:
        values = {int(i): x.to_bytes(e["length"], "little") for i, x in e["values"].items()}
        assert protocol.sync_write(e["address"], e["length"], values) == frame
    elif "items" in e:
        assert protocol.bulk_read([tuple(item) for item in e["items"]]) == frame
    elif e["inst"] == protocol.READ:
        assert protocol.read(e["id"], e["address"], e["length"]) == frame
    elif "value" in e:
        assert struct.unpack_from("<H", packet.parameters)[0] == e["address"]
        assert int.from_bytes(packet.parameters[2:], "little") == e["value"]


@of_kind("scip_code")
def test_scip_numbers(v: dict[str, Any]) -> None:
    assert decode_number(bytes.fromhex(v["hex"])) == v["expect"]["value"]


@of_kind("scip_sum")
def test_scip_sums(v: dict[str, Any]) -> None:
    line = bytes.fromhex(v["hex"])
    assert checked(line) == line[:-1]


@of_kind("sum8")
def test_benewake_commands(v: dict[str, Any]) -> None:
    frame, e = bytes.fromhex(v["hex"]), v["expect"]
    assert command(e["cmd"], frame[3:-1]) == frame
    if "rate_hz" in e:
        assert struct.unpack("<H", frame[3:5]) == (e["rate_hz"],)


@of_kind("rplidar")
def test_rplidar_frames(v: dict[str, Any]) -> None:
    frame, e = bytes.fromhex(v["hex"]), v["expect"]
    assert frame[0] == 0xA5
    if "length" in e:
        assert descriptor(e["length"], e["mode"], e["type"]) == frame


@of_kind("rtde")
def test_rtde_packages(v: dict[str, Any]) -> None:
    frame, e = bytes.fromhex(v["hex"]), v["expect"]
    ((kind, payload),) = rtde.PackageParser().feed(frame)
    assert kind == e["type"]
    assert rtde.package(kind, payload) == frame
    if "accepted" in e:
        assert bool(payload[0]) is e["accepted"]
    if "version" in e:
        assert list(struct.unpack(">4I", payload)) == e["version"]
    if "frequency" in e:
        assert rtde.outputs_request(e["names"], e["frequency"]) == frame
        assert list(rtde.split_names(payload[8:])) == e["names"]
    if "speed_slider_mask" in e:
        recipe = rtde.recipe(e["recipe"], ["speed_slider_mask"], ["UINT32"])
        assert recipe.unpack(payload) == {"speed_slider_mask": e["speed_slider_mask"]}


@of_kind("rtde_payload")
def test_rtde_payloads(v: dict[str, Any]) -> None:
    payload, e = bytes.fromhex(v["hex"]), v["expect"]
    recipe = rtde.recipe(e["recipe"], ["timestamp", "actual_q"], ["DOUBLE", "VECTOR6D"])
    values = recipe.unpack(payload)
    assert payload[0] == recipe.id
    assert values["timestamp"] == pytest.approx(e["timestamp"], abs=e["tolerance"])
    assert values["actual_q"] == pytest.approx(e["actual_q"], abs=e["tolerance"])


@of_kind("xarm")
def test_xarm_frames(v: dict[str, Any]) -> None:
    frame, e = bytes.fromhex(v["hex"]), v["expect"]
    got = decode_xarm(frame, is_answer="state" in e)
    assert (got.tid, got.register) == (e["tid"], e["reg"])
    if "state" in e:
        assert got.state == e["state"]
        assert got.is_unable_to_move
    else:
        assert xarm(got.tid, got.register, got.parameters) == frame


@of_kind("cola_a")
def test_cola_a(v: dict[str, Any]) -> None:
    frame = bytes.fromhex(v["hex"])
    assert decode_cola_a(frame) == v["expect"]["text"]
    assert cola_a(v["expect"]["text"]) == frame


@of_kind("cola_b")
def test_cola_b(v: dict[str, Any]) -> None:
    frame, e = bytes.fromhex(v["hex"]), v["expect"]
    assert cola_b_framer().feed(b"\x02" + frame) == [frame]
    payload = frame[8:-1]
    assert payload.startswith(e["command"].encode())
    assert xor_byte(payload) == e["checksum_xor"]
    assert cola_b(payload) == frame


@of_kind("statusword")
def test_drive_states(v: dict[str, Any]) -> None:
    word = int(v["hex"], 16)
    assert state_of(word) == v["expect"]["state"]
    for free_bit in (4, 7, 8, 9, 10, 11, 12, 13, 14, 15):
        assert state_of(word ^ 1 << free_bit) == v["expect"]["state"]


def test_no_kind_is_left_out() -> None:
    covered = {"modbus_rtu", "modbus_tcp", "dxl2", "scip_code", "scip_sum", "sum8", "rplidar", "rtde", "rtde_payload"}
    assert {v["kind"] for v in VECTORS} <= covered | {"xarm", "cola_a", "cola_b", "statusword"}
