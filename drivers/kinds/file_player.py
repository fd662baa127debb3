"""Code shared by cameras and range scanners that play files: each read returns the next file, one per period."""

from __future__ import annotations

import struct
import threading
import zlib
from abc import abstractmethod
from pathlib import Path
from typing import TypeVar

from drivers.transport.device import WireDevice
from drivers.transport.link import now_s
from drivers.transport.mailbox import IMAGES_RING
from hal.clock import Deadline
from hal.readings import Stamped
from hal.registry import Context

T = TypeVar("T")
PNG = b"\x89PNG\r\n\x1a\n"


class FilePlayer(WireDevice[T]):
    """Plays files, at most one per period, and waits between them."""

    ring = IMAGES_RING

    def __init__(self, context: Context, path: Path, *, rate_hz: float) -> None:
        super().__init__(context, max_age_s=3.0 / rate_hz)
        self._path = path
        self._period_s = 1.0 / rate_hz
        self._turn = threading.Lock()
        self._closing = threading.Event()
        self._next_s = 0.0
        self._index = 0

    @abstractmethod
    def show(self, index: int, shown_s: float) -> None:
        """Load file number `index`, which increases without end, and publish it as of `shown_s` (links' clock).

        Raises:
            DeviceFault: the file is damaged. DeviceUnavailable: there are no more files.
        """

    def play(self, deadline: Deadline) -> Stamped[T]:
        """Return the next file's content, not before its period has elapsed.

        Raises:
            DeviceTimeout: the deadline ends before the period. DeviceFault, DeviceUnavailable: see `show`.
        """
        self.require_open()
        started_s = now_s()
        until_s = started_s + deadline.remaining_s()
        if not self._turn.acquire(timeout=max(0.0, until_s - now_s())):
            raise self.timeout(now_s() - started_s)
        try:
            self._closing.wait(max(0.0, min(self._next_s, until_s) - now_s()))
            self.require_open()
            if self._next_s > until_s:
                raise self.timeout(now_s() - started_s)
            shown_s = now_s()
            self._next_s = shown_s + self._period_s
            index, self._index = self._index, self._index + 1  # a damaged file does not keep those behind it
            self.show(index, shown_s)
            return self.newest(deadline, not_before_s=-float("inf"))
        finally:
            self._turn.release()

    def release(self) -> None:
        """End a wait in progress."""
        self._closing.set()

    def is_up(self) -> bool:
        """Return True: files do not disconnect."""
        return True

    def reconnects(self) -> int:
        """Return 0: files do not reconnect."""
        return 0

    def link_name(self) -> str:
        """Return `files` and the path."""
        return f"files {self._path}"


def undamaged_png(content: bytes) -> bytes:
    """Return the content of a PNG file, all of whose chunks have the right check sum.

    One wrong bit in the first chunk may make a small picture gigabytes large, which takes longer than any deadline.

    Raises:
        ValueError: it is damaged, or no PNG.
    """
    at, kind = len(PNG), b""
    while content.startswith(PNG) and kind != b"IEND" and len(content) >= at + 12:
        (length,), kind = struct.unpack_from(">I", content, at), content[at + 4 : at + 8]
        end = at + 8 + length
        if content[end : end + 4] != struct.pack(">I", zlib.crc32(content[at + 4 : end])):
            break
        at = end + 4
    else:
        if kind == b"IEND":
            return content
    raise ValueError("a damaged PNG")
