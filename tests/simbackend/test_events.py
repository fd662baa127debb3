"""Tests of what happens in the simulated world while it runs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import RigidTransform, Rotation

from hal.simulated_events import EventSection
from tests.simbackend.rig import SimCell, sim_cell


def cell_with(*events: dict[str, Any]) -> Iterator[SimCell]:
    sections = tuple(EventSection.model_validate(event) for event in events)
    with sim_cell(events=sections) as cell:
        yield cell


def pose(arm: Any) -> RigidTransform:
    return RigidTransform.from_matrix(arm.truth().base_from_panel_matrix)


def test_a_panel_moves_by_what_the_cell_file_says_and_its_picture_with_it() -> None:
    for cell in cell_with({"kind": "panel-moves", "at_s": 0.1, "shift_m": (0.03, 0.0, 0.0), "duration_s": 0.1}):
        arm, camera = cell.connect("arm"), cell.connect("wrist_camera")
        before, seen = pose(arm), camera.read_image(deadline=cell.deadline(1.0)).value.pixels.astype(float)
        cell.clock.sleep(0.15)
        half = pose(arm)
        cell.clock.sleep(0.15)
        moved = before.inv() * pose(arm)
        np.testing.assert_allclose(moved.translation, [0.03, 0.0, 0.0], atol=1e-12)
        assert 0.005 < (before.inv() * half).translation[0] < 0.025
        after = camera.read_image(deadline=cell.deadline(1.0)).value.pixels.astype(float)
        assert np.abs(after - seen).mean() > 1.0


def test_a_door_swings_about_its_edge() -> None:
    edge = (-0.3, 0.0, 0.0)
    for cell in cell_with({"kind": "panel-moves", "turn_rad": (0.0, 0.1, 0.0), "about_m": edge, "duration_s": 0.0}):
        arm = cell.connect("arm")
        begun = cell.shared.peek("world").draws.panel_pose(cell.cell.file.workspace, cell.cell.file.simulation)
        cell.clock.sleep(0.05)
        np.testing.assert_allclose(pose(arm).apply(edge), begun.apply(edge), atol=1e-12)
        turn = (begun.rotation.inv() * pose(arm).rotation).as_rotvec()
        np.testing.assert_allclose(turn, Rotation.from_rotvec([0.0, 0.1, 0.0]).as_rotvec(), atol=1e-12)


def test_an_event_waits_until_the_tips_are_near_its_object() -> None:
    event = {"kind": "panel-moves", "shift_m": (0.0, 0.01, 0.0), "near": "start", "duration_s": 0.0}
    for cell in cell_with({**event, "near_m": 0.05}):
        arm = cell.connect("arm")
        before = pose(arm)
        cell.clock.sleep(0.2)
        np.testing.assert_array_equal(pose(arm).as_matrix(), before.as_matrix())
    for cell in cell_with({**event, "near_m": 1.0}):
        arm = cell.connect("arm")
        before = pose(arm)
        cell.clock.sleep(0.2)
        assert np.linalg.norm(pose(arm).translation - before.translation) == pytest.approx(0.01)


def test_a_lamp_that_is_out_is_dark() -> None:
    for cell in cell_with({"kind": "lamp-out", "object": "run_lamp"}):
        arm = cell.connect("arm")
        cell.clock.sleep(0.02)
        assert next(one.state for one in arm.truth().objects if one.name == "run_lamp") == "off"


def test_an_event_must_name_its_object() -> None:
    with pytest.raises(ValidationError, match="`object` is needed"):
        EventSection.model_validate({"kind": "blocked"})
