"""Tests of the arm models: kinematics against EAIK and the engine, reach, and URDF text that the engine can parse."""

from __future__ import annotations

import numpy as np
import pybullet
import pytest
from eaik.IK_DH import DhRobot
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from hal.config import load_cell
from simbackend.arm_model import MODELS, ArmModel, arm_urdf, base_from_flange
from tests.simbackend.rig import ROOT

NAMES = sorted(MODELS)
SOLVED = 6  # joints of a chain that EAIK takes
GRIP = RigidTransform.from_translation([0.0, 0.0, 0.21])


def urdf_of(model: ArmModel) -> str:
    return arm_urdf(model, flange_from_sensor=RigidTransform.identity(), flange_from_grip=GRIP, load_kg=0.9)


def solver(model: ArmModel) -> DhRobot:
    links = model.capabilities.links[:SOLVED]
    columns = ([getattr(link, key) for link in links] for key in ("alpha_rad", "a_m", "d_m"))
    return DhRobot(*(np.array(column) for column in columns))


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=40, deadline=None)
@given(given_rad=st.lists(st.floats(-3.0, 3.0), min_size=SOLVED, max_size=SOLVED))
def test_forward_kinematics_agree_with_eaik(name: str, given_rad: list[float]) -> None:
    model = MODELS[name]()
    q = given_rad[:SOLVED]
    ours = np.asarray(base_from_flange(model.capabilities.links[:SOLVED], np.array(q)).as_matrix())
    np.testing.assert_allclose(ours, solver(model).fwdKin(np.array(q)), atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_the_engine_puts_the_flange_where_the_table_says(name: str, tmp_path: object) -> None:
    model = MODELS[name]()
    path = tmp_path / "arm.urdf"
    path.write_text(urdf_of(model), encoding="ascii")
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(str(path), useFixedBase=True, physicsClientId=client)
        q = np.random.default_rng(3).uniform(-1.5, 1.5, len(model.capabilities.links))
        for i, angle in enumerate(q):
            pybullet.resetJointState(body, i, angle, physicsClientId=client)
        state = pybullet.getLinkState(body, len(q), computeForwardKinematics=1, physicsClientId=client)
    finally:
        pybullet.disconnect(client)
    expected = base_from_flange(model.capabilities.links, q)
    np.testing.assert_allclose(state[4], expected.translation, atol=1e-6)
    turn = np.reshape(pybullet.getMatrixFromQuaternion(state[5]), (3, 3))
    np.testing.assert_allclose(turn, expected.rotation.as_matrix(), atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_no_line_of_the_urdf_is_too_long_for_the_parser(name: str) -> None:
    assert max(len(line) for line in urdf_of(MODELS[name]()).splitlines()) < 1000


def test_the_t3_reaches_1_04_m_from_shoulder_to_flange() -> None:
    links = MODELS["t3"]().capabilities.links
    stretched = base_from_flange(links, np.array([0.3, 0.2, np.pi / 2, 0.0, 0.0, 0.0]))
    shoulder_m = np.array([0.0, 0.0, links[0].d_m])
    assert np.linalg.norm(stretched.translation - shoulder_m) == pytest.approx(1.04, abs=0.002)


@pytest.mark.parametrize("cell_name", ["bench", "ur10e"])
def test_every_object_is_reached_squarely_and_off_the_wrist_singularity(cell_name: str) -> None:
    """At the plate and 0.4 m in front, with the panel off by 60 mm and 8 degrees, a solution has sin q5 > 0.3."""
    from simbackend.draws import Draws

    cell = load_cell(ROOT / "cells" / f"{cell_name}.toml")
    model = MODELS[cell.file.devices["arm"].options["model"]]()
    eaik = solver(model)
    low, high = np.array(model.capabilities.lower_rad), np.array(model.capabilities.upper_rad)
    facing = RigidTransform.from_matrix(np.diag([1.0, -1.0, -1.0, 1.0]))
    for seed in range(12):
        base_from_panel = Draws(seed).panel_pose(cell.file.workspace, cell.file.simulation)
        for panel_object in cell.panel.objects:
            for distance_m in (0.0, 0.4):
                panel_from_grip = RigidTransform.from_translation([*panel_object.position_m, distance_m]) * facing
                flange = np.asarray((base_from_panel * panel_from_grip * GRIP.inv()).as_matrix())
                found = eaik.IK(flange)
                wrists = [
                    abs(np.sin(q[4]))
                    for q, is_approximate in zip(found.Q, found.is_LS, strict=True)
                    if not is_approximate and np.all((q > low) & (q < high))
                ]
                assert max(wrists, default=0.0) > 0.3, (seed, panel_object.name, distance_m)
