"""The one thread that moves the arm: does what callers hand over, a call at a time, and beats in between."""

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

T = TypeVar("T")

JOIN_S = 2.0
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    call: Callable[[], Any]
    result: Future[Any]


class ControlThread:
    """Jobs in the order in which they come; errors go to the caller, the thread lives on.

    Args:
        beat: called again and again while there is no job; one that raises ends the thread. None lets the thread sleep
            until a job comes (in lockstep with a simulated world, where nothing happens between motions).
        at_end: called by the thread as its last act.
    """

    def __init__(self, *, beat: Callable[[], None] | None, at_end: Callable[[], None]) -> None:
        self._beat = beat
        self._at_end = at_end
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._gate = threading.Lock()  # a job enters before closing, and is answered, or not at all
        self._is_closing = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin; a second call does nothing."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._loop, name="control", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Refuse new jobs, finish the one that runs, end; a second call does nothing."""
        with self._gate:
            self._is_closing = True
        self._jobs.put(None)
        if self._thread is not None:
            self._thread.join(timeout=JOIN_S)

    def do(self, call: Callable[[], T]) -> T:
        """What `call` returns or raises, called on the thread.

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
        try:
            while not self._is_closing:
                self._turn()
        except Exception:  # of a beat: nobody knows any more what holds the arm
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
        # Callers that asked while the thread closed get an answer too.
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
