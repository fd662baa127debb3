"""Device clocks on the host's: wraps, late frames, drift, restarts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.transport.timebase import HostTime, Unwrapper


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


def test_drift_is_followed() -> None:
    host = HostTime()
    errors_s = []
    for i in range(20_000):
        true_s = 0.01 * i
        errors_s.append(host.host_s(device_s=true_s * (1 - 200e-6), arrived_s=true_s) - true_s)
    assert max(abs(e) for e in errors_s) < 0.001


def test_a_restarted_device_clock_starts_a_new_estimate() -> None:
    host = HostTime()
    host.host_s(device_s=5000.0, arrived_s=10.0)
    assert host.host_s(device_s=1.0, arrived_s=20.0) == 20.0
