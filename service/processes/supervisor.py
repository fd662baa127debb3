"""Starts, watches and restarts the stop process and the cell process, and ends both when it ends."""

from __future__ import annotations

import contextlib
import logging
import secrets
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal.config import Cell, DeviceSection
from hal.errors import CellError, DeviceTimeout, DeviceUnavailable
from service.processes.cell import MISSING, CellOrder, CellRuntime, error_from_line, note_from_line
from service.processes.child import Child
from service.processes.connection import CellConnection, LocalConnection, RemoteConnection
from service.processes.latch import Beat, Latch, LatchState
from service.processes.stop_desk import Records, StopDesk, StopHost
from service.processes.stop_host import InlineStop, ProcessStop
from service.recording.endpoint import Endpoint

START_TIMEOUT_S = 400.0  # the first start compiles the control kernels, which takes minutes on a busy machine
MAX_RESTARTS = 3
BEAT_TIMEOUT_S = 10.0  # numba's compiler can hold the interpreter lock for seconds, which delays the beat thread
WATCH_S = 0.1
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
        self._folder = Path(tempfile.mkdtemp(prefix="panelwright-"))
        self.latch = Latch.create(self._folder / "latch")
        self._beat = Beat(self._folder / "beat")
        self._stop: StopHost = (
            InlineStop(self.latch, stop_listener, origins)
            if inline
            else ProcessStop(self.latch, self._folder / "latch", stop_listener, origins, report=records.note)
        )
        self._remote = RemoteConnection(cell)
        self._local: LocalConnection | None = None
        self._child: Child | None = None
        self._restarts = 0
        self._swapped: dict[str, DeviceSection] = {}
        self._problem: CellError | None = None
        self._is_ready = threading.Event()
        self._is_closing = threading.Event()
        self._lock = threading.RLock()
        self._desk = StopDesk(self.latch, self._stop, records)

    @property
    def connection(self) -> CellConnection:
        """The connection to the cell; its devices are unavailable while the cell process is down."""
        return self._local or self._remote

    @property
    def folder(self) -> Path:
        """Runtime folder with latch, heartbeat and sockets; only this user has access."""
        return self._folder

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

    def start(self) -> None:
        """Start the cell and wait until it is ready; in a simulated cell, reset the latch afterwards.

        Raises:
            CellError: the cell could not start.
        """
        begun = self.latch.state().count
        try:
            self._start_inline() if self.inline else self._start_child()
        except CellError as error:
            self._problem = error
            raise
        if self.cell.file.cell.mode == "sim" and self.latch.state().count == begun:  # nobody stopped it meanwhile
            self.reset("supervisor: a simulated cell starts ready", seen_count=begun)
        if not self.inline:
            threading.Thread(target=self._watch, name="watch-cell", daemon=True).start()

    def stop(self, source: str) -> LatchState:
        """Latch the software stop; see `StopDesk.stop`."""
        return self._desk.stop(source)

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
        return (
            ProcessHealth(
                name="cell",
                pid=child.pid if child is not None else None,
                is_alive=alive,
                restarts=self._restarts,
                detail=detail,
            ),
            ProcessHealth(name="stop", pid=self._stop.pid, is_alive=self._stop.is_alive(), restarts=0),
        )

    def close(self) -> None:
        """Latch the stop, then end all processes; takes a bounded time and is idempotent."""
        if self._is_closing.is_set():
            return
        self._is_closing.set()
        self._stop.stop("the service ends")
        self._is_ready.clear()
        if self._local is not None:
            self._local.close()
        with self._lock:
            child = self._child
        if child is not None:
            child.end()
        self._remote.close()
        self._stop.close()
        self.latch.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _start_inline(self) -> None:
        runtime = self._replay() if self._replay is not None else self._start_runtime()
        self._local = LocalConnection(self.cell, runtime.objects, close=runtime.close)
        self._is_ready.set()

    def _start_runtime(self) -> CellRuntime:
        return CellRuntime.start(
            self.cell,
            is_latched=self.latch.is_set,
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
        self._problem = None
        self._is_ready.set()
        self._report("cell-ready", {"pid": child.pid, "seconds": round(time.monotonic() - child.started_s, 3)})

    def _note(self, kind: str, data: dict[str, Any]) -> None:
        """Handle a note that the cell process sends."""
        if kind == MISSING:
            self._missing[data["device"]] = MissingDevice(**data)
        self._report(kind, data)

    def _order(self) -> CellOrder:
        """Return the order for the next cell process, with a new address and key so that old connections cannot reach it."""
        return CellOrder(
            cell_path=str(self.cell.path),
            seed=self.cell.file.cell.seed,
            latch_path=str(self._folder / "latch"),
            beat_path=str(self._folder / "beat"),
            address=str(self._folder / f"cell-{secrets.token_hex(4)}.sock"),
            authkey=secrets.token_hex(32),
            runs_dir=None if self._runs_dir is None else str(self._runs_dir.absolute()),
            partial=self._partial,
            swapped={name: section.model_dump(mode="json") for name, section in self._swapped.items()},
            record=None if self._record is None else (self._record.address, self._record.key),
        )

    def _begin_child(self, on_line: Callable[[str], None], on_exit: Callable[[int], None]) -> Child:
        with self._lock:
            if self._is_closing.is_set():
                raise DeviceUnavailable("the service is ending", hint="start it again", device="cell")
            self._child = Child("service.processes.cell", on_line=on_line, on_exit=on_exit)
            return self._child

    def _watch(self) -> None:
        """Watch the cell process until the end; when it dies or hangs, latch the stop, clean up and restart it."""
        while not self._is_closing.wait(WATCH_S):
            child = self._child
            assert child is not None  # noqa: S101 - narrowing: the watch begins after the start
            if child.is_alive() and self._beat.age_s() < BEAT_TIMEOUT_S:
                continue
            self._bury(child)
            if self._restarts >= MAX_RESTARTS:
                log.error("the cell died %d times and is not restarted", self._restarts + 1)
                return
            self._restarts += 1
            with contextlib.suppress(CellError):
                self._revive()

    def _bury(self, child: Child) -> None:
        why = "died" if not child.is_alive() else f"hung: no sign of life for {self._beat.age_s():.1f} s"
        self._is_ready.clear()
        self._stop.stop(f"the cell process {why}")
        child.kill()  # also ends the process of its simulated world
        self._remote.detach()
        self._problem = DeviceUnavailable(
            f"the cell process {why}",
            hint="it is restarted up to three times; the stop stays latched until a reset",
            device="cell",
        )
        log.error("the cell process (pid %d) %s", child.pid, why)
        self._report("cell-down", {"pid": child.pid, "why": why})

    def _revive(self) -> None:
        try:
            self._start_child()
        except CellError as error:
            self._problem = error
            log.error("the cell did not restart: %s", error.for_people())
            self._report("cell-restart-failed", {"why": error.what})
            raise
