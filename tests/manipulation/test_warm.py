"""The compiled loops are ready before a user waits for them, and each is compiled only once."""

from __future__ import annotations

import sys

import numpy as np
from numba.core.dispatcher import Dispatcher

from hal.geometry import identity, perturbed
from hal.motion import CartesianPath, Compliance, Guard, Quantity
from manipulation.arm.kinematics import Kinematics
from manipulation.planning.cartesian_path import line
from manipulation.planning.collision import CollisionModel
from manipulation.planning.hand import Hand
from manipulation.planning.shapes import floor_box
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.planning.transfer import TransferPlanner
from manipulation.warm import warm_up
from tests.manipulation.arms import T3
from tests.manipulation.rig import GRIP, HOME, make_rig, tool_pose


def signatures() -> dict[str, int]:
    """Return how often each compiled loop of the package was compiled or loaded, by name."""
    modules = [module for name, module in sys.modules.items() if name.startswith("manipulation.")]
    loops = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return {f"{loop.py_func.__module__}.{loop.py_func.__name__}": len(loop.signatures) for loop in loops}


def a_pressed_path() -> CartesianPath:
    """Return a compliant move of the tips with a guard of each quantity that a compiled loop computes."""
    start = tool_pose(HOME)
    guards = (
        Guard(name="turn", quantity=Quantity.ROTATION, limit=3.0),
        Guard(name="push", quantity=Quantity.FORCE, limit=90.0),
    )
    soft = Compliance(stiffness=(4e3,) * 6, damping=(500.0,) * 6, mass=(20.0,) * 6)
    end = perturbed(start, np.array([0.01, 0.0, 0.0, 0.0, 0.05, 0.0]))
    return line(start, end, name="press", speed_m_per_s=0.05, flange_from_tool=GRIP, guards=guards, compliance=soft)


def test_every_loop_has_one_signature_and_no_motion_waits_for_a_compiler() -> None:
    warm_up()
    warm = signatures()
    assert len(warm) > 10
    planner = TransferPlanner(
        model=CollisionModel.build(Kinematics.of(T3), Hand().capsules(GRIP, 0.02), (floor_box(0.0),)),
        flange_from_tool=identity(),
        limits=SpeedLimits(tip_m_per_s=0.25),
    )
    planner.plan(HOME, HOME + 0.1)
    planner.model.nearest(HOME)
    rig = make_rig()
    rig.controller.tare()
    rig.controller.execute(planner.plan(HOME, HOME))
    rig.controller.execute(a_pressed_path())
    rig.controller.state()
    rig.controller.close()
    assert signatures() == warm
    assert set(warm.values()) == {1}
