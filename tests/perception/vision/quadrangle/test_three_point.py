"""Tests of the compiled three-point solver and of the derivatives of the reprojection error."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.camera_model import rays
from perception.vision.quadrangle.cost import chi_square, expand, rotation_of
from perception.vision.quadrangle.three_point import real_cubic_root, three_point
from tests.perception.vision.quadrangle.quadrangle_cases import CAMERA, SHAPES, angle_deg, pixels_of, view

DOUBLE_ROOT_PX = 0.5  # real parts of complex pairs are also returned; with a smaller error they are double roots
FULL = sorted(name for name in SHAPES if name != "three in a row")


def three_light_poses(points_m: np.ndarray, pixels: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return all poses that project three points to their pixels."""
    Rs, ts = np.empty((4, 3, 3)), np.empty((4, 3))
    count = three_point(np.ascontiguousarray(points_m), rays(np.ascontiguousarray(pixels), CAMERA), Rs, ts)
    found = [(Rs[k], ts[k]) for k in range(count)]
    return [(R, t) for R, t in found if np.abs(pixels_of(points_m, R, t) - pixels).max() < DOUBLE_ROOT_PX]


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), shape=st.sampled_from(FULL), tilt_deg=st.floats(1.0, 70.0))
def test_every_three_light_pose_meets_its_pixels_and_one_is_the_truth(seed: int, shape: str, tilt_deg: float) -> None:
    true = view(np.random.default_rng(seed), shape, tilt_deg=tilt_deg)
    poses = three_light_poses(true.points_m[:3], true.pixels[:3])
    assert 1 <= len(poses) <= 4
    nearest = min(angle_deg(R, true.R) for R, _ in poses)
    assert nearest < 0.5  # near a double root the accuracy is only the square root of the rounding error
    if nearest < 1e-3:
        for R, t in poses:
            np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
            assert np.abs(pixels_of(true.points_m[:3], R, t) - true.pixels[:3]).max() < 1.0


@settings(max_examples=200, deadline=None)
@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-50, 50))
def test_the_cubic_root_is_the_largest_real_one(b: float, c: float, d: float) -> None:
    root = real_cubic_root(b, c, d)
    real = [r.real for r in np.roots([1.0, b, c, d]) if abs(r.imag) < 1e-6 * (1 + abs(r))]
    assert min(abs(root - r) for r in real) < 1e-4 * (1 + abs(root))


def test_gradient_and_information_agree_with_finite_differences() -> None:
    rng = np.random.default_rng(0)
    for is_exact in (False, True, False, True):
        X, m = 0.1 * rng.normal(size=(4, 3)), 0.1 * rng.normal(size=(4, 2))
        A = np.tile([3e3, 5e2, 2e3], (4, 1))
        R, t = rotation_of(rng.normal(size=3)), np.array([0.1, 0.05, 1.0])
        if is_exact:  # where residuals vanish, the Gauss-Newton matrix is half the Hessian
            seen = X @ R.T + t
            m = seen[:, :2] / seen[:, 2:]
        g, N = np.empty(6), np.empty((6, 6))
        cost = expand(R, t, X, m, A, g, N)

        def at(x: np.ndarray, R: np.ndarray = R, t: np.ndarray = t, rest: tuple = (X, m, A)) -> float:
            return float(chi_square(rotation_of(x[3:]) @ R, t + x[:3], *rest))

        e = 1e-4 * np.eye(6)
        assert cost == pytest.approx(at(np.zeros(6)))
        if is_exact:
            numeric = np.array([[at(a + b) - at(a - b) - at(b - a) + at(-a - b) for a in e] for b in e]) / 8e-8
            np.testing.assert_allclose(N, numeric, atol=1e-5 * np.abs(N).max())
        else:
            numeric = np.array([at(a) - at(-a) for a in e]) / 4e-4
            np.testing.assert_allclose(g, numeric, atol=1e-5 * np.abs(g).max())
