"""The tip stays inside the boxes of the cell file, and the joints inside its limits, whatever a motion asks for."""

from __future__ import annotations

import numpy as np
import pytest

from hal.config import BoxSection, SafetySection
from hal.errors import ConfigError
from hal.geometry import perturbed
from hal.motion import CartesianPath, MotionOutcome
from manipulation.arm.kinematics import Kinematics
from manipulation.control.sensing import DeviceFailure
from manipulation.control.setpoint import SetPointLimiter, flange_matrix
from tests.manipulation.arms import T3
from tests.manipulation.rig import GRIP, HOME, make_rig, tool_pose

ARM = Kinematics.of(T3)
DT_S = 0.002
TIP_M = np.asarray(tool_pose(HOME).translation)
CURVE_M = 1e-3  # joints that brake move the tip on a curve, not on the line to its place of rest


def box(half_m: float, *, shift_m: float = 0.0) -> BoxSection:
    """Return a cube around the tip of the home position, shifted along x."""
    middle = TIP_M + np.array([shift_m, 0.0, 0.0])
    return BoxSection(lower_m=tuple(middle - half_m), upper_m=tuple(middle + half_m))


def outside_m(filter_: SetPointLimiter, one: BoxSection) -> float:
    tip_m = np.asarray(ARM.tool(filter_.last_rad, GRIP).translation)
    way = np.maximum(np.maximum(np.array(one.lower_m) - tip_m, tip_m - np.array(one.upper_m)), 0.0)
    return float(np.linalg.norm(way))


@pytest.mark.parametrize("seed", range(20))
def test_no_set_points_lead_the_tip_out_of_the_box_not_even_while_it_brakes(seed: int) -> None:
    rng, one = np.random.default_rng(seed), box(0.05)
    made = SetPointLimiter(ARM, flange_matrix(GRIP), 1.0, DT_S, (one,))
    made.begin_at(HOME)
    wanted = HOME + rng.choice([-1.0, 1.0], 6) * rng.uniform(0.3, 1.0, 6)
    with pytest.raises(DeviceFailure, match="leave the workspace"):
        for _ in range(2000):
            made.sent(made.apply(wanted))
            assert outside_m(made, one) < CURVE_M
    moved = float(np.abs(made.last_rad - HOME).max())
    assert moved > 1e-3, "it moves as far as it may"
    while not made.is_at_rest:
        made.sent(made.brake())
        assert outside_m(made, one) < CURVE_M


def test_an_arm_that_stands_outside_may_only_come_nearer() -> None:
    one = box(0.05, shift_m=-0.2)
    made = SetPointLimiter(ARM, flange_matrix(GRIP), 0.25, DT_S, (one,))
    made.begin_at(HOME)
    before_m = outside_m(made, one)
    away, nearer = HOME.copy(), HOME.copy()
    grid = np.linspace(-0.3, 0.3, 7)
    reach = [np.linalg.norm(np.asarray(ARM.tool(HOME + np.eye(6)[1] * d, GRIP).translation) - TIP_M) for d in grid]
    assert max(reach) > 0.05
    signs = [np.asarray(ARM.tool(HOME + np.eye(6)[1] * d, GRIP).translation)[0] for d in (-0.1, 0.1)]
    nearer[1] += 0.1 if signs[1] < signs[0] else -0.1
    away[1] -= nearer[1] - HOME[1]
    for _ in range(100):
        made.sent(made.apply(nearer))
    assert outside_m(made, one) < before_m
    made.begin_at(HOME)
    with pytest.raises(DeviceFailure, match="leave the workspace"):
        for _ in range(100):
            made.sent(made.apply(away))


def test_a_motion_that_would_leave_the_box_ends_with_the_reason_inside_of_it() -> None:
    rig = make_rig(safety=SafetySection(workspace=(box(0.02),)))
    try:
        goal = perturbed(tool_pose(HOME), np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]))
        path = CartesianPath(
            name="out", flange_from_tool=GRIP, times_s=np.array([0.0, 1.0]), base_from_tool=(tool_pose(HOME), goal)
        )
        report = rig.controller.execute(path)
        assert (report.outcome, "leave the workspace" in report.cause) == (MotionOutcome.FAULT, True)
        moved_m = np.asarray(report.base_from_tool.translation) - TIP_M
        assert 0.01 < np.abs(moved_m).max() < 0.02 + CURVE_M
    finally:
        rig.controller.close()


def test_joint_limits_of_the_cell_file_narrow_the_arms_range_and_must_fit_it() -> None:
    narrow = [(-0.5, 0.5)] * 6
    arm = Kinematics.of(T3, narrow)
    assert (arm.lower_rad.max(), arm.upper_rad.min()) == (-0.5, 0.5)
    made = SetPointLimiter(arm, flange_matrix(GRIP), 1.0, DT_S)
    made.begin_at(np.zeros(6))
    for _ in range(1500):
        made.sent(made.apply(np.full(6, 2.0)))
    assert made.last_rad.max() <= 0.5
    for wrong in (narrow[:5], [(0.5, -0.5)] * 6, [(100.0, 101.0)] * 6):
        with pytest.raises(ConfigError, match="joint_limits_rad"):
            Kinematics.of(T3, wrong)
