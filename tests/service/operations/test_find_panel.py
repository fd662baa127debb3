"""Tests of choosing a way to find the panel, of checking it by the next one, and of a cell without lights."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.behind_cables import open_session
from benchmarks.panel_ways import with_tags
from hal.config import Cell, load_cell
from hal.errors import InvalidRequest, NotFound
from hal.geometry import difference
from perception.vision import PanelWay
from service.operations.find_panel import locate, reference_in_view, reference_points_m, ways_of
from service.operations.locate import go_to_overview, run_panel_pose
from service.operations.session import OperationContext, Session
from service.processes.cell import CellRuntime
from service.processes.connection import LocalConnection
from service.schema.requests import PanelPoseRequest
from service.tasks.model import Task
from service.tasks.store import TaskContext
from service.world_model import WorldModel

ROOT = Path(__file__).parents[3]


class WithCell:
    """A started cell with other files."""

    def __init__(self, started: Any, cell: Cell) -> None:
        self._started, self.cell = started, cell

    def __getattr__(self, name: str) -> Any:
        return getattr(self._started, name)


def cell_without_lights() -> Cell:
    cell = load_cell(ROOT / "cells/bench.toml", seed=31)
    devices = {name: section for name, section in cell.file.devices.items() if name != "panel_lights"}
    file = cell.file.model_copy(update={"devices": devices})
    return cell.model_copy(update={"panel": with_tags(cell.panel), "file": file})


def test_a_panel_that_is_partly_outside_of_the_image_is_looked_at_from_farther_away(tmp_path: Path) -> None:
    cell = load_cell(ROOT / "cells/bench.toml", seed=14)  # 0.1 m to the side, nearer, and turned by 15 degrees
    simulation = cell.file.simulation.model_copy(update={"panel_spread_m": 0.1, "panel_spread_rad": 0.2618})
    cell = cell.model_copy(update={"file": cell.file.model_copy(update={"simulation": simulation})})
    with open_session(cell, tmp_path) as session:
        truth = RigidTransform.from_matrix(session.context.connection.device("arm").truth().base_from_panel_matrix)
        assert np.linalg.norm(difference(truth, session.known_panel().parent_from_child)[:3]) < 0.01
        session.world.forget()
        go_to_overview(session)
        with pytest.raises(NotFound, match="light 2 is not seen"):
            locate(session)


@pytest.fixture(scope="module")
def context(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OperationContext]:
    folder, cell = tmp_path_factory.mktemp("panel"), cell_without_lights()
    runtime = CellRuntime.start(cell, is_latched=lambda: False)
    try:
        connection = LocalConnection(cell, runtime.objects, close=runtime.close)
        task = TaskContext(Task(id="test", verb="panel-pose", request={}, moves=True), folder)
        made = OperationContext(connection=connection, task=task, runs_dir=folder, world=WorldModel())
        go_to_overview(Session(context=made))
        yield made
    finally:
        runtime.close()


def test_without_lights_the_panel_is_found_by_its_tags_and_checked_by_its_outline(context: OperationContext) -> None:
    session = Session(context=context)
    assert ways_of(session) == (PanelWay.TAGS, PanelWay.OUTLINE, PanelWay.LOOKS)
    answer = run_panel_pose(session, PanelPoseRequest(move=False))
    assert answer.way == "tags" and len(answer.points_px) == 16
    (check,) = answer.checks
    assert check.way == "outline" and not check.contradicts
    assert check.finding.startswith("tags and outline agree within")


def test_a_way_can_be_asked_for(context: OperationContext) -> None:
    session = Session(context=context)
    by_outline, by_looks = (locate(session, way) for way in (PanelWay.OUTLINE, PanelWay.LOOKS))
    assert by_outline.seen.way is PanelWay.OUTLINE and by_looks.seen.way is PanelWay.LOOKS
    apart = difference(by_outline.base_from_panel.parent_from_child, by_looks.base_from_panel.parent_from_child)
    assert np.linalg.norm(apart[:3]) < 0.01
    with pytest.raises(InvalidRequest, match="cannot be found by its lights") as refused:
        locate(session, PanelWay.LIGHTS)
    assert "tags, outline, looks" in refused.value.hint


def test_tags_that_the_file_has_elsewhere_contradict_the_outline(context: OperationContext) -> None:
    cell = context.connection.cell
    tags = tuple(
        tag.model_copy(update={"position_m": (tag.position_m[0] + 0.008, *tag.position_m[1:])})
        for tag in cell.panel.tags
    )
    wrong = cell.model_copy(update={"panel": cell.panel.model_copy(update={"tags": tags})})
    connection = WithCell(context.connection, wrong)
    task = Task(id="wrong", verb="panel-pose", request={}, moves=True)
    found = locate(
        Session(
            context=OperationContext(
                connection=connection, task=TaskContext(task, context.runs_dir), runs_dir=context.runs_dir
            )
        )
    )
    assert found.seen.way is PanelWay.TAGS
    (contradiction,) = found.contradictions
    assert "tags and outline put the panel" in contradiction and "measure it again" in contradiction
    assert task.step == "two ways of finding the panel disagree"


def test_a_camera_is_calibrated_by_the_corners_of_all_tags(context: OperationContext) -> None:
    session = Session(context=context)
    points_px, covariance_px = reference_in_view(session)
    assert points_px.shape == (16, 2) and covariance_px.shape == (16, 2, 2)
    cell = context.connection.cell
    absent = cell.panel.tags[0].model_copy(update={"id": 40, "position_m": (0.0, 0.197, 0.0)})
    more = cell.panel.model_copy(update={"tags": (*cell.panel.tags, absent)})
    none = cell.panel.model_copy(update={"tags": ()})
    for panel, problem in ((more, NotFound), (none, InvalidRequest)):
        started = WithCell(context.connection, cell.model_copy(update={"panel": panel}))
        other = OperationContext(connection=started, task=context.task, runs_dir=context.runs_dir)
        with pytest.raises(problem):
            _ = (
                reference_in_view(Session(context=other))
                if problem is NotFound
                else reference_points_m(Session(context=other))
            )
