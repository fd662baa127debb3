"""Tests of how a sensor's errors enter C and M: each sigma in its direction, lines at the point known best."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import sensing
from fusion.features import Kind, line, plane
from fusion.sensing.propagation import from_joint
from hal.arrays import Array
from hal.geometry import certain, matrix_of, transform

PIVOT, D = np.array([0.3, -0.2, 0.5]), np.array([0.0, 0.6, 0.8])
ACROSS = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6]])
SIGMA_M, SIGMA_RAD = 1e-3, 0.02
ERRORS = np.diag([SIGMA_M**2] * 3 + [SIGMA_RAD**2] * 2)
EDGE, FACE = line((0.1, 0.2, 0.0), (1, 0, 0)), plane((0.1, 0.2, 0.0), (0, 0, 1))
TURNED = transform(Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix(), (0.5, 0.1, 0.9))


def turned(x: Array) -> Rotation:
    return Rotation.from_rotvec(x[3] * ACROSS[0] + x[4] * ACROSS[1])


def far_along_the_line(x: Array) -> tuple[Array, Array]:
    """Return a line that is known best at PIVOT, described by a point half a metre away."""
    d = turned(x).apply(D)
    return PIVOT + x[:3] + 0.5 * d, d


def far_off_in_the_plane(x: Array) -> tuple[Array, Array]:
    turn = turned(x)
    return PIVOT + x[:3] + turn.apply(0.5 * ACROSS[0] - 0.3 * ACROSS[1]), turn.apply(D)


def test_a_line_is_placed_where_it_is_known_best() -> None:
    made = from_joint(EDGE, Kind.LINE, far_along_the_line, ERRORS, "", "")
    np.testing.assert_allclose(made.mu_m, PIVOT, atol=1e-6)
    np.testing.assert_allclose(ACROSS @ made.C_m2 @ ACROSS.T, SIGMA_M**2 * np.eye(2), rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(ACROSS @ made.M @ ACROSS.T, SIGMA_RAD**-2 * np.eye(2), rtol=1e-3, atol=1e-3)
    assert np.abs(made.M @ D).max() < 1e-6


def test_a_plane_is_placed_where_it_is_known_best() -> None:
    made = from_joint(FACE, Kind.PLANE, far_off_in_the_plane, ERRORS, "", "")
    np.testing.assert_allclose(made.mu_m, PIVOT, atol=1e-6)
    assert pytest.approx(SIGMA_M**2, rel=1e-3) == D @ made.C_m2 @ D
    assert np.abs(made.M @ D).max() < 1e-6


def test_a_direction_whose_sense_flips_with_the_noise_is_no_less_known() -> None:
    def flipping(x: Array) -> tuple[Array, Array]:
        place, d = far_along_the_line(x)
        return place, d if x[3] > 0 else -d

    steady = from_joint(EDGE, Kind.LINE, far_along_the_line, ERRORS, "", "")
    np.testing.assert_allclose(from_joint(EDGE, Kind.LINE, flipping, ERRORS, "", "").M, steady.M, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("pose", [RigidTransform.identity(), TURNED])
def test_each_sigma_of_a_distance_acts_along_its_own_axis(pose: RigidTransform) -> None:
    made = sensing.proximity(FACE, certain(pose), distance_m=0.1, sigma_m=1e-3, lateral_sigma_m=4e-3)
    in_sensor = matrix_of(pose).T @ made.C_m2 @ matrix_of(pose)
    np.testing.assert_allclose(in_sensor, np.diag([16e-6, 16e-6, 1e-6]), rtol=1e-5, atol=1e-11)
    np.testing.assert_allclose(made.mu_m, pose.apply([0.0, 0.0, 0.1]))


def test_a_fitted_plane_has_the_offset_and_the_tilt_that_were_given() -> None:
    place, normal = (0.02, 0.01, 0.4), np.array([0.0, 0.6, -0.8])
    made = sensing.range_plane(
        FACE, certain(TURNED), point_m=place, normal=normal, offset_sigma_m=2e-3, normal_sigma_rad=5e-3
    )
    n = matrix_of(TURNED) @ normal
    assert np.sqrt(n @ made.C_m2 @ n) == pytest.approx(2e-3, rel=1e-3)
    assert np.linalg.eigvalsh(made.M) == pytest.approx([0.0, 5e-3**-2, 5e-3**-2], rel=1e-3, abs=1e-3)
    np.testing.assert_allclose(made.mu_m, TURNED.apply(place), atol=1e-6)
