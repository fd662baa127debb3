"""Tasks make only allowed transitions, one may move at a time, cancel stops the arm first, and nothing is lost."""

from __future__ import annotations

import errno
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.errors import Cancelled, CellError, DeviceUnavailable, InvalidRequest, MotionError
from service.errors import Busy, JournalError, NoSuchTask, NotPossibleNow
from service.tasks.model import ALLOWED, MAX_EVENTS, Artefact, Task, TaskState
from service.tasks.store import TaskContext, TaskStore
from tests.service.waiting import eventually

S = TaskState


class Recorder:
    """Stores the records, and refuses them when told to."""

    def __init__(self) -> None:
        self.records: list[tuple[str, dict[str, Any]]] = []
        self.is_full = False

    def append(self, kind: str, data: dict[str, Any]) -> None:
        if self.is_full:
            raise JournalError("disk full", hint="free space")
        self.records.append((kind, data))


class Bench:
    def __init__(self, folder: Path) -> None:
        self.recorder = Recorder()
        self.stops = 0
        self.store = TaskStore(folder, recorder=self.recorder, stop_motion=self._stop, max_queued=3, keep=5)

    def _stop(self) -> None:
        self.stops += 1

    def run(self, work: Any, *, moves: bool = False) -> Task:
        task = self.store.start("test", {}, work, moves=moves)
        assert task.wait(10.0)
        return task


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.store.close()


def _until_cancelled(context: TaskContext) -> None:
    while True:
        context.check_cancelled()
        threading.Event().wait(0.001)


def test_success_carries_the_result(bench: Bench) -> None:
    answer = {"pose": [0.1 + 0.2, -1e-17, 3], "name": "Füllstand", "none": None, "deep": {"list": [True, []]}}
    task = bench.run(lambda _: answer)
    task.result["deep"]["list"].append("a reader's copy")
    assert (task.state, task.result, task.fraction) == (S.SUCCEEDED, answer, 1.0)


def test_a_full_disk_is_no_defect_of_ours(bench: Bench) -> None:
    def fill(_: TaskContext) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    problem = bench.run(fill).problem
    assert problem is not None
    assert (problem["type"], problem["retry"]) == ("urn:panelwright:file-fault", "after-fix")
    assert "room" in problem["hint"]


def test_a_known_error_becomes_a_problem(bench: Bench) -> None:
    def fail(_: TaskContext) -> None:
        raise DeviceUnavailable("camera unplugged", hint="plug it in", device="camera")

    task = bench.run(fail)
    assert task.state is S.FAILED
    assert task.problem is not None
    assert task.problem["details"] == {"device": "camera"}
    assert task.problem["status"] == 503


def test_a_cancelled_motion_in_a_task_that_nobody_cancelled_is_a_failure(bench: Bench) -> None:
    def fail(_: TaskContext) -> None:
        raise Cancelled("the motion was cancelled", hint="start again")

    assert bench.run(fail).state is S.FAILED


def test_a_result_that_is_no_json_is_a_defect_not_a_crash(bench: Bench) -> None:
    task = bench.run(lambda _: {"thing": object()})
    assert task.state is S.FAILED
    assert task.problem is not None
    assert task.problem["type"] == "urn:panelwright:defect"


def test_cancel_stops_the_arm_first_and_goes_on_until_the_task_ends(bench: Bench) -> None:
    seen: list[int] = []

    def move(context: TaskContext) -> None:
        while not context.is_cancelled:
            threading.Event().wait(0.001)
        seen.append(bench.stops)
        eventually(lambda: bench.stops >= 3)  # a cancel between two motions must stop the second one
        context.check_cancelled()

    task = bench.store.start("test", {}, move, moves=True)
    eventually(lambda: task.state is S.RUNNING)
    bench.store.cancel(task.id)
    assert bench.stops >= 1
    assert task.wait(10.0)
    assert task.state is S.CANCELLED


def test_cancelling_twice_is_no_error_and_does_not_end_it_early(bench: Bench) -> None:
    release = threading.Event()

    def slow(context: TaskContext) -> None:
        release.wait(10.0)
        context.check_cancelled()

    task = bench.store.start("test", {}, slow, moves=True)
    eventually(lambda: task.state is S.RUNNING)
    bench.store.cancel(task.id)
    bench.store.cancel(task.id)
    assert task.state is S.CANCELLING
    release.set()
    assert task.wait(10.0)
    assert task.state is S.CANCELLED


def test_cancelling_a_queued_task_ends_it_without_touching_the_arm(bench: Bench) -> None:
    first = bench.store.start("test", {}, _until_cancelled, moves=True)
    eventually(lambda: first.state is S.RUNNING)
    ran: list[int] = []
    second = bench.store.start("test", {}, lambda _: ran.append(1), moves=True)
    bench.store.cancel(second.id, reason="bob took over")
    assert second.state is S.CANCELLED
    assert second.problem is not None and "bob took over" in second.problem["detail"]
    assert bench.stops == 0
    bench.store.cancel(first.id)
    bench.run(lambda _: None, moves=True)
    assert not ran


