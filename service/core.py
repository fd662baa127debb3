"""The service without HTTP: connects the processes, journal, lease, tasks and stored data of one cell."""

from __future__ import annotations

import fcntl
import logging
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from pydantic import BaseModel

from hal.caller import calling_as
from hal.config import Cell, DeviceSection
from hal.errors import CellError, DeviceUnavailable, InvalidRequest, LeaseError, Stopped
from hal.priorities import Priority, take_priority
from service.access.actor import actor
from service.access.keys import FILE as KEYS_FILE
from service.access.keys import KeyBook
from service.commissioning.places import AllowedPlaces
from service.commissioning.preflight import check_wires
from service.errors import NotPossibleNow
from service.knowledge.calibrations import Calibrations
from service.operations import Operation, OperationContext
from service.plant import Plant
from service.processes.device_slots import IN_MOTION
from service.processes.speed_desk import SpeedDesk
from service.processes.stop_desk import Records
from service.processes.supervisor import Supervisor
from service.rounds.cell import RunningCell
from service.tasks.earlier_runs import tasks_of_earlier_runs
from service.tasks.gate import GatedConnection
from service.tasks.journal import Journal
from service.tasks.journal_watch import JournalWatch
from service.tasks.lease import Command, LeaseDesk
from service.tasks.losses import Losses
from service.tasks.model import Task, TaskState
from service.tasks.store import TaskContext, TaskStore
from service.tasks.sub_leases import SubLease
from service.world_model import WorldModel

if TYPE_CHECKING:
    from service.processes.cell import CellRuntime
    from service.recording.session import RecordingSession

RECORDINGS = "recordings"  # folder below `runs_dir` of the files that clients may replay
LOOK_S = 0.05
NO_LEASE = Command()
NOTE_STOP_S = 0.01  # the stop port waits for the record before it answers
COMMIT_S = 2.0  # an answer waits no longer for a slow disk
log = logging.getLogger(__name__)


