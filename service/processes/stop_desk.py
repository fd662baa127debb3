"""Latches and clears the software stop for the service, and records both."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from dataclasses import dataclass
from typing import Any, Protocol

from hal.errors import CellError, MotionRefused
from hal.isolated import Report
from service.processes.latch import Latch, LatchState, StopLevel

SEEN_S = 1.0  # nobody has seen a stop that is younger
log = logging.getLogger(__name__)


class StopHost(Protocol):
    """The interface of the object that writes the latch."""

    def stop(self, source: str, level: StopLevel = StopLevel.OFF) -> LatchState:
        """Latch the stop; never fails."""
        ...

    def reset(self, source: str, *, seen_count: int) -> bool:
        """Clear the latch unless it was set again after `seen_count`; returns whether it is clear.

        Raises:
            MotionRefused: the stop process does not run or did not answer.
        """
        ...

    @property
    def pid(self) -> int | None:
        """Process id, or None when it has no process of its own."""
        ...

    @property
    def restarts(self) -> int:
        """How often its process was started again."""
        ...

    def is_alive(self) -> bool:
        """Whether the stop port answers requests."""
        ...

    def look(self) -> None:
        """Latch the stop when the process was lost; called many times a second."""
        ...

    def close(self) -> None:
        """End the stop port; the latch stays set."""
        ...


def _nowhere(_kind: str, _data: dict[str, Any]) -> None:
    return None


@dataclass(frozen=True, slots=True, kw_only=True)
class Records:
    """Where events are recorded.

    Attributes:
        note: records without waiting for the disk.
        commit: records and returns when the entry is on disk; raises when it cannot be written.
    """

    note: Report = _nowhere
    commit: Report = _nowhere


class StopDesk:
    """Stops, resets and their records; several threads may call it.

    Args:
        latch: the stop latch, of which this object writes only what is recorded.
        host: writes the latch.
    """

    def __init__(self, latch: Latch, host: StopHost, records: Records) -> None:
        self._latch = latch
        self._host = host
        self._records = records
        self._noted = latch.state().count
        latch.note_recorded(self._noted)  # the stop port waits for records from now on
        self._noted_s = time.monotonic()
        self._noting = threading.Lock()

    def stop(self, source: str, level: StopLevel = StopLevel.OFF) -> LatchState:
        """Latch the software stop; returns when it is also recorded, if that is possible."""
        with self._noting:  # so that this call records the stop, and not `note_stop`, which does not wait for the disk
            state = self._host.stop(source, level)
            self._noted, self._noted_s = state.count, time.monotonic()
        try:
            self._record(state)
        except CellError as error:  # the stop holds, with or without a record
            log.error("the stop is latched but not recorded: %s", error.for_people())
        return state

    def note_stop(self) -> None:
        """Record the newest stop once, because the stop port writes the latch without recording.

        Call it periodically; of several stops between two calls only the last one is recorded. It returns when the stop is on
        disk, for which the stop port waits before it answers.
        """
        with self._noting:
            state = self._latch.state()
            if state.count <= self._noted:
                return
            self._noted, self._noted_s = state.count, time.monotonic()
        if not state.is_latched:
            return
        try:
            self._record(state)
        except CellError as error:
            log.error("the stop is latched but not recorded: %s", error.for_people())

    def _record(self, state: LatchState) -> None:
        self._records.commit("stop", {"source": state.source, "count": state.count, "level": str(state.level)})
        with contextlib.suppress(ValueError):  # the latch is closed
            self._latch.note_recorded(state.count)

    def reset(self, source: str, *, seen_count: int | None) -> LatchState:
        """Clear the latch; this alone moves nothing. A latch that is clear stays as it is, and running tasks go on.

        Args:
            seen_count: the latch's count that the caller has seen; None for whichever stop is older than a second.

        Raises:
            MotionRefused: the stop was latched again meanwhile, or the stop process is down or does not answer.
            JournalError: the reset cannot be recorded, so the stop stays latched.
        """
        self.note_stop()  # before the reset overwrites the latch's record
        if seen_count is None:
            seen_count = self._count_of_old_stop()
        state = self._latch.state()
        if not state.is_latched and state.count == seen_count:
            return state
        told = {"source": source, "count": seen_count}
        self._records.commit("stop-reset", told)
        try:
            is_clear = self._host.reset(source, seen_count=seen_count)
        except MotionRefused:
            self._records.note("stop-reset-refused", told)
            raise
        if not is_clear:
            self._records.note("stop-reset-refused", told)
            raise MotionRefused(
                f"the stop was pressed again or reset since count {seen_count}, so this reset does nothing",
                hint="look at the cell, GET /v1/stop, then reset with its newest `count`",
            )
        return self._latch.state()

    def _count_of_old_stop(self) -> int:
        """Return the latch's count; refuse if it is latched for less time than a person needs to see it."""
        with self._noting:
            count, age_s = self._noted, time.monotonic() - self._noted_s
        if self._latch.is_set() and age_s < SEEN_S:
            raise MotionRefused(
                f"the stop was pressed {age_s:.1f} s ago, so it stays latched",
                hint="look at the cell, GET /v1/stop, then reset with its `count` as `seen_count`",
            )
        return count
