"""Tests of the RPLIDAR: conformance, resynchronisation without checksums, health, frames of the manual."""

import math
import random
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.drivers.damaged import burst_damages, turns_given
from drivers.emulators import rplidar as emulator
from drivers.emulators.beams import line_m
from drivers.emulators.faults import FaultOptions, FaultPlan
from drivers.emulators.scripted import ScriptedScanner, scripted_scan
from drivers.rplidar.express import CAPSULE_BYTES, REQUEST, CapsuleParser, decode_capsule, is_capsule, is_first
from drivers.rplidar.nodes import NodeParser, decode
from drivers.rplidar.scanner import Rplidar, RplidarOptions, descriptor, sectors
from drivers.rplidar.turns import Measurements, TurnCollector, missing_rad
from drivers.transport.checks import xor_byte
from drivers.transport.link import NoAnswer, now_s
from hal.conformance import RangeScannerContract, Rig
from hal.devices import RangeImage
from hal.errors import DeviceUnavailable
from hal.readings import Cause, Quality
from hal.registry import Context, connect
from tests.drivers.rigs import ScriptLink, count_good, soon, until, wired, wired_rig

DRIVER = "serial:rplidar"
FAST = {"scan_rate_hz": 40.0}
TURN_RAD = np.arange(360) * math.tau / 360


