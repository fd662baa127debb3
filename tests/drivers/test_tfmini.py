"""Tests of the TFmini-Plus: conformance over a pty, faults of the link, and frames of the manual."""

import math
import struct
from collections.abc import Iterator
from typing import Any

import pytest

from benchmarks.drivers.damaged import damages, passed
from drivers.emulators import tfmini as emulator
from drivers.emulators.scripted import ScriptedLights, ScriptedProximity
from drivers.tfmini import AGREEING, command, data_framer
from drivers.transport.checks import sum_low_byte
from hal.conformance import ProximityContract, Rig
from hal.errors import ConfigError, DeviceUnavailable, Unsupported
from hal.readings import Cause, Quality
from hal.registry import Context, connect
from hal.simulated import Fault
from tests.drivers.rigs import CLOCK, soon, until, wired, wired_rig


class TestTfmini(ProximityContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedProximity(), {}), "serial:tfmini", sample_period_s=0.05) as rig:
            yield rig


def test_commands_are_the_manuals() -> None:
    assert command(0x03, (1000).to_bytes(2, "little")).hex() == "5a0603e8034e"
    assert command(0x01).hex() == "5a04015f"


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "garbage", "echo"])
def test_no_fault_of_the_wire_gives_a_wrong_distance(fault: str) -> None:
    backing = ScriptedProximity()
    with wired(emulator.start(backing, {"fault": fault, "every": 3, "seed": 5}), "serial:tfmini") as device:
        seen = 0
        last = 0
        for _ in range(30):
            sample = device.read_distance_m(deadline=soon())
            if sample.sequence == last:
                device.mailbox.wait(oldest_host_s=sample.host_time_s + 1e-6, until_s=soon().at_s)
                continue
            last = sample.sequence
            steps = (sample.value - backing.first_m) / 0.001
            assert abs(steps - round(steps)) < 1e-6
            assert backing.reads - 10 <= round(steps) <= backing.reads
            seen += 1
        assert seen >= 10


@pytest.mark.parametrize("kind", [kind for kind in damages(0) if "flipped" not in kind])
def test_no_frame_that_lost_bytes_passes_the_checks(kind: str) -> None:
    """Of the 10 000 damaged frames 15 to 45 passed when the sum alone was checked."""
    assert passed(damages(3)[kind], 30_000, seed=3) == 0


def frame(distance: int, raw_temperature: int) -> bytes:
    body = b"\x59\x59" + struct.pack("<HHH", distance, 2000, raw_temperature)
    return body + bytes([sum_low_byte(body)])


def test_the_temperature_may_drift_but_not_jump() -> None:
    framer = data_framer()
    assert len(framer.feed(b"".join(frame(100, 2300 + 10 * k) for k in range(30)))) == 30
    assert framer.feed(frame(100, 2700) + frame(101, 2600)) == [frame(101, 2600)]


def test_a_sensor_with_another_field_in_the_temperatures_place_is_read() -> None:
    frames = [frame(100 + k, 7) for k in range(10)]
    assert data_framer().feed(b"".join(frames)) == frames[AGREEING - 1 :]


def test_weak_echo_is_invalid_and_not_a_number() -> None:
    with wired(emulator.start(ScriptedProximity(fixed_m=math.nan), {}), "serial:tfmini") as device:
        sample = device.read_distance_m(deadline=soon())
    assert (sample.quality, sample.cause) == (Quality.INVALID, Cause.OUT_OF_RANGE)
    assert math.isnan(sample.value)


def test_it_comes_back_by_itself_after_unplugging() -> None:
    with wired(far_side := emulator.start(ScriptedProximity(), {}), "serial:tfmini") as device:
        for _ in range(3):
            far_side.unplug(away_s=0.05)
            until(lambda: device.mailbox.error() is None and device.health().connected)
            assert math.isfinite(device.read_distance_m(deadline=soon()).value)
        assert device.health().reconnects >= 1


def test_the_unit_is_set_and_centimetres_are_understood() -> None:
    with wired(emulator.start(ScriptedProximity(fixed_m=0.123), {}), "serial:tfmini", {"unit": "cm"}) as device:
        assert device.read_distance_m(deadline=soon()).value == pytest.approx(0.12)
    with wired(emulator.start(ScriptedProximity(fixed_m=0.123), {}), "serial:tfmini", {"unit": "mm"}) as device:
        assert device.read_distance_m(deadline=soon()).value == pytest.approx(0.123)


def test_a_sensor_that_lost_its_power_for_a_moment_is_not_read_in_the_unit_of_before() -> None:
    far_side = emulator.start(ScriptedProximity(fixed_m=0.5), {})
    with wired(far_side, "serial:tfmini") as device:
        far_side.inject(Fault.SILENT)
        far_side.is_mm = False
        until(lambda: device.mailbox.peek().age_s(CLOCK.now_s()) > 0.25)
        before = device.mailbox.published
        far_side.inject(None)
        until(lambda: device.mailbox.published > before + 5)
        samples, lost = device.mailbox.since(before)
        assert not lost and [s.value for s in samples] == pytest.approx([0.5] * len(samples))
        assert device.health().reconnects >= 1


@pytest.mark.parametrize("rate_hz", [1.0, 3.0])
def test_a_slow_sensor_is_not_taken_for_a_silent_one(rate_hz: float) -> None:
    with wired(emulator.start(ScriptedProximity(), {}), "serial:tfmini", {"rate_hz": rate_hz}) as device:
        until(lambda: device.mailbox.published >= 3)
        assert device.health().reconnects == 0


def test_a_second_opener_is_refused_and_told_the_owner() -> None:
    far_side = emulator.start(ScriptedProximity(), {})
    with wired(far_side, "serial:tfmini"), pytest.raises(DeviceUnavailable, match="taken by"):
        connect(Context(name="second"), "serial:tfmini", far_side.address)


def test_a_missing_port_is_named_with_what_to_do() -> None:
    with pytest.raises(DeviceUnavailable, match="does not exist") as caught:
        connect(Context(name="finger"), "serial:tfmini", {"port": "/dev/serial/by-id/nothing"})
    assert "finger" in str(caught.value)
    assert "plug" in caught.value.hint


def test_a_misspelt_option_is_answered_with_its_path() -> None:
    with pytest.raises(ConfigError, match=r"devices\.finger\.options: bauds") as caught:
        connect(Context(name="finger"), "serial:tfmini", {"port": "x", "bauds": 9600})
    assert "baud" in caught.value.hint


def test_it_cannot_stand_for_lights() -> None:
    with pytest.raises(Unsupported, match="lights"):
        emulator.start(ScriptedLights(), {})
