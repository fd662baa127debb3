"""Runs tasks, which are long operations that a caller starts, watches and may cancel; one motion task at a time."""

from __future__ import annotations

import logging
import secrets
import shutil
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

from hal.errors import Cancelled, CellError, InvalidRequest
from hal.malloc_arenas import return_free_memory
from hal.priorities import Priority, take_priority
from service.access.actor import actor
from service.errors import Aborted, Busy, Defect, NoSuchTask, NotPossibleNow, of_file
from service.jsonable import jsonable
from service.problem import problem_of
from service.tasks.context import TaskContext
from service.tasks.model import Artefact, Task, TaskEvent, TaskState
from service.tasks.sub_leases import SubLease

__all__ = ["Artefact", "Task", "TaskContext", "TaskEvent", "TaskRecorder", "TaskState", "TaskStore"]

CANCEL_REPEAT_S = 0.05  # repeated, because a cancel between two motions must also end the second one
log = logging.getLogger(__name__)


class TaskRecorder(Protocol):
    """The interface through which tasks are recorded (the journal)."""

    def append(self, kind: str, data: dict[str, Any]) -> None:
        """Record durably before returning; raises `JournalError`."""
        ...


Work = Callable[[TaskContext], Any]


class TaskStore:
    """Starts, keeps and cancels tasks.

    Args:
        folder: artefacts go to `folder/<task id>/`.
        recorder: the journal; a task is acknowledged after its record is on disk.
        stop_motion: ends the running motion; called at a cancellation and repeatedly until the task has ended.
        max_queued: more waiting tasks than this are refused with `Busy`; of one client, more than half of it.
        keep: number of finished tasks that are kept; the artefacts of older ones are removed.
    """

    def __init__(
        self,
        folder: Path,
        *,
        recorder: TaskRecorder,
        stop_motion: Callable[[], None],
        max_queued: int = 16,
        keep: int = 200,
    ) -> None:
        self._folder = folder
        self._recorder = recorder
        self._stop_motion = stop_motion
        self._max_queued = max_queued
        self._keep = keep
        self._lock = threading.Lock()
        self._tasks: OrderedDict[str, Task] = OrderedDict()
        self._listeners: set[Callable[[Task], None]] = set()
        self._is_closed = False
        # Motion tasks share one thread, so that two never command the arm; reading tasks do not wait for them.
        self._lanes = {
            True: ThreadPoolExecutor(1, "task-motion", take_priority, (Priority.WORK,)),
            False: ThreadPoolExecutor(2, "task-read", take_priority, (Priority.WORK,)),
        }

    def start(
        self,
        verb: str,
        request: dict[str, Any],
        work: Work,
        *,
        moves: bool,
        holder: str | None = None,
        key: str | None = None,
        sub_lease: SubLease | None = None,
        client: str | None = None,
        can_pause: bool = False,
    ) -> Task:
        """Queue a task; the same idempotency `key` with the same request returns the same task again.

        Raises:
            Busy: too many tasks wait.
            InvalidRequest: the key was used for another request.
            JournalError: the start cannot be recorded, so the task does not start.
        """
        with self._lock:
            earlier = self._with_key(key, verb, request)
            if earlier is not None:
                return earlier
            self._check_room(client)
            task = Task(id=secrets.token_hex(8), verb=verb, request=request, moves=moves, holder=holder, key=key)
            task.can_pause = can_pause
            task.by, task.sub_lease, task.client, task.on_change = actor(), sub_lease, client, self._changed
            self._tasks[task.id] = task
            forgotten = self._forget_old()
        self._remove_artefacts(forgotten)
        try:
            asked = {"task": task.id, "verb": verb, "request": request, "holder": holder, "key": key}
            asked |= {"sub_lease": sub_lease.name} if sub_lease is not None else {}
            self._recorder.append("task-queued", asked)
        except CellError:
            with self._lock:
                self._tasks.pop(task.id, None)
            raise
        task.add_event("state")
        running = self._lanes[moves].submit(self._run, task, work)
        if moves:  # it took seconds and handled images; tasks that only read may follow each other fast
            running.add_done_callback(lambda _: return_free_memory())
        return task

    def has_key(self, key: str) -> bool:
        """Return whether a kept task was asked for with this idempotency key."""
        return any(task.key == key for task in self.all())

    def restore(self, task: Task) -> None:
        """Add a task of an earlier service run, for reading only; one that had not ended counts as aborted."""
        if not task.state.is_final:
            error = Aborted(
                f"the service ended while task {task.id} was {task.state}", hint="look at the cell, then start it again"
            )
            task.problem = problem_of(error)
            task.state = TaskState.FAILED
            self._record_end(task)
        with self._lock:
            self._tasks.setdefault(task.id, task)
            forgotten = self._forget_old()
        self._remove_artefacts(forgotten)

    def sweep(self) -> None:
        """Remove artefacts of tasks that are not kept any more; called after the tasks of earlier runs were restored."""
        if self._folder.is_dir():
            self._remove_artefacts([path.name for path in self._folder.iterdir() if path.name not in self._tasks])

    def get(self, task_id: str) -> Task:
        """Return the task with the id `task_id`.

        Raises:
            NoSuchTask: there is no such task, or it is not kept any more.
        """
        task = self._tasks.get(task_id)
        if task is None:
            raise NoSuchTask(f"there is no task {task_id!r}", hint="GET /v1/tasks lists the tasks that are kept")
        return task

    def all(self) -> list[Task]:
        """Return all kept tasks, newest first."""
        with self._lock:
            return list(self._tasks.values())[::-1]

    def moving(self) -> Task | None:
        """Return the task that may move the arm now, or None."""
        return next((t for t in self.all() if t.moves and t.state in (TaskState.RUNNING, TaskState.CANCELLING)), None)

    def moving_for_others(self, holder: str) -> str | None:
        """Describe a motion task (running or queued) that this holder of the lease did not start; None without one."""
        for task in reversed(self.all()):  # the running task comes before the queued ones
            if task.moves and not task.state.is_final and task.holder != holder:
                who = task.holder or "a client without a lease"
                return f"{task.verb} (task {task.id}) of {who} is {task.state}"
        return None

    def artefact_path(self, task_id: str, name: str) -> tuple[Path, Artefact]:
        """Return the file and the description of an artefact.

        Raises:
            NoSuchTask: there is no such task or artefact.
        """
        task = self.get(task_id)
        found = next((item for item in task.artefacts if item.name == name), None)
        path = self._folder / task_id / name
        if found is None or not path.is_file():
            raise NoSuchTask(f"task {task_id} has no artefact {name!r}", hint="the task's `artefacts` lists them")
        return path, found

    def cancel(self, task_id: str, *, reason: str = "asked for") -> Task:
        """Cancel a task: it can begin no further motion, and running motions are stopped until it has ended.

        Raises:
            NoSuchTask: there is no such task.
            NotPossibleNow: the task has ended already.
        """
        task = self.get(task_id)
        if not task.ask_cancel(reason):
            raise NotPossibleNow(
                f"task {task_id} has {task.state} and cannot be cancelled", hint="nothing to do", state=str(task.state)
            )
        if task.state is TaskState.CANCELLING and task.moves:
            self._stop_until_ended(task)
        return task

    def pause(self, task_id: str) -> Task:
        """Let a task stand still before its next step, until it is told to go on.

        Raises:
            NoSuchTask: there is no such task.
            NotPossibleNow: it has ended, or has no steps between which it could stand still.
            JournalError: the pause cannot be recorded.
        """
        task = self.get(task_id)
        if task.state.is_final or not task.can_pause:
            what = (
                f"task {task_id} has {task.state}"
                if task.state.is_final
                else f"{task.verb} has no steps to pause between"
            )
            hint = "nothing to do" if task.state.is_final else "cancel it, or wait for its end"
            raise NotPossibleNow(what, hint=hint, state=str(task.state))
        if task.goes_on.is_set():
            self._recorder.append("task-paused", {"task": task_id})
            task.goes_on.clear()
            task.add_event("state", detail="pause")
        return task

    def go_on(self, task_id: str) -> Task:
        """Let a paused task go on; one that is not paused goes on anyway.

        Raises:
            NoSuchTask: there is no such task.
            JournalError: it cannot be recorded.
        """
        task = self.get(task_id)
        if not task.goes_on.is_set():
            self._recorder.append("task-went-on", {"task": task_id})
            task.goes_on.set()
        return task

    def cancel_moving(self, reason: str) -> None:
        """Cancel every motion task, running or queued."""
        for task in self.all():
            if task.moves and task.ask_cancel(reason) and task.state is TaskState.CANCELLING:
                self._stop_until_ended(task)

    def subscribe(self, listener: Callable[[Task], None]) -> Callable[[], None]:
        """Call `listener` after each change of any task, from any thread; returns a function that ends this."""
        with self._lock:
            self._listeners.add(listener)
        return lambda: self._listeners.discard(listener)

    def close(self, *, timeout_s: float = 3.0) -> None:
        """Cancel all tasks and wait at most `timeout_s`; a second call does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        for task in self.all():
            if not task.state.is_final and task.ask_cancel("the service ends") and task.moves:
                self._quiet_stop()
        for lane in self._lanes.values():
            lane.shutdown(wait=False, cancel_futures=True)
        end_s = time.monotonic() + timeout_s
        for task in self.all():
            task.wait(max(0.0, end_s - time.monotonic()))

    def _run(self, task: Task, work: Work) -> None:
        try:
            if task.state is TaskState.QUEUED:  # recorded before anybody sees that it runs
                self._recorder.append("task-started", {"task": task.id})
            if not task.move_to(TaskState.RUNNING):
                self._record_end(task)  # cancelled while it waited
                return
            result = jsonable(work(TaskContext(task, self._folder / task.id)))
        except Cancelled as error:
            self._end(task, TaskState.CANCELLED, error=error)
        except CellError as error:
            self._end(task, TaskState.FAILED, error=error)
        except Exception as error:  # a defect of an operation ends its task, never the service
            log.exception("task %s failed by a defect", task.id)
            text = f"{task.verb} failed by a defect in the program: {type(error).__name__}: {error}"
            defect = Defect(text, hint="the log has the traceback; please report it")
            self._end(task, TaskState.FAILED, error=of_file(error) or defect)
        else:
            self._end(task, TaskState.SUCCEEDED, result=result)

    def _end(self, task: Task, state: TaskState, *, error: CellError | None = None, result: Any = None) -> None:
        if state is TaskState.CANCELLED and not task.cancel_asked.is_set():
            state = TaskState.FAILED  # the motion was cancelled, but not by a cancellation of the task
        task.result = result
        task.problem = problem_of(error) if error is not None else None
        # Recorded before it becomes visible, so that an end that a client has seen survives a power failure.
        unrecorded = self._record_end(task, state)
        if unrecorded is not None and state is TaskState.SUCCEEDED:
            task.problem, state = problem_of(unrecorded), TaskState.FAILED
        task.move_to(state)

    def _record_end(self, task: Task, state: TaskState | None = None) -> CellError | None:
        """Record the end of a task; returns the error if that was not possible."""
        ended = {"task": task.id, "state": str(state or task.state), "result": task.result, "problem": task.problem}
        ended |= {"fraction": task.fraction, "step": task.step, "started_s": task.started_s}
        try:
            self._recorder.append("task-ended", {**ended, "artefacts": jsonable(task.artefacts)})
        except CellError as error:
            level = logging.INFO if self._is_closed else logging.ERROR  # after closing, the next start reports it
            log.log(level, "the end of task %s was not recorded: %s", task.id, error)
            return error
        return None

    def _stop_until_ended(self, task: Task) -> None:
        self._quiet_stop()

        def repeat() -> None:
            while not task.wait(CANCEL_REPEAT_S):
                self._quiet_stop()

        threading.Thread(target=repeat, name=f"cancel-{task.id}", daemon=True).start()

    def _quiet_stop(self) -> None:
        try:
            self._stop_motion()
        except CellError as error:
            log.warning("stopping the motion of a cancelled task: %s", error)
        except Exception:  # repeat after any defect, because the arm may still move
            log.exception("stopping the motion of a cancelled task")

    def _with_key(self, key: str | None, verb: str, request: dict[str, Any]) -> Task | None:
        earlier = next((t for t in self._tasks.values() if key is not None and t.key == key), None)
        if earlier is not None and (earlier.verb, earlier.request) != (verb, request):
            raise InvalidRequest(
                "this Idempotency-Key was used for another request",
                hint="use a fresh key for a new request",
                task=earlier.id,
            )
        return earlier

    def _check_room(self, client: str | None) -> None:
        if self._is_closed:
            raise Busy("the service is ending", hint="wait for its restart")
        waiting = [task for task in self._tasks.values() if task.state is TaskState.QUEUED]
        queued, own = len(waiting), sum(client is not None and task.client == client for task in waiting)
        if queued >= self._max_queued:
            raise Busy(f"{queued} tasks wait already", hint="wait for one to end or cancel one", queued=queued)
        if 2 * own >= self._max_queued:
            raise Busy(f"{own} tasks of {client} wait already", hint="wait for one to end or cancel one", queued=own)

    def _forget_old(self) -> list[str]:
        ended = [task.id for task in self._tasks.values() if task.state.is_final]
        forgotten = ended[: max(0, len(ended) - self._keep)]
        for task_id in forgotten:
            del self._tasks[task_id]
        return forgotten

    def _remove_artefacts(self, task_ids: list[str]) -> None:
        for task_id in task_ids:
            shutil.rmtree(self._folder / task_id, ignore_errors=True)

    def _changed(self, task: Task) -> None:
        for listener in list(self._listeners):
            listener(task)
