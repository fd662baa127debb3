"""Tests of comparing objects found by their surfaces with the panel file and with another reading."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from hal.geometry import UncertainPose, perturbed
from hal.panel import Handwheel, Mushroom
from perception.range import PinholeSensor, Sighting, check_place, outline_px, states_agree
from perception.range.matching.cross_check import ELSEWHERE_P, OUTLINE_POINTS, TURN_SLACK_RAD
from perception.range.matching.match import Match

BASE_FROM_PANEL = RigidTransform.from_components([0.9, 0.1, 0.5], Rotation.from_euler("xyz", [1.5, 0.1, -1.6]))
PANEL_COVARIANCE = np.diag([1e-3, 1e-3, 1e-3, 2e-3, 2e-3, 2e-3]) ** 2
OBJECT_COVARIANCE = np.diag([8e-4, 8e-4, 8e-4, 1e-3, 1e-3, 1e-3]) ** 2
BUILT_M = 0.0005
MUSHROOM = Mushroom(name="stop", position_m=(0.19, 0.04))
WHEEL = Handwheel(name="bypass", position_m=(-0.06, 0.02))


def sighting(
    panel_object: Mushroom | Handwheel, base_from_object: UncertainPose | None = None, state: float = 0.0
) -> Sighting:
    """Return an object found at a pose, or in its place."""
    at = BASE_FROM_PANEL * RigidTransform.from_translation([*panel_object.position_m, 0.0])
    found = base_from_object or UncertainPose(parent_from_child=at, covariance=OBJECT_COVARIANCE)
    match = Match(
        model=panel_object.name,
        sensor_from_object=found,
        labels={},
        state=state,
        state_sigma=0.01,
        free=(),
        score=100.0,
        seen=0.6,
    )
    return Sighting(panel_object=panel_object, match=match, base_from_object=found, state=state)


def test_the_chi_square_of_a_place_holds_when_every_error_is_drawn_as_stated() -> None:
    rng = np.random.default_rng(5)
    drawn = []
    for _ in range(600):
        built = [*(MUSHROOM.position_m + BUILT_M * rng.standard_normal(2)), 0.0]
        true_object = BASE_FROM_PANEL * RigidTransform.from_translation(built)
        told_object, told_panel = (
            UncertainPose(parent_from_child=perturbed(true, np.sqrt(np.diag(C)) * rng.standard_normal(6)), covariance=C)
            for true, C in ((true_object, OBJECT_COVARIANCE), (BASE_FROM_PANEL, PANEL_COVARIANCE))
        )
        check = check_place(sighting(MUSHROOM, told_object), told_panel, BUILT_M)
        assert check is not None
        drawn.append(check.chi_square)
    low, high = chi2.ppf([0.0005, 0.9995], 2 * len(drawn))
    assert low < np.sum(drawn) < high


def test_a_place_is_elsewhere_beyond_what_chance_explains_and_unknown_without_a_pose() -> None:
    panel = UncertainPose(parent_from_child=BASE_FROM_PANEL, covariance=np.eye(6) * 1e-12)
    sigma_m = np.hypot(8e-4, BUILT_M)
    for sigmas, is_elsewhere in ((0.98, False), (1.02, True)):
        off_m = sigmas * sigma_m * np.sqrt(chi2.isf(ELSEWHERE_P, 2))
        at = RigidTransform.from_translation([WHEEL.position_m[0] + off_m, WHEEL.position_m[1], 0.0])
        found = UncertainPose(parent_from_child=BASE_FROM_PANEL * at, covariance=OBJECT_COVARIANCE)
        check = check_place(sighting(WHEEL, found), panel, BUILT_M)
        assert check is not None and check.is_elsewhere is is_elsewhere
        assert check.off_m == pytest.approx(off_m) and check.sigma_m == pytest.approx(sigma_m, rel=1e-3)
    assert check_place(Sighting(panel_object=WHEEL, why="hidden"), panel, BUILT_M) is None


def test_a_wheel_agrees_modulo_its_spokes_and_a_cap_by_the_name_of_its_state() -> None:
    spoke = 2.0 * np.pi / WHEEL.spokes
    for turns in (-2, 0, 5):
        assert states_agree(sighting(WHEEL, state=0.02), value=turns * spoke - 0.02, sigma=0.01)
    beyond = TURN_SLACK_RAD + 3.0 * np.hypot(0.01, 0.02) + 0.001
    assert not states_agree(sighting(WHEEL, state=0.0), value=spoke + beyond, sigma=0.02)
    pressed = sighting(MUSHROOM, state=-MUSHROOM.travel_m)
    assert states_agree(pressed, state="pressed") and not states_agree(pressed, state="released")
    assert states_agree(pressed) and states_agree(Sighting(panel_object=MUSHROOM), state="pressed")


def test_the_outline_lies_where_single_points_project_to() -> None:
    sensor = PinholeSensor(width_px=128, height_px=96, fx_px=120.0, fy_px=110.0, cx_px=63.0, cy_px=48.5)
    base_from_sensor = BASE_FROM_PANEL * RigidTransform.from_components(
        [0.02, 0.01, 0.5], Rotation.from_euler("x", np.pi - 0.2)
    )
    drawn = outline_px(sighting(WHEEL), sensor, base_from_sensor, BASE_FROM_PANEL)
    assert drawn.shape == (OUTLINE_POINTS, 2)
    assert WHEEL.relief is not None
    radius_m = max(WHEEL.half_footprint_m)
    on_panel = RigidTransform.from_translation(
        [WHEEL.position_m[0] + radius_m, WHEEL.position_m[1], WHEEL.relief.height_m]
    )
    x, y, z = (base_from_sensor.inv() * BASE_FROM_PANEL * on_panel).translation
    assert drawn[0] == pytest.approx([120.0 * x / z + 63.0, 110.0 * y / z + 48.5])
    lost = outline_px(Sighting(panel_object=WHEEL), sensor, base_from_sensor, BASE_FROM_PANEL)
    np.testing.assert_allclose(lost, drawn, atol=1e-9)  # it is looked for where it was found