class TestRplidar(RangeScannerContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        far_side = emulator.start(ScriptedScanner(), FAST)
        with wired_rig(far_side, DRIVER, {"scan_rate_hz": 20.0}, sample_period_s=0.1) as rig:
            yield rig


def test_descriptors_are_the_vendors() -> None:
    assert descriptor(5, 1, 0x81).hex() == "a55a0500004081"
    assert descriptor(20, 0, 4).hex() == "a55a1400000004"


@given(st.integers(min_value=0), st.lists(st.integers(min_value=0), max_size=8), st.binary(max_size=30))
def test_measurements_do_not_depend_on_chunks_and_survive_noise(seed: int, cuts: list[int], noise: bytes) -> None:
    range_m = np.random.default_rng(seed).uniform(0.2, 8.0, 360)
    turn = emulator.encode_turn(TURN_RAD, range_m)
    data = noise + turn + turn
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    parser = NodeParser()
    runs = [run for a, b in pairwise(places) for run in parser.feed(data[a:b])]
    angle_rad, got_m = decode(np.concatenate([run for run in runs if run is not None])[-340:])
    true_m = np.round(np.tile(range_m, 2) * 4000) / 4000
    np.testing.assert_allclose(got_m, true_m[-348:-8])
    np.testing.assert_allclose(angle_rad, np.tile(TURN_RAD, 2)[-348:-8], atol=math.radians(1 / 128) + 1e-9)


def test_lost_bytes_are_noticed() -> None:
    turn = emulator.encode_turn(TURN_RAD, np.full(360, 1.0))
    parser = NodeParser()
    runs = parser.feed(turn[:900] + turn[902:] + turn)
    assert parser.missteps == 1
    assert any(run is None for run in runs)


def test_sectors_keep_the_nearest_and_leave_empty_ones_empty() -> None:
    got = sectors(np.radians([0.0, 0.4, 359.8, 90.0]), np.array([2.0, 1.5, 3.0, 4.0]), 360)
    assert (got[0], got[90]) == (1.5, 4.0)
    assert np.isnan(got[1:90]).all()


def is_a_true_turn(image: RangeImage, reads: int) -> bool:
    c = ScriptedScanner().capabilities()
    signed = (TURN_RAD + math.pi) % math.tau - math.pi
    seen = np.isfinite(image.depth_m[0])
    assert seen.sum() >= 170, "more than half of a turn is missing"
    return any(
        np.allclose(image.depth_m[0][seen], line_m(RangeImage(depth_m=scripted_scan(i)), c, signed)[seen], atol=2e-4)
        for i in range(max(1, reads - 60), reads + 1)
    )


@pytest.mark.parametrize("fault", [None, "drop", "dup", "split", "delay", "silent", "garbage", "echo", "disconnect"])
def test_every_measurement_is_exact_whatever_the_wire_does(fault: str | None) -> None:
    backing = ScriptedScanner()
    options = {**FAST, "fault": fault, "every": 4, "seed": 6, "delay_s": 0.1, "silent_s": 0.1, "away_s": 0.02}
    with wired(emulator.start(backing, options), DRIVER, {"scan_rate_hz": 20.0}) as device:
        assert count_good(device, lambda image: is_a_true_turn(image, backing.reads)) >= 5


@pytest.mark.parametrize(
    ("mode", "bursts", "fault", "every", "lost_deg"),
    [
        ("standard", 36, "crc", 3, (110, 130)),  # in standard mode such a burst is lost as a whole
        ("standard", 36, "drop", 18, (9, 80)),
        ("standard", 36, "garbage", 18, (10, 60)),
        ("standard", 36, "dup", 18, (0, 0)),
        ("express", 12, "crc", 3, (110, 130)),
        ("express", 12, "drop", 12, (25, 65)),
        ("express", 12, "dup", 12, (0, 0)),
    ],
)
def test_a_turn_with_gaps_is_given_with_what_is_missing(
    mode: str, bursts: int, fault: str, every: int, lost_deg: tuple[float, float]
) -> None:
    fast = {"scan_rate_hz": 10.0, "nodes": 384 if mode == "express" else 360, "bursts": bursts, "seed": 3}
    backing = ScriptedScanner()
    with wired(
        emulator.start(backing, {**fast, "fault": fault, "every": every}), DRIVER, {"mode": mode, "scan_rate_hz": 10.0}
    ) as device:
        until(lambda: device.mailbox.published >= 8)
        samples, _ = device.mailbox.since(2)
    for sample in samples:
        empty = np.isnan(sample.value.depth_m).sum()
        assert lost_deg[0] - 5 <= empty <= lost_deg[1] + 5
        assert (sample.quality is Quality.VALID) == (not sample.detail) == (empty <= 5)
        if sample.detail:
            assert (sample.quality, sample.cause) == (Quality.DEGRADED, Cause.COMM)
            told = int(sample.detail.split()[0])
            assert abs(told - empty) <= 5 and lost_deg[0] <= told <= lost_deg[1]
        if mode == "standard":
            assert is_a_true_turn(sample.value, backing.reads)


@pytest.mark.parametrize("mode", ["standard", "express"])
def test_90_seconds_with_5_percent_of_bursts_damaged_give_true_turns_without_a_pause(mode: str) -> None:
    """900 turns at ten a second, each at its own distance, are fed as fast as they are taken in."""
    device = Rplidar(Context(name="scanner"), RplidarOptions(port="none", mode=mode, scan_rate_hz=10.0))
    plan, chance = FaultPlan(FaultOptions(seed=5)), random.Random(5)
    damages = (lambda _: b"", plan.lose_bytes, lambda burst: plan.noise(burst) + burst, lambda burst: burst + burst)
    begin_s, stamps_s, wrong = now_s(), list[float](), 0
    for turn in range(900):
        range_m = np.full(384, 1.0 + 0.002 * turn)
        if mode == "standard":
            data = emulator.encode_turn(np.arange(384) * (math.tau / 384), range_m)
        else:
            data = emulator.encode_capsules(range_m, is_first=turn == 0)
        size = len(data) // 12
        for n in range(12):
            burst = data[n * size : (n + 1) * size]
            burst = chance.choice(damages)(burst) if chance.random() < 0.05 else burst
            before = device.mailbox.published
            if burst:
                device.receive(burst, begin_s + (turn + (n + 1) / 12) / 10.0)
            if device.mailbox.published > before:
                sample = device.mailbox.peek()
                stamps_s.append(sample.host_time_s)
                ended = round((sample.host_time_s - begin_s) * 10.0) - 1  # the turn that ended at the stamp
                off_m = np.abs(sample.value.depth_m - (1.0 + 0.002 * ended))
                wrong += int(np.sum(off_m > 0.0015))
    assert len(stamps_s) > 850
    assert np.diff(stamps_s).max() < 0.35
    assert wrong <= (3 if mode == "standard" else 0)  # measurements of standard scans have no check sum


def test_less_than_half_of_a_turn_is_not_given() -> None:
    far_side = emulator.start(ScriptedScanner(), {"scan_rate_hz": 40.0, "bursts": 4, "fault": "crc", "every": 1})
    try:
        with pytest.raises(DeviceUnavailable, match="gives no valid data"):
            device = Rplidar(Context(name="scanner"), RplidarOptions(**far_side.address))
            device.join(0.3)
    finally:
        far_side.close()


def test_an_ill_scanner_is_reset_once() -> None:
    with wired(emulator.start(ScriptedScanner(), {**FAST, "health": 2}), DRIVER) as device:
        assert np.isfinite(device.read_range(deadline=soon()).value.depth_m).all()


def test_a_scanner_that_warns_gives_degraded_scans() -> None:
    with wired(emulator.start(ScriptedScanner(), {**FAST, "health": 1}), DRIVER) as device:
        assert device.read_range(deadline=soon()).quality is Quality.DEGRADED


@pytest.mark.parametrize(("mode", "at_once"), [("standard", 1), ("standard", 90), ("express", 64)])
def test_a_turn_is_stamped_with_its_end_and_not_with_what_came_after_it(mode: str, at_once: int) -> None:
    """Measurements at 0.5 ms intervals arrive `at_once`; without correction the stamps would be 4 to 45 ms late."""
    device = Rplidar(Context(name="scanner"), RplidarOptions(port="none", mode=mode))
    nodes = emulator.encode_turn(TURN_RAD, np.full(360, 1.0)) * 6
    capsules = emulator.encode_capsules(np.full(384, 1.0), is_first=False) * 6
    data, unit, size = (nodes, 1, 5) if mode == "standard" else (capsules, 32, CAPSULE_BYTES)
    turn_s = (360 if mode == "standard" else 384) * 0.0005
    begin_s = now_s()
    ends_s: list[float] = []
    for at in range(0, len(data), size * at_once // unit):
        upto = min(at + size * at_once // unit, len(data))
        device.receive(data[at:upto], begin_s + upto / size * unit * 0.0005)
        if (sample := device.mailbox.peek()) is not None and len(ends_s) < device.mailbox.published:
            ends_s.append(sample.host_time_s - begin_s)
    assert len(ends_s) >= 3
    late_s = [(end_s + turn_s / 2) % turn_s - turn_s / 2 for end_s in ends_s]
    assert max(map(abs, late_s)) < 0.0015


def test_measurements_without_a_whole_turn_are_told() -> None:
    device = Rplidar(Context(name="scanner"), RplidarOptions(port="none"))
    piece = emulator.encode_turn(TURN_RAD, np.full(360, 1.0))[10:500]
    device.receive(piece, now_s())
    with pytest.raises(NoAnswer, match="no complete turn in 3 s; check that its motor turns"):
        device.receive(piece, now_s() + 60.0)


def test_a_motor_may_spin_up_before_the_first_measurement_comes() -> None:
    answers = descriptor(20, 0, 4) + bytes(20), descriptor(3, 0, 6) + bytes(3), descriptor(5, 1, 0x81)
    device = Rplidar(Context(name="scanner"), RplidarOptions(port="none"))
    device.set_up(ScriptLink(b"", *answers))
    assert device._heard_s > now_s() + 2.0


def test_firmware_without_express_scans_is_told() -> None:
    device = Rplidar(Context(name="scanner"), RplidarOptions(port="none", mode="express"))
    with pytest.raises(NoAnswer, match='set mode = "standard"'):
        device.start(ScriptLink(b"", descriptor(20, 0, 4) + bytes(20), descriptor(3, 0, 6) + bytes(3)))


def test_an_incurable_scanner_is_told() -> None:
    far_side = emulator.start(ScriptedScanner(), {"health": 2, "is_cured_by_reset": False})
    try:
        with pytest.raises(DeviceUnavailable, match="error 0000h, which a reset did not clear"):
            connect(Context(name="scanner"), DRIVER, far_side.address)
    finally:
        far_side.close()


def measured(angle_rad: Any, distance_m: Any = None) -> Measurements:
    angle_rad = np.asarray(angle_rad) % math.tau
    distance_m = np.ones(len(angle_rad)) if distance_m is None else distance_m
    return Measurements(
        head_rad=angle_rad, angle_rad=angle_rad, distance_m=distance_m, arrived_s=np.zeros(len(angle_rad))
    )


def turns_of(*pieces: Measurements) -> list[Measurements]:
    """Return the turns that one whole turn, these pieces and the begin of another turn give."""
    collector = TurnCollector()
    whole = measured(TURN_RAD)
    return [turn for piece in (whole, *pieces, whole, whole) for turn, _ in collector.add(piece)]


def test_a_turn_with_a_stray_angle_in_it_is_discarded_and_one_with_a_gap_is_not() -> None:
    assert [len(turn) for turn in turns_of(measured(TURN_RAD))] == [360, 360]
    assert [len(turn) for turn in turns_of(measured(np.delete(TURN_RAD, slice(40, 60))))] == [340, 360]
    assert [len(turn) for turn in turns_of(measured(TURN_RAD + math.radians(0.4)))] == [360, 360]
    for place in (5, 100, 300):
        for stray_deg in (10.0, 90.0, 200.0, 350.0):
            angle_rad, distance_m = np.insert(TURN_RAD, place, np.radians(stray_deg)), np.ones(361)
            distance_m[place] = 9.0
            strayed = turns_of(measured(angle_rad, distance_m))
            assert len(strayed[-1]) == 360 and all(np.all(turn.distance_m == 1.0) for turn in strayed)


def test_a_piece_that_came_twice_is_taken_once() -> None:
    distance_m = np.linspace(1.0, 2.0, 360)
    whole = measured(TURN_RAD, distance_m)
    for cut in (130, 150, 155):
        [turn, _] = turns_of(whole.at(slice(0, 150)), whole.at(slice(120, cut)), whole.at(slice(cut, None)))
        np.testing.assert_array_equal(turn.distance_m, distance_m)


@pytest.mark.parametrize("count", [36, 360, 3600])
@pytest.mark.parametrize("lost_deg", [0, 12, 30, 120, 150])
@pytest.mark.parametrize("first_deg", [0, 100, 300])
def test_the_missing_angle_is_told(count: int, lost_deg: int, first_deg: int) -> None:
    """Gaps in the middle, at the start and across the start of a turn; steps vary by the motor's jitter."""
    rng = np.random.default_rng(count)
    angle_rad = np.sort((np.arange(count) + rng.uniform(-0.2, 0.2, count)) * math.tau / count)
    place_deg = (np.arange(count) * 360.0 / count - first_deg) % 360.0
    got_deg = math.degrees(missing_rad(angle_rad[place_deg >= lost_deg] % math.tau))
    assert got_deg == pytest.approx(lost_deg, abs=max(2.0, 360.0 / count) + 0.02 * (360 - lost_deg))


class TestExpress(RangeScannerContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        far_side = emulator.start(ScriptedScanner(), {"scan_rate_hz": 20.0})
        options = {"mode": "express", "scan_rate_hz": 10.0}
        with wired_rig(far_side, "serial:rplidar", options, sample_period_s=0.2) as rig:
            yield rig


def test_the_request_of_an_express_scan_is_the_manuals() -> None:
    assert REQUEST.hex() == "a58205000000000022"


def test_a_capsule_by_hand() -> None:
    body = bytearray(82)
    body[0:2] = (10 * 64).to_bytes(2, "little")
    body[2:4] = (1500 << 2 | 0b01).to_bytes(2, "little")  # 1.5 m, bit 4 of the offset
    body[4:6] = (2500 << 2 | 0b10).to_bytes(2, "little")  # 2.5 m, bit 5 of the offset
    body[6] = 0x52  # offsets: 16 + 2 eighths of a degree, and 32 + 5
    check = xor_byte(bytes(body))
    capsule = bytes([0xA0 | check & 15, 0x50 | check >> 4]) + bytes(body)
    assert is_capsule(capsule) and not is_first(capsule)
    head_rad, angle_rad, distance_m = decode_capsule(capsule, np.radians(42.0))
    assert np.degrees(head_rad) == pytest.approx(np.arange(10, 42))
    assert np.degrees(angle_rad[:2]) == pytest.approx([10.0 - 18 / 8, 11.0 - 37 / 8])
    assert distance_m[:2] == pytest.approx([1.5, 2.5])
    assert np.all(np.isnan(distance_m[2:]))
    assert not is_capsule(capsule[:50] + b"\x01" + capsule[51:])


@given(st.lists(st.integers(1, 200), max_size=20), st.binary(max_size=100))
def test_express_measurements_do_not_depend_on_the_chunks(sizes: list[int], noise: bytes) -> None:
    turn = emulator.encode_capsules(np.linspace(1.0, 2.0, 384), is_first=False)
    data = turn + noise + turn
    whole = CapsuleParser().feed(data)
    parser, parts, at = CapsuleParser(), list[Any](), 0
    for size in [*sizes, len(data)]:
        parts += parser.feed(data[at : at + size])
        at += size
    assert [part is None for part in parts] == [part is None for part in whole]
    for part, same in zip(parts, whole, strict=True):
        if part is not None and same is not None:
            np.testing.assert_array_equal(part, same)
    assert sum(part is not None for part in whole) >= 20


def test_a_lost_capsule_does_not_stretch_its_neighbour() -> None:
    turn = emulator.encode_capsules(np.linspace(1.0, 2.0, 384), is_first=False)
    parts = CapsuleParser().feed(turn[: 5 * CAPSULE_BYTES] + turn[6 * CAPSULE_BYTES :])
    assert [part is None for part in parts] == [False] * 4 + [True] + [False] * 5


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "garbage", "delay"])
def test_no_fault_of_the_wire_gives_a_wrong_express_scan(fault: str) -> None:
    backing = ScriptedScanner()
    angle_rad = (np.arange(360) * (2 * np.pi / 360) + np.pi) % (2 * np.pi) - np.pi

    def is_true(value: RangeImage) -> bool:
        c = backing.capabilities()
        lines = (
            line_m(RangeImage(depth_m=scripted_scan(index)), c, angle_rad)
            for index in range(max(1, backing.reads - 40), backing.reads + 1)
        )
        return any(_is_within(value.depth_m[0], line) for line in lines)

    far_side = emulator.start(backing, {"fault": fault, "every": 3, "scan_rate_hz": 20.0, "nodes": 384})
    with wired(far_side, "serial:rplidar", {"mode": "express", "scan_rate_hz": 10.0}) as device:
        assert count_good(device, is_true, wanted=3) >= 1


def _is_within(seen_m: Any, line: Any) -> bool:
    """Return whether each valid beam is near a true beam beside it, as 384 measurements fall into 360 sectors."""
    near = np.stack([np.roll(line, shift) for shift in (-2, -1, 0, 1, 2)])
    seen = np.isfinite(seen_m)
    low, high = np.nanmin(near, axis=0), np.nanmax(near, axis=0)
    return bool(np.all((seen_m[seen] >= low[seen] - 0.01) & (seen_m[seen] <= high[seen] + 0.01)))


def test_a_head_before_a_capsule_that_passes_its_checksum_with_it_by_chance_gives_no_measurement() -> None:
    """The checksum has eight bits, so this happens once in 256 times."""
    at = 5 * CAPSULE_BYTES
    turns = (emulator.encode_capsules(np.linspace(1.0, 2.0 + 0.01 * k, 384), is_first=False) for k in range(100))
    lengths = ((turn, n) for turn in turns for n in range(4, 80))
    chance = ((t, n) for t, n in lengths if is_capsule(t[at : at + n] + t[at : at + CAPSULE_BYTES - n]))
    turn, length = next(chance)
    true = turn[at:]
    given = [points for points in CapsuleParser().feed(turn[:at] + true[:length] + true) if points is not None]
    exact = {points[2].tobytes() for points in CapsuleParser().feed(turn) if points is not None}
    assert len(given) >= len(exact) - 1 and all(points[2].tobytes() in exact for points in given)


def test_one_measurement_that_does_not_fit_is_left_out_and_its_turn_is_given() -> None:
    whole = measured(TURN_RAD, np.linspace(1.0, 2.0, 360))
    for at, stray_rad in ((100, 0.1), (100, 6.0), (359, 3.0), (1, 3.0)):
        head_rad = TURN_RAD.copy()
        head_rad[at] = stray_rad
        [turn, *_] = turns_of(whole, measured(head_rad, whole.distance_m), whole, whole)[1:]
        np.testing.assert_array_equal(turn.distance_m, np.delete(whole.distance_m, at))


@pytest.mark.parametrize("name", burst_damages(1))
@pytest.mark.parametrize("mode", ["standard", "express"])
def test_of_a_stream_with_a_damaged_burst_in_twenty_nearly_all_turns_are_given(mode: str, name: str) -> None:
    found = turns_given(mode, burst_damages(3)[name], 8.0, seed=3)
    assert found.given >= 0.9 * found.turns
    assert found.wrong <= (0.005 if mode == "standard" else 0.0) * found.beams, "standard scans have no checksum"
