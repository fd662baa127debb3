"""Tests of the compliance of the simulated fingers: the force that the engine answers a push with, and the forces on the pads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.config import load_cell
from simbackend.pads import PAD_STIFFNESS_N_PER_M, ROOT_STIFFNESS_N_PER_M, Pads, Roots
from simbackend.urdf import at, box, inertial, joint, link, shape, sphere
from simbackend.wire import WorldConfig
from simbackend.world import World, _quiet_pybullet
from tests.simbackend.rig import BENCH

GREY = (0.5, 0.5, 0.5)
DT_S = 0.002
SHAPES = {
    "one point of a ball": (sphere(0.005), 0.005, 1),
    "face of a bar": (box((0.1, 0.1, 0.01)), 0.005, 4),
}


def finger_urdf() -> str:
    """Return a finger that hangs on a driven slide along z and a yielding root along z."""
    no_mass = inertial(0.0, (0, 0, 0), (0.0, 0.0, 0.0))
    lines = ['<robot name="hand">', *link("base", no_mass)]
    lines += link("carriage", inertial(0.002, (0, 0, 0), (1e-6,) * 3))
    lines += joint("drive", "prismatic", "base", "carriage", at(0, 0, 0))
    solid = shape(at(0, 0, 0.0375), box((0.007, 0.012, 0.075)), GREY)
    lines += link("finger", inertial(0.034, (0, 0, 0.0375), (2e-5,) * 3), solid)
    lines += joint("root", "prismatic", "carriage", "finger", at(0, 0, 0))
    return "\n".join([*lines, "</robot>"])


def pressed_n(engine: Any, folder: Path, geometry: str, half_m: float, way_m: float) -> float:
    """Return the force with which the finger presses on a fixed body after its slide has gone `way_m` past the contact."""
    engine.resetSimulation()
    engine.setPhysicsEngineParameter(fixedTimeStep=DT_S, deterministicOverlappingPairs=1, enableFileCaching=0)
    body = [
        '<robot name="body">',
        *link("base", inertial(0.0, (0, 0, 0), (0.0, 0.0, 0.0)), shape(at(0, 0, 0.080), geometry, GREY)),
        "</robot>",
    ]
    (folder / "hand.urdf").write_text(finger_urdf(), encoding="ascii")
    (folder / "body.urdf").write_text("\n".join(body), encoding="ascii")
    hand = engine.loadURDF(str(folder / "hand.urdf"), useFixedBase=True, flags=engine.URDF_USE_INERTIA_FROM_FILE)
    engine.loadURDF(str(folder / "body.urdf"), useFixedBase=True)
    pads, roots = Pads(engine, hand, [1], friction=0.5), Roots(engine, hand, [[1]], dt_s=DT_S)
    begins_m, force_n = 0.080 - half_m - 0.075, 0.0
    for tick in range(1500):
        goal_m = begins_m + way_m * min(1.0, tick / 800)
        engine.setJointMotorControl2(hand, 0, engine.POSITION_CONTROL, targetPosition=goal_m, force=5000.0)
        x, v = engine.getJointState(hand, 1)[:2]
        engine.setJointMotorControl2(hand, 1, engine.TORQUE_CONTROL, force=roots.force_n(x, v))
        engine.stepSimulation()
        pads.note(engine.getContactPoints(bodyA=hand))
        force_n = pads.force_n[0]
    return force_n


@pytest.mark.parametrize("name", SHAPES)
def test_a_finger_is_as_stiff_as_its_pad_and_its_root_in_series(name: str, tmp_path: Path) -> None:
    engine = _quiet_pybullet()
    engine.connect(engine.DIRECT)
    try:
        geometry, half_m, points = SHAPES[name]
        force_n = pressed_n(engine, tmp_path, geometry, half_m, 0.004)
    finally:
        engine.disconnect()
    series = 1.0 / (1.0 / (points * PAD_STIFFNESS_N_PER_M) + 1.0 / ROOT_STIFFNESS_N_PER_M)
    assert force_n == pytest.approx(0.004 * series, rel=0.1)


class Engine:
    """Notes with which force joints are held."""

    VELOCITY_CONTROL = 0

    def __init__(self) -> None:
        self.holding_n: list[float] = []

    def changeDynamics(self, _arm: int, _link: int, **values: float) -> None:  # noqa: N802 - the engine's name
        assert min(values.values()) > 0.0

    def setJointMotorControl2(self, _arm: int, _joint: int, _mode: int, *, force: float) -> None:  # noqa: N802
        self.holding_n.append(force)


def contact(link_number: int, force_n: float) -> tuple[Any, ...]:
    return (0, 0, 1, link_number, *(None,) * 5, force_n)


def test_the_force_on_a_pad_is_that_of_all_its_contact_points() -> None:
    pads = Pads(Engine(), 0, [7, 9], friction=0.5)
    pads.note([contact(7, 3.0), contact(7, 4.0), contact(9, 1.0), contact(2, 50.0)])
    assert pads.force_n == (7.0, 1.0)
    pads.note([])
    assert pads.force_n == (0.0, 0.0)


def test_roots_are_rigid_in_ticks_that_are_too_long_for_their_springs() -> None:
    engine = Engine()
    assert Roots(engine, 0, [[1, 2]], dt_s=0.002).force_n(0.001, 0.0) < 0.0
    assert Roots(engine, 0, [[1, 2]], dt_s=0.01).force_n(0.001, 0.0) == 0.0
    assert engine.holding_n[:2] == [0.0, 0.0]
    assert min(engine.holding_n[2:]) > 100.0


def test_the_wrist_shows_a_force_on_a_finger_in_full_along_each_axis() -> None:
    world = World(WorldConfig(cell=load_cell(BENCH, seed=11), model="t3", proximity=(), proximity_range_m=0.3))
    engine = world.engine
    try:
        finger = next(
            i for i in range(engine.getNumJoints(world.arm)) if engine.getJointInfo(world.arm, i)[12] == b"finger_left"
        )
        for _ in range(100):
            world._advance()
        unloaded = np.array(world.reaction)
        for force_n in 50.0 * np.eye(3):
            for _ in range(300):
                turn = np.array(engine.getMatrixFromQuaternion(engine.getLinkState(world.arm, world.sensor)[5]))
                at_m = engine.getLinkState(world.arm, finger)[0]
                pushed = (turn.reshape(3, 3) @ force_n).tolist()
                engine.applyExternalForce(world.arm, finger, pushed, at_m, engine.WORLD_FRAME)
                world._advance()
            assert (unloaded - world.reaction)[:3] == pytest.approx(force_n, abs=0.2)
            for _ in range(300):
                world._advance()
    finally:
        world.close()
