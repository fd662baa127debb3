"""Tests of the four-light pose: exact data, statistics, mirror poses, all minima, bad input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.errors import InvalidRequest, NotObservable
from hal.geometry import difference, transform
from perception.vision.quadrangle import QuadranglePose, estimate, warm_up
from tests.perception.vision.quadrangle.quadrangle_cases import (
    BENT,
    CAMERA,
    RECTANGLE,
    SHAPES,
    View,
    angle_deg,
    pixels_of,
    view,
)


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    warm_up()


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), shape=st.sampled_from(sorted(SHAPES)), tilt_deg=st.floats(0.0, 70.0),
       range_m=st.floats(0.4, 3.0))  # fmt: skip
def test_exact_pixels_give_the_exact_pose(seed: int, shape: str, tilt_deg: float, range_m: float) -> None:
    true = view(np.random.default_rng(seed), shape, tilt_deg=tilt_deg, range_m=range_m)
    pose = estimate(true.points_m, true.pixels, 0.01**2, CAMERA)
    assert pose.chi_square < 1e-3
    found = [(pose.rotation, pose.translation_m)] + [(a.rotation, a.translation_m) for a in pose.alternatives]
    assert min(angle_deg(R, true.R) + np.linalg.norm(t - true.t) for R, t in found) < 0.05


def test_a_bent_lens_gives_the_same_pose() -> None:
    true = view(np.random.default_rng(3), "rectangle", tilt_deg=25.0)
    bent = project(true.points_m @ true.R.T + true.t, BENT)
    assert np.abs(bent - true.pixels).max() > 1.0
    pose = estimate(true.points_m, bent, 0.1**2, BENT)
    assert angle_deg(pose.rotation, true.R) < 1e-4
    np.testing.assert_allclose(pose.translation_m, true.t, atol=1e-7)


def brute_force_minima(true: View, pixels: Array, sigma_px: float, rng: np.random.Generator) -> list[float]:
    """Return the chi-squares of the distinct minima that scipy's solver reaches from 50 random starts."""

    def residuals(poses: Array) -> Array:
        """Return residuals (k, 8) for (k, 6) rotation vectors and translations."""
        seen = pixels_of(true.points_m, Rotation.from_rotvec(poses[:, :3]).as_matrix(), poses[:, 3:])
        return np.nan_to_num((seen - pixels) / sigma_px, nan=1e3).reshape(len(poses), -1)

    def residual(x: Array) -> Array:
        return residuals(x[None])[0]

    def jacobian(x: Array) -> Array:
        """Return forward differences as the solver would compute them, all six at once."""
        steps = np.sqrt(np.finfo(float).eps) * np.maximum(np.abs(x), 1e-3)
        both = residuals(np.vstack([x, x + np.diag(steps)]))
        return (both[1:] - both[0]).T / steps

    centre = true.R @ true.points_m.mean(axis=0) + true.t
    found: list[float] = []
    for _ in range(50):
        R = Rotation.random(random_state=rng)
        t = centre * rng.uniform(0.7, 1.4) - R.apply(true.points_m.mean(axis=0))
        start = np.concatenate([R.as_rotvec(), t])
        fit = least_squares(residual, start, jacobian, method="lm", xtol=1e-12, ftol=1e-12)
        if all(abs(2 * fit.cost - c) > 1e-3 * (1 + c) for c in found):
            found.append(2 * fit.cost)
    return sorted(found)


