"""Runs the stop port for the service, in its own process or in a thread of this process."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hal.config import LossAction
from hal.errors import ConfigError, MotionRefused
from service.processes.beat import SILENCE_S, Beat
from service.processes.child import Child
from service.processes.latch import UNREADABLE, Latch, LatchState, StopLevel
from service.processes.stop import StopServer

MID_WRITE_S = 0.02  # a latch that is unreadable for longer has lost its writer; a stop waits no longer for it
STOP_ANSWER_S = 0.5  # after this, the latch is set from this process
RESET_ANSWER_S = 5.0  # generous, because a busy machine answers late
READY_S = 20.0
LOST_S = 0.5  # a stop process that gives no heartbeat for so long after it was noticed is killed and started again
PAUSES_S = (0.0, 0.0, 0.5, 1.0, 2.0)  # before a restart, by the number of short lives in a row
SHORT_LIFE_S = 10.0
log = logging.getLogger(__name__)


class InlineStop:
    """Runs the stop port in a thread of this process, for tests and debugging."""

    def __init__(self, latch: Latch, listener: socket.socket | None, origins: tuple[str, ...]) -> None:
        self._latch = latch
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="stop-port", daemon=True)
        self._thread.start()
        self._server: asyncio.Server | None = None
        if listener is not None:
            start = StopServer(latch, origins).start(listener)
            self._server = asyncio.run_coroutine_threadsafe(start, self._loop).result(READY_S)

    def stop(self, source: str, level: StopLevel = StopLevel.OFF) -> LatchState:
        """Latch the stop."""
        return self._latch.set(source, level)

    def reset(self, source: str, *, seen_count: int) -> bool:
        """Clear the latch unless it was set again after `seen_count`."""
        return self._latch.reset(source, seen_count=seen_count)

    def is_alive(self) -> bool:
        """Whether its thread is running."""
        return self._thread.is_alive()

    def look(self) -> None:
        """Do nothing, because there is no other process."""

    @property
    def restarts(self) -> int:
        """Zero, because it is not restarted."""
        return 0

    @property
    def pid(self) -> int | None:
        """None, because it has no process of its own."""
        return None

    def close(self) -> None:
        """End the thread and close the port; a second call does nothing."""
        if not self._thread.is_alive():
            return
        ended = asyncio.run_coroutine_threadsafe(self._end(), self._loop)
        with contextlib.suppress(TimeoutError):
            ended.result(1.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(1.0)

    async def _end(self) -> None:
        if self._server is not None:
            self._server.close()
        serving = asyncio.all_tasks() - {asyncio.current_task()}
        for task in serving:
            task.cancel()
        await asyncio.gather(*serving, return_exceptions=True)


class ProcessStop:
    """Runs the stop process and restarts it when it dies or hangs; the latch stays set, so nothing can move.

    Args:
        folder: runtime folder of the service, with the latch and the heartbeats.
        report: called for each loss of the process.
        silence_s: see `Beat.lost`.
        service_lost: what the process does when it loses this one; see the cell file.
    """

    def __init__(
        self,
        latch: Latch,
        folder: Path,
        listener: socket.socket | None,
        origins: tuple[str, ...],
        *,
        report: Callable[[str, dict[str, Any]], None],
        silence_s: float = SILENCE_S,
        service_lost: LossAction = "stop",
    ) -> None:
        self._latch = latch
        self._folder = folder
        self._beat = Beat(folder, "stop")
        self._silence_s = silence_s
        self._lost_since_s: float | None = None
        self._short_lives = 0
        self._listener = listener if listener is not None else _any_port()
        self._origins = origins
        self._service_lost = service_lost
        self._report = report
        self._restarts = 0
        self._is_closing = threading.Event()
        self._is_ready = threading.Event()
        self._child = self._begin()

    def lost(self) -> str | None:
        """Return how the stop process was lost, as in "has ended"; None while it lives or starts."""
        if not self._child.is_alive():
            return "has ended"
        return self._beat.lost(silence_s=self._silence_s) if self._is_ready.is_set() else None

    def look(self) -> None:
        """Latch the stop when the stop process was lost, and later kill it; called many times a second by one thread."""
        why, now_s = self.lost(), time.monotonic()
        if why is None or self._is_closing.is_set():
            self._lost_since_s = None
            return
        if self._lost_since_s is None:
            self._lost_since_s = now_s
            self._latch.set(f"the stop process {why}")  # from here, because it cannot
            log.error("the stop process %s; the stop is latched", why)
            self._report("stop-process-lost", {"pid": self._child.pid, "why": why})
        if now_s - self._lost_since_s > LOST_S:
            self._child.kill()  # `_exited` starts it again

    def stop(self, source: str, level: StopLevel = StopLevel.OFF) -> LatchState:
        """Latch the stop through the stop process, or directly when that does not answer."""
        before = self._readable(MID_WRITE_S)
        command = "hold" if level is StopLevel.HOLD else "stop"
        is_told = self._child.is_alive() and self._child.write_line(f"{command} {_line(source)}")
        if before == UNREADABLE or not (is_told and self._has_changed(before.count, STOP_ANSWER_S)):
            self._latch.set(source, level)
        return self._latch.state()

    def reset(self, source: str, *, seen_count: int) -> bool:
        """Ask the stop process to clear the latch; it refuses if the latch was set again after `seen_count`.

        Raises:
            MotionRefused: it does not run, or did not answer in time; a late answer clears nothing.
        """
        if self._readable(STOP_ANSWER_S).count != seen_count:
            return False
        if not self._is_ready.wait(RESET_ANSWER_S):
            raise MotionRefused(
                "the stop process is down and is being started again, so the stop stays latched",
                hint="wait until GET /readyz says that the cell is running, then reset again",
            )
        is_told = self._child.write_line(f"reset {seen_count} {_line(source)}")
        if not (is_told and self._has_changed(seen_count, RESET_ANSWER_S)):
            self._latch.set("a reset without an answer")  # raises the count, so that a late reset is refused
            raise MotionRefused(
                "the stop process did not answer, so the stop stays latched",
                hint="look at the cell, then reset again; is the machine overloaded?",
            )
        now = self._readable(STOP_ANSWER_S)
        return not now.is_latched and now.count == seen_count + 1

    def is_alive(self) -> bool:
        """Whether the process has said that it is ready, is running and gives its heartbeat."""
        return self._is_ready.is_set() and self.lost() is None

    @property
    def restarts(self) -> int:
        """How often the process was started again."""
        return self._restarts

    @property
    def pid(self) -> int | None:
        """Process id of the stop process."""
        return self._child.pid

    def close(self) -> None:
        """End the process; it latches the stop before it ends."""
        self._is_closing.set()
        self._child.end(grace_s=1.0)
        self._listener.close()

    def _begin(self) -> Child:
        arguments = ["--fd", str(self._listener.fileno()), "--folder", str(self._folder)]
        arguments += ["--silence", str(self._silence_s), "--service-lost", self._service_lost]
        for origin in self._origins:
            arguments += ["--origin", origin]
        return Child(
            "service.processes.stop",
            arguments,
            pass_fds=[self._listener.fileno()],
            on_line=lambda _line: self._is_ready.set(),
            on_exit=self._exited,
        )

    def _exited(self, code: int) -> None:
        """Latch the stop and start the process again; called once for each process that ended."""
        if self._is_closing.is_set():
            return
        self._is_ready.clear()
        self._latch.set("the stop process died")
        log.error("the stop process died with code %d; the stop is latched", code)
        self._report("stop-process-down", {"code": code})
        is_short = time.monotonic() - self._child.started_s < SHORT_LIFE_S
        self._short_lives = min(self._short_lives + 1, len(PAUSES_S) - 1) if is_short else 0
        if not self._is_closing.wait(PAUSES_S[self._short_lives]):
            self._restarts += 1
            self._child = self._begin()
        if self._is_closing.is_set():
            self._child.end(grace_s=0.0)

    def _has_changed(self, count: int, within_s: float) -> bool:
        end_s = time.monotonic() + within_s
        pause = threading.Event()
        while time.monotonic() < end_s:
            now = self._latch.state()
            if now != UNREADABLE and now.count != count:
                return True
            if self.lost() is not None:
                return False
            pause.wait(0.0005)
        return False

    def _readable(self, within_s: float) -> LatchState:
        """Return the latch's record when no write is under way; the writer may have lost its processor for some ms."""
        end_s = time.monotonic() + within_s
        pause = threading.Event()
        while (now := self._latch.state()) == UNREADABLE and time.monotonic() < end_s and self.lost() is None:
            pause.wait(0.0005)
        return now


def _line(text: str) -> str:
    return text.replace("\n", " ").replace("\r", " ")


def _any_port() -> socket.socket:
    return bound_socket("127.0.0.1", 0)


def bound_socket(host: str, port: int, *, option: str = "--port") -> socket.socket:
    """Return a bound TCP socket; `port` 0 takes any free port. `option` is the command-line option to name in errors.

    Raises:
        ConfigError: the port is taken or may not be used.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Accepted sockets inherit it. asyncio sets it only on sockets with a named protocol, and without it the second
        # packet of an answer waits 40 ms for the first one's acknowledgement.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        listener.bind((host, port))
        listener.listen(512)  # listen at once, because with SO_REUSEADDR only listening sockets exclude each other
    except OSError as error:
        listener.close()
        raise ConfigError(
            f"port {port} on {host} cannot be used: {error.strerror or error}",
            hint=f"another panelwright may run; end it or choose another {option}",
            port=port,
        ) from error
    return listener
