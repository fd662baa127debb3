"""Tests of SCIP scanners: conformance over TCP and serial, exact scans, numbers of the manual, faults, clock wrap."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.emulators import scip as emulator
from drivers.emulators.beams import line_m
from drivers.emulators.scripted import ScriptedScanner, scripted_scan
from drivers.scip import Scip, ScipOptions, ScipParser, checked, decode_number, decode_ranges_mm
from drivers.transport.checks import sum_scip
from drivers.transport.link import NoAnswer
from hal.conformance import RangeScannerContract, Rig
from hal.devices import RangeImage, RangeScannerCapabilities
from hal.errors import DeviceFault
from hal.registry import Context
from tests.drivers.rigs import count_good, soon, until, wired, wired_rig

FAST = {"scans_per_minute": 2400}
DRIVER = "scip:scanner"


class TestScip(RangeScannerContract):
    @pytest.fixture(params=["tcp", "serial"])
    def rig(self, request: pytest.FixtureRequest) -> Iterator[Rig[Any]]:
        far_side = emulator.start(ScriptedScanner(), {**FAST, "transport": request.param})
        with wired_rig(far_side, DRIVER, sample_period_s=0.1) as rig:
            yield rig


@pytest.mark.parametrize(("text", "value"), [(b"CB", 1234), (b"1Dh", 5432), (b"m2@0", 16_000_000)])
def test_numbers_of_the_manual(text: bytes, value: int) -> None:
    assert decode_number(text) == value
    assert emulator.encode_number(value, len(text)) == text


@given(st.lists(st.integers(0, (1 << 18) - 1), min_size=1, max_size=300))
def test_ranges_decode_to_what_was_encoded_and_agree_with_the_scalar_rule(values: list[int]) -> None:
    data = emulator.encode_ranges(np.array(values))
    assert decode_ranges_mm(data).tolist() == values
    assert [decode_number(data[i : i + 3]) for i in range(0, len(data), 3)] == values


@given(st.lists(st.integers(min_value=0), max_size=10), st.binary(max_size=20))
def test_answers_do_not_depend_on_chunks_or_noise(cuts: list[int], noise: bytes) -> None:
    answer = b"MD0000000101000\n99b\n" + b"0000@\n" + b"0CB0CB\x36\n\n"
    lines = [b"0000", b"0CB0CB"]
    answer = b"MD0000000101000\n99b\n" + b"".join(x + bytes([(sum(x) & 0x3F) + 0x30]) + b"\n" for x in lines) + b"\n"
    data = noise.replace(b"M", b"") + answer
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    parser = ScipParser()
    found = [m for a, b in pairwise(places) for m in parser.feed(data[a:b], "MD000000010100")]
    assert [m.lines for m in found] == [tuple(lines)]


def is_a_true_scan(image: RangeImage, capabilities: RangeScannerCapabilities, reads: int) -> bool:
    """Return whether the image equals one of the scripted scanner's scans, beam by beam."""
    angles = capabilities.first_angle_rad + capabilities.step_angle_rad * np.arange(capabilities.width)
    for index in range(max(1, reads - 40), reads + 1):
        true = line_m(RangeImage(depth_m=scripted_scan(index)), ScriptedScanner().capabilities(), angles)
        if np.allclose(image.depth_m[0], np.round(true, 3), atol=6e-4):
            return True
    return False


@pytest.mark.parametrize("fault", [None, "crc", "drop", "dup", "split", "delay", "silent", "garbage", "echo", "status"])
def test_every_scan_is_bit_exact_whatever_the_wire_does(fault: str | None) -> None:
    backing = ScriptedScanner()
    options = {**FAST, "transport": "serial", "fault": fault, "every": 4, "seed": 2, "delay_s": 0.1, "silent_s": 0.1}
    with wired(emulator.start(backing, options), DRIVER) as device:
        c = device.capabilities()
        assert count_good(device, lambda image: is_a_true_scan(image, c, backing.reads)) >= 5


