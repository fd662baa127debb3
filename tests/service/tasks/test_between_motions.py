"""A stop, its reset and a take-over take effect although the arm stands between two motions of a task."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from hal.config import load_cell
from hal.errors import LeaseError
from hal.motion import Hold
from service.core import Service
from service.operations import Operation, OperationContext
from service.serve import Options, Panelwright
from service.tasks.lease import Command
from service.tasks.model import Task, TaskState
from tests.service.conftest import WriteCell
from tests.service.verbs import OPERATIONS, HoldRequest, HoldResult
from tests.service.waiting import eventually

PATIENCE_S = 20.0


class Thinker:
    """Operation that moves, waits until it may continue, and moves again."""

    def __init__(self) -> None:
        self.thinks, self.may_go_on = threading.Event(), threading.Event()
        self.moved = 0
        self.computes = False

    def run(self, context: OperationContext, _request: HoldRequest) -> dict[str, Any]:
        self._move(context)
        self.thinks.set()
        assert self.may_go_on.wait(PATIENCE_S)
        if self.computes:
            context.task.progress(0.5, "compute")
            return HoldResult(held_s=0.0)
        self._move(context)
        return HoldResult(held_s=0.0)

    def _move(self, context: OperationContext) -> None:
        context.connection.mover.execute(Hold(name="hold", duration_s=0.01))
        self.moved += 1


@pytest.fixture
def thinker() -> Thinker:
    return Thinker()


@pytest.fixture
def service(write_cell: WriteCell, tmp_path: Path, thinker: Thinker) -> Iterator[Service]:
    think = Operation(
        name="think", request_model=HoldRequest, result_model=HoldResult, run=thinker.run, summary="Think"
    )
    service = Service(
        load_cell(write_cell(robot=True)), {**OPERATIONS, "think": think}, runs_dir=tmp_path / "runs", inline=True
    )
    service.start()
    yield service
    thinker.may_go_on.set()
    service.close()


def stop_and_reset(service: Service) -> None:
    service.supervisor.reset("test", seen_count=service.supervisor.stop("test").count)


def refused(task: Task) -> str:
    """Return the problem of a failed task."""
    assert task.wait(PATIENCE_S)
    assert task.state is TaskState.FAILED and task.problem is not None
    assert task.problem["type"] == "urn:panelwright:stopped"
    return str(task.problem["detail"])


def test_a_task_that_thought_while_the_stop_was_pressed_and_reset_moves_no_more(
    service: Service, thinker: Thinker
) -> None:
    task = service.submit("think", HoldRequest())
    assert thinker.thinks.wait(PATIENCE_S)
    stop_and_reset(service)
    thinker.may_go_on.set()
    assert "pressed after this task was asked for" in refused(task)
    assert thinker.moved == 1
    again = service.submit("think", HoldRequest())
    assert again.wait(PATIENCE_S) and again.state is TaskState.SUCCEEDED, "a new command moves"


def test_a_task_that_only_computes_when_the_stop_is_pressed_ends_at_its_next_report_of_progress(
    service: Service, thinker: Thinker
) -> None:
    thinker.computes = True
    task = service.submit("think", HoldRequest())
    assert thinker.thinks.wait(PATIENCE_S)
    service.supervisor.stop("test")
    thinker.may_go_on.set()
    assert "pressed after this task was asked for" in refused(task)


def test_what_waited_in_the_queue_when_the_stop_was_pressed_does_not_move_after_the_reset(
    service: Service, thinker: Thinker
) -> None:
    service.submit("think", HoldRequest())
    waiting = service.submit("hold", HoldRequest(seconds=0.1))
    assert thinker.thinks.wait(PATIENCE_S)
    stop_and_reset(service)
    thinker.may_go_on.set()
    refused(waiting)


def test_a_take_over_at_the_very_moment_of_a_command_wins(service: Service) -> None:
    class Overtaken(HoldRequest):
        def model_dump(self, **given: Any) -> dict[str, Any]:  # asked for between the look at the lease and the start
            service.lease.take_over("bob")
            return super().model_dump(**given)

    alice = service.lease.acquire("alice")
    with pytest.raises(LeaseError):
        service.submit("hold", Overtaken(), command=Command(token=alice.token))
    assert service.tasks.all()[0].wait(PATIENCE_S)
    assert service.tasks.all()[0].state is TaskState.CANCELLED


def kinds(service: Service) -> list[tuple[str, str]]:
    """Return the stops and resets in the journal, with their sources."""
    return [(r.kind, r.data["source"]) for r in service.journal.records(kinds=("stop", "stop-reset"))]


def test_a_stop_by_the_stop_port_is_in_the_journal(write_cell: WriteCell, tmp_path: Path) -> None:
    options = Options(port=0, runs_dir=tmp_path / "runs", inline=True)
    panelwright = Panelwright(load_cell(write_cell()), options, operations=OPERATIONS)
    panelwright.start()
    try:
        service = panelwright.service
        httpx2.post(panelwright.stop_url, timeout=PATIENCE_S, trust_env=False)
        eventually(lambda: ("stop", "POST /v1/stop from 127.0.0.1") in kinds(service))
        service.supervisor.reset("test", seen_count=service.supervisor.latch.state().count)
        service.supervisor.latch.set("pressed, and reset at once")
        service.supervisor.reset("test", seen_count=service.supervisor.latch.state().count)
        eventually(lambda: len(kinds(service)) >= 5)
        assert kinds(service)[-4:] == [
            ("stop", "POST /v1/stop from 127.0.0.1"),
            ("stop-reset", "test"),
            ("stop", "pressed, and reset at once"),
            ("stop-reset", "test"),
        ]
    finally:
        panelwright.close()


@pytest.mark.parametrize("is_pressed", [True, False])
def test_a_stop_that_is_pressed_while_a_simulated_cell_starts_stays(
    write_cell: WriteCell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_pressed: bool
) -> None:
    service = Service(load_cell(write_cell()), OPERATIONS, runs_dir=tmp_path / "runs", inline=True)
    start: Callable[[], None] = service.supervisor._start_inline

    def pressed_meanwhile() -> None:
        start()
        if is_pressed:
            service.supervisor.stop("somebody")

    monkeypatch.setattr(service.supervisor, "_start_inline", pressed_meanwhile)
    try:
        service.start()
        assert service.supervisor.latch.is_set() is is_pressed
    finally:
        service.close()


@pytest.mark.parametrize("action", ["hold", "stop"])
def test_the_cell_file_chooses_what_happens_when_the_client_of_a_motion_is_lost(
    write_cell: WriteCell, tmp_path: Path, action: str
) -> None:
    cell = load_cell(write_cell(robot=True, extra=f'[safety]\nlease_ttl_s = 1.0\nclient_lost = "{action}"'))
    service = Service(cell, OPERATIONS, runs_dir=tmp_path / "runs", inline=True)
    service.start()
    try:
        alice = service.lease.acquire("alice")
        task = service.submit("hold", HoldRequest(), command=Command(token=alice.token))
        assert task.wait(PATIENCE_S), "nobody gives a heartbeat"
        assert task.state is not TaskState.SUCCEEDED
        if action == "hold":
            assert not service.supervisor.latch.is_set()
        else:
            eventually(service.supervisor.latch.is_set)
            assert "alice lapsed" in service.supervisor.latch.state().source
    finally:
        service.close()
