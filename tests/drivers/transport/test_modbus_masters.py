"""Modbus masters over scripted links assign answers to the right requests."""

from __future__ import annotations

import subprocess
import sys

import pytest

from drivers.transport.checks import crc_modbus
from drivers.transport.link import NoAnswer, Refused
from drivers.transport.modbus import ModbusRtu, ModbusTcp
from tests.drivers.rigs import ScriptLink, later


def rtu(body: str) -> bytes:
    data = bytes.fromhex(body)
    return data + crc_modbus(data).to_bytes(2, "little")


OLD, YOUNG = rtu("0904 02 0055"), rtu("0904 02 00aa")


def test_rtu_takes_an_answer_among_noise_echo_and_a_false_header() -> None:
    ask = rtu("0903 07d0 0003")
    answer = rtu("0903 06 3900 00ff 0e0a")
    link = ScriptLink(ask + b"\x09\x03\x06\x00" + answer)
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, is_clear=True)
    registers = master.read_registers(unit=9, address=0x7D0, count=3, until_s=later())
    assert registers == (0x3900, 0x00FF, 0x0E0A)
    assert link.written == [ask]


def test_rtu_never_takes_a_late_answer_for_the_next() -> None:
    old, young = rtu("0902 01 55"), rtu("0902 01 aa")
    probe = rtu("0983 02")  # exception to the function of the probing request
    link = ScriptLink(b"", old + probe, young)
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, quarantine_s=0.0, is_clear=True)
    with pytest.raises(NoAnswer):
        master.read_bits(unit=9, address=0, count=8, until_s=later(0.0))
    bits = master.read_bits(unit=9, address=0, count=8, until_s=later())
    assert sum(1 << i for i, bit in enumerate(bits) if bit) == 0xAA
    assert [frame[1] for frame in link.written] == [2, 3, 2]


def test_a_slave_that_knows_registers_only_is_heard_again_at_once_after_a_lost_answer() -> None:
    """Grippers and force sensors do not answer requests for bits at all."""
    link = ScriptLink(b"", rtu("0984 02"), rtu("0903 02 00aa"))
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, quarantine_s=0.0, is_clear=True)
    with pytest.raises(NoAnswer):
        master.read_registers(unit=9, address=180, count=1, until_s=later(0.0))
    assert master.read_registers(unit=9, address=180, count=1, until_s=later()) == (0xAA,)
    assert [frame[1] for frame in link.written] == [3, 4, 3]


def test_the_first_answer_of_a_session_was_asked_for_in_it() -> None:
    """The port was opened again while an answer of the session before was still on its way."""
    link = ScriptLink(OLD + rtu("09ab 01"), YOUNG)  # the device does not know function 43
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0)
    assert master.read_registers(unit=9, address=180, count=1, until_s=later(), function=4) == (0xAA,)
    assert [frame[1] for frame in link.written] == [43, 4]
    assert master.identity(9, later()) is None


@pytest.mark.parametrize(
    ("answers", "asked"),
    [
        ((b"", OLD + rtu("0983 02"), YOUNG), [43, 3, 4]),  # it answers only functions that it knows
        ((b"", b"", OLD, YOUNG), [43, 3, 4, 4]),  # and it knows no other than this one
    ],
)
def test_a_device_that_does_not_answer_the_probe_is_not_believed_too_early(
    answers: tuple[bytes, ...], asked: list[int]
) -> None:
    link = ScriptLink(*answers)
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, quarantine_s=0.0)
    assert master.read_registers(unit=9, address=180, count=1, until_s=later(), function=4) == (0xAA,)
    assert [frame[1] for frame in link.written] == asked


def test_the_probe_of_a_session_asks_each_unit_who_it_is() -> None:
    vendor, rest = "2b0e 01 83 ff 01 01 00 03 414243", "2b0e 01 83 00 00 02 01 01 44 02 03 312e30"
    link = ScriptLink(rtu("09" + vendor), rtu("09" + rest), rtu("0903 02 0001"), rtu("08ab 01"), rtu("0803 02 0002"))
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0)
    assert master.read_registers(unit=9, address=0, count=1, until_s=later()) == (1,)
    assert str(master.identity(9, later())) == "ABC D 1.0"
    assert master.read_registers(unit=8, address=0, count=1, until_s=later()) == (2,)
    assert [frame[:2] for frame in link.written] == [b"\x09\x2b", b"\x09\x2b", b"\x09\x03", b"\x08\x2b", b"\x08\x03"]


def test_tcp_asks_who_a_device_is_when_told_to() -> None:
    link = ScriptLink(bytes.fromhex("0001 0000 000f 01 2b0e 01 83 00 00 02 00 02 4142 01 01 44"))
    master = ModbusTcp(link, timeout_s=0.01)
    assert str(master.identity(1, later())) == "AB D"
    assert master.identity(1, later()) is not None
    assert len(link.written) == 1