def test_the_geometry_is_the_scanners_own() -> None:
    far_side = emulator.start(
        ScriptedScanner(),
        {**FAST, "first_step": 0, "last_step": 1080, "front_step": 540, "steps_per_turn": 1440, "max_mm": 30_000},
    )
    with wired(far_side, DRIVER) as device:
        c = device.capabilities()
    assert (c.projection, c.width, c.height) == ("polar", 1081, 1)
    assert c.first_angle_rad == pytest.approx(-math.radians(135))
    assert c.step_angle_rad == pytest.approx(math.radians(0.25))
    assert c.max_range_m == 30.0


@pytest.mark.parametrize("key", ["ARES", "SCAN"])
def test_a_scanner_that_says_it_does_not_turn_is_no_scanner(key: str) -> None:
    told = {"AMIN": "0", "AMAX": "9", "AFRT": "5", "ARES": "10", "DMIN": "20", "DMAX": "4000", "SCAN": "600", key: "0"}
    with pytest.raises(NoAnswer, match=f"{key} 0"):
        Scip(Context(name="scanner"), ScipOptions(host="127.0.0.1"))._geometry(told)


def test_a_scan_began_after_the_call() -> None:
    with wired(emulator.start(ScriptedScanner(), FAST), DRIVER) as device:
        asked_s = soon(0.0).at_s
        sample = device.read_range(deadline=soon())
        assert sample.host_time_s - device.beams.scan_s >= asked_s


def test_the_devices_clock_wraps_unseen() -> None:
    far_side = emulator.start(ScriptedScanner(), {**FAST, "clock_start_ms": (1 << 24) - 150})
    with wired(far_side, DRIVER) as device:
        first = device.read_range(deadline=soon())
        until(lambda: far_side.stamp_ms() < 10_000)
        last = device.newest(soon(), not_before_s=soon(0.0).at_s + 0.1)
    assert last.device_time_s - first.device_time_s == pytest.approx(last.host_time_s - first.host_time_s, abs=0.02)


def test_codes_below_twenty_millimetres_are_no_distances() -> None:
    class Blind(ScriptedScanner):
        def read_range(self, *, deadline: Any) -> Any:
            sample = super().read_range(deadline=deadline)
            depth_m = sample.value.depth_m.copy()
            depth_m[:, ::2] = 0.007
            return replace(sample, value=RangeImage(depth_m=depth_m))

    with wired(emulator.start(Blind(), FAST), DRIVER) as device:
        depth_m = device.read_range(deadline=soon()).value.depth_m
    assert np.isnan(depth_m).any()
    assert np.nanmin(depth_m) >= 0.02


def test_hardware_trouble_is_a_fault() -> None:
    with wired(emulator.start(ScriptedScanner(), {**FAST, "fault": "status", "every": 4}), DRIVER) as device:
        with pytest.raises(DeviceFault, match="72") as caught:
            for _ in range(20):
                device.newest(soon(), not_before_s=soon(0.0).at_s)
        assert caught.value.details["code"] == 0x72


def test_a_pinhole_scanner_gives_its_middle_row() -> None:
    c = RangeScannerCapabilities(
        projection="pinhole",
        width=101,
        height=3,
        fx=100.0,
        fy=100.0,
        cx=50.0,
        cy=1.0,
        min_range_m=0.1,
        max_range_m=5.0,
        sigma_m=0.001,
        rate_hz=10.0,
    )
    wall = RangeImage(depth_m=np.full((3, 101), 2.0, np.float32))
    angles = np.radians([0.0, 20.0, -20.0, 60.0, 120.0])
    got = line_m(wall, c, angles)
    np.testing.assert_allclose(got[:3], 2.0 / np.cos(angles[:3]))
    assert np.isnan(got[3:]).all()


@pytest.mark.parametrize("summed", [b"DMIN:20;", b"DMIN:20"])
def test_parameter_lines_are_summed_with_or_without_their_semicolon(summed: bytes) -> None:
    assert checked(b"DMIN:20;" + bytes([sum_scip(summed)])) == b"DMIN:20;"
    assert checked(b"DMIN:21;" + bytes([sum_scip(summed)])) is None
