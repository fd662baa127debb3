"""Tests of the conversion of device clocks to host time: wraps, late frames, drift, restarts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.transport.timebase import EXCHANGES, ExchangeTime, FrameTimes, HostTime, Unwrapper


@given(st.lists(st.integers(0, 30_000), min_size=1, max_size=50), st.integers(0, 65_535))
def test_a_wrapping_counter_grows_by_its_steps(steps: list[int], start: int) -> None:
    clock = Unwrapper(bits=16, tick_s=1.0)
    count = start
    first = clock.seconds(count)
    for step in steps:
        count += step
        assert clock.seconds(count % 65_536) - first == count - start


def test_late_frames_do_not_shift_the_stamps() -> None:
    rng = np.random.default_rng(3)
    host = HostTime()
    for i in range(2000):
        device_s = 0.01 * i
        delay_s = 0.001 + (0.3 if i % 3 == 0 else rng.exponential(0.0005))
        stamp_s = host.host_s(device_s=device_s, arrived_s=100.0 + device_s + delay_s)
        if i > 20:
            assert stamp_s == pytest.approx(100.0 + device_s + 0.001, abs=0.001)


@pytest.mark.parametrize("drift", [200e-6, -200e-6, 0.02, -0.02])
def test_drift_is_followed_be_it_of_quartz_or_of_a_clock_counted_in_software(drift: float) -> None:
    host = HostTime()
    errors_s = []
    for i in range(20_000):
        true_s = 0.01 * i
        errors_s.append(host.host_s(device_s=true_s * (1 - drift), arrived_s=true_s) - true_s)
    assert max(abs(e) for e in errors_s[200:]) < 0.001


def test_a_restarted_device_clock_starts_a_new_estimate() -> None:
    host = HostTime()
    host.host_s(device_s=5000.0, arrived_s=10.0)
    assert host.host_s(device_s=1.0, arrived_s=20.0) == 20.0


def _errors_s(sent_s: list[float], late_s: list[float]) -> list[float]:
    """Return stamp minus time of sending, for frames that the host receives late."""
    times = FrameTimes(period_s=0.01, frame_bytes=9)
    errors_s, seen_s = [], 0.0
    for number, (sent, late) in enumerate(zip(sent_s, late_s, strict=True)):
        seen_s = max(seen_s, sent + late)
        [(_, stamp_s)] = times.stamped([str(number).encode()], arrived_s=seen_s, byte_s=0.0)
        errors_s.append(stamp_s - sent)
    return errors_s


def _rare_delays_s(count: int, seed: int) -> list[float]:
    rng = np.random.default_rng(seed)
    return list(np.where(rng.random(count) < 0.05, rng.uniform(0.002, 0.006, count), 1e-4))


def test_the_frames_of_a_steady_talker_are_stamped_as_if_this_host_were_never_late() -> None:
    sent_s = [100.0 + 0.01 * i for i in range(3000)]
    assert np.quantile(np.abs(_errors_s(sent_s, _rare_delays_s(3000, 1))), 0.99) < 5e-4


@pytest.mark.parametrize("slow", [1.0, 1.02, 0.97])
def test_a_talker_that_sleeps_between_frames_is_followed(slow: float) -> None:
    rng = np.random.default_rng(2)
    sent_s = list(100.0 + np.cumsum(0.01 * slow + rng.exponential(1e-4, 3000)))
    assert np.quantile(np.abs(_errors_s(sent_s, _rare_delays_s(3000, 3))), 0.99) < 2e-3


def test_lost_frames_do_not_make_stamps_early() -> None:
    sent_s = [100.0 + 0.01 * i for i in range(3000) if i % 3]
    assert np.max(np.abs(_errors_s(sent_s, [1e-4] * len(sent_s)))) < 5e-4


def test_the_frames_of_an_irregular_talker_are_stamped_as_they_come() -> None:
    sent_s = list(100.0 + 0.01 * np.arange(3000) + np.random.default_rng(4).uniform(0.0, 0.008, 3000))
    assert np.quantile(np.abs(_errors_s(sent_s, [1e-4] * 3000)), 0.95) < 5e-4


def test_repeated_bytes_at_the_same_moment_are_one_frame_and_line_time_counts() -> None:
    times = FrameTimes(period_s=0.01, frame_bytes=9)
    assert times.stamped([b"a", b"a"], arrived_s=5.0, byte_s=1e-4) == [(b"a", pytest.approx(5.0 - 9e-4))]
    assert [frame for frame, _ in times.stamped([b"a"], arrived_s=5.01, byte_s=1e-4)] == [b"a"]


def test_a_frame_that_ends_a_pause_may_be_as_old_as_that_and_is_left_out() -> None:
    times, heard = FrameTimes(period_s=0.01, frame_bytes=9), []
    for n, late_s in enumerate([0.0] * 20 + [0.35] + [0.0] * 5):
        arrived_s = 0.01 * n + (0.34 if n > 20 else late_s)
        heard += [frame for frame, _ in times.stamped([bytes([n])], arrived_s=arrived_s, byte_s=0.0)]
    assert heard == [bytes([n]) for n in range(26) if n not in (20, 21)], "the next frame was waiting behind it"


def test_what_a_late_reader_finds_waiting_is_stamped_frame_by_frame() -> None:
    times = FrameTimes(period_s=0.01, frame_bytes=9)
    for n in range(20):
        times.stamped([bytes([n])], arrived_s=0.01 * n, byte_s=0.0)
    heard = times.stamped([bytes([n]) for n in range(20, 60)], arrived_s=0.59, byte_s=0.0)
    assert [frame[0] for frame, _ in heard] == list(range(20, 60))
    assert [stamp_s for _, stamp_s in heard] == pytest.approx([0.01 * n for n in range(20, 60)])


@pytest.mark.parametrize("period_s", [0.15, 1.0])
def test_a_talker_that_is_slower_than_was_told_does_not_pause(period_s: float) -> None:
    times = FrameTimes(period_s=0.01, frame_bytes=9)
    heard = [times.stamped([bytes([n])], arrived_s=period_s * n, byte_s=0.0) for n in range(9)]
    assert sum(map(len, heard)) == 9


def test_what_was_learned_of_a_talker_is_forgotten_when_its_wire_is_opened_anew() -> None:
    times, jitter_s = FrameTimes(period_s=0.01, frame_bytes=9), np.random.default_rng(5).uniform(0.0, 0.008, 300)
    for number, late_s in enumerate(jitter_s):
        times.stamped([b"%d" % number], arrived_s=0.01 * number + late_s, byte_s=0.0)
    times.reset()
    arrived_s = [100.0 + 0.01 * i + (0.004 if i == 5 else 0.0) for i in range(10)]
    stamps_s = [times.stamped([b"%d" % i], arrived_s=now_s, byte_s=0.0)[0][1] for i, now_s in enumerate(arrived_s)]
    assert stamps_s == pytest.approx([100.0 + 0.01 * i for i in range(10)]), "steady from now on, and one came late"


@pytest.mark.parametrize(("told_s", "true_s"), [(0.01, 0.002), (0.002, 0.01)])
def test_a_period_that_was_told_wrong_makes_no_stamp_older_than_one_such_period(told_s: float, true_s: float) -> None:
    times = FrameTimes(period_s=told_s, frame_bytes=9)
    for i in range(2000):
        [(_, stamp_s)] = times.stamped([b"%d" % i], arrived_s=true_s * i, byte_s=0.0)
        assert true_s * i - 1.25 * told_s <= stamp_s <= true_s * i + 1e-9


def opened_anew(device_first_s: float, arrived_first_s: float) -> float:
    """Return the stamp of the first frame after a loss; before it the device clock was 100 s behind the host's."""
    host = HostTime()
    for i in range(200):
        host.host_s(device_s=0.01 * i, arrived_s=100.0 + 0.01 * i + 0.001)
    host.reset()
    return host.host_s(device_s=device_first_s, arrived_s=arrived_first_s)