def test_rtu_drops_what_lies_ready_before_it_asks() -> None:
    link = ScriptLink(rtu("0902 01 aa"))
    link.ready = rtu("0902 01 55")
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, is_clear=True)
    assert master.read_bits(unit=9, address=0, count=2, until_s=later()) == (False, True)
    assert master.late_bytes == 6


def test_rtu_refuses_damaged_and_foreign_answers() -> None:
    for wrong in (b"\x09\x02\x01\xaa\x00\x00", rtu("0802 01 aa"), rtu("0902 02 aaaa"), rtu("0901 01 aa")):
        master = ModbusRtu(ScriptLink(wrong), timeout_s=0.01, gap_s=0.0, is_clear=True)
        with pytest.raises(NoAnswer):
            master.read_bits(unit=9, address=0, count=8, until_s=later(0.0))


def test_tcp_matches_transaction_unit_and_function() -> None:
    late = bytes.fromhex("0009 0000 0004 01 02 01 55")
    good = bytes.fromhex("0001 0000 0004 01 02 01 aa")
    link = ScriptLink(late + good)
    master = ModbusTcp(link, timeout_s=0.01)
    bits = master.read_bits(unit=1, address=0, count=8, until_s=later())
    assert bits == tuple(bool(0xAA >> i & 1) for i in range(8))
    master = ModbusTcp(ScriptLink(late), timeout_s=0.01)
    with pytest.raises(NoAnswer, match="do not fit"):
        master.read_bits(unit=1, address=0, count=8, until_s=later(0.0))


def test_exceptions_say_what_they_mean() -> None:
    master = ModbusTcp(ScriptLink(bytes.fromhex("0001 0000 0003 01 81 02")), timeout_s=0.01)
    with pytest.raises(Refused, match="no such address") as caught:
        master.read_bits(unit=1, address=0, count=8, until_s=later(), function=1)
    assert caught.value.code == 2


def test_a_busy_device_is_asked_again_while_there_is_time() -> None:
    link = ScriptLink(rtu("098f 06"), rtu("098f 05"), rtu("090f 0000 0002"))
    ModbusRtu(link, timeout_s=0.01, gap_s=0.0, is_clear=True).write_coils(
        unit=9, address=0, values=[True, False], until_s=later()
    )
    assert len(link.written) == 3


def test_a_device_that_is_busy_in_a_poll_leaves_the_bus_to_others() -> None:
    link = ScriptLink(*4 * [rtu("0982 06")])
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, is_clear=True)
    with pytest.raises(NoAnswer, match=r"exception 6 \(device busy\) to function 2"):
        master.read_bits(unit=9, address=0, count=2, until_s=later(master.attempt_s))
    assert len(link.written) == 1


def test_exceptions_name_the_function_and_a_remedy() -> None:
    master = ModbusRtu(ScriptLink(rtu("0982 02")), timeout_s=0.01, gap_s=0.0, is_clear=True)
    with pytest.raises(Refused, match=r"exception 2 \(no such address\) to function 2") as refused:
        master.read_bits(unit=9, address=0, count=2, until_s=later())
    assert "fewer points" in refused.value.hint


def test_answers_that_come_too_late_are_told_with_the_option_that_waits_longer() -> None:
    link = ScriptLink(b"")
    link.ready = rtu("0902 01 55")  # answer to an earlier request
    with pytest.raises(NoAnswer, match=r"later than `timeout_s` = 0.01 s: 6"):
        ModbusRtu(link, timeout_s=0.01, gap_s=0.0, is_clear=True).read_bits(
            unit=9, address=0, count=2, until_s=later(0.0)
        )


def test_a_device_that_was_slow_to_every_question_is_not_believed_until_it_has_finished() -> None:
    stale, fresh = rtu("09 04 02 00 01"), rtu("09 04 02 00 02")
    link = ScriptLink()
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, quarantine_s=0.01, is_clear=True)
    while {written[1] for written in link.written} != {1, 2, 3, 4}:
        with pytest.raises(NoAnswer):
            master.read_registers(unit=9, address=0, count=1, until_s=later(0.05), function=4)
    link.answers = [stale, fresh]
    assert master.read_registers(unit=9, address=0, count=1, until_s=later(), function=4) == (2,)
    assert master.late_bytes >= len(stale)


def test_pymodbus_is_imported_when_a_link_opens_and_not_before() -> None:
    code = "import sys, drivers.modbus_io, drivers.ft300, drivers.robotiq_2f, drivers.tfmini_i; print('pymodbus' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout == "False\n"
