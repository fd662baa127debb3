"""The stop latch: one byte of shared memory that the control thread reads each tick and the stop process writes.

Nothing here imports more than the standard library: the stop process must start fast and stay small.
"""

from __future__ import annotations

import mmap
import struct
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

SIZE = 128
CLEAR = 0x5A  # every other byte, zeroed memory too, means latched: damage must not start an arm
LATCHED = 0x01
WORD = 8  # bytes
BODY = struct.Struct("<BQd80s")  # flag, count, wall time, source
BODY_AT = WORD
TRIES = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class LatchState:
    """What the latch says. `count` rises with each change; `time_s` is wall time, for people."""

    is_latched: bool
    count: int
    time_s: float
    source: str


UNREADABLE = LatchState(is_latched=True, count=0, time_s=0.0, source="latch not readable")


class Latch:
    """A mapped latch file. One process writes, its threads one after the other; any number reads without a lock.

    A sequence counter guards the record (a seqlock): odd while it is being written, different when it changed
    meanwhile. The flag alone is one byte, so `is_set` needs no retry.
    """

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), SIZE)
        self._sequence = _word(self._memory, "Q")
        self._writing = threading.RLock()

    @classmethod
    def create(cls, path: Path) -> Latch:
        """Make the file; it starts latched."""
        path.write_bytes(b"\0" * SIZE)
        latch = cls(path)
        latch.set("start: latched until an explicit reset")
        return latch

    def __enter__(self) -> Latch:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def is_set(self) -> bool:
        """Is the stop latched? A closed or damaged latch counts as latched."""
        try:
            return self._memory[BODY_AT] != CLEAR
        except ValueError:
            return True

    def state(self) -> LatchState:
        """The whole record; latched when no consistent one can be read."""
        for _ in range(TRIES):
            try:
                before = self._sequence[0]
                flag, count, time_s, source = BODY.unpack_from(self._memory, BODY_AT)
                after = self._sequence[0]
            except ValueError:
                break
            if before == after and before % 2 == 0:
                text = source.rstrip(b"\0").decode("utf-8", "replace")
                return LatchState(is_latched=flag != CLEAR, count=count, time_s=time_s, source=text)
        return UNREADABLE

    def set(self, source: str) -> LatchState:
        """Latch the stop. Always succeeds, also when it is latched already."""
        with self._writing:
            return self._write(LATCHED, source)

    def reset(self, source: str, *, seen_count: int) -> bool:
        """Clear the latch, if nobody stopped again since the caller saw `seen_count`; tells whether it is clear."""
        with self._writing:
            if self.state().count != seen_count:
                return False
            self._write(CLEAR, source)
            return True

    def close(self) -> None:
        """Unmap; a second call does nothing."""
        self._sequence.release()
        self._memory.close()

    def _write(self, flag: int, source: str) -> LatchState:
        sequence = self._sequence[0]
        sequence += 1 + sequence % 2  # odd, also after a writer died in the middle
        self._sequence[0] = sequence
        if flag == LATCHED:
            self._memory[BODY_AT] = LATCHED  # before the rest: the control thread may look right now
        _, count, _, _ = BODY.unpack_from(self._memory, BODY_AT)
        text = source.encode("utf-8", "replace")[:80]
        BODY.pack_into(self._memory, BODY_AT, flag, count + 1, time.time(), text)
        self._sequence[0] = sequence + 1
        return self.state()


class Beat:
    """A sign of life in shared memory: one process writes its monotonic time, another looks how old it is."""

    def __init__(self, path: Path) -> None:
        if not path.exists():
            path.write_bytes(b"\0" * WORD)
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), WORD)
        self._at_s = _word(self._memory, "d")

    def beat(self) -> None:
        """I live."""
        self._at_s[0] = time.monotonic()

    def age_s(self) -> float:
        """Seconds since the last beat; both processes share the machine's monotonic clock."""
        return time.monotonic() - float(self._at_s[0])

    def close(self) -> None:
        """Unmap; a second call does nothing."""
        self._at_s.release()
        self._memory.close()


def _word(memory: mmap.mmap, kind: Literal["Q", "d"]) -> memoryview[Any]:
    """The first eight bytes as one number, read and written in one piece.

    `struct.pack_into` clears its bytes before it fills them: another process then sees a zero, now and then.
    """
    return memoryview(memory)[:WORD].cast(kind)
