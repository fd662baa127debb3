"""Tests of the model of what the cell has found out so far."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from hal.config import load_cell
from hal.geometry import UncertainPose
from manipulation.plausibility import FrameDigest
from perception.vision import ObjectReading
from service.world_model import Facts, WorldModel, expected_panel

POSE = UncertainPose(parent_from_child=RigidTransform.from_translation([0.7, 0.0, 0.4]), covariance=1e-6 * np.eye(6))
CELL = load_cell(Path(__file__).parents[2] / "cells" / "bench.toml")


def reading(name: str, *, state: str | None) -> ObjectReading:
    return ObjectReading(
        name=name,
        kind="lamp",
        present=True,
        centre_px=np.zeros(2),
        outline_px=np.zeros((0, 2)),
        state=state,
        reason=None if state else "too dark",
    )


def test_a_refused_reading_leaves_the_answer_of_before() -> None:
    world = WorldModel()
    world.note_readings([reading("a", state="on"), reading("b", state=None)])
    world.note_readings([reading("a", state=None)])
    assert {name: r.state for name, r in world.readings.items()} == {"a": "on"}
    world.forget_reading("a")
    assert not world.readings


def test_what_a_reader_holds_does_not_change_under_it() -> None:
    world = WorldModel()
    world.note_readings([reading("a", state="on")])
    held: Any = world.readings
    world.note_readings([reading("b", state="off")])
    assert set(held) == {"a"}
    with pytest.raises(TypeError):
        held["a"] = reading("a", state="off")


def test_readings_that_come_from_many_threads_at_once_are_all_kept() -> None:
    world, names = WorldModel(), [f"lamp_{k}" for k in range(200)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda name: world.note_readings([reading(name, state="on")]), names))
    assert set(world.readings) == set(names)


def test_a_frame_is_kept_for_each_sensor_and_the_one_before_is_returned() -> None:
    world = WorldModel()
    first, second = FrameDigest(stamp_s=1.0, digest=b"1"), FrameDigest(stamp_s=2.0, digest=b"2")
    assert world.note_frame("camera", first) is None
    assert world.note_frame("scanner", first) is None
    assert world.note_frame("camera", second) is first


def test_kinematics_are_made_once_and_everything_is_forgotten_together() -> None:
    world, made = WorldModel(), []

    def make() -> Any:
        made.append(object())
        return made[-1]

    assert world.kinematics(make) is world.kinematics(make) and len(made) == 1
    world.believe_panel(POSE)
    assert world.base_from_panel is POSE
    world.forget_panel()
    assert world.base_from_panel is None and world.kinematics(make) is made[0]
    world.note_readings([reading("a", state="on")])
    world.forget()
    assert not world.readings and world.base_from_panel is None
    world.kinematics(make)
    assert len(made) == 2
    assert Facts().readings == {}


def test_the_tolerances_of_the_cell_file_are_three_sigma() -> None:
    expected = expected_panel(CELL)
    workspace = CELL.file.workspace
    assert np.allclose(expected.parent_from_child.translation, workspace.panel_position_m)
    sigma = np.sqrt(np.diag(expected.covariance))
    assert np.allclose(3.0 * sigma, [workspace.position_tolerance_m] * 3 + [workspace.angle_tolerance_rad] * 3)


def test_whole_turns_of_a_wheel_are_kept_when_everything_else_is_forgotten() -> None:
    world = WorldModel()
    world.note_turned("bypass", -6.0)
    world.note_readings([reading("a", state="on")])
    world.forget()
    assert (dict(world.turned_rad), dict(world.readings)) == ({"bypass": -6.0}, {})
