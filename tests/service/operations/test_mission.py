"""Tests of the mission on the simulated cell, inline: its actions, reproducibility, and no access to the truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hal.config import load_cell
from hal.errors import CellError, DeviceFault, InvalidRequest, NotFound
from hal.motion import DeclaredMotion, MotionReport
from hal.simulated import Fault, ObjectTruth, Truth
from hal.strict import validate
from service.errors import StepFailed
from service.evaluate import evaluate
from service.history.observer import Observations
from service.history.store import History
from service.missions.progress import load_progress
from service.operations.acquisition import look, settle
from service.operations.find_panel import locate
from service.operations.inspect import look_close
from service.operations.locate import go_to_overview, object_depths, rims_in, scan_plate
from service.operations.mission import run_mission
from service.operations.range_detection import (
    CLOSER,
    OVERVIEW,
    check_surfaces,
    need_its_place,
    scan_beside,
    view_surfaces,
)
from service.operations.session import OperationContext, Session
from service.operations.travel import go_to_joints
from service.processes.cell import CellRuntime
from service.processes.connection import LocalConnection
from service.schema.mission_file import MissionFile
from service.schema.mission_request import MissionRequest
from service.schema.requests import ActionBody
from service.tasks.model import Task
from service.tasks.store import TaskContext
from service.world_model import WorldModel

ROOT = Path(__file__).parents[3]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@contextmanager
def mission_context(folder: Path, seed: int, *, misplaced_m: float = 0.0) -> Iterator[OperationContext]:
    """Yield an inline cell with a task; the wheel is built `misplaced_m` from its place in the panel file."""
    cell = load_cell(ROOT / "cells/bench.toml", seed=seed)
    runtime = CellRuntime.start(cell, is_latched=lambda: False)
    if misplaced_m:
        wheel = cell.panel.object("bypass")
        moved = wheel.model_copy(update={"position_m": (wheel.position_m[0] - misplaced_m, wheel.position_m[1])})
        things = tuple(moved if panel_object is wheel else panel_object for panel_object in cell.panel.objects)
        cell = cell.model_copy(update={"panel": cell.panel.model_copy(update={"objects": things})})
    try:
        yield OperationContext(
            connection=LocalConnection(cell, runtime.objects, close=runtime.close),
            task=TaskContext(Task(id="test", verb="missions", request={}, moves=True), folder / "artefacts"),
            runs_dir=folder / "runs",
            world=WorldModel(),
            observer=Observations(history=History(folder / "history", cell="bench", panel="bench")).of_task(
                task="test", verb="missions", asked_by="alice", cell_now_s=runtime.clock.now_s
            ),
        )
    finally:
        runtime.close()


def report_of(folder: Path) -> dict[str, Any]:
    """Return the only report below a folder."""
    (path,) = folder.glob("runs/*/report.json")
    report: dict[str, Any] = json.loads(path.read_text())
    return report


def without_wall_time(report: dict[str, Any]) -> dict[str, Any]:
    """Return the reproducible part: everything except names and wall-clock times."""
    kept = {key: value for key, value in report.items() if key not in ("mission", "started", "wall_s", "judge")}
    return {**kept, "steps": [{**step, "wall_s": 0.0} for step in report["steps"]]}


def lie(truth: Truth) -> Truth:
    """Return a truth in which everything has another place and state."""
    matrix = truth.base_from_panel_matrix.copy()
    matrix[:3, 3] += (0.05, -0.04, 0.03)
    wrong = tuple(
        ObjectTruth(name=panel_object.name, value=-1.0, state="broken", text="8888") for panel_object in truth.objects
    )
    return replace(truth, base_from_panel_matrix=matrix, objects=wrong, initial=wrong)


def with_wheel(session: Session, **changes: object) -> Session:
    """The session with another description of the wheel in its panel file."""
    connection = copy(session.context.connection)
    objects = tuple(one.model_copy(update=changes) if one.name == "bypass" else one for one in session.panel.objects)
    panel = session.panel.model_copy(update={"objects": objects})
    connection.cell = session.cell.model_copy(update={"panel": panel})
    return Session(context=replace(session.context, connection=connection))


def stand_close(session: Session) -> None:
    """Drive to where an action ends, at the close-up of a control."""
    go_to_overview(session)
    locate(session)
    look_close(session, session.panel.object("setpoint").point_m, ("setpoint",))


def test_a_planted_wrong_truth_changes_nothing_but_the_judgement(tmp_path: Path) -> None:
    request = MissionRequest(actions=(ActionBody(object="setpoint", value=65.0),), touches=3)
    for name in ("honest", "planted"):
        with mission_context(tmp_path / name, seed=3) as context:
            arm = context.connection.device("arm")
            if name == "planted":
                true_truth = arm.truth
                arm.truth = lambda *at, ask=true_truth: lie(ask(*at))
            answer = run_mission(context, request)
            evaluate(context.connection, tmp_path / name / "runs" / answer.mission)
    honest, planted = report_of(tmp_path / "honest"), report_of(tmp_path / "planted")
    assert without_wall_time(honest) == without_wall_time(planted)
    assert honest["judge"]["agrees"] and honest["judge"]["pose_error_m"] < 0.005
    assert not planted["judge"]["agrees"] and planted["judge"]["pose_error_m"] > 0.02
    assert honest["succeeded"]
    assert "square view" not in {step["name"] for step in honest["steps"]}, "one view and the scan give the pose"
    assert honest["fused"]["touching"]["ended"] == "the pose is as good as wanted"
    assert not honest["fused"]["touching"]["touches"]
    checks = {check["name"]: check for check in honest["by_surfaces"]}
    assert set(checks) == {"bypass", "emergency"}
    assert all(c["found"] and c["agrees"] and c["off_m"] < 0.004 for c in checks.values())
    assert checks["emergency"]["shows"] == "released"
    depths = {depth["name"]: depth for depth in honest["depths"]}
    assert {"current", "temperature", "run_lamp", "bypass", "mode"} <= set(depths)
    measured = [depth for depth in depths.values() if depth["depth_m"] is not None]
    assert len(measured) >= 6 and not any(depth["contradicts"] for depth in measured)
    assert depths["bypass"]["depth_m"] == pytest.approx(0.025, abs=4.0 * depths["bypass"]["sigma_m"])
    assert depths["bypass"]["views"] >= 3 and depths["bypass"]["sigma_m"] < 0.0015
    pictures = [path.name for path in (tmp_path / "honest/runs").glob("*/*.png")]
    assert {"lights.png", "range.png", "surfaces.png", "pose.png", "wrench.png", "joints.png"} <= set(pictures)

    assert_everything_was_stored(tmp_path / "honest", honest)


def assert_everything_was_stored(folder: Path, report: dict[str, Any]) -> None:
    """Check that the history has every reading of the report, with its picture, and what the control was told to be."""
    history = History(folder / "history", cell="bench", panel="bench")
    stored = [row.reading for row in history.reader().all(history.ask())]
    read = [(one["name"], one["value"], one["state"], one["text"]) for one in report["readings"] if not one["reason"]]
    assert set(read) <= {(one.object, one.value, one.state, one.text) for one in stored if one.is_valid}
    assert {one.object for one in stored} == {one["name"] for one in report["readings"]}
    assert {one.mission for one in stored} == {report["mission"]}
    assert (stored[-1].object, stored[-1].told, stored[-1].phase) == ("setpoint", "65", "after setpoint")
    assert all(0.0 < one.cell_s < 1000.0 and one.asked_by == "alice" for one in stored)
    sizes = [cv2.imread(str(history.crops.path(str(one.crop)))).shape[:2] for one in stored]
    assert len(sizes) == len(stored) and all(16 < side < 480 for size in sizes for side in size)


UNMET = {"object": "pressure", "above": 9.9, "unit": "bar"}  # at the end of the scale, where no seed puts the needle
GUARDED = {
    "steps": [
        {"kind": "inspect", "name": "read", "objects": ["pressure", "flow"]},
        {"kind": "set", "name": "skipped", "object": "pump", "other": True, "needs": [UNMET], "on_failure": "skip"},
        {"kind": "set", "name": "press", "object": "start", "needs": [UNMET]},
    ]
}


def test_a_mission_is_planned_without_motion_and_ends_before_contact_when_a_condition_is_unmet(tmp_path: Path) -> None:
    with mission_context(tmp_path, seed=3) as context:
        stood = context.connection.mover.state().position_rad.tolist()
        plan = run_mission(context, MissionRequest(file="demo", dry_run=True)).plan
        assert plan is not None and plan.is_possible and not plan.located
        ends = [station.flange_m[-1] for station in plan.stations]
        assert [station.flange_m[0] for station in plan.stations[1:]] == ends[:-1], (
            "each way begins where the last ended"
        )
        assert {"overview", "park"} <= {station.what for station in plan.stations}
        assert [station.step for station in plan.stations].count("operate") == 4
        assert plan.expected_s == pytest.approx(plan.ways_s + plan.contact_s) and 30.0 < plan.expected_s < 300.0
        assert context.connection.mover.state().position_rad.tolist() == stood
        assert not list(tmp_path.glob("runs/*"))
        guarded = validate(GUARDED, MissionFile, source="mission")
        with pytest.raises(StepFailed, match="step press was ended before it did anything: pressure shows"):
            run_mission(context, MissionRequest(mission=guarded))
        truth = context.connection.device("arm").truth()
    report = report_of(tmp_path)
    assert truth.peak_force_n < 1.0 and not report["actions"]
    outcomes = [(one["path"], one["outcome"]) for one in report["mission_steps"]]
    assert outcomes == [("read", "done"), ("skipped", "skipped"), ("press", "failed")]
    assert {one["name"] for one in report["readings"]} == {"pressure", "flow"}
    assert report["steps"][-1]["name"] == "park after the error" and report["steps"][-1]["ok"]
    (folder,) = tmp_path.glob("runs/*/progress.json")
    assert load_progress(folder.parent, cell="bench", panel="bench").done == ["read"]


def test_a_control_that_cannot_be_operated_keeps_the_mission_from_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_session: Session, body: ActionBody) -> None:
        raise InvalidRequest(f"the angle of {body.object} is not known", hint="read it first")

    monkeypatch.setattr("service.operations.mission.work", refuse)
    asked = (ActionBody(object="bypass", angle_rad=1.0), ActionBody(object="setpoint", value=65.0))
    with mission_context(tmp_path, seed=3) as context:
        answer = run_mission(context, MissionRequest(actions=asked))
    assert [(one.object, one.outcome, one.confirmed) for one in answer.actions] == [
        ("bypass", "invalid-request", False),
        ("setpoint", "invalid-request", False),
    ]
    assert answer.actions[0].detail == "the angle of bypass is not known; read it first"
    assert not answer.succeeded
    assert report_of(tmp_path)["steps"][-1]["name"] == "retreat", "the mission goes on to its end"


def test_a_wheel_beside_its_place_in_the_file_is_looked_at_again_stated_and_not_worked(tmp_path: Path) -> None:
    with mission_context(tmp_path, seed=3, misplaced_m=0.008) as context:
        session = Session(context=context)
        go_to_overview(session)
        locate(session)
        first = view_surfaces(session, scan_plate(session), OVERVIEW)
        stood = session.mover.state().position_rad
        checks, pictures = check_surfaces(session, first)
        moved = np.abs(session.mover.state().position_rad - stood).max()
        near = scan_beside(session)
        go_to_overview(session)
        stood = session.mover.state().position_rad
        again, _ = check_surfaces(session, first, near)
        assert np.array_equal(session.mover.state().position_rad, stood), "a range image from near the wheel is enough"
        settle(session)
        looks = [look(session)]
        for place in ("flow", "mode"):
            looks += [view.look for view in look_close(session, session.panel.object(place).point_m, [place]).pictures]
        wheel_in_file = session.panel.object("bypass")
        built_m = (wheel_in_file.position_m[0] + 0.008, wheel_in_file.position_m[1])
        by_file, by_wrong_file = [
            {depth.name: depth for depth in object_depths(at, rims_in(at, looks))}
            for at in (with_wheel(session, position_m=built_m), with_wheel(session, position_m=built_m, height_m=0.018))
        ]
    by_name = {check.name: check for check in checks}
    assert by_name["emergency"].agrees and by_name["emergency"].seen_from == OVERVIEW
    wheel = by_name["bypass"]
    assert wheel.stands_elsewhere and wheel.seen_from == CLOSER and moved > 0.05
    assert wheel.off_m == pytest.approx(0.008, abs=0.002)
    assert [check.stands_elsewhere for check in again] == [check.stands_elsewhere for check in checks]
    assert [picture.name for picture in pictures] == ["surfaces", "surfaces-bypass"]
    with pytest.raises(NotFound, match="bypass is not operated"):
        need_its_place(checks, "bypass")
    assert not by_file["bypass"].contradicts and by_wrong_file["bypass"].contradicts
    assert "bypass: its rim stands" in by_wrong_file["bypass"].finding
    assert by_wrong_file["bypass"].depth_m == pytest.approx(by_file["bypass"].depth_m, abs=0.003)
    assert not any(depth.contradicts for name, depth in by_wrong_file.items() if name != "bypass")


@pytest.mark.parametrize("device", ["wrist_camera", "range_scanner"])
def test_a_device_that_dies_ends_the_mission_by_name_and_nothing_is_lost(tmp_path: Path, device: str) -> None:
    with mission_context(tmp_path, seed=4) as context:
        if device == "range_scanner":
            stand_close(Session(context=context))  # as after an action; the mission must be able to leave this pose
        context.connection.device(device).inject_fault(Fault.DISCONNECTED)
        with pytest.raises(CellError) as caught:
            run_mission(context, MissionRequest(file="demo"))
        state = context.connection.mover.state()
    assert device in str(caught.value)
    report = report_of(tmp_path)
    assert device in report["problem"]["detail"]
    assert report["steps"] and not report["succeeded"]
    park = load_cell(ROOT / "cells/bench.toml").file.workspace.park_rad
    np.testing.assert_allclose(state.position_rad, park, atol=0.01)


def test_an_arm_that_does_not_follow_is_left_where_it_stands(tmp_path: Path) -> None:
    """Otherwise parking would begin with a jump of 20 mm and 102 N at the wrist."""
    with mission_context(tmp_path, seed=4) as context:
        mover = context.connection.mover
        execute, reports = mover.execute, []

        def noted(motion: DeclaredMotion) -> MotionReport:
            reports.append(execute(motion))
            return reports[-1]

        mover.execute = noted  # type: ignore[method-assign]  # records every motion of the mission and after it
        context.connection.device("arm").inject_fault(Fault.FROZEN)
        with pytest.raises(DeviceFault, match="does not follow"):
            run_mission(context, MissionRequest(file="demo"))
    assert [report.tripped == "tracking" for report in reports] == [False] * (len(reports) - 1) + [True]
    report = report_of(tmp_path)
    assert "arm does not follow" in report["not_parked"]
    assert report["not_parked"].endswith("the arm was not parked; look at it, then reset the stop")
    (page,) = tmp_path.glob("runs/*/report.html")
    assert "Not parked" in page.read_text()


def test_an_arm_that_stands_at_the_panel_and_knows_of_none_gets_away(tmp_path: Path) -> None:
    with mission_context(tmp_path, seed=4) as context:
        session = Session(context=context)
        stand_close(session)
        session.world.forget()  # as after a restart of the service
        home = np.array(session.cell.file.workspace.park_rad)
        assert not go_to_joints(session, home, name="home")  # no path can be planned from this pose
        go_to_overview(session)


def test_a_frozen_camera_is_found_out(tmp_path: Path) -> None:
    with mission_context(tmp_path, seed=4) as context:
        context.connection.device("wrist_camera").inject_fault(Fault.FROZEN)
        with pytest.raises(CellError, match="same frame"):
            run_mission(context, MissionRequest(file="demo"))
