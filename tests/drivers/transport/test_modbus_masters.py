"""Modbus masters over scripted links assign answers to the right requests."""

from __future__ import annotations

import pytest

from drivers.transport.checks import crc_modbus
from drivers.transport.link import NoAnswer, Refused
from drivers.transport.modbus import ModbusRtu, ModbusTcp
from tests.drivers.rigs import ScriptLink, later


def rtu(body: str) -> bytes:
    data = bytes.fromhex(body)
    return data + crc_modbus(data).to_bytes(2, "little")


def test_rtu_takes_an_answer_among_noise_echo_and_a_false_header() -> None:
    ask = rtu("0903 07d0 0003")
    answer = rtu("0903 06 3900 00ff 0e0a")
    link = ScriptLink(ask + b"\x09\x03\x06\x00" + answer)
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0)
    registers = master.read_registers(unit=9, address=0x7D0, count=3, until_s=later())
    assert registers == (0x3900, 0x00FF, 0x0E0A)
    assert link.written == [ask]


def test_rtu_never_takes_a_late_answer_for_the_next() -> None:
    old, young = rtu("0902 01 55"), rtu("0902 01 aa")
    probe = rtu("0983 02")  # exception to the function of the probing request
    link = ScriptLink(b"", old + probe, young)
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, quarantine_s=0.0)
    with pytest.raises(NoAnswer):
        master.read_bits(unit=9, address=0, count=8, until_s=later(0.0))
    bits = master.read_bits(unit=9, address=0, count=8, until_s=later())
    assert sum(1 << i for i, bit in enumerate(bits) if bit) == 0xAA
    assert [frame[1] for frame in link.written] == [2, 3, 2]


def test_a_slave_that_knows_registers_only_is_heard_again_at_once_after_a_lost_answer() -> None:
    """Grippers and force sensors do not answer requests for bits at all."""
    link = ScriptLink(b"", rtu("0984 02"), rtu("0903 02 00aa"))
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, quarantine_s=0.0)
    with pytest.raises(NoAnswer):
        master.read_registers(unit=9, address=180, count=1, until_s=later(0.0))
    assert master.read_registers(unit=9, address=180, count=1, until_s=later()) == (0xAA,)
    assert [frame[1] for frame in link.written] == [3, 4, 3]


def test_rtu_drops_what_lies_ready_before_it_asks() -> None:
    link = ScriptLink(rtu("0902 01 aa"))
    link.ready = rtu("0902 01 55")
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0)
    assert master.read_bits(unit=9, address=0, count=2, until_s=later()) == (False, True)
    assert master.late_bytes == 6


def test_rtu_refuses_damaged_and_foreign_answers() -> None:
    for wrong in (b"\x09\x02\x01\xaa\x00\x00", rtu("0802 01 aa"), rtu("0902 02 aaaa"), rtu("0901 01 aa")):
        master = ModbusRtu(ScriptLink(wrong), timeout_s=0.01, gap_s=0.0)
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
    ModbusRtu(link, timeout_s=0.01, gap_s=0.0).write_coils(unit=9, address=0, values=[True, False], until_s=later())
    assert len(link.written) == 3


def test_a_device_that_is_busy_in_a_poll_leaves_the_bus_to_others() -> None:
    link = ScriptLink(*4 * [rtu("0982 06")])
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0)
    with pytest.raises(NoAnswer, match=r"exception 6 \(device busy\) to function 2"):
        master.read_bits(unit=9, address=0, count=2, until_s=later(master.attempt_s))
    assert len(link.written) == 1


def test_exceptions_name_the_function_and_a_remedy() -> None:
    master = ModbusRtu(ScriptLink(rtu("0982 02")), timeout_s=0.01, gap_s=0.0)
    with pytest.raises(Refused, match=r"exception 2 \(no such address\) to function 2") as refused:
        master.read_bits(unit=9, address=0, count=2, until_s=later())
    assert "fewer points" in refused.value.hint


def test_answers_that_come_too_late_are_told_with_the_option_that_waits_longer() -> None:
    link = ScriptLink(b"")
    link.ready = rtu("0902 01 55")  # answer to an earlier request
    with pytest.raises(NoAnswer, match=r"later than `timeout_s` = 0.01 s: 6"):
        ModbusRtu(link, timeout_s=0.01, gap_s=0.0).read_bits(unit=9, address=0, count=2, until_s=later(0.0))


def test_a_device_that_was_slow_to_every_question_is_not_believed_until_it_has_finished() -> None:
    stale, fresh = rtu("09 04 02 00 01"), rtu("09 04 02 00 02")
    link = ScriptLink()
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, quarantine_s=0.01)
    while {written[1] for written in link.written} != {1, 2, 3, 4}:
        with pytest.raises(NoAnswer):
            master.read_registers(unit=9, address=0, count=1, until_s=later(0.05), function=4)
    link.answers = [stale, fresh]
    assert master.read_registers(unit=9, address=0, count=1, until_s=later(), function=4) == (2,)
    assert master.late_bytes >= len(stale)
