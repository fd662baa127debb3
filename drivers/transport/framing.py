"""Incremental framing: turns bytes, in chunks of any size, into checked frames; the result does not depend on the chunks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(slots=True)
class FramingCounts:
    """Counters of a framer: good frames, frames that failed their check, bytes outside any frame."""

    frames: int = 0
    bad: int = 0
    noise: int = 0


class Framer:
    """Finds frames that start with `header`, have a known length and pass `check`.

    After a failed candidate only its first byte is dropped, so a false header inside noise never hides a true frame.

    Args:
        header: first bytes of every frame (at least one).
        length: returns the total length of the frame at the start of its argument; None asks for more bytes, 0 says that
            no frame begins here. An integer for frames of one size.
        check: returns whether a complete frame is valid.
    """

    def __init__(
        self,
        header: bytes,
        length: int | Callable[[bytes], int | None],
        check: Callable[[bytes], bool],
    ) -> None:
        self._header = header
        self._length = length
        self._check = check
        self._buffer = b""
        self.counts = FramingCounts()

    @property
    def pending(self) -> int:
        """Return the number of bytes kept because they may begin a frame."""
        return len(self._buffer)

    def reset(self) -> None:
        """Discard the kept bytes, because the link was reopened."""
        self._buffer = b""

    def feed(self, chunk: bytes) -> list[bytes]:
        """Return the frames completed by this chunk."""
        data = self._buffer + chunk
        frames: list[bytes] = []
        at = 0
        while True:
            start = self._next_header(data, at)
            self.counts.noise += start - at
            at = start
            size = self._size_at(data, at)
            if size is None or at + size > len(data):
                break
            frame = data[at : at + size]
            if size and self._check(frame):
                frames.append(frame)
                at += size
            else:
                self.counts.bad += size > 0
                self.counts.noise += 1
                at += 1
        self.counts.frames += len(frames)
        self._buffer = data[at:]
        return frames

    def _size_at(self, data: bytes, at: int) -> int | None:
        if len(data) - at < len(self._header):
            return None
        return self._length if isinstance(self._length, int) else self._length(data[at:])

    def _next_header(self, data: bytes, at: int) -> int:
        """Return where the next header, or a partial one at the very end, begins; `len(data)` if there is none."""
        found = data.find(self._header, at)
        if found >= 0:
            return found
        for keep in range(min(len(self._header) - 1, len(data) - at), 0, -1):
            if data.endswith(self._header[:keep]):
                return len(data) - keep
        return len(data)