@pytest.mark.parametrize("shape", ["rectangle", "raised", "irregular"])
@pytest.mark.parametrize("tilt_deg", [3.0, 30.0])
def test_no_random_start_finds_a_lower_minimum(shape: str, tilt_deg: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(2):
        true = view(rng, shape, tilt_deg=tilt_deg, range_m=1.5)
        pixels = true.pixels + rng.normal(scale=0.5, size=(4, 2))
        pose = estimate(true.points_m, pixels, 0.5**2, CAMERA)
        brute = brute_force_minima(true, pixels, 0.5, rng)
        assert pose.chi_square == pytest.approx(brute[0], abs=1e-3)
        listed = [pose.chi_square] + [a.chi_square for a in pose.alternatives if a.covariance is not None]
        for cost in brute:
            if cost < brute[0] + 9.0:
                assert min(abs(cost - c) for c in listed) < 1e-2 * (1 + cost)


def solved(seed: int, count: int, *, tilt_deg: tuple[float, float], sigma_px: float, range_m: float) -> list[
    tuple[View, QuadranglePose]
]:  # fmt: skip
    rng = np.random.default_rng(seed)
    pairs = []
    for _ in range(count):
        true = view(rng, "rectangle", tilt_deg=float(rng.uniform(*tilt_deg)), range_m=range_m)
        pixels = true.pixels + rng.normal(scale=sigma_px, size=(4, 2))
        pairs.append((true, estimate(true.points_m, pixels, sigma_px**2, CAMERA)))
    return pairs


def test_errors_match_the_covariance() -> None:
    pairs = solved(5, 400, tilt_deg=(15.0, 50.0), sigma_px=0.2, range_m=0.8)
    nees = []
    for true, pose in pairs:
        e = difference(transform(true.R, true.t), pose.camera_from_object)
        nees.append(e @ np.linalg.solve(pose.covariance, e) / 6.0)
    assert abs(np.mean(nees) - 1.0) < 4.0 * np.sqrt(2.0 / (6 * len(pairs)))
    chi = [pose.chi_square for _, pose in pairs]
    assert abs(np.mean(chi) - 2.0) < 4.0 * 2.0 / np.sqrt(len(chi))


def flipped(true: View, R: Array) -> bool:
    """Return whether a pose is flipped as in data/pose: nearer to the mirrored normal and more than 5 degrees off."""
    sight = true.R @ true.points_m.mean(axis=0) + true.t
    sight /= np.linalg.norm(sight)
    n, e = true.R[:, 2], R[:, 2]
    return bool(e @ (2 * (n @ sight) * sight - n) > e @ n and np.degrees(np.arccos(np.clip(e @ n, -1, 1))) > 5)


def test_a_mirrored_answer_is_flagged_and_the_truth_is_among_the_alternatives() -> None:
    pairs = solved(6, 400, tilt_deg=(0.0, 20.0), sigma_px=1.0, range_m=2.0)
    wrong = [(true, pose) for true, pose in pairs if flipped(true, pose.rotation)]
    assert len(wrong) > 20  # enough cases for statistics
    assert sum(not pose.ambiguous for _, pose in wrong) <= 0.03 * len(pairs)
    flagged = [(true, pose) for true, pose in wrong if pose.ambiguous]
    listed = sum(any(not flipped(true, a.rotation) for a in pose.alternatives) for true, pose in flagged)
    assert listed >= 0.95 * len(flagged)


def test_the_probability_is_calibrated() -> None:
    pairs = solved(8, 500, tilt_deg=(0.0, 60.0), sigma_px=1.0, range_m=2.0)
    predicted = np.mean([1.0 - pose.probability for _, pose in pairs])
    happened = np.mean([flipped(true, pose.rotation) for true, pose in pairs])
    # Uniform tilt gives frontal views more weight than the solid angle, so there are more flips than predicted.
    assert 0.5 * predicted < happened < 2.0 * predicted


def test_a_clear_view_is_not_ambiguous() -> None:
    for _, pose in solved(9, 40, tilt_deg=(30.0, 55.0), sigma_px=0.1, range_m=0.6):
        assert not pose.ambiguous
        assert pose.probability > 0.999


def test_covariance_follows_the_pixels_covariance() -> None:
    true = view(np.random.default_rng(1), "rectangle", tilt_deg=30.0)
    once = estimate(true.points_m, true.pixels, 0.1**2, CAMERA)
    twice = estimate(true.points_m, true.pixels, np.eye(2) * 0.2**2, CAMERA)
    each = estimate(true.points_m, true.pixels, np.tile(np.eye(2) * 0.2**2, (4, 1, 1)), CAMERA)
    np.testing.assert_allclose(twice.covariance, 4.0 * once.covariance, rtol=1e-4)
    np.testing.assert_allclose(each.covariance, twice.covariance)


def test_covariance_equals_the_bound_by_finite_differences() -> None:
    true = view(np.random.default_rng(2), "irregular", tilt_deg=35.0)
    pose = estimate(true.points_m, true.pixels, 0.3**2, CAMERA)
    columns = []
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        ahead, back = (
            pixels_of(true.points_m, Rotation.from_rotvec(s[3:]).as_matrix() @ true.R, true.t + s[:3])
            for s in (step, -step)
        )
        columns.append((ahead - back).ravel() / 2e-6)
    J = np.stack(columns, axis=1)
    np.testing.assert_allclose(pose.covariance, 0.3**2 * np.linalg.inv(J.T @ J), rtol=1e-3, atol=1e-12)


def test_a_misplaced_light_shows_in_the_chi_square() -> None:
    true = view(np.random.default_rng(4), "rectangle", tilt_deg=30.0, range_m=0.7)
    pixels = true.pixels + np.array([[12.0, 0.0], [0, 0], [0, 0], [0, 0]])
    pose = estimate(true.points_m, pixels, 0.2**2, CAMERA)
    assert pose.p_value < 1e-6


@pytest.mark.parametrize(
    ("points", "pixels", "covariance", "words"),
    [
        (RECTANGLE[:3], np.ones((4, 2)), 1.0, "four points"),
        (RECTANGLE, np.ones((4, 3)), 1.0, "four points"),
        (RECTANGLE, np.full((4, 2), np.nan), 1.0, r"points_px\[0\] is not finite"),
        (RECTANGLE, np.ones((4, 2)) * [[1], [2], [3], [4]], np.ones((3, 3)), "covariance_px must be"),
        (RECTANGLE, np.ones((4, 2)), -1.0, r"covariance_px\[0\]"),
        (RECTANGLE, np.ones((4, 2)), [[1.0, 2.0], [2.0, 1.0]], r"covariance_px\[0\]"),
        (RECTANGLE, np.ones((4, 2)), [[1.0, 0.5], [0.0, 1.0]], r"covariance_px\[0\]"),
    ],
)
def test_bad_input_is_refused_by_name(points: Array, pixels: Array, covariance: object, words: str) -> None:
    with pytest.raises(InvalidRequest, match=words):
        estimate(points, pixels, covariance, CAMERA)


@pytest.mark.parametrize("points", [np.zeros((4, 3)), np.outer([0.0, 0.1, 0.2, 0.4], [1.0, 2.0, 3.0])])
def test_lights_on_one_line_are_not_observable(points: Array) -> None:
    with pytest.raises(NotObservable, match="one line"):
        estimate(points, [[600, 400], [650, 420], [700, 440], [800, 480]], 0.01, CAMERA)


def test_a_pixel_that_the_lens_cannot_see_is_refused() -> None:
    folding = CameraIntrinsics(width_px=4000, height_px=4000, fx_px=600.0, fy_px=600.0, cx_px=2000.0, cy_px=2000.0,
                               distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))  # fmt: skip
    with pytest.raises(InvalidRequest, match=r"points_px\[3\]"):
        estimate(RECTANGLE, [[1900, 1900], [2100, 1900], [2100, 2100], [3900, 2100]], 0.01, folding)
