"""Tests of tool weight and sensor bias: exact and noisy readings, and poses that cannot separate them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hal.calibration import ToolLoad
from hal.errors import InvalidRequest, NotObservable
from perception.calibration.wrench import GRAVITY_M_PER_S2, calibrate_wrench

LOAD = ToolLoad(mass_kg=1.3, centre_of_mass_m=(0.01, -0.02, 0.09), bias=(4.0, -7.0, 12.0, 0.3, -0.2, 0.1))


def reading(R: np.ndarray, load: ToolLoad = LOAD) -> np.ndarray:
    pull = load.mass_kg * R.T @ [0.0, 0.0, -GRAVITY_M_PER_S2]
    return np.concatenate([pull, np.cross(load.centre_of_mass_m, pull)]) + load.bias


def poses(count: int, seed: int, spread_rad: float = 1.2) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return Rotation.from_rotvec(spread_rad * rng.uniform(-1, 1, (count, 3))).as_matrix()


def test_exact_readings_give_the_exact_load() -> None:
    R = poses(8, 1)
    found = calibrate_wrench(R, [reading(r) for r in R])
    assert found.load.mass_kg == pytest.approx(1.3)
    np.testing.assert_allclose(found.load.centre_of_mass_m, LOAD.centre_of_mass_m, atol=1e-9)
    np.testing.assert_allclose(found.load.bias, LOAD.bias, atol=1e-8)
    assert found.rms_n < 1e-9


def test_errors_match_the_covariance() -> None:
    rng = np.random.default_rng(2)
    scaled = []
    for seed in range(40):
        R = poses(14, seed)
        noisy = np.array([reading(r) for r in R]) + rng.normal(size=(14, 6)) * [0.2, 0.2, 0.2, 0.01, 0.01, 0.01]
        found = calibrate_wrench(R, noisy)
        scaled.append((found.load.mass_kg - 1.3) ** 2 / found.covariance[3, 3])
    assert 0.5 < np.mean(scaled) < 1.9


def test_one_direction_of_gravity_is_refused_and_the_next_is_named() -> None:
    R = Rotation.from_rotvec([[0, 0, a] for a in np.linspace(0, 3, 8)]).as_matrix()  # all upright
    with pytest.raises(NotObservable, match="too few directions") as refused:
        calibrate_wrench(R, [reading(r) for r in R])
    down = np.array(refused.value.details["next_down"])
    assert abs(np.linalg.norm(down) - 1.0) < 0.02
    assert abs(down[2]) < 0.2


def test_a_tilt_about_one_axis_only_is_refused() -> None:
    R = Rotation.from_rotvec([[a, 0, 0] for a in np.linspace(-0.1, 0.1, 8)]).as_matrix()
    with pytest.raises(NotObservable):
        calibrate_wrench(R, [reading(r) for r in R])


def test_bad_input_is_refused() -> None:
    R = poses(6, 1)
    good = np.array([reading(r) for r in R])
    with pytest.raises(InvalidRequest, match="N >= 4"):
        calibrate_wrench(R[:3], good[:3])
    broken = good.copy()
    broken[4, 2] = np.nan
    with pytest.raises(InvalidRequest, match=r"wrenches\[4\]"):
        calibrate_wrench(R, broken)
    with pytest.raises(InvalidRequest, match="weight") as refused:
        calibrate_wrench(R, -good)
    assert "sign" in refused.value.hint
