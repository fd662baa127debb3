"""Stamps of a device's samples rise from sample to sample, whatever its clock and the link do."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.transport import device as device_module
from drivers.transport.timebase import HostTime
from hal.clock import Clock, SimClock
from hal.readings import Stamped
from hal.registry import Context
from tests.drivers.transport.test_newest import Bare

PERIOD_S, LINE_S = 0.02, 0.001
LATENESS = st.lists(st.one_of(st.just(0.0), st.floats(0.0, 0.03), st.floats(0.0, 0.6)), min_size=2, max_size=80)


class Kept(Bare):
    """Device that keeps all its samples; no clock reads the time, so that the test decides it."""

    def __init__(self, clock: Clock | None = None) -> None:
        context = Context(name="gripper") if clock is None else Context(name="gripper", clock=clock)
        super().__init__(context, max_age_s=0.1)

    def samples(self) -> list[Stamped[str]]:
        return self.mailbox.since(0)[0]


def published(late_s: list[float], drift: float) -> tuple[list[Stamped[str]], list[float], list[float]]:
    """Return the samples of a device whose frames come late, when each was taken, and when it arrived."""
    device, host, at_s = Kept(), HostTime(), 1000.0
    taken_s, arrived_s = [], []
    for number, late in enumerate(late_s):
        taken_s.append(1000.0 + PERIOD_S * number)
        at_s = max(at_s, taken_s[-1] + LINE_S + late)  # frames do not overtake each other
        arrived_s.append(at_s)
        device_s = PERIOD_S * number * (1.0 + drift)
        device.publish(str(number), valid_s=host.host_s(device_s=device_s, arrived_s=at_s), device_time_s=device_s)
    return device.samples(), taken_s, arrived_s


@given(LATENESS, st.sampled_from([0.0, 1e-4, -1e-4, 0.02, -0.02]))
def test_however_late_frames_come_stamps_rise_and_are_not_after_arrival(late_s: list[float], drift: float) -> None:
    samples, taken_s, arrived_s = published(late_s, drift)
    assert [sample.value for sample in samples] == [str(i) for i in range(len(late_s))]
    assert all(one.host_time_s < other.host_time_s for one, other in pairwise(samples))
    for sample, arrived in zip(samples, arrived_s, strict=True):
        assert sample.host_time_s <= arrived + 1e-9
    if drift == 0.0:  # a stamp that was held forward is closer to the truth than the one before
        errors_s = [sample.host_time_s - taken for sample, taken in zip(samples, taken_s, strict=True)]
        worst_s = LINE_S + max(late_s)
        assert all(LINE_S - 1e-6 <= error <= worst_s + 1e-6 for error in errors_s)
        assert all(after <= before + 1e-6 for before, after in pairwise(errors_s))


def test_a_sample_that_the_device_took_before_the_newest_one_is_dropped() -> None:
    device = Kept()
    for value, device_s in (("one", 1.0), ("two", 2.0), ("one", 1.0), ("two", 2.0), ("three", 3.0)):
        device.publish(value, valid_s=1000.0 + device_s, device_time_s=device_s)
    assert [sample.value for sample in device.samples()] == ["one", "two", "three"]
    assert [sample.sequence for sample in device.samples()] == [1, 2, 3]
    assert device.errors == 2


def test_a_restarted_device_clock_goes_on_with_later_stamps() -> None:
    device = Kept()
    device.publish("before", valid_s=1000.0, device_time_s=5000.0)
    device.publish("after", valid_s=1000.5, device_time_s=0.1)
    assert [sample.host_time_s for sample in device.samples()] == [1000.0, 1000.5]


def test_a_thread_switch_between_two_clocks_does_not_shift_a_stamp(monkeypatch: pytest.MonkeyPatch) -> None:
    switches = iter([0.0, 0.026, 0.0, 0.0, 0.0, 0.0])  # s that pass before each reading of the links' clock
    time_s = [50.0]

    def read_s() -> float:
        time_s[0] += next(switches, 0.0)
        return time_s[0]

    monkeypatch.setattr(device_module, "now_s", read_s)
    device = Kept(SimClock(start_s=10.0))
    device.publish("one", valid_s=50.02)
    assert device.samples()[0].host_time_s == pytest.approx(10.0 - 0.006)