def test_cancelling_a_task_that_only_reads_leaves_the_arm_alone(bench: Bench) -> None:
    task = bench.store.start("test", {}, _until_cancelled, moves=False)
    eventually(lambda: task.state is S.RUNNING)
    bench.store.cancel(task.id)
    assert task.wait(10.0)
    assert bench.stops == 0


@pytest.mark.parametrize("moves", [True, False])
def test_closing_stops_the_arm_of_a_task_that_moves_it(bench: Bench, moves: bool) -> None:
    task = bench.store.start("test", {}, _until_cancelled, moves=moves)
    eventually(lambda: task.state is S.RUNNING)
    bench.store.close()
    assert (bench.stops > 0) is moves


def test_progress_stays_between_nothing_and_all(bench: Bench) -> None:
    def work(context: TaskContext) -> None:
        for fraction in (-0.5, 0.3, 1.7):
            context.progress(fraction, "step")

    told = [event.fraction for event in bench.run(work).events if event.kind == "progress"]
    assert told == [0.0, 0.3, 1.0]


def test_an_artefact_that_is_written_again_is_listed_once_with_its_new_size(bench: Bench) -> None:
    def work(context: TaskContext) -> None:
        context.artefact("a.txt", b"hello", "text/plain")
        context.artefact("a.txt", b"hello again", "text/plain")

    assert [(kept.name, kept.size_bytes) for kept in bench.run(work).artefacts] == [("a.txt", 11)]


def test_who_comes_back_gets_the_events_after_the_last_one_seen(bench: Bench) -> None:
    task = bench.run(lambda context: context.progress(0.5, "half"))
    seen = [event.sequence for event in task.events]
    assert seen == list(range(1, len(seen) + 1))
    assert [event.sequence for event in task.events_after(seen[1])] == seen[2:]


def test_an_ended_task_cannot_be_cancelled(bench: Bench) -> None:
    with pytest.raises(NotPossibleNow):
        bench.store.cancel(bench.run(lambda _: None).id)


def test_a_full_queue_refuses(bench: Bench) -> None:
    first = bench.store.start("test", {}, _until_cancelled, moves=True)
    eventually(lambda: first.state is S.RUNNING)
    for _ in range(3):
        bench.store.start("test", {}, _until_cancelled, moves=True)
    with pytest.raises(Busy):
        bench.store.start("test", {}, _until_cancelled, moves=True)


def test_two_moving_tasks_never_overlap(bench: Bench) -> None:
    inside: list[int] = []

    def move(_: TaskContext) -> None:
        inside.append(1)
        assert len(inside) == 1
        threading.Event().wait(0.01)
        inside.pop()

    tasks = [bench.store.start("test", {}, move, moves=True) for _ in range(3)]
    assert all(task.wait(10.0) for task in tasks)
    assert [task.state for task in tasks] == [S.SUCCEEDED] * 3


def test_what_cannot_be_recorded_does_not_start(bench: Bench) -> None:
    bench.recorder.is_full = True
    ran: list[int] = []
    with pytest.raises(JournalError):
        bench.store.start("test", {}, lambda _: ran.append(1), moves=True)
    assert not ran
    assert not bench.store.all()


def test_what_waited_until_the_disk_was_full_does_not_start_either(bench: Bench) -> None:
    may_end, ran = threading.Event(), []
    bench.store.start("test", {}, lambda _: may_end.wait(10.0), moves=True)
    waiting = bench.store.start("test", {}, lambda _: ran.append(1), moves=True)
    bench.recorder.is_full = True
    may_end.set()
    assert waiting.wait(10.0)
    assert waiting.state is S.FAILED and not ran


def test_start_and_end_are_recorded_before_they_show(bench: Bench) -> None:
    task = bench.run(lambda _: {"x": 1})
    assert [kind for kind, _ in bench.recorder.records] == ["task-queued", "task-started", "task-ended"]
    assert bench.recorder.records[1][1]["task"] == task.id


def test_artefacts_stay_in_their_folder(bench: Bench, tmp_path: Path) -> None:
    task = bench.run(lambda context: context.artefact("a.txt", b"hello", "text/plain"))
    path, artefact = bench.store.artefact_path(task.id, "a.txt")
    assert (path.read_bytes(), artefact.size_bytes) == (b"hello", 5)
    for name in ("../a.txt", "/etc/passwd", "a/b", "", ".", "..", "a\0b", "x" * 200, ".hidden"):
        assert not Artefact.is_name(name)
        with pytest.raises(NoSuchTask):
            bench.store.artefact_path(task.id, name)
        assert bench.run(lambda context, name=name: context.artefact(name, b"", "x")).state is S.FAILED


def test_the_oldest_ended_tasks_are_forgotten_and_running_ones_never(bench: Bench) -> None:
    running = bench.store.start("test", {}, _until_cancelled, moves=True)
    for _ in range(10):
        bench.run(lambda _: None)
    assert len(bench.store.all()) <= 7
    assert bench.store.get(running.id) is running


