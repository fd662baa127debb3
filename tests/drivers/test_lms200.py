"""SICK LMS 200: conformance, baud search, exact scans, codes, faults, the quick manual's frames."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from drivers.emulators import lms200 as emulator
from drivers.emulators.beams import line_m
from drivers.emulators.scripted import ScriptedScanner, scripted_scan
from drivers.lms200 import decode_scan, framer, telegram
from hal.conformance import RangeScannerContract, Rig
from hal.devices import RangeImage, RangeScannerCapabilities
from hal.errors import DeviceFault
from tests.drivers.rigs import count_good, soon, wired, wired_rig

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
    np.testing.assert_allclose(decode_scan(payload), [1.0, 1.0])  # centimetres; flags above 13 bits do not count


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