class Service:
    """Everything behind the HTTP front.

    Args:
        cell: the cell to run.
        operations: the operations by verb.
        runs_dir: folder for the reports of missions; tasks and journal are kept in `runs_dir/.service`.
        stop_listener, origins, inline, partial, replay: see `Supervisor`.
        record: file to record everything in, from before the start of the cell to the end of the service.
    """

    def __init__(
        self,
        cell: Cell,
        operations: Mapping[str, Operation],
        *,
        runs_dir: Path,
        stop_listener: socket.socket | None = None,
        origins: tuple[str, ...] = (),
        inline: bool = False,
        partial: bool = False,
        record: Path | None = None,
        replay: Callable[[], CellRuntime] | None = None,
    ) -> None:
        self.cell = cell
        self.operations = operations
        self.runs_dir = runs_dir
        self.world = WorldModel()
        self.calibrations = Calibrations.of_runs(runs_dir, cell)
        self.started_s = time.monotonic()
        self._allowed_places = AllowedPlaces.of(cell, runs_dir / RECORDINGS)
        state_dir = runs_dir / ".service"
        self.recording = None if record is None else self._record(record, inline)
        self.journal = Journal(state_dir / "journal.sqlite")
        self.plant = Plant(cell, state_dir, journal=self.journal, note=self.note, commit=self.commit)
        self.keys = book_of(runs_dir)
        self.supervisor = Supervisor(
            cell,
            stop_listener=stop_listener,
            origins=origins,
            inline=inline,
            runs_dir=runs_dir,
            partial=partial,
            records=Records(note=self.note, commit=self.commit),
            record=None if self.recording is None else self.recording.endpoint,
            replay=replay,
        )
        self.speed = SpeedDesk(self.supervisor.latch, state_dir / "reduced-speed", self.commit)
        self.losses = Losses(cell, stop=self.stop_quietly)
        self.journal_watch = JournalWatch(self.journal, self._on_no_record)
        recorder = self.journal if self.recording is None else self.recording.recorder(self.journal)
        self.tasks = TaskStore(state_dir / "tasks", recorder=recorder, stop_motion=self._stop_motion)
        if self.recording is not None:
            self.tasks.subscribe(self.recording.on_task)
        self.lease = LeaseDesk(
            ttl_s=cell.file.safety.lease_ttl_s,
            others=self.tasks.moving_for_others,
            report=self.note,
            commit=self.commit,
        )
        self.plant.keep_rounds(
            lambda is_active: RunningCell(
                supervisor=self.supervisor, lease=self.lease, tasks=self.tasks, is_active=is_active, submit=self._round
            )
        )
        self._is_closing = threading.Event()
        self._folder_lock = (state_dir / "lock").open("w")  # held until the process ends, even if it is killed
        self._is_alone = _is_alone(self._folder_lock)
        self._restore_tasks()

    def start(self) -> None:
        """Start the cell and wait until it is ready.

        Raises:
            CellError: the cell could not start.
        """
        self.note("service-start", {"cell": self.cell.name, "mode": self.cell.file.cell.mode})
        for watch in (self._watch_stop, self._watch_lease):
            threading.Thread(target=watch, name=watch.__name__, daemon=True).start()
        self.journal_watch.start()
        self.plant.start(keeps_rounds=self._is_alone)
        self.supervisor.start()

    def _restore_tasks(self) -> None:
        """Take over the tasks of earlier runs; with another service on the folder they are that one's, and were not aborted."""
        if not self._is_alone:
            log.warning(
                "another panelwright writes to %s too: tasks of earlier runs are not shown, and rounds do not begin here",
                self.runs_dir,
            )
            return
        for task in tasks_of_earlier_runs(self.journal):
            self.tasks.restore(task)
        self.tasks.sweep()

    def submit(
        self,
        verb: str,
        request: BaseModel,
        *,
        command: Command = NO_LEASE,
        key: str | None = None,
        is_followed: bool = False,
        client: str | None = None,
    ) -> Task:
        """Start the operation `verb` as a task.

        Args:
            is_followed: whether a client must follow a motion that it asks for without a lease; see `sub_leases`.
            client: the machine that asked for it.

        Raises:
            InvalidRequest: there is no such verb, or the request is not valid for this cell.
            LeaseError: another client holds the cell, or the command is old or came too late or too early.
            Stopped: the operation moves the arm, and the stop is latched.
            DeviceUnavailable: the cell is not running.
            Busy, JournalError: the task could not be accepted.
        """
        operation = self.operations.get(verb)
        if operation is None:
            raise InvalidRequest(f"there is no verb {verb!r}", hint=f"verbs: {', '.join(self.operations)}")
        operation.refuse(self.cell, request, self.supervisor.connection, self.world)
        moves = operation.may_move(request)
        holder = self._admit(command, key) if moves or operation.writes else None
        self._check_cell()
        latch = self.supervisor.latch.state()
        if moves and latch.is_latched:
            raise stopped(latch.source)
        observe = partial(self.plant.observations.of_task, verb=verb, asked_by=actor() or holder or "")
        asked = request.model_dump(mode="json")
        sub = self.lease.lend(is_own=is_followed and holder is None) if moves else None
        work = self._work(operation, request, command=command, observe=observe, sub=sub, stops_seen=latch.count)
        start = partial(self.tasks.start, holder=holder, key=key, sub_lease=sub, client=client)
        task = start(verb, asked, work, moves=moves, can_pause=operation.can_pause and moves)
        if moves:
            self._confirm(task, command.token)
        return task

    def _work(
        self,
        operation: Operation,
        request: BaseModel,
        *,
        command: Command,
        observe: Callable[..., Any],
        sub: SubLease | None,
        stops_seen: int,
    ) -> Callable[[TaskContext], Any]:
        """Return the work of a task, which moves nothing after a stop that is newer than `stops_seen`."""

        def work(task: TaskContext) -> Any:
            def check_may_move() -> None:
                task.check_cancelled()
                self._check_not_stopped_since(stops_seen)
                if sub is not None:
                    sub.check()

            self.lease.check_in_time(command)  # again, because it may have waited in the queue
            if sub is not None:
                task.end_when(lambda: self._check_not_stopped_since(stops_seen))
            cell, stop = self.calibrations.applied(), self.supervisor.stop
            after = self.losses.followed(task.id, lambda: self._check_not_stopped_since(stops_seen))
            connection = GatedConnection(self.supervisor.connection, check_may_move, cell=cell, stop=stop, after=after)
            observer = observe(task=task.id, cell_now_s=connection.clock.now_s)
            context = OperationContext(
                connection=connection, task=task, runs_dir=self.runs_dir, world=self.world, observer=observer
            )
            with calling_as(f"{operation.name} {task.id}"):
                return operation.run(context, request)

        return work

    def _admit(self, command: Command, key: str | None) -> str | None:
        """Ask the lease, and return its holder; the number of a command that is repeated with its key counts once."""
        is_repeat = key is not None and self.tasks.has_key(key)
        return self.lease.check(command.token) if is_repeat else self.lease.admit(command)

    def _confirm(self, task: Task, lease_token: str | None) -> None:
        """Check the lease again, because a client that took it over before the task was listed could not cancel the task."""
        sub = task.sub_lease
        try:
            self.lease.check(lease_token)
            if sub is not None:
                sub.on_loss = lambda reason: self._on_client_lost(task, reason)
                sub.is_over = lambda: task.state.is_final
                sub.check()
        except LeaseError as error:
            with suppress(NotPossibleNow):
                self.tasks.cancel(task.id, reason=error.what)
            raise

    def _round(self, mission: str, key: str) -> Task:
        """Start the mission of a round."""
        request = self.operations["missions"].request_model.model_validate({"file": mission})
        return self.submit("missions", request, key=key)

    def swap_device(self, name: str, section: DeviceSection) -> None:
        """Use another driver or other options for a device until the service ends; see `service.processes.device_slots`.

        Raises:
            DeviceUnavailable: the cell is not running.
            InvalidRequest: the options name a port or host that this cell may not use.
            DeviceError, ConfigError: the new device did not connect; the old one is kept.
            MotionRefused, Busy: a motion or another swap is running.
            JournalError: it cannot be recorded.
        """
        self._check_cell()
        self._allowed_places.check(name, section.options)
        check_wires(self.cell, {name: section})
        started_s = time.monotonic()
        told = {"device": name, "before": self.cell.file.devices[name].driver, "driver": section.driver}
        self.commit("device-swap", told)
        try:
            self.supervisor.swap(name, section)
        except CellError as error:
            self.note("device-swap-failed", {**told, "why": error.what})
            raise
        self.commit("device-swapped", {**told, "seconds": round(time.monotonic() - started_s, 3)})

    def lacking(self) -> dict[str, tuple[str, ...]]:
        """Return for each verb the missing devices that it may need; empty for a verb that can do all of its work."""
        return {verb: self._lacking_for(operation) for verb, operation in self.operations.items()}

    def lost_without(self, device: str) -> tuple[str, ...]:
        """Return the verbs that may need the missing device `device`."""
        return tuple(verb for verb, devices in self.lacking().items() if device in devices)

    def _lacking_for(self, operation: Operation) -> tuple[str, ...]:
        kinds = {*operation.needs, *(IN_MOTION if operation.moves else ())}
        devices = self.cell.file.devices
        return tuple(one.device for one in self.supervisor.missing if devices[one.device].kind in kinds)

    def close(self) -> None:
        """Stop the arm, end tasks and processes, close the journal; takes a bounded time and is idempotent."""
        if self._is_closing.is_set():
            return
        self._is_closing.set()
        self.stop_quietly("the service ends")
        self.tasks.close()
        self.journal_watch.close()
        self.supervisor.close()
        self.note("service-end", {})
        self.plant.close()
        self.journal.close()
        if self.recording is not None:
            self.recording.close()
        self._folder_lock.close()

    def stop_quietly(self, source: str) -> None:
        """Latch the stop without raising, for use while the service closes."""
        try:
            self.supervisor.stop(source)
        except Exception:  # closing goes on after any error
            log.exception("latching the stop")

    def _check_cell(self) -> None:
        if self.supervisor.is_ready:
            return
        if self.supervisor.problem is not None:
            raise self.supervisor.problem
        raise DeviceUnavailable("the cell is starting", hint="GET /readyz shows when it is ready", device="cell")

    def _check_not_stopped_since(self, count: int) -> None:
        """Raise `Stopped` when the latch's count has risen: a stop that was reset since leaves no other trace."""
        if self.supervisor.latch.state().count != count:
            raise Stopped(
                "the software stop was pressed after this task was asked for",
                hint="look at the cell, then command again: a reset alone moves nothing",
            )

    def _stop_motion(self) -> None:
        with self.losses.cancelling() as may_end:
            if may_end and self.supervisor.is_ready:
                self.supervisor.connection.mover.cancel()

    def _on_client_lost(self, task: Task, why: str) -> None:
        """End the motion of a client that is lost, in the way that the cell file chooses."""
        is_moving = task.state is TaskState.RUNNING
        with self.losses.of_client(task.id, why) if is_moving else nullcontext():
            self.tasks.cancel(task.id, reason=why)

    def _on_no_record(self, why: str) -> None:
        """Latch the stop, because nothing may move without a record."""
        if not self.supervisor.latch.is_set():
            log.error("%s; the stop is latched", why)
            self.stop_quietly(why)

    def _watch_stop(self) -> None:
        while not self._is_closing.wait(NOTE_STOP_S):
            self.supervisor.note_stop()

    def _watch_lease(self) -> None:
        """End the lease at the moment at which its heartbeat is overdue; a thread of its own, so that no record delays it."""
        take_priority(Priority.ANSWERS)
        while not self._is_closing.wait(min(LOOK_S, self.lease.soonest_s())):
            self.lease.expire()

    def note(self, kind: str, data: dict[str, Any]) -> None:
        """Write an entry to the journal without waiting for the disk."""
        if self.recording is not None:
            self.recording.note(kind, data)
        try:
            self.journal.note(kind, data)
        except CellError as error:
            log.error("not recorded: %s %s: %s", kind, data, error)

    def commit(self, kind: str, data: dict[str, Any]) -> None:
        """Write an entry to the journal and return when it is on disk, for what is acknowledged to a client.

        Raises:
            JournalError: it could not be written.
        """
        if self.recording is not None:
            self.recording.note(kind, data)
        self.journal.append(kind, data, timeout_s=COMMIT_S)

    def _record(self, path: Path, inline: bool) -> RecordingSession:
        from service.recording.session import RecordingSession

        return RecordingSession.start(path, self.cell, calibrations=self.calibrations, inline=inline)


def book_of(runs_dir: Path) -> KeyBook:
    """Return the keys of the service with this folder."""
    return KeyBook(runs_dir / ".service" / KEYS_FILE)


def _is_alone(lock: IO[str]) -> bool:
    """Take the lock of a folder; returns False when another service holds it."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def stopped(source: str) -> Stopped:
    """Return the error for a motion while the stop is latched."""
    return Stopped(
        f"the software stop is latched ({source})", hint="look at the cell, then POST /v1/stop/reset and command again"
    )
