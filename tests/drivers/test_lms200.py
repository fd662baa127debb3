"""Tests of the SICK LMS 200: conformance, baud search, exact scans, codes, faults, frames of the quick manual."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from drivers.emulators import lms200 as emulator
from drivers.emulators.beams import line_m
from drivers.emulators.scripted import ScriptedScanner, scripted_scan
from drivers.lms200 import SET_UP_S, Lms200, Lms200Options, decode_scan, framer, telegram
from drivers.transport.link import now_s
from hal.conformance import RangeScannerContract, Rig
from hal.devices import RangeImage, RangeScannerCapabilities
from hal.errors import DeviceFault
from hal.readings import Quality
from hal.registry import Context
from tests.drivers.rigs import ScriptLink, count_good, soon, wired, wired_rig

DRIVER = "serial:lms200"


class TestLms200(RangeScannerContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedScanner(), {}), DRIVER, sample_period_s=0.15) as rig:
            yield rig


def test_telegrams_are_the_quick_manuals() -> None:
    assert telegram(bytes.fromhex("2024")).hex() == "020002002024" + "3408"
    assert telegram(bytes.fromhex("2025")).hex() == "020002002025" + "3508"
    assert telegram(bytes.fromhex("3001")).hex() == "020002003001" + "3118"
    assert telegram(bytes.fromhex("31")).hex() == "0200010031" + "1512"


@pytest.mark.parametrize("power_up", [9600, 19_200, 38_400, 500_000])
@pytest.mark.parametrize("wanted", [38_400, 500_000])
def test_it_is_found_at_any_baud_rate_and_brought_to_the_wanted_one(power_up: int, wanted: int) -> None:
    far_side = emulator.start(ScriptedScanner(), {"power_up_baud": power_up})
    far_side.is_streaming = True
    with wired(far_side, DRIVER, {"baud": wanted}) as device:
        device.read_range(deadline=soon())
        assert far_side.baud == wanted
        assert far_side.config[6] == 1


@pytest.mark.parametrize(("field", "step", "beams"), [(180, 100, 181), (180, 50, 361), (100, 25, 401)])
def test_angles(field: int, step: int, beams: int) -> None:
    with wired(
        emulator.start(ScriptedScanner(), {}), DRIVER, {"field_deg": field, "step_hundredths_deg": step}
    ) as device:
        c = device.capabilities()
        image = device.read_range(deadline=soon()).value
    assert c.width == beams == image.depth_m.shape[1]
    assert c.first_angle_rad == pytest.approx(-math.radians(field / 2))
    assert c.rate_hz == pytest.approx(38_400 / 10 / (2 * beams + 10))  # the line is slower than the mirror


def test_on_a_fast_line_the_mirror_sets_the_rate() -> None:
    with wired(emulator.start(ScriptedScanner(), {}), DRIVER, {"baud": 500_000}) as device:
        assert device.capabilities().rate_hz == pytest.approx(75.0, rel=0.01)


def is_a_true_scan(image: RangeImage, c: RangeScannerCapabilities, reads: int) -> bool:
    angles = c.first_angle_rad + c.step_angle_rad * np.arange(c.width)
    scripted = ScriptedScanner().capabilities()
    return any(
        np.allclose(image.depth_m[0], line_m(RangeImage(depth_m=scripted_scan(i)), scripted, angles), atol=6e-4)
        for i in range(max(1, reads - 40), reads + 1)
    )


@pytest.mark.parametrize(
    "fault", ["crc", "drop", "dup", "split", "delay", "silent", "garbage", "echo", "status", "disconnect"]
)
def test_every_scan_is_exact_whatever_the_wire_does(fault: str) -> None:
    backing = ScriptedScanner()
    options = {"fault": fault, "every": 4, "seed": 4, "delay_s": 0.1, "silent_s": 0.1, "away_s": 0.02}
    with wired(emulator.start(backing, options), DRIVER) as device:
        c = device.capabilities()
        assert count_good(device, lambda image: is_a_true_scan(image, c, backing.reads), wanted=3) >= 3


def test_codes_are_no_distances_and_units_are_the_telegrams() -> None:
    payload = b"\xb0" + (3 | 1 << 14).to_bytes(2, "little") + bytes.fromhex("e803 f71f fe3f")
    np.testing.assert_allclose(decode_scan(payload), [1.0, math.nan, math.nan])
    payload = b"\xb0" + (2).to_bytes(2, "little") + bytes.fromhex("6400 64e0")
    np.testing.assert_allclose(decode_scan(payload), [1.0, 1.0])  # centimetres; bits above 13 are flags


@pytest.mark.parametrize("length", range(1, 6))
def test_a_scan_that_is_cut_short_has_no_ranges(length: int) -> None:
    assert len(decode_scan(bytes([0xB0, 2, 0x40, 1, 0])[:length])) == 0


def test_a_fatal_status_is_a_fault() -> None:
    far_side = emulator.start(ScriptedScanner(), {"fault": "status", "every": 3})
    with wired(far_side, DRIVER) as device, pytest.raises(DeviceFault, match="fatal"):
        for _ in range(20):
            device.newest(soon(), not_before_s=soon(0.0).at_s)


def test_own_bytes_are_not_taken_for_the_scanners() -> None:
    assert framer().feed(telegram(b"\x31")) == []


STOPPED = telegram(b"\xa0\x00\x10", address=0x80)


def scan(millimetres: int, *, status: int = 0, count: int = 181) -> bytes:
    """Return a scan telegram with equal beams."""
    head = b"\xb0" + (count | 1 << 14).to_bytes(2, "little")
    return telegram(head + count * millimetres.to_bytes(2, "little") + bytes([status]), address=0x80)


def lone_device() -> Lms200:
    return Lms200(Context(name="scanner"), Lms200Options(port="none"))


@pytest.mark.parametrize(
    ("status", "quality"),
    [(0, Quality.VALID), (1, Quality.VALID), (0x80, Quality.VALID), (2, Quality.DEGRADED), (3, Quality.INVALID)],
)
def test_what_the_scanner_says_of_itself_is_the_quality_of_its_scans(status: int, quality: Quality) -> None:
    device = lone_device()
    device.receive(scan(1000, status=status), 0.0)
    sample = device.mailbox.peek()
    assert sample is not None and sample.quality is quality


def test_a_false_header_does_not_make_a_true_scan_wait_for_the_bytes_it_promises() -> None:
    device = lone_device()
    device.receive(b"\x02\x80\x00\x03" + scan(1000), 0.0)
    assert device.mailbox.published == 1


class Scanner(ScriptLink):
    """Scanner that acknowledges each request, and answers if the reader waits for long enough."""

    def __init__(self, answer: bytes, *, takes_s: float) -> None:
        super().__init__()
        self.answer, self.takes_s = answer, takes_s

    def read(self, until_s: float) -> bytes:
        if self.ready:
            return super().read(until_s)
        answer, self.answer = (self.answer, b"") if until_s - now_s() > self.takes_s else (b"", self.answer)
        return answer

    def write(self, data: bytes, until_s: float) -> None:
        super().write(data, until_s)
        self.ready = b"\x06"


def test_a_request_that_was_acknowledged_is_waited_for_and_not_repeated() -> None:
    link = Scanner(STOPPED, takes_s=1.5)
    lone_device()._set_mode(link, b"\x00SICK_LMS", SET_UP_S)
    assert len(link.written) == 1


def test_an_answer_behind_a_false_header_is_found() -> None:
    link = ScriptLink(b"\x06\x02\x80\x00\x02noise" + STOPPED)
    lone_device()._set_mode(link, b"\x25")


class Repeater(ScriptLink):
    """Scanner that misses the time-out of the first request, so both answers come after the second request."""

    def read(self, until_s: float) -> bytes:
        first, self.ready = self.ready[: len(STOPPED)], self.ready[len(STOPPED) :]
        return first


def test_answers_to_repeated_requests_are_not_left_for_the_next_one() -> None:
    link = Repeater(b"", 2 * STOPPED)
    lone_device()._set_mode(link, b"\x25")
    assert not link.ready


def test_a_scanner_that_has_the_wanted_baud_rate_is_not_told_to_change_it() -> None:
    well, millimetres = b"\x10", bytes([0, 0, 0, 0, 0, 0, 1]) + bytes(27)
    variant = telegram(b"\xbb\x01\xb4\x00\x64\x00" + well, address=0x80)
    config = telegram(b"\xf4" + millimetres + well, address=0x80)
    link = ScriptLink(STOPPED, variant, STOPPED, config, STOPPED)
    lone_device().start(link)
    assert [frame[4:6] for frame in link.written[:3]] == [b"\x20\x25", b"\x3b\xb4", b"\x20\x00"]