def test_after_a_loss_a_late_first_frame_of_a_clock_that_went_on_is_seen_to_be_late() -> None:
    assert opened_anew(5.0, 105.151) == pytest.approx(105.001, abs=1e-4)


@pytest.mark.parametrize("device_s", [0.5, 50.0, 3.0])
def test_after_a_loss_another_clock_is_believed_at_once(device_s: float) -> None:
    assert opened_anew(device_s, 105.0) == pytest.approx(105.0)


def test_an_exchange_that_lasts_claims_nothing_for_the_time_that_it_waited() -> None:
    exchanges = ExchangeTime()
    assert exchanges.taken_s(1.0, 1.004) == pytest.approx(1.002)
    assert exchanges.taken_s(2.0, 2.1) == pytest.approx(2.002), "the value may be as old as the request"
    assert exchanges.taken_s(3.0, 3.002) == pytest.approx(3.001)


@given(st.lists(st.tuples(st.floats(0, 0.01), st.floats(0, 0.1), st.floats(0, 0.1)), min_size=1, max_size=200))
def test_no_answer_looks_younger_than_half_of_the_shortest_exchange(waits: list[tuple[float, float, float]]) -> None:
    """Each exchange has a link time, a wait before the value is taken, and a wait after it."""
    exchanges, asked_s, shortest_s = ExchangeTime(), 0.0, 1.0
    for wire_s, before_s, after_s in waits:
        lasted_s = wire_s + before_s + after_s
        shortest_s = min(shortest_s, lasted_s)
        claimed_s = exchanges.taken_s(asked_s, asked_s + lasted_s)
        assert asked_s - 1e-9 <= claimed_s <= asked_s + 0.5 * lasted_s + 1e-9
        if len(waits) < EXCHANGES:
            assert claimed_s <= asked_s + 0.5 * shortest_s + 1e-9
        asked_s += 1.0
