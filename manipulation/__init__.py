"""Manipulation (paper V): collision-free motion, a guarded skill for each kind of control, and the control loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from manipulation import plausibility
    from manipulation.arm.kinematics import Kinematics
    from manipulation.control.controller import Controller
    from manipulation.control.sensing import MotionDevices
    from manipulation.control.way_back import Trail
    from manipulation.planning.hand import Hand
    from manipulation.planning.shapes import CollisionBox
    from manipulation.planning.time_parameterization import SpeedLimits
    from manipulation.planning.touch_points import touch_points
    from manipulation.planning.visiting_order import visiting_order
    from manipulation.skills.context import SkillContext, is_in_reach
    from manipulation.skills.operate import operate
    from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify
    from manipulation.skills.probe import proximity_probe, touch_probe
    from manipulation.skills.rehearsal import out_of_reach_m, rehearse
    from manipulation.skills.retreat import free_hand, park, step_back
    from manipulation.skills.sweep import plan_sweep
    from manipulation.skills.travel import back_out_of, plan_to_first, plan_to_joints, reachable, stands_clear
    from manipulation.warm import warm_up

__all__ = [
    "CollisionBox",
    "Controller",
    "Hand",
    "Kinematics",
    "MotionDevices",
    "ObjectState",
    "Outcome",
    "SkillContext",
    "SkillFailure",
    "SkillReport",
    "SpeedLimits",
    "Trail",
    "Verify",
    "back_out_of",
    "free_hand",
    "is_in_reach",
    "operate",
    "out_of_reach_m",
    "park",
    "plan_sweep",
    "plan_to_first",
    "plan_to_joints",
    "plausibility",
    "proximity_probe",
    "reachable",
    "rehearse",
    "stands_clear",
    "step_back",
    "touch_points",
    "touch_probe",
    "visiting_order",
    "warm_up",
]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
