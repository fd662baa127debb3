from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from hal.errors import Unreachable
from hal.geometry import UncertainPose, certain, transform_rpy
from hal.motion import DeclaredMotion, MotionReport, RobotState
from hal.panel import Shown
from manipulation.arm.kinematics import Kinematics
from manipulation.planning.hand import Hand
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.skills.context import SkillContext, leaning, panel_from_grip
from manipulation.skills.sweep import Sweep, plan_sweep
from tests.manipulation.arms import T3
from tests.manipulation.planning.test_collision import make_panel

GRIP = transform_rpy((0.0, 0.0, 0.21), (0.0, 0.0, 0.0))
PANEL = transform_rpy((0.75, 0.0, 0.6), (np.pi / 2, 0.0, -np.pi / 2))
PARK = np.array([0.0, 0.0, -0.3, 0.0, 1.2, 0.0])


class NoMover:
    """Mover that must not be used."""

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        raise AssertionError("planning moves nothing")

    def cancel(self) -> None:
        raise AssertionError

    def tare(self) -> np.ndarray:
        raise AssertionError

    def state(self) -> RobotState:
        raise AssertionError


def context(pose: RigidTransform = PANEL, uncertain: UncertainPose | None = None) -> SkillContext:
    return SkillContext(
        mover=NoMover(),
        kinematics=Kinematics.of(T3),
        panel=make_panel(),
        base_from_panel=uncertain or certain(pose),
        flange_from_grip=GRIP,
        limits=SpeedLimits(tip_m_per_s=0.25),
        park_rad=PARK,
        shown={"valve": Shown(value=0.0)},
    )


@pytest.mark.parametrize("turn", [0.0, 0.7, np.pi, -2.0])
def test_the_grip_points_at_the_plate_and_closes_along_its_turn(turn: float) -> None:
    pose = panel_from_grip((0.1, -0.05, 0.03), turn)
    matrix = pose.rotation.as_matrix()
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    assert np.allclose(matrix[:, 2], [0, 0, -1])
    assert np.allclose(matrix[:, 0], [np.cos(turn), np.sin(turn), 0])
    assert np.allclose(pose.translation, [0.1, -0.05, 0.03])


def test_the_chosen_way_reaches_every_pose_and_touches_only_what_it_may() -> None:
    work = context()
    ways = [[panel_from_grip((0.0, 0.05, z), turn) for z in (0.06, 0.04, 0.02)] for turn in (0.0, np.pi / 2, np.pi)]
    index, path = work.choose(ways, near_rad=PARK, width_m=0.03, may_touch=("valve",))
    for q, pose in zip(path, ways[index], strict=True):
        reached = work.kinematics.tool(q, GRIP)
        assert np.allclose(reached.as_matrix(), (PANEL * pose).as_matrix(), atol=1e-6)
    model = work.collision(width_m=0.03, may_touch=("valve",), near_plate=True)
    assert all(model.is_clear(q, margin_m=0.0) for q in path)


def test_a_stroke_into_a_neighbour_is_unreachable_and_names_it() -> None:
    work = context()
    ways = [[panel_from_grip((0.1, 0.0, z), turn) for z in (0.06, 0.005)] for turn in (0.0, np.pi / 2)]
    with pytest.raises(Unreachable, match="fader"):
        work.choose(ways, near_rad=PARK, width_m=0.0, may_touch=())


def test_a_panel_out_of_reach_is_unreachable() -> None:
    work = context(transform_rpy((2.0, 0.0, 0.6), (np.pi / 2, 0.0, -np.pi / 2)))
    ways = [[panel_from_grip((0.0, 0.0, 0.05), 0.0)]]
    with pytest.raises(Unreachable):
        work.choose(ways, near_rad=PARK, width_m=0.0, may_touch=())


def test_a_leaning_hand_keeps_its_tips_and_comes_along_its_fingers() -> None:
    stroke = [panel_from_grip((0.1, y, z), 0.4) for y, z in ((0.02, 0.06), (0.02, 0.02), (0.05, 0.02))]
    strokes = leaning([stroke], (0, 1))
    leans_deg = [float(np.degrees(np.arccos(-one[1].rotation.as_matrix()[2, 2]))) for one in strokes]
    assert np.allclose(sorted(leans_deg), [10.0] * 4 + [20.0] * 4)
    for one in strokes:
        assert np.allclose([pose.translation for pose in one[1:]], [pose.translation for pose in stroke[1:]])
        assert np.allclose(
            (one[0].inv() * one[1]).as_matrix(), RigidTransform.from_translation([0, 0, 0.04]).as_matrix()
        )
        assert np.allclose((one[1].inv() * one[2]).rotation.as_matrix(), np.eye(3))


def test_a_wider_hand_has_its_fingers_further_apart_and_the_same_body() -> None:
    hand = Hand()
    narrow = {capsule.name: capsule for capsule in hand.capsules(GRIP, 0.0)}
    wide = {capsule.name: capsule for capsule in hand.capsules(GRIP, 0.06)}
    assert wide["finger_right"].start_m[0] - narrow["finger_right"].start_m[0] == pytest.approx(0.03)
    assert wide["finger_left"].start_m[0] == pytest.approx(-wide["finger_right"].start_m[0])
    assert wide["body_left"] == narrow["body_left"]
    for capsule in narrow.values():
        if capsule.name.startswith("finger"):
            # The round end of the capsule reaches the tip and not further.
            assert capsule.end_m[2] + capsule.radius_m == pytest.approx(GRIP.translation[2])


def sweep_near_the_limit(to_limit_rad: float) -> Sweep:
    """Plan a sweep with a scanner that the fifth joint nods, this far from the upper limit of that joint."""
    upper_rad = (*T3.upper_rad[:4], PARK[4] + to_limit_rad, T3.upper_rad[5])
    near_limit = replace(context(), kinematics=Kinematics.of(replace(T3, upper_rad=upper_rad)))
    mount = transform_rpy((0.0, 0.0, 0.1), (0.0, 0.0, np.pi / 2))
    return plan_sweep(near_limit, mount, rate_rad_per_s=0.3, start_rad=PARK, width_m=0.0)


@pytest.mark.parametrize(("to_limit_rad", "expected_rad"), [(1.0, 0.48), (0.3, 0.24), (0.2, 0.16)])
def test_a_sweep_turns_as_far_to_each_side_as_the_joint_limits_allow(to_limit_rad: float, expected_rad: float) -> None:
    sweep = sweep_near_the_limit(to_limit_rad)
    assert (sweep.up_rad, sweep.down_rad) == (0.48, expected_rad)
    turned = sweep.across.base_from_tool[0].rotation.inv() * sweep.across.base_from_tool[-1].rotation
    assert turned.magnitude() == pytest.approx(0.48 + expected_rad)


def test_a_sweep_that_would_be_too_small_is_refused() -> None:
    with pytest.raises(Unreachable, match=r"by 0\.48 and 0\.00 rad"):
        sweep_near_the_limit(0.02)
