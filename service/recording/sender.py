"""Sends what a process records to the recorder's process, in small batches and from a thread of its own."""

from __future__ import annotations

import io
import logging
import pickle
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from scipy.spatial.transform import RigidTransform, Rotation

BATCH = 64  # rows; pickling more at once would keep the control loop from the interpreter for longer than 0.1 ms
PAUSE_S = 0.02
MOST_ROWS = 50_000  # some 20 s of a control loop in real time; beyond this rows are dropped and counted
END_S = 5.0
FAILED = "recording-failed"
log = logging.getLogger(__name__)

Take = Callable[[bytes], str]
"""Delivers a batch (a pickled list) to the recorder; returns what is wrong with the recording, or an empty text."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Note:
    """Something that happened: a task's state, a stop, a device that was exchanged. `data` holds plain JSON values."""

    kind: str
    data: dict[str, Any]
    wall_s: float


@dataclass(frozen=True, slots=True)
class Dropped:
    """How many rows were dropped because the recorder did not keep up."""

    rows: int


class Sender:
    """A queue to the recorder. Putting something takes about a microsecond and never waits.

    Args:
        take: see `Take`; called by this object's thread only.
        report: called once, with `recording-failed` and the cause, when the recording cannot go on.
        waits: whether nothing is sent before `begin`; what is put meanwhile follows it.
    """

    def __init__(self, take: Take, *, report: Callable[[str, dict[str, Any]], None], waits: bool = False) -> None:
        self._take = take
        self._report = report
        self._waiting: deque[Any] = deque()
        self._dropped = 0
        self._is_over = False
        self._has_begun = not waits
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="record", daemon=True)
        self._thread.start()

    def begin(self, first: Any) -> None:
        """Record something before everything that has been put so far."""
        self._waiting.appendleft(first)
        self._has_begun = True

    def put(self, item: Any) -> None:
        """Record something that must not be lost."""
        if not self._is_over:
            self._waiting.append(item)

    def put_row(self, row: tuple[Any, ...]) -> None:
        """Record a row of the control loop (the fields of a `Row`); it is dropped and counted when too many wait."""
        if self._is_over:
            return
        if len(self._waiting) < MOST_ROWS:
            self._waiting.append(row)
        else:
            self._dropped += 1

    def close(self) -> None:
        """Send what waits, and end; takes a bounded time, and a second call does nothing."""
        self._end.set()
        self._thread.join(END_S)

    def _run(self) -> None:
        try:
            while not self._end.wait(PAUSE_S):
                self._send_waiting()
            self._send_waiting()
        except Exception as error:  # the recorder's process has ended, or a defect: the cell goes on without it
            self._give_up(f"{type(error).__name__}: {error}")

    def _send_waiting(self) -> None:
        while self._has_begun and self._waiting and not self._is_over:
            batch = [self._waiting.popleft() for _ in range(min(BATCH, len(self._waiting)))]
            if self._dropped:
                batch.append(Dropped(self._dropped))
                self._dropped = 0
            problem = self._take(packed(batch))
            if problem:
                self._give_up(problem)

    def _give_up(self, why: str) -> None:
        self._is_over = True
        self._waiting.clear()
        log.error("the recording ends here: %s", why)
        self._report(FAILED, {"why": why})


class _Pickler(pickle.Pickler):
    """Keeps poses to the bit; their own pickling makes them orthonormal again, which changes the last bits."""

    def reducer_override(self, value: Any) -> Any:
        if type(value) is RigidTransform:
            return _pose, (value.as_matrix(),)
        if type(value) is Rotation:
            return _rotation, (value.as_quat(),)
        return NotImplemented


def _pose(matrix: Any) -> RigidTransform:
    return RigidTransform(matrix, normalize=False)


def _rotation(quaternion: Any) -> Rotation:
    return Rotation(quaternion, normalize=False)


def packed(batch: list[Any]) -> bytes:
    """Return a batch as bytes."""
    stream = io.BytesIO()
    _Pickler(stream, protocol=5).dump(batch)
    return stream.getvalue()
