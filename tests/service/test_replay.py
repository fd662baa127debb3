"""A recorded session is replayed without its devices, and says where it differs."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from hal.config import load_cell
from hal.motion import GripperMotion, Hold
from hal.simulated import Fault
from service.commands.record import show, told
from service.core import Service
from service.operations import OPERATIONS, Operation, OperationContext
from service.recording.reader import open_recording
from service.replay.book import Book, distance, replayed_cell
from service.replay.verdict import Verdict, differing, replay_tasks
from service.schema.mission_request import MissionRequest
from service.schema.requests import WantedPose
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.recording import conftest, looks

ROOT = Path(__file__).resolve().parents[2]
recorded = conftest.recorded
looked = conftest.looked
RecordSession = conftest.RecordSession
TWO = [("look", {"looks": 2}), ("measure", {}), ("look", {"looks": 1, "to_rad": -0.2})]


@pytest.fixture
def replayed(tmp_path: Path) -> Callable[..., list[Verdict]]:
    """Return a function that replays a recording, perhaps by other operations."""

    def replay(path: Path, operations: Mapping[str, Operation] = looks.OPERATIONS) -> list[Verdict]:
        book = Book(open_recording(path))
        cell = book.recording.unpack(tmp_path / "unpacked")
        service = Service(
            cell, operations, runs_dir=tmp_path / "again", inline=True, replay=lambda: replayed_cell(book, cell)
        )
        with conftest.running(service):
            return list(replay_tasks(service, book, begin=lambda _task: None))

    return replay


@pytest.mark.parametrize("inline", [True, False])
def test_a_replayed_session_is_the_same_to_the_last_bit(
    inline: bool, recorded: RecordSession, replayed: Callable[..., list[Verdict]]
) -> None:
    verdicts = replayed(recorded(tasks=TWO, inline=inline))
    assert [(verdict.verb, verdict.differences, verdict.complaint) for verdict in verdicts] == [
        ("look", (), ""),
        ("measure", (), ""),
        ("look", (), ""),
    ]
    assert all(verdict.same_bits for verdict in verdicts)
    assert [verdict.calls for verdict in verdicts] == [13, 1, 8]


def changed(how: Callable[[looks.LookRequest], looks.LookRequest]) -> Mapping[str, Operation]:
    """Return the operations with another look, as a later version of the program might have."""

    def look(context: OperationContext, request: looks.LookRequest) -> looks.LookResult:
        return looks.look(context, how(request))

    return {**looks.OPERATIONS, "look": replace(looks.OPERATIONS["look"], run=look)}


@pytest.mark.parametrize(
    ("how", "complaint"),
    [
        ({"looks": 3}, "asks for panel_lights.set_on after call 13 of .*, but the recording holds no further call"),
        ({"to_rad": 0.3}, "asks for cell.mover.execute .* motion 'turn' ends elsewhere than the recorded one"),
        ({"by": "spin"}, "asks for cell.mover.execute .* recorded was motion 'turn'"),
    ],
)
def test_a_changed_code_path_is_told_with_the_call_that_was_not_recorded(
    how: dict[str, Any], complaint: str, looked: Path, replayed: Callable[..., list[Verdict]]
) -> None:
    (verdict,) = replayed(looked, changed(lambda request: request.model_copy(update=how)))
    assert re.search(complaint, verdict.complaint)
    assert "the code path has changed" in verdict.hint
    assert not verdict.same_readings


def test_a_motion_that_differs_in_its_last_bits_still_sees_the_same_and_is_told(
    looked: Path, replayed: Callable[..., list[Verdict]]
) -> None:
    (verdict,) = replayed(looked, changed(lambda request: request.model_copy(update={"to_rad": 0.1 + 1e-9})))
    assert verdict.same_readings
    assert not verdict.same_bits
    assert "motion 'turn' differs from the recorded one" in verdict.differences[0]


def test_a_recording_of_real_devices_is_replayed_without_a_reset_because_nothing_moves(
    recorded: RecordSession, replayed: Callable[..., list[Verdict]]
) -> None:
    (verdict,) = replayed(recorded(tasks=TWO[:1], mode="mixed"))
    assert verdict.same_bits, verdict.differences


def test_fewer_questions_are_told_too(looked: Path, replayed: Callable[..., list[Verdict]]) -> None:
    (verdict,) = replayed(looked, changed(lambda request: request.model_copy(update={"looks": 1})))
    assert (verdict.answered, verdict.calls) == (8, 13)
    assert not verdict.same_readings


def test_recorded_errors_are_raised_again(
    write_cell: WriteCell, tmp_path: Path, replayed: Callable[..., list[Verdict]]
) -> None:
    path = tmp_path / "session.mcap"
    service = Service(
        load_cell(write_cell(robot=True)), looks.OPERATIONS, runs_dir=tmp_path / "runs", inline=True, record=path
    )
    with conftest.running(service):
        service.supervisor.connection.device("finger_proximity").inject_fault(Fault.SILENT)
        assert conftest.run(service, "measure").problem["details"]["device"] == "finger_proximity"
    (verdict,) = replayed(path)
    assert verdict.same_bits


def test_pages_may_look_at_a_replayed_cell_without_disturbing_it(looked: Path, tmp_path: Path) -> None:
    book = Book(open_recording(looked))
    cell = book.recording.unpack(tmp_path / "unpacked")
    options = Options(
        port=0, runs_dir=tmp_path / "again", inline=True, warm=False, replay=lambda: replayed_cell(book, cell)
    )
    panelwright = Panelwright(cell, options, operations=looks.OPERATIONS)
    panelwright.start()
    try:
        with httpx2.Client(base_url=panelwright.url, timeout=30.0, trust_env=False) as http:
            for _ in range(2):
                for name in cell.file.devices:
                    assert http.get(f"/v1/devices/{name}").status_code == 200
                assert http.get("/v1/devices/wrist_camera/reading?format=png").status_code == 200
            refused = http.put("/v1/devices/wrist_ft", json={"driver": "fake:force_torque", "options": {}})
            assert "replayed from a recording" in refused.json()["detail"]
        (verdict,) = replay_tasks(panelwright.service, book, begin=lambda _task: None)
    finally:
        panelwright.close()
    assert verdict.same_bits


def test_how_far_apart_motions_end() -> None:
    hold = Hold(name="a", duration_s=1.0)
    assert distance(hold, Hold(name="a", duration_s=2.0)) == 0.0
    assert distance(hold, Hold(name="b", duration_s=1.0)) is None
    grip = GripperMotion(name="a", width_m=0.05, force_n=1.0)
    assert distance(hold, grip) is None
    assert distance(grip, replace(grip, width_m=0.052)) == pytest.approx(2.0)
    turn = looks._turn("a", np.zeros(6), 0.1)
    assert distance(turn, looks._turn("a", np.zeros(6), 0.1005)) == pytest.approx(0.5)


def test_differences_name_their_place_and_leave_the_run_out() -> None:
    before = {"pose": [1.0, 2.0], "wall_s": 1.0, "kept": {"a": None}}
    assert differing(before, {"pose": [1.0, 2.0], "wall_s": 9.0, "kept": {"a": None}}) == []
    assert differing(before, {"pose": [1.0, 2.5], "kept": {}}) == ["pose[1]: recorded 2.0, now 2.5"]
    assert differing(before, {"pose": [1.0], "kept": {}}) == ["pose: recorded [1.0, 2.0], now [1.0]"]


def test_the_verdict_is_told_in_words(
    looked: Path, replayed: Callable[..., list[Verdict]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert "cell fake, sim, seed 3" in told(open_recording(looked))
    for how in ({}, {"looks": 3}, {"to_rad": 0.1 + 1e-9}):
        (verdict,) = replayed(looked, changed(lambda request, how=how: request.model_copy(update=how)))  # type: ignore[misc]
        show(verdict)
    text = " ".join(capsys.readouterr().out.split())
    assert "look: same to the last bit: 13 of 13 recorded calls" in text
    assert "look: not the same" in text
    assert "the code path has changed" in text
    assert "look: same readings" in text


@pytest.mark.slow
@pytest.mark.parametrize("exposure_s", [0.01, 0.0002], ids=["light", "dark, so that other exposures are set"])
def test_a_simulated_mission_is_replayed_to_the_last_bit(
    tmp_path: Path, replayed: Callable[..., list[Verdict]], exposure_s: float
) -> None:
    path, file = tmp_path / "mission.mcap", tmp_path / "bench.toml"
    for name in ("panels", "cells"):
        (tmp_path / name).symlink_to(ROOT / name)
    text = (ROOT / "cells/bench.toml").read_text(encoding="utf-8")
    camera = "options = { width_px = 640, height_px = 480"
    assert camera in text
    file.write_text(text.replace(camera, f"{camera}, exposure_s = {exposure_s}"), encoding="utf-8")
    service = Service(load_cell(file, seed=11), OPERATIONS, runs_dir=tmp_path / "runs", record=path)
    with conftest.running(service):
        wanted = WantedPose(position_m=0.0005, angle_rad=0.0005)  # so that the touches are part of the recording
        task = service.submit("missions", MissionRequest(actions=(), touches=3, wanted=wanted))
        assert task.wait(250.0)
        assert task.state == "succeeded"
    (verdict,) = replayed(path, OPERATIONS)
    assert (verdict.complaint, verdict.differences) == ("", ())
    assert verdict.same_bits
    assert verdict.calls > 40
    asked = [call.method for task in open_recording(path).tasks for call in task.calls]
    assert ("set_exposure" in asked) == (exposure_s < 0.01)


def test_a_recording_without_the_end_of_a_task_is_replayed_as_far_as_it_goes(
    looked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    book = Book(open_recording(looked))
    task = book.recording.tasks[0]
    last = next(k for k, call in enumerate(task.calls) if str(call) == "range_scanner.read_range")
    task.calls, task.state, task.result = task.calls[:last], None, None
    book.recording.is_cut = True
    cell = book.recording.unpack(tmp_path / "cut")
    service = Service(
        cell, looks.OPERATIONS, runs_dir=tmp_path / "again", inline=True, replay=lambda: replayed_cell(book, cell)
    )
    with conftest.running(service):
        (verdict,) = replay_tasks(service, book, begin=lambda _task: None)
    assert verdict.same_bits
    assert "no end of this task" in verdict.note
    show(verdict)
    assert "as far as the recording goes" in " ".join(capsys.readouterr().out.split())
    assert book.refused is not None
    assert "cut off" in book.refused.hint
