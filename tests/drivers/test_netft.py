"""Tests of the Net F/T: conformance over UDP, sequence rules, status, faults."""

import itertools
import socket
import struct
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from drivers.emulators import netft as emulator
from drivers.emulators.scripted import ScriptedForceTorque, scripted_wrench
from drivers.netft import Netft, NetftOptions, request
from hal.conformance import ForceTorqueContract, Rig
from hal.devices import Wrench
from hal.readings import Cause, Quality
from hal.registry import Context
from tests.drivers.rigs import count_good, soon, until, wired, wired_rig

DRIVER = "udp:netft"


class TestNetft(ForceTorqueContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedForceTorque(), {}), DRIVER, sample_period_s=0.05) as rig:
            yield rig


def record(sequence: int, fx: int, status: int = 0) -> bytes:
    return struct.pack(">III6i", sequence, 7 * sequence, status, fx, 0, 0, 0, 0, 0)


def lonely() -> Netft:
    """Return a driver without link; the test passes it the records."""
    return Netft(Context(name="wrist"), NetftOptions(host="127.0.0.1", port=1))


def test_requests_are_the_manuals() -> None:
    assert request(2).hex() == "1234000200000000"


def test_gaps_are_counted_and_late_and_repeated_records_dropped() -> None:
    device = lonely()
    for sequence in (5, 6, 6, 9, 8, 10):
        device.receive(record(sequence, sequence * 1_000_000), 0.0)
    samples, _ = device.mailbox.since(0)
    assert [sample.value.force_n[0] for sample in samples] == [5.0, 6.0, 9.0, 10.0]
    assert [b.sequence - a.sequence for a, b in itertools.pairwise(samples)] == [1, 3, 1]
    assert device.health().errors == 2


def test_records_that_are_held_up_again_and_again_are_never_given_as_fresh() -> None:
    """Every third record is 0.15 s late, and the two after it come at once, so the usual interval cannot be learned."""
    device, arrived_s, late = lonely(), 0.0, set[int]()
    for sequence in range(1, 91):
        is_late = sequence % 3 == 0
        late |= {sequence} if is_late else set()
        arrived_s += 0.15 if is_late else 0.0002
        device.receive(record(sequence, sequence * 1_000_000), arrived_s)
    samples, _ = device.mailbox.since(0)
    assert not late & {round(sample.value.force_n[0]) for sample in samples}


def test_a_sensor_that_starts_anew_is_followed() -> None:
    device = lonely()
    for sequence in (900, 1, 2, 3):
        device.receive(record(sequence, sequence * 1_000_000), 0.0)
    samples, _ = device.mailbox.since(0)
    assert [sample.value.force_n[0] for sample in samples] == [900.0, 2.0, 3.0]
    assert device.health().errors == 0


def test_a_first_record_that_comes_late_or_twice_starts_nothing() -> None:
    device = lonely()
    for sequence in (1, 1, 2, 3, 1, 4):
        device.receive(record(sequence, sequence * 1_000_000), 0.0)
    samples, _ = device.mailbox.since(0)
    assert [sample.value.force_n[0] for sample in samples] == [1.0, 2.0, 3.0, 4.0]


def test_a_status_makes_the_sample_invalid_and_other_lengths_are_ignored() -> None:
    device = lonely()
    device.receive(record(1, 5)[:-1], 0.0)
    device.receive(record(1, 5) + b"\x00", 0.0)
    assert device.mailbox.peek() is None
    device.receive(record(1, 5, status=0x80000000), 0.0)
    sample = device.mailbox.peek()
    assert sample is not None
    assert (sample.quality, sample.cause) == (Quality.INVALID, Cause.DEVICE)


def is_true(value: Wrench, reads: int) -> bool:
    index = round(value.force_n[0] / 0.01)
    true = scripted_wrench(index)
    same = np.allclose(value.force_n, true.force_n) and np.allclose(value.torque_nm, true.torque_nm)
    return bool(reads - 60 <= index <= reads and same)


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "delay", "silent", "garbage", "status", "disconnect"])
def test_no_fault_of_the_net_gives_a_wrong_wrench(fault: str) -> None:
    backing = ScriptedForceTorque()
    options = {"fault": fault, "every": 4, "delay_s": 0.05, "silent_s": 0.05, "away_s": 0.02}
    with wired(emulator.start(backing, options), DRIVER) as device:
        assert count_good(device, lambda value: is_true(value, backing.reads)) >= 5


def test_close_stops_the_sensors_stream() -> None:
    far_side = emulator.start(ScriptedForceTorque(), {})
    with wired(far_side, DRIVER) as device:
        assert far_side.is_streaming
        device.close()
        until(lambda: not far_side.is_streaming)


def test_a_plain_socket_gets_a_single_record_as_the_manual_says() -> None:
    backing = ScriptedForceTorque()
    far_side = emulator.start(backing, {})
    with closing(far_side), closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as client:
        client.settimeout(2.0)
        client.sendto(bytes.fromhex("1234000200000001"), ("127.0.0.1", far_side.address["port"]))
        data = client.recv(100)
        assert len(data) == 36
        assert data[:4] == b"\x00\x00\x00\x01"
        assert int.from_bytes(data[12:16], "big") == pytest.approx(1e6 * scripted_wrench(1).force_n[0])
        until(lambda: not far_side.is_streaming)


def test_what_is_read_is_newtons() -> None:
    with wired(emulator.start(ScriptedForceTorque(), {}), DRIVER) as device:
        value = device.read_wrench(deadline=soon()).value
    np.testing.assert_allclose(value.force_n[2], -0.5 * value.force_n[0], atol=1e-6)
