"""The stop latch: one byte of shared memory that the control thread reads each tick and the stop process writes.

This module imports only the standard library, because the stop process must start fast and stay small.
"""

from __future__ import annotations

import mmap
import struct
import threading
import time
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import TracebackType

LATCH = "latch"  # name of the file in the runtime folder
SIZE = 128
CLEAR = 0x5A  # any other byte, including zero, means latched, so damaged memory cannot release the arm
LATCHED = 0x01
HELD = 0x02  # latched, with the drives left on; every other byte switches them off
WORD = 8  # bytes
BODY = struct.Struct("<BQd80s")  # flag, count, wall time, source
BODY_AT = WORD
RECORDED_AT = 112  # the count of the newest stop that is in the journal; written by the service
SPEED_AT = 120  # written by the service
FULL_SPEED = 0x5A  # any other byte means that people are near, so that damaged memory makes the arm slow
TRIES = 100


class StopLevel(StrEnum):
    """What a stop does after the arm has come to rest (IEC 60204-1)."""

    OFF = "off"  # the drives are switched off and the brakes hold the arm (stop category 1)
    HOLD = "hold"  # the drives stay on and hold the arm (stop category 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class LatchState:
    """The state of the latch. `count` rises with each change; `time_s` is wall time, for display only."""

    is_latched: bool
    count: int
    time_s: float
    source: str
    level: StopLevel = StopLevel.OFF


UNREADABLE = LatchState(is_latched=True, count=0, time_s=0.0, source="latch not readable")


class Latch:
    """A memory-mapped latch file, written by one process (one thread at a time) and read by any number without a lock.

    A sequence counter guards the record (a seqlock): it is odd during a write, and it differs if the record changed
    during a read. The flag is a single byte, so `is_set` needs no retry.
    """

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), SIZE)
        # A view writes the word at once; `struct.pack_into` clears its bytes first, so another process may read a zero.
        self._sequence = memoryview(self._memory)[:WORD].cast("Q")
        self._recorded = memoryview(self._memory)[RECORDED_AT : RECORDED_AT + WORD].cast("Q")
        self._writing = threading.RLock()

    @classmethod
    def create(cls, path: Path) -> Latch:
        """Create the file with the stop latched."""
        path.write_bytes(b"\0" * SIZE)
        latch = cls(path)
        latch.set("start: latched until an explicit reset")
        latch.reduce(False)
        return latch

    def __enter__(self) -> Latch:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def is_set(self) -> bool:
        """Return whether the stop is latched; a closed or damaged latch counts as latched."""
        try:
            return self._memory[BODY_AT] != CLEAR
        except ValueError:
            return True

    def keeps_power(self) -> bool:
        """Return whether the stop is latched in a way that leaves the drives on; never for a closed or damaged latch."""
        try:
            return self._memory[BODY_AT] == HELD
        except ValueError:
            return False

    def is_reduced(self) -> bool:
        """Return whether people are near, so that the reduced speed holds; a closed or damaged latch counts as that."""
        try:
            return self._memory[SPEED_AT] != FULL_SPEED
        except ValueError:
            return True

    def reduce(self, is_reduced: bool) -> None:
        """Set whether people are near; the control thread reads it in each tick."""
        self._memory[SPEED_AT] = 0 if is_reduced else FULL_SPEED

    def state(self) -> LatchState:
        """Return the whole record; its state is latched when no consistent record can be read."""
        for _ in range(TRIES):
            try:
                before = self._sequence[0]
                flag, count, time_s, source = BODY.unpack_from(self._memory, BODY_AT)
                after = self._sequence[0]
            except ValueError:
                break
            if before == after and before % 2 == 0:
                text = source.rstrip(b"\0").decode("utf-8", "replace")
                level = StopLevel.HOLD if flag == HELD else StopLevel.OFF
                return LatchState(is_latched=flag != CLEAR, count=count, time_s=time_s, source=text, level=level)
        return UNREADABLE

    def set(self, source: str, level: StopLevel = StopLevel.OFF) -> LatchState:
        """Latch the stop; always succeeds, also when it is latched already.

        A stop that switches off is never made a weaker one.
        """
        with self._writing:
            holds = level is StopLevel.HOLD and self._memory[BODY_AT] in (CLEAR, HELD)
            return self._write(HELD if holds else LATCHED, source)

    def reset(self, source: str, *, seen_count: int) -> bool:
        """Clear the latch unless it was set again after `seen_count`; returns whether it is clear."""
        with self._writing:
            if self.state().count != seen_count:
                return False
            self._write(CLEAR, source)
            return True

    @property
    def recorded_count(self) -> int:
        """The count of the newest stop that is in the journal."""
        return int(self._recorded[0])

    def note_recorded(self, count: int) -> None:
        """Note that the stop with this count is in the journal."""
        self._recorded[0] = max(self._recorded[0], count)

    def close(self) -> None:
        """Unmap the file; a second call does nothing."""
        self._sequence.release()
        self._recorded.release()
        self._memory.close()

    def _write(self, flag: int, source: str) -> LatchState:
        sequence = self._sequence[0]
        sequence += 1 + sequence % 2  # odd, also when an earlier writer died during its write
        self._sequence[0] = sequence
        if flag != CLEAR:
            self._memory[BODY_AT] = flag  # written first, because the control thread may read it at any time
        _, count, _, _ = BODY.unpack_from(self._memory, BODY_AT)
        text = source.encode("utf-8", "replace")[:80]
        BODY.pack_into(self._memory, BODY_AT, flag, count + 1, time.time(), text)
        self._sequence[0] = sequence + 1
        return self.state()