def test_what_forgotten_tasks_left_goes_from_the_disk_too(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "of-an-earlier-run").mkdir()
    bench.store.sweep()
    tasks = [bench.run(lambda context: context.artefact("a.txt", b"x", "text/plain")) for _ in range(10)]
    bench.run(lambda _: None)
    kept = {task.id for task in bench.store.all()}
    assert len(kept) < len(tasks)
    assert {path.name for path in tmp_path.iterdir()} == {task.id for task in tasks} & kept


def test_an_unfinished_task_of_an_earlier_run_counts_as_aborted(bench: Bench) -> None:
    bench.store.restore(Task(id="old", verb="missions", request={}, moves=True, state=S.RUNNING))
    task = bench.store.get("old")
    assert task.state is S.FAILED
    assert task.problem is not None
    assert task.problem["type"] == "urn:panelwright:aborted"


def test_close_ends_everything(bench: Bench) -> None:
    task = bench.store.start("test", {}, _until_cancelled, moves=True)
    eventually(lambda: task.state is S.RUNNING)
    bench.store.close()
    assert task.state is S.CANCELLED
    with pytest.raises(Busy):
        bench.store.start("test", {}, lambda _: None, moves=False)


@pytest.mark.parametrize("error", [MotionError("no arm", hint="none"), RuntimeError("a defect")])
def test_an_error_while_stopping_does_not_hinder_the_cancel(error: Exception, tmp_path: Path) -> None:
    def broken() -> None:
        raise error

    store = TaskStore(tmp_path, recorder=Recorder(), stop_motion=broken)
    task = store.start("test", {}, _until_cancelled, moves=True)
    eventually(lambda: task.state is S.RUNNING)
    store.cancel(task.id)
    assert task.wait(10.0)
    store.close()


@given(steps=st.lists(st.sampled_from([*TaskState, "cancel"]), max_size=12))
@settings(max_examples=300)
def test_no_sequence_of_moves_leaves_the_table(steps: list[Any]) -> None:
    task = Task(id="t", verb="v", request={}, moves=True)
    for step in steps:
        before = task.state
        moved = task.ask_cancel("x") if step == "cancel" else task.move_to(step)
        if task.state is not before:
            assert moved
            assert task.state in ALLOWED[before]
        if before.is_final:
            assert not moved
            assert task.state is before
    assert [event.sequence for event in task.events] == list(range(1, len(task.events) + 1))


def test_every_state_can_end_and_ends_are_final() -> None:
    for state in TaskState:
        reached, waiting = set[TaskState](), [state]
        while waiting:
            for following in ALLOWED[waiting.pop()]:
                if following not in reached:
                    reached.add(following)
                    waiting.append(following)
        assert state.is_final == (not reached)
        assert state.is_final or any(following.is_final for following in reached)


def test_events_are_bounded_and_their_numbers_show_the_gap() -> None:
    task = Task(id="t", verb="v", request={}, moves=False)
    for i in range(MAX_EVENTS + 50):
        task.add_event("progress", fraction=0.5, step=str(i))
    events = task.events_after(0)
    assert len(events) == MAX_EVENTS
    assert events[0].sequence == 51


def test_a_used_key_with_another_request_is_refused(bench: Bench) -> None:
    first = bench.store.start("v", {"a": 1}, lambda _: None, moves=False, key="k")
    assert bench.store.start("v", {"a": 1}, lambda _: None, moves=False, key="k") is first
    with pytest.raises(InvalidRequest):
        bench.store.start("v", {"a": 2}, lambda _: None, moves=False, key="k")


def test_an_unknown_task_is_named() -> None:
    assert issubclass(NoSuchTask, CellError)


def test_a_paused_task_stands_still_between_its_steps_until_it_goes_on(bench: Bench) -> None:
    held = threading.Event()

    def walk(context: TaskContext) -> str:
        for _ in range(3):
            context.pause_point(held.set)
        while not context.is_cancelled and not held.is_set():
            context.pause_point(held.set)
        return "walked"

    task = bench.store.start("walk", {}, walk, moves=True, can_pause=True)
    assert bench.store.pause(bench.store.pause(task.id).id) is task, "a repeat is no error"
    eventually(lambda: held.is_set() and task.pause == "held")
    assert not task.state.is_final
    bench.store.go_on(task.id)
    assert task.wait(10.0)
    assert (task.result, task.pause) == ("walked", "no")
    kinds = [kind for kind, _ in bench.recorder.records]
    assert kinds.count("task-paused") == kinds.count("task-went-on") == 1
    with pytest.raises(NotPossibleNow, match="has succeeded"):
        bench.store.pause(task.id)


def test_a_paused_task_can_be_cancelled_and_one_without_steps_does_not_pause(bench: Bench) -> None:
    task = bench.store.start("test", {}, _until_cancelled, moves=False)
    with pytest.raises(NotPossibleNow, match="no steps"):
        bench.store.pause(task.id)
    bench.store.cancel(task.id)
    paused = bench.store.start("test", {}, _until_held, moves=True, can_pause=True)
    bench.store.pause(paused.id)
    eventually(lambda: paused.pause == "held")
    bench.store.cancel(paused.id)
    assert paused.wait(10.0)
    assert paused.state is S.CANCELLED


def _until_held(context: TaskContext) -> None:
    while True:
        context.pause_point(lambda: None)
        threading.Event().wait(0.001)
