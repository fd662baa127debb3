"""Starts, watches and restarts the stop process and the cell process, and ends both when it ends."""

from __future__ import annotations

import logging
import secrets
import shutil
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal import pauses
from hal.config import Cell, DeviceSection
from hal.errors import CellError, DeviceTimeout, DeviceUnavailable
from hal.motion import CellSignals
from service.processes.beat import SILENCE_S, Beat, every_beat
from service.processes.cell import CellRuntime
from service.processes.cell_lines import BLOCKED, LOST, MISSING, CellOrder, error_from_line, note_from_line
from service.processes.child import Child
from service.processes.connection import CellConnection, LocalConnection, RemoteConnection
from service.processes.early_cell import EarlyCell, begin_cell
from service.processes.latch import LATCH, Latch, LatchState, StopLevel
from service.processes.runtime_folder import RuntimeFolder
from service.processes.stop_desk import Records, StopDesk, StopHost
from service.processes.stop_host import InlineStop, ProcessStop
from service.recording.endpoint import Endpoint

START_TIMEOUT_S = 400.0  # the first start compiles the control kernels, which takes minutes on a busy machine
PAUSES_S = (0.0, 0.0, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)  # before a restart, by the number of short lives in a row
SHORT_LIFE_S = 2.0  # a cell that ends so soon after it was ready will probably do so again
GIVE_UP_S = 2.5  # a cell that was lost and has not ended is killed after this time
NO_RECORDS = Records()
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessHealth:
    """The state of one supervised process."""

    name: str
    pid: int | None
    is_alive: bool
    restarts: int
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class MissingDevice:
    """A device that is not connected while the cell runs, with the cause and a remedy."""

    device: str
    why: str
    hint: str


