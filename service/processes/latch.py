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
BACK = 0x03  # latched because the service is lost, and an arm that moves goes back the way it came
STRENGTH = (CLEAR, BACK, HELD, LATCHED)  # a stop replaces those before it and never weakens those behind it
WORD = 8  # bytes
BODY = struct.Struct("<BQd80s")  # flag, count, wall time, source
BODY_AT = WORD
REST = struct.Struct("<Qd80s")  # of the body, behind the flag
RECORDED_AT = 112  # the count of the newest stop that is in the journal; written by the service
SPEED_AT = 120  # written by the service
FULL_SPEED = 0x5A  # any other byte means that people are near, so that damaged memory makes the arm slow
TRIES = 100


class StopLevel(StrEnum):
    """What a stop does after the arm has come to rest (IEC 60204-1); callers choose between the first two."""

    OFF = "off"  # the drives are switched off and the brakes hold the arm (stop category 1)
    HOLD = "hold"  # the drives stay on and hold the arm (stop category 2)
    RETREAT = "retreat"  # an arm that moved goes back the way it came; then the drives are switched off


@dataclass(frozen=True, slots=True, kw_only=True)
class LatchState:
    """The state of the latch. `count` rises with each change; `time_s` is wall time, for display only."""

    is_latched: bool
    count: int
    time_s: float
    source: str
    level: StopLevel = StopLevel.OFF


FLAGS = {StopLevel.OFF: LATCHED, StopLevel.HOLD: HELD, StopLevel.RETREAT: BACK}
LEVELS = {flag: level for level, flag in FLAGS.items()}  # every other byte switches off
WHEN_LOST = {"hold": StopLevel.HOLD, "retreat": StopLevel.RETREAT, "stop": StopLevel.OFF}  # words of the cell file
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

    def has(self, level: StopLevel) -> bool:
        """Return whether a stop is latched that is at least as strong as one of this level."""
        try:
            flag = self._memory[BODY_AT]
        except ValueError:
            return True
        return flag not in STRENGTH or STRENGTH.index(flag) >= STRENGTH.index(FLAGS[level])

    def keeps_power(self) -> bool:
        """Return whether the stop is latched in a way that leaves the drives on; never for a closed or damaged latch."""
        try:
            return self._memory[BODY_AT] == HELD
        except ValueError:
            return False

    def goes_back(self) -> bool:
        """Return whether the stop is latched in a way that lets a moving arm go back; never for a closed or damaged latch."""
        try:
            return self._memory[BODY_AT] == BACK
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
                level = LEVELS.get(flag, StopLevel.OFF)
                return LatchState(is_latched=flag != CLEAR, count=count, time_s=time_s, source=text, level=level)
        return UNREADABLE

    def set(self, source: str, level: StopLevel = StopLevel.OFF) -> LatchState:
        """Latch the stop; always succeeds, also when it is latched already.

        A stop that switches off is never made a weaker one, and one that holds does not let the arm go back.
        """
        with self._writing:
            now = self._memory[BODY_AT] if self._memory[BODY_AT] in STRENGTH else LATCHED
            return self._write(max(FLAGS[level], now, key=STRENGTH.index), source)

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
        REST.pack_into(self._memory, BODY_AT + 1, count + 1, time.time(), text)  # its bytes are zero for a moment
        self._memory[BODY_AT] = flag
        self._sequence[0] = sequence + 1
        return self.state()
