"""A restarted service knows what the last one did, and resumes nothing by itself."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from hal.config import load_cell
from hal.errors import InvalidRequest
from service.core import Service
from service.errors import JournalError
from service.tasks.model import TaskState
from tests.service.conftest import WriteCell
from tests.service.verbs import OPERATIONS, EchoRequest, FailRequest, HoldRequest
from tests.service.waiting import eventually


def _service(cell: Path, runs: Path) -> Service:
    service = Service(load_cell(cell), OPERATIONS, runs_dir=runs, inline=True)
    service.start()
    return service


def test_ended_tasks_come_back_with_result_problem_progress_and_artefacts(
    write_cell: WriteCell, tmp_path: Path
) -> None:
    cell, runs = write_cell(), tmp_path / "runs"
    first = _service(cell, runs)
    good = first.submit("echo", EchoRequest(text="hello"))
    bad = first.submit("fail", FailRequest())
    assert good.wait(20.0) and bad.wait(20.0)
    first.close()
    second = _service(cell, runs)
    try:
        again = second.tasks.get(good.id)
        assert (again.state, again.result["text"], again.fraction) == (TaskState.SUCCEEDED, "hello", 1.0)
        assert again.step == "speaking"
        path, _ = second.tasks.artefact_path(good.id, "said.txt")
        assert path.read_text() == "hello"
        failed = second.tasks.get(bad.id)
        assert failed.state is TaskState.FAILED
        assert failed.problem == bad.problem
        assert second.journal.verify() > 0
    finally:
        second.close()


def test_who_asks_again_with_the_same_key_after_a_crash_gets_the_task_of_before_and_moves_nothing(
    write_cell: WriteCell, tmp_path: Path
) -> None:
    cell, runs = write_cell(robot=True), tmp_path / "runs"
    first = _service(cell, runs)
    task = first.submit("hold", HoldRequest(), key="once")
    eventually(lambda: task.state is TaskState.RUNNING)
    first.journal.close()
    first.close()
    second = _service(cell, runs)
    try:
        again = second.submit("hold", HoldRequest(), key="once")
        assert (again.id, again.state) == (task.id, TaskState.FAILED)
        with pytest.raises(InvalidRequest):
            second.submit("hold", HoldRequest(seconds=1.0), key="once")
    finally:
        second.close()


def test_a_task_that_was_cut_off_is_aborted_and_not_taken_up(write_cell: WriteCell, tmp_path: Path) -> None:
    cell, runs = write_cell(robot=True), tmp_path / "runs"
    first = _service(cell, runs)
    task = first.submit("hold", HoldRequest())
    eventually(lambda: task.state is TaskState.RUNNING)
    first.journal.close()  # like a power failure: nothing is recorded after this
    first.close()
    second = _service(cell, runs)
    try:
        again = second.tasks.get(task.id)
        assert again.state is TaskState.FAILED
        assert again.problem is not None
        assert (again.problem["type"], again.problem["retry"]) == ("urn:panelwright:aborted", "after-fix")
        assert f"the service ended while task {task.id} was running" in again.problem["detail"]
        assert again.started_s == pytest.approx(task.started_s, abs=60.0)
        assert second.tasks.moving() is None
    finally:
        second.close()


def test_a_second_service_on_the_same_folder_aborts_nothing_and_keeps_the_chain(
    write_cell: WriteCell, tmp_path: Path
) -> None:
    """A user runs `panelwright demo` beside `panelwright serve`."""
    cell, runs = write_cell(robot=True), tmp_path / "runs"
    first = _service(cell, runs)
    task = first.submit("hold", HoldRequest())
    eventually(lambda: task.state is TaskState.RUNNING)
    second = _service(cell, runs)
    try:
        assert second.tasks.all() == []
        assert second.submit("echo", EchoRequest()).wait(20.0)
        first.tasks.cancel(task.id)
        assert task.wait(20.0)
        ends = [r.data["state"] for r in first.journal.records(kinds=("task-ended",)) if r.data["task"] == task.id]
        assert ends == ["cancelled"]
        assert first.journal.verify() > 0
    finally:
        second.close()
        first.close()


def test_starts_stops_and_resets_are_on_record(write_cell: WriteCell, tmp_path: Path) -> None:
    service = _service(write_cell(), tmp_path / "runs")
    service.supervisor.stop("test")
    service.supervisor.reset("test", seen_count=service.supervisor.latch.state().count)
    service.close()
    kinds = [record.kind for record in service.journal.records()]
    assert kinds == ["service-start", "stop-reset", "stop", "stop-reset", "stop", "service-end"]


def test_a_journal_that_cannot_be_written_lets_nothing_start_and_the_stop_works(
    write_cell: WriteCell, tmp_path: Path
) -> None:
    service = _service(write_cell(robot=True), tmp_path / "runs")
    try:
        with sqlite3.connect(service.journal.path) as db:
            db.execute("CREATE TRIGGER full BEFORE INSERT ON journal BEGIN SELECT RAISE(ABORT, 'disk full'); END")
        with pytest.raises(JournalError, match="disk full"):
            service.submit("hold", HoldRequest(seconds=0.1))
        assert service.tasks.all() == []
        assert service.supervisor.stop("test").is_latched
        with pytest.raises(JournalError, match="disk full"):
            service.supervisor.reset("test", seen_count=service.supervisor.latch.state().count)
        assert service.supervisor.latch.is_set()
        with pytest.raises(JournalError, match="disk full"):
            service.lease.acquire("alice")
        assert service.lease.holder()[0] is None
    finally:
        service.close()


def test_what_is_acknowledged_is_on_disk_at_that_moment(
    write_cell: WriteCell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill right behind the answer loses nothing."""
    service = _service(write_cell(), tmp_path / "runs")
    committed: list[str] = []
    monkeypatch.setattr(service.journal, "note", lambda _kind, _data: None)  # only what an answer waits for is written

    def newest() -> str:
        return service.journal.records()[-1].kind

    try:
        lease = service.lease.acquire("alice")
        committed.append(newest())
        service.lease.release(lease.token)
        committed.append(newest())
        count = service.supervisor.stop("test").count
        committed.append(newest())
        service.supervisor.reset("test", seen_count=count)
        committed.append(newest())
        assert committed == ["lease-acquired", "lease-released", "stop", "stop-reset"]
    finally:
        service.close()
