"""A pose to a deed: collision-free motion, a guarded skill for each kind of control, and the control loop (paper V)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from manipulation import plausibility
    from manipulation.arm.kinematics import Kinematics
    from manipulation.control.controller import Controller
    from manipulation.planning.collision import CollisionModel
    from manipulation.planning.shapes import CollisionBox
    from manipulation.planning.time_parameterization import SpeedLimits
    from manipulation.planning.touch_points import touch_points
    from manipulation.planning.transfer import QUICK, THOROUGH, Effort
    from manipulation.planning.visiting_order import visiting_order
    from manipulation.skills.attempt import Attempt
    from manipulation.skills.context import SkillContext, is_in_reach
    from manipulation.skills.operate import operate
    from manipulation.skills.outcome import ObjectState, SkillFailure, SkillReport, Verify
    from manipulation.skills.probe import proximity_probe, touch_probe
    from manipulation.skills.retreat import park, retreat
    from manipulation.skills.sweep import plan_sweep
    from manipulation.warm import warm_up

__all__ = [
    "QUICK",
    "THOROUGH",
    "Attempt",
    "CollisionBox",
    "CollisionModel",
    "Controller",
    "Effort",
    "Kinematics",
    "ObjectState",
    "SkillContext",
    "SkillFailure",
    "SkillReport",
    "SpeedLimits",
    "Verify",
    "is_in_reach",
    "operate",
    "park",
    "plan_sweep",
    "plausibility",
    "proximity_probe",
    "retreat",
    "touch_points",
    "touch_probe",
    "visiting_order",
    "warm_up",
]
__getattr__ = load_on_first_use(__name__, __file__)
