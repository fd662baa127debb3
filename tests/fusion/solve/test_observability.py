"""Unobservable motions are described in words and as a twist, with a standard deviation at the features."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.features import Kind, point
from fusion.measurement import measurement
from fusion.solve import solve
from fusion.solve.observability import PRIOR_SIGMA, covariance_and_freedom
from hal.arrays import Array
from hal.geometry import transform

CENTRE = np.array([0.3, -0.1, 0.2])
AXIS = np.array([0.0, 0.0, 1.0])


def blind_to(twist: Array) -> Array:
    """Return the information (6, 6) about all motions except one."""
    unit = twist / np.linalg.norm(twist)
    return 1e8 * (np.eye(6) - np.outer(unit, unit))


@pytest.mark.parametrize("rise_m_per_rad", [0.0, 0.05])
def test_a_free_turn_about_the_middle_is_named_with_its_slide(rise_m_per_rad: float) -> None:
    twist = np.concatenate(
        [np.cross(CENTRE, AXIS) + rise_m_per_rad * AXIS, AXIS]
    )  # of the origin, which moves with the rotation
    covariance, (free,) = covariance_and_freedom(blind_to(twist), CENTRE, 0.2)
    assert abs(free.twist @ twist) == pytest.approx(np.linalg.norm(twist))
    slide = f" while sliding {1000 * np.radians(rise_m_per_rad):.1f} mm per degree" if rise_m_per_rad else ""
    assert free.words == f"turn about the base's z axis{slide}"
    assert np.sqrt(AXIS @ covariance[3:, 3:] @ AXIS) == pytest.approx(
        PRIOR_SIGMA / np.hypot(1.0, rise_m_per_rad / 0.2), rel=1e-3
    )


def test_pure_shifts_stand_alone_beside_a_free_turn() -> None:
    shift, turn = np.array([1.0, 0, 0, 0, 0, 0]), np.concatenate([np.cross(CENTRE, AXIS), AXIS])
    basis = np.linalg.qr(np.column_stack([shift, turn]))[0]
    _, free = covariance_and_freedom(1e8 * (np.eye(6) - basis @ basis.T), CENTRE, 0.2)
    assert {f.words for f in free} == {"shift along the base's x axis", "turn about the base's z axis"}


def test_two_marks_leave_a_turn_about_their_line_and_one_degree_of_freedom() -> None:
    pose = transform(Rotation.from_rotvec([0.4, -0.3, 0.8]).as_matrix(), (0.5, 0.1, 0.3))
    marks = [point((0.1, 0.2, 0.0)), point((0.4, 0.2, 0.0))]
    given = [measurement(m, Kind.POINT, mu_m=pose.apply(m.point_m), C_m2=1e-6 * np.eye(3)) for m in marks]
    found = solve(given, pose)
    assert found.dof == 1
    (free,) = found.unobservable
    along = pose.rotation.apply([1.0, 0.0, 0.0])
    assert abs(free.twist[3:] @ along) == pytest.approx(np.linalg.norm(free.twist[3:]))
    assert np.sqrt(along @ found.covariance[3:, 3:] @ along) == pytest.approx(PRIOR_SIGMA, rel=1e-3)
