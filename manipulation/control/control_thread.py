"""The one thread that moves the arm: it runs the callers' jobs one at a time, and a periodic task between them."""

from __future__ import annotations

import logging
import os
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, TypeVar

from hal.cpu_affinity import share_core
from hal.errors import MotionRefused
from hal.priorities import Priority, take_priority

T = TypeVar("T")

JOIN_S = 2.0
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    call: Callable[[], Any]
    result: Future[Any]


class ControlThread:
    """Runs jobs in the order in which they arrive; an error goes to the caller and the thread goes on.

    Args:
        beat: called repeatedly while there is no job; if it raises, the thread ends. None lets the thread sleep until a
            job comes (in lockstep with a simulated world, where nothing happens between motions).
        at_end: called by the thread just before it ends.
    """

    def __init__(self, *, beat: Callable[[], None] | None, at_end: Callable[[], object]) -> None:
        self._beat = beat
        self._at_end = at_end
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._gate = threading.Lock()  # a job is either queued before closing and answered, or refused
        self._is_closing = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread; a second call does nothing."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._loop, name="control", daemon=True)
            self._thread.start()

    def close(self, *, within_s: float = JOIN_S) -> None:
        """Refuse new jobs, finish the running one and end the thread; a second call does nothing."""
        with self._gate:
            self._is_closing = True
        self._jobs.put(None)
        if self._thread is not None:
            self._thread.join(timeout=within_s)

    @property
    def ticking(self) -> int | None:
        """Id of the thread while it must have a turn in each period; None while it may sleep or does not run."""
        thread = self._thread
        if self._beat is None or self._is_closing or thread is None or not thread.is_alive():
            return None
        return thread.native_id

    def do(self, call: Callable[[], T]) -> T:
        """Run `call` on the thread and return its result; what it raises is raised here.

        Raises:
            MotionRefused: the thread does not run.
        """
        result: Future[T] = Future()
        with self._gate:
            if self._thread is None or self._is_closing:
                raise MotionRefused("the controller does not run", hint="start the cell first")
            self._jobs.put(_Job(call, result))
        return result.result()

    def _loop(self) -> None:
        if self._beat is None:
            share_core(os.getpid())
        else:
            take_priority(Priority.CONTROL)
        try:
            while not self._is_closing:
                self._turn()
        except Exception:  # raised by `beat`; the state of the arm is not known any more
            log.exception("the control thread ends")
        with self._gate:
            self._is_closing = True
        self._refuse_rest()
        self._at_end()

    def _turn(self) -> None:
        try:
            job = self._jobs.get(block=self._beat is None)
        except queue.Empty:
            job = None
        if job is not None:
            _do(job)
        elif self._beat is not None:
            self._beat()

    def _refuse_rest(self) -> None:
        # Callers whose jobs arrived while the thread closed get an answer too.
        while True:
            try:
                job = self._jobs.get(block=False)
            except queue.Empty:
                return
            if job is not None:
                job.result.set_exception(MotionRefused("the controller was closed", hint="start the cell again"))


def _do(job: _Job) -> None:
    try:
        job.result.set_result(job.call())
    except BaseException as error:  # whatever went wrong belongs to the caller
        job.result.set_exception(error)
