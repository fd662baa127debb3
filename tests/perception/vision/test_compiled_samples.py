"""Compares compiled functions with numpy and OpenCV."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception.vision.bilinear import polar_values, step_counts
from perception.vision.patch import sample_at
from perception.vision.status.pointer_axis import pointer_axis


@given(seed=st.integers(0, 10_000))
def test_polar_values_are_those_of_opencv(seed: int) -> None:
    random = np.random.default_rng(seed)
    image = random.integers(0, 256, (37, 41)).astype(np.uint8)
    centre = random.uniform(5.0, 30.0, 2)
    radii, angles = np.linspace(0.0, 25.0, 9), np.linspace(-3.0, 3.0, 31)  # outside, the border pixels are repeated
    directions = np.stack([np.sin(angles), -np.cos(angles)])
    expected = sample_at(image, *(centre[k] + radii[:, None] * directions[k] for k in (0, 1)))
    values = polar_values(image, (float(centre[0]), float(centre[1])), radii, directions)
    assert values == pytest.approx(expected, abs=255 / 16)  # OpenCV rounds coordinates to 1/32 px
    assert np.mean(np.abs(values - expected)) < 2.0


def test_step_counts_are_those_of_second_differences() -> None:
    gray = np.random.default_rng(0).integers(0, 256, (23, 31)).astype(np.uint8)
    for every in (1, 4):
        rows = gray[::every].astype(int)
        steps = np.abs(rows[:, 2:] - 2 * rows[:, 1:-1] + rows[:, :-2])
        assert np.array_equal(step_counts(gray, every), np.bincount(steps.ravel(), minlength=1021))


def reference_axis(
    ink: np.ndarray, r: np.ndarray, offset: np.ndarray, reach: float, e_sigma: float, px: float
) -> float:
    """Return the angle of `pointer_axis`, computed by numpy."""
    near = np.broadcast_to(np.abs(offset) < reach, ink.shape)
    solution = np.zeros(2)
    for _ in range(3):
        shown = np.where(near, ink, 0.0)
        top = shown.max(axis=1, keepdims=True)
        top = np.where(top > 1.8 * np.percentile(top[top > 0], 35.0), 0.0, top)
        shown = np.maximum(np.where(top > 0, shown, 0.0) - 0.3 * top, 0.0)
        mass = shown.sum(axis=1)
        there = mass > 0
        theta = (shown * offset).sum(axis=1) / np.where(there, mass, 1.0)
        width = mass * abs(offset[1] - offset[0]) / np.where(there, 0.7 * top[:, 0], 1.0)
        weight = np.minimum(mass / np.median(mass[there]), 2.0)
        A = np.column_stack([np.ones_like(r), 1.0 / r])
        solution = np.array([np.median(theta[there]), 0.0])
        for _ in range(5):
            miss_m = (theta - A @ solution) * r
            scale = max(1.4826 * np.median(np.abs(miss_m[there])), 0.15 / px)
            w = weight / (1.0 + (miss_m / (1.5 * scale)) ** 2) * r**2 / scale**2
            N = A.T @ (w[:, None] * A) + np.diag([0.0, 1.0 / e_sigma**2])
            solution = np.linalg.solve(N, A.T @ (w * theta))
        half_m = 0.6 * np.percentile((width * r)[there], 35) + 0.6 / px
        near = np.abs(offset - (solution[0] + solution[1] / r)[:, None]) < (half_m / r)[:, None]
    return float(solution[0])


@given(seed=st.integers(0, 10_000))
def test_a_pointers_axis_is_the_one_that_numpy_finds(seed: int) -> None:
    random = np.random.default_rng(seed)
    r, offset = np.linspace(0.01, 0.03, 40), np.linspace(-0.3, 0.3, 160)
    lean = random.uniform(-0.04, 0.04) + random.normal(0.0, 1e-4) / r
    ink = 60.0 * np.exp(-0.5 * ((offset - lean[:, None]) * r[:, None] / 6e-4) ** 2) + random.random((40, 160)) * 4
    ink[12:16, 70:90] += random.uniform(0.0, 200.0)  # a numeral
    ink = ink.astype(np.float32)
    reach, e_sigma, px = 0.12, 3e-4, 2200.0
    angle, variance = pointer_axis(ink, np.zeros(ink.shape, bool), r, offset, reach, e_sigma, px)
    assert angle == pytest.approx(reference_axis(ink, r, offset, reach, e_sigma, px), abs=1e-5)
    assert 0.0 < variance < 0.1**2


def test_an_axis_wants_ink_in_three_rows() -> None:
    ink = np.zeros((20, 60), np.float32)
    r, offset = np.linspace(0.01, 0.03, 20), np.linspace(-0.3, 0.3, 60)
    angle, variance = pointer_axis(ink, np.zeros(ink.shape, bool), r, offset, 0.1, 3e-4, 2200.0)
    assert np.isnan(angle) and np.isnan(variance)


def test_rows_where_a_pointer_goes_under_a_cable_do_not_tell_its_axis() -> None:
    """A cable that crosses the pointer at an angle leaves less and less of it, so the rest leans away from it."""
    r, offset = np.linspace(0.01, 0.03, 40), np.linspace(-0.3, 0.3, 160)
    ink = (60.0 * np.exp(-0.5 * (offset * r[:, None] / 6e-4) ** 2)).astype(np.float32)
    hidden = offset * r[:, None] > 2e-3 * (1.0 - np.arange(40)[:, None] / 26)  # meets the pointer halfway
    shown = np.where(hidden, 0.0, ink).astype(np.float32)
    seen, _ = pointer_axis(shown, np.zeros(ink.shape, bool), r, offset, 0.12, 3e-4, 2200.0)
    known, _ = pointer_axis(shown, hidden, r, offset, 0.12, 3e-4, 2200.0)
    assert abs(known) < 0.003 < abs(seen)
