"""Link to the world process: starts it, exchanges requests and answers, ends it."""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.errors import DeviceUnavailable
from hal.process_state import ProcessState, ThreadTimes, process_state, threads_of
from hal.spare_process import start_module
from simbackend.wire import DOUBLE, IMAGE_BYTES, REQUEST, SNAPSHOT, Op, WorldConfig, read_exactly

START_S = 180.0  # the first start on a machine compiles the rasteriser; later ones take two seconds
CLOSE_S = 2.0
SUSPENDED_S = 1.0  # a world that a debugger holds for longer is given up
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")  # the other core is for the cell
PATIENCE_S = 0.5  # nobody asks what a world does that owes an answer for a shorter time
STILL_S = 2.0
COMPUTING_S = 4.0  # of one answer
ANSWER_S = 20.0  # the longest answer, a large picture on a busy machine, takes about a second


class Debt:
    """Tells a world that owes an answer and hangs from one that works on it, and from one for which the machine has no time.

    Args:
        threads: returns the threads of a process by id.
    """

    def __init__(self, threads: Callable[[int], dict[int, ThreadTimes]] = threads_of) -> None:
        self._threads = threads
        self._asked_at_s: float | None = None
        self._still_since_s = self._computed_s = 0.0
        self._turns = 0

    def look(self, pid: int, asked_at_s: float | None, now_s: float) -> str | None:
        """Return why the answer will not come, as in "has done nothing"; None if it may. Call it many times a second."""
        if asked_at_s is None or now_s - asked_at_s < PATIENCE_S:
            self._asked_at_s = None
            return None
        threads = self._threads(pid).values()
        turns, computed_s = sum(one.turns for one in threads), sum(one.computed_s for one in threads)
        if self._asked_at_s != asked_at_s:
            self._asked_at_s, self._still_since_s, self._computed_s = asked_at_s, now_s, computed_s
        if not threads or turns != self._turns or any(one.state in "RD" for one in threads):
            self._turns, self._still_since_s = turns, now_s
        if now_s - self._still_since_s > STILL_S:
            return f"hangs: it owes an answer and has done nothing for {STILL_S:.0f} s"
        if computed_s - self._computed_s > COMPUTING_S:
            return f"hangs: it has computed for {COMPUTING_S:.0f} s and not answered"
        return None


class WorldLink:
    """One world process and the pipe to it. Requests are fixed vectors; pictures return through shared memory."""

    def __init__(self, config: WorldConfig) -> None:
        self._lock = threading.RLock()
        self._is_closed = False
        self._suspended_since_s: float | None = None
        self._asked_at_s: float | None = None  # while an answer is awaited
        self._debt = Debt()
        ours, theirs = socket.socketpair()
        with tempfile.TemporaryFile(prefix="panelwright-images-") as file:
            file.truncate(IMAGE_BYTES)
            self._images = mmap.mmap(file.fileno(), IMAGE_BYTES)
            fds = (theirs.fileno(), file.fileno())
            self.process = start_module("simbackend.world_process", fds, ONE_THREAD)
        theirs.close()
        self._pipe = Connection(ours.detach())
        self._stream = self._pipe.fileno()
        try:
            self.first = self._greet(config)
        except DeviceUnavailable:
            self.close()
            raise

    def _greet(self, config: WorldConfig) -> bytes:
        """Send the configuration; return the first snapshot."""
        try:
            self._pipe.send(config)
            answer = self._pipe.recv() if self._pipe.poll(START_S) else f"no answer within {START_S:.0f} s"
            complaint = complaint_of(answer)
            if complaint is None:
                return read_exactly(self._stream, SNAPSHOT * DOUBLE)
        except (EOFError, OSError):
            complaint = "it ended while starting"
        raise DeviceUnavailable(
            f"the simulated world did not start: {complaint}",
            hint="run `panelwright doctor`; is pybullet installed?",
            device="world",
        )

    def step(self, request: bytes) -> bytes:
        """Send a step request; return the bytes of the snapshot."""
        with self._lock, self._guarded():
            os.write(self._stream, request)
            return read_exactly(self._stream, SNAPSHOT * DOUBLE)

    def ask(self, op: Op, *arguments: float) -> Any:
        """Send any other request; return the object in the answer."""
        with self._lock, self._guarded():
            os.write(self._stream, _vector(op, *arguments))
            return self._pipe.recv()

    def picture(self, arguments: list[float], shape: tuple[int, ...]) -> tuple[Any, NDArray[np.float32]]:
        """Return the description and the pixels that a picture request yields."""
        with self._lock:
            info = self.ask(Op.RENDER, *arguments)
            return info, np.frombuffer(self._images, np.float32, int(np.prod(shape))).reshape(shape).copy()

    def why_ended(self) -> str | None:
        """Return how the process was lost, as in "the simulated world has ended"; None while it lives or is closed.

        It is lost when it has ended, when it has been suspended for a second, when it owes an answer and does nothing for
        two seconds or has computed for four, and when it does not answer for 20 s on a machine that is too busy for it.
        """
        now_s, asked_at_s = time.monotonic(), self._asked_at_s
        if self._is_closed:
            return None
        code = self.process.poll()
        if code is not None:
            return f"the simulated world has ended (exit code {code})"
        if asked_at_s is not None and now_s - asked_at_s > ANSWER_S:
            return f"the simulated world did not answer for {ANSWER_S:.0f} s"
        if process_state(self.process.pid) is not ProcessState.SUSPENDED:
            self._suspended_since_s = None
            why = self._debt.look(self.process.pid, asked_at_s, now_s)
            return None if why is None or self._has_answered() else f"the simulated world {why}"
        if self._suspended_since_s is None:
            self._suspended_since_s = now_s
        held_s = now_s - self._suspended_since_s
        return f"the simulated world {ProcessState.SUSPENDED}" if held_s > SUSPENDED_S else None

    def _has_answered(self) -> bool:
        """Whether an answer has come that nobody has read yet."""
        return bool(select.select([self._stream], [], [], 0.0)[0])

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        if self._is_closed:
            raise DeviceUnavailable("the simulated world is closed", hint="open the cell again", device="world")
        self._asked_at_s = time.monotonic()
        try:
            yield
        except (EOFError, OSError) as error:
            raise DeviceUnavailable(
                f"the simulated world has ended (exit code {self.process.poll()})",
                hint="start the cell again; its log says why the world ended",
                device="world",
            ) from error
        finally:
            self._asked_at_s = None

    def close(self) -> None:
        """End the process; a second call does nothing."""
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = True
            with contextlib.suppress(OSError):
                os.write(self._stream, _vector(Op.CLOSE))
            self._pipe.close()
        try:
            self.process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(CLOSE_S)


def complaint_of(answer: object) -> str | None:
    """Return why a world cannot be used, by its answer to the configuration; None if it can.

    A world answers with the lengths of its requests and snapshots. A vector of another length would shift every value
    that follows it on the pipe.
    """
    if isinstance(answer, str):
        return answer
    if answer == (REQUEST, SNAPSHOT):
        return None
    return f"it has vectors of {answer} doubles, and this program of {(REQUEST, SNAPSHOT)}; are both of one version?"


def _vector(op: Op, *arguments: float) -> bytes:
    request = np.zeros(REQUEST)
    request[0] = op
    request[1 : 1 + len(arguments)] = arguments
    return request.tobytes()