class Supervisor:
    """Starts and owns the processes of a cell.

    Args:
        cell: the cell to start.
        stop_listener: bound socket of the stop port; None for no port (in tests).
        origins: web origins that may read answers of the stop port.
        inline: whether to run the cell and the stop port in this process.
        runs_dir: folder of the calibration records found here; None to use only those of the cell file.
        partial: whether to go on without devices that do not connect; see `missing`.
        records: where starts, unexpected ends, stops and resets are recorded.
        record: the recorder to which the cell tells every call; None to record nothing.
        replay: starts the recorded cell in place of the devices of `cell`; needs `inline`.
    """

    def __init__(
        self,
        cell: Cell,
        *,
        stop_listener: socket.socket | None = None,
        origins: tuple[str, ...] = (),
        inline: bool = False,
        runs_dir: Path | None = None,
        partial: bool = False,
        records: Records = NO_RECORDS,
        record: Endpoint | None = None,
        replay: Callable[[], CellRuntime] | None = None,
    ) -> None:
        self._record = record
        self._replay = replay
        self.cell = cell
        self.inline = inline
        self._runs_dir = runs_dir
        self._partial = partial
        self._report = records.note
        self._missing: dict[str, MissingDevice] = {}
        self._runtime = RuntimeFolder()
        self.latch = Latch.create(self.folder / LATCH)
        self._own_beat, self._cell_beat = Beat(self.folder, "service"), Beat(self.folder, "cell")
        self._own_beat.beat()
        self._end_of_pauses = pauses.tell(self._own_beat.pause)
        lost = cell.file.safety.service_lost
        self._stop: StopHost = (
            InlineStop(self.latch, stop_listener, origins)
            if inline
            else ProcessStop(self.latch, self.folder, stop_listener, origins, report=records.note, service_lost=lost)
        )
        self._remote = RemoteConnection(cell)
        self._local: LocalConnection | None = None
        self._child: Child | None = None
        self._early: EarlyCell | None = None
        self._restarts = 0
        self._short_lives = 0
        self._lost_since_s: float | None = None
        self._how_lost = self._why_lost = ""
        self._ready_at_s = time.monotonic()
        self._is_watched = False
        self._must_bury = threading.Event()
        self._swapped: dict[str, DeviceSection] = {}
        self._problem: CellError | None = None
        self._is_ready = threading.Event()
        self._is_closing = threading.Event()
        self._lock = threading.RLock()
        self._desk = StopDesk(self.latch, self._stop, records)
        self._watching = threading.Event() if inline else every_beat(self._look, name="heartbeat")

    @property
    def connection(self) -> CellConnection:
        """The connection to the cell; its devices are unavailable while the cell process is down."""
        return self._local or self._remote

    @property
    def folder(self) -> Path:
        """Runtime folder with latch, heartbeat and sockets; only this user has access."""
        return self._runtime.path

    @property
    def _temporary(self) -> Path:
        """Folder for the temporary files of the cell process."""
        return self.folder / "cell"

    @property
    def is_ready(self) -> bool:
        """Whether the cell is running and ready."""
        return self._is_ready.is_set()

    @property
    def problem(self) -> CellError | None:
        """The error that keeps the cell from running, if it is known."""
        return self._problem

    @property
    def missing(self) -> tuple[MissingDevice, ...]:
        """Devices that have not connected, neither at the cell's start nor later."""
        return tuple(self._missing.values())

    def begin_with(self, early: EarlyCell) -> None:
        """Use a cell process that runs already as the first one, and own it from now on."""
        self._early = early

    def start(self) -> None:
        """Start the cell and wait until it is ready; in a simulated or replayed cell, reset the latch afterwards.

        Raises:
            CellError: the cell could not start.
        """
        begun = self.latch.state().count
        try:
            self._start_inline() if self.inline else self._start_child()
        except CellError as error:
            self._problem = error
            raise
        moves_nothing_real = self.cell.file.cell.mode == "sim" or self._replay is not None
        if moves_nothing_real and self.latch.state().count == begun:  # nobody stopped it meanwhile
            self.reset("supervisor: a simulated cell starts ready", seen_count=begun)
        if not self.inline:
            self._is_watched = True
            threading.Thread(target=self._watch, name="watch-cell", daemon=True).start()

    def stop(self, source: str, level: StopLevel = StopLevel.OFF) -> LatchState:
        """Latch the software stop; see `StopDesk.stop`."""
        return self._desk.stop(source, level)

    def note_stop(self) -> None:
        """Record a stop that was made at the stop port; call it periodically."""
        self._desk.note_stop()

    def reset(self, source: str, *, seen_count: int | None) -> LatchState:
        """Clear the latch; see `StopDesk.reset`."""
        return self._desk.reset(source, seen_count=seen_count)

    def swap(self, name: str, section: DeviceSection) -> None:
        """Replace the device called `name`, also for later restarts of the cell process; see `device_slots.Swapper`."""
        (self._local or self._remote).swap(name, section)
        self._swapped[name] = section
        self._missing.pop(name, None)

    def processes(self) -> tuple[ProcessHealth, ...]:
        """Return the state of the supervised processes."""
        child = self._child
        alive = self._local is not None or (child is not None and child.is_alive())
        detail = self._problem.what if self._problem is not None else ""
        pid = None if child is None else child.pid
        stop, can_stop = self._stop, self._stop.is_alive()
        no_stop = "" if can_stop else "the stop process is being started"
        return (
            ProcessHealth(name="cell", pid=pid, is_alive=alive, restarts=self._restarts, detail=detail),
            ProcessHealth(name="stop", pid=stop.pid, is_alive=can_stop, restarts=stop.restarts, detail=no_stop),
        )

    def close(self) -> None:
        """Latch the stop, then end all processes; takes a bounded time and is idempotent."""
        if self._is_closing.is_set():
            return
        self._is_closing.set()
        self._must_bury.set()  # wakes the thread that waits for it
        self._stop.stop("the service ends")
        self._is_ready.clear()
        if self._local is not None:
            self._local.close()
        with self._lock:
            child = self._child
        if child is not None:
            child.end()
        if self._early is not None:
            self._early.close()
        self._remote.close()
        self._watching.set()
        self._end_of_pauses()
        self._stop.close()
        self.latch.close()
        self._runtime.close()

    def _start_inline(self) -> None:
        runtime = self._replay() if self._replay is not None else self._start_runtime()
        self._local = LocalConnection(self.cell, runtime.objects, close=runtime.close)
        self._is_ready.set()

    def _start_runtime(self) -> CellRuntime:
        return CellRuntime.start(
            self.cell,
            is_latched=self.latch.is_set,
            signals=CellSignals(is_reduced=self.latch.is_reduced, keeps_power=self.latch.keeps_power),
            runs_dir=self._runs_dir,
            partial=self._partial,
            report=self._note,
            record=self._record,
        )

    def _start_child(self) -> None:
        from hal.host import connect

        answered = threading.Event()
        errors: list[CellError] = []

        def on_line(line: str) -> None:
            note = note_from_line(line)
            if note is not None:
                self._note(*note)
                return
            if line.startswith("error "):
                errors.append(error_from_line(line))
            answered.set()

        def on_exit(code: int) -> None:
            if not errors:
                text = f"the cell process ended with code {code}"
                errors.append(DeviceUnavailable(text, hint="see its last messages in the log above", device="cell"))
            answered.set()

        self._missing.clear()
        self._why_lost = ""
        order = self._order()
        child = self._begin_child(on_line, on_exit)
        child.write_line(order.to_line())
        if not answered.wait(START_TIMEOUT_S):
            errors.append(
                DeviceTimeout(
                    f"the cell was not ready in {START_TIMEOUT_S:.0f} s",
                    hint="a driver may hang; `panelwright doctor` tries each device",
                    device="cell",
                )
            )
        if errors:
            child.end(grace_s=1.0)
            raise errors[0]
        clock = connect(order.address, bytes.fromhex(order.authkey), "cell.clock")
        self._remote.attach(lambda name: connect(order.address, bytes.fromhex(order.authkey), name, clock=clock))
        self._remote.open()
        self._problem = None
        self._ready_at_s = time.monotonic()
        self._is_ready.set()
        self._report("cell-ready", {"pid": child.pid, "seconds": round(time.monotonic() - child.started_s, 3)})

    def _note(self, kind: str, data: dict[str, Any]) -> None:
        """Handle a note that the cell process sends."""
        if kind == MISSING:
            self._missing[data["device"]] = MissingDevice(**data)
        if kind == LOST:
            self._why_lost = data["why"]
        if kind == BLOCKED:
            self.stop(data["why"])
        self._report(kind, data)

    def _order(self) -> CellOrder:
        """Return the order for the next cell process, with a new address and key so that old connections cannot reach it."""
        return CellOrder(
            cell_path=str(self.cell.path),
            seed=self.cell.file.cell.seed,
            folder=str(self.folder),
            address=str(self.folder / f"cell-{secrets.token_hex(4)}.sock"),
            authkey=secrets.token_hex(32),
            runs_dir=None if self._runs_dir is None else str(self._runs_dir.absolute()),
            partial=self._partial,
            service_lost=self.cell.file.safety.service_lost,
            swapped={name: section.model_dump(mode="json") for name, section in self._swapped.items()},
            record=None if self._record is None else (self._record.address, self._record.key),
        )

    def _begin_child(self, on_line: Callable[[str], None], on_exit: Callable[[int], None]) -> Child:
        with self._lock:
            if self._is_closing.is_set():
                raise DeviceUnavailable("the service is ending", hint="start it again", device="cell")
            if self._early is not None and self._child is None:
                self._child = self._early.take(on_line, on_exit)
            else:
                self._temporary.mkdir(exist_ok=True)
                self._child = begin_cell(self._temporary, on_line, on_exit)
            return self._child

    def _look(self) -> None:
        """Give the heartbeat of the service, and look at those of the stop process and the cell; 50 times a second."""
        self._own_beat.beat()
        self._stop.look()
        child, now_s = self._child, time.monotonic()
        if not self._is_watched or child is None or self._is_closing.is_set():
            return
        why = self._cell_beat.lost(silence_s=SILENCE_S) if child.is_alive() else "has ended"
        if why is None:
            if self._lost_since_s is not None:  # it goes on, but the stop stays latched
                self._lost_since_s = None
                self._is_ready.set()
            return
        if self._lost_since_s is None:
            self._lost_since_s = now_s
            self._is_ready.clear()
            self._how_lost = why
            self._stop.stop(f"the cell process {why}")
        if not child.is_alive() or now_s - self._lost_since_s > GIVE_UP_S:
            self._is_watched = False  # until it is started again
            self._must_bury.set()

    def _watch(self) -> None:
        """Clean up after each cell process that was lost and start it again, until the end."""
        while True:
            self._must_bury.wait()
            self._must_bury.clear()
            child = self._child
            if self._is_closing.is_set() or child is None:
                return
            self._bury(child)
            is_short = time.monotonic() - self._ready_at_s < SHORT_LIFE_S
            self._short_lives = self._short_lives + 1 if is_short else 0
            self._start_again()

    def _start_again(self) -> None:
        """Start the cell, as often as it takes, with longer and longer pauses."""
        while not self._is_closing.wait(PAUSES_S[min(self._short_lives, len(PAUSES_S) - 1)]):
            self._restarts += 1
            try:
                self._start_child()
            except CellError as error:
                self._problem = error
                self._short_lives += 1
                log.error("the cell did not restart: %s", error.for_people())
                self._report("cell-restart-failed", {"why": error.what})
            else:
                self._lost_since_s, self._is_watched = None, True
                return

    def _bury(self, child: Child) -> None:
        child.kill()  # also ends the process of its simulated world
        child.hear_last_words()
        why = self._why_lost or f"the cell process {self._how_lost}"
        self._remote.detach()
        self._problem = DeviceUnavailable(
            f"{why}; the cell is started again",
            hint="wait until GET /readyz says that it is ready; the stop stays latched until a reset",
            device="cell",
        )
        log.error("the cell process (pid %d) is lost: %s", child.pid, why)
        self._report("cell-down", {"pid": child.pid, "why": why})
        shutil.rmtree(self._temporary, ignore_errors=True)
