"""Bytes with deadlines over a non-blocking file descriptor: the part that serial ports and sockets share."""

from __future__ import annotations

import errno
import os
import select
import threading

from drivers.transport.link import CountingLink, LinkLost, NoAnswer, now_s

CHUNK_BYTES = 65_536
LOOK_UP_S = 0.02  # longest time that a cancelled read may continue
SELECT_MOST = 1024  # `select` accepts descriptors below this number only


class FdLink(CountingLink):
    """Link over an open, non-blocking descriptor that this object owns."""

    def __init__(self, fd: int, name: str) -> None:
        self._fd = fd
        self._name = name
        self._is_cancelled = False
        self._write_lock = threading.Lock()
        self._close_lock = threading.Lock()
        self._poll_in, self._poll_out = select.poll(), select.poll()
        self._poll_in.register(fd, select.POLLIN)
        self._poll_out.register(fd, select.POLLOUT)

    @property
    def name(self) -> str:
        """Return the name shown to people."""
        return self._name

    @property
    def byte_s(self) -> float:
        """Return 0: a network delivers whole messages."""
        return 0.0

    def read(self, until_s: float) -> bytes:
        """Return at least one byte, or `b""` at `until_s`."""
        try:
            if not self._has_bytes(until_s):
                return b""
            data = os.read(self._fd, CHUNK_BYTES)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:
            raise LinkLost(f"{self._name}: {error}") from error
        if not data:
            raise LinkLost(f"{self._name}: the other end closed the connection")
        self.received += len(data)
        return data

    def _has_bytes(self, until_s: float) -> bool:
        while not self._is_cancelled:
            wait_s = max(0.0, until_s - now_s())
            if self._is_readable(min(wait_s, LOOK_UP_S)):
                return True
            if wait_s <= LOOK_UP_S:
                return False
        raise LinkLost(f"{self._name} is being closed")

    def cancel(self) -> None:
        """Make a waiting read and all later ones raise `LinkLost`; any thread may call this.

        The owner closes the link.
        """
        self._is_cancelled = True

    def _is_readable(self, wait_s: float) -> bool:
        # `poll` waits in whole milliseconds, rounded up, which would send a due SYNC up to 1 ms late.
        if self._fd < SELECT_MOST:
            return bool(select.select([self._fd], [], [], wait_s)[0])
        return bool(self._poll_in.poll(wait_s * 1e3))

    def write(self, data: bytes, until_s: float) -> None:
        """Send all of `data` before `until_s`."""
        if not self._write_lock.acquire(timeout=max(0.0, until_s - now_s())):
            raise NoAnswer(f"{self._name}: another write still blocks the port")
        try:
            self._write_all(data, until_s)
        except (OSError, ValueError) as error:
            raise LinkLost(f"{self._name}: {error}") from error
        finally:
            self._write_lock.release()

    def _write_all(self, data: bytes, until_s: float) -> None:
        rest = memoryview(data)
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                wait_s = until_s - now_s()
                if wait_s <= 0.0 or not self._poll_out.poll(wait_s * 1e3):
                    raise NoAnswer(f"{self._name}: the port accepts no more bytes") from None

    def is_present(self) -> bool:
        """Return True: a socket has no path that could vanish; serial ports override this."""
        return True

    def close(self) -> None:
        """Close the descriptor once."""
        with self._close_lock:
            fd, self._fd = self._fd, -1
        if fd >= 0:
            self._release(fd)

    def _release(self, fd: int) -> None:
        try:
            os.close(fd)
        except OSError as error:
            if error.errno != errno.EBADF:
                raise
