"""Compares the compiled steps with plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from simbackend import kernels


@pytest.mark.parametrize("seed", range(20))
def test_a_setpoint_stays_within_range_and_stride(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wanted, last = rng.uniform(-4.0, 4.0, (2, 6))
    stride, lower, upper = rng.uniform(0.01, 1.0, 6), rng.uniform(-3.0, -1.0, 6), rng.uniform(1.0, 3.0, 6)
    low, high = np.maximum(last - stride, lower), np.minimum(last + stride, upper)
    expected = np.minimum(np.maximum(wanted, np.minimum(low, high)), np.maximum(low, high))
    np.testing.assert_array_equal(kernels.reachable(wanted, last, stride, lower, upper), expected)


def test_a_drive_beyond_its_range_comes_back_and_goes_no_further() -> None:
    one = np.ones(1)
    inward = kernels.reachable(0.0 * one, 3.5 * one, 0.2 * one, -3.0 * one, 3.0 * one)
    outward = kernels.reachable(9.0 * one, 3.5 * one, 0.2 * one, -3.0 * one, 3.0 * one)
    assert inward[0] < 3.5
    assert outward[0] <= 3.5


@pytest.mark.parametrize("seed", range(20))
def test_a_raw_wrench_is_the_sum_of_its_parts_to_the_last_digit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, bias, drift, phase, noise, sigma = rng.normal(size=(6, 6))
    digit = np.repeat([0.02, 0.0005], 3)
    raw = true + bias + drift * np.sin(0.7 + phase) + sigma * noise
    read = kernels.raw_wrench(true, bias, drift, phase, 0.7, noise, sigma, digit)
    np.testing.assert_allclose(read, (raw / digit).round() * digit, atol=1e-12)
