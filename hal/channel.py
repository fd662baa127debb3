"""Sends messages between two processes on one machine: pickles over a Unix socket, large arrays in shared memory.

Arrays are sent out of band (pickle protocol 5) in a memory file that both sides map. The kernel frees it with its last
user, so even `kill -9` leaves nothing behind. A channel carries one call at a time and must not be shared by threads.
"""

from __future__ import annotations

import io
import mmap
import os
import pickle
import socket
import struct
from multiprocessing import reduction
from multiprocessing.connection import Connection, answer_challenge, deliver_challenge
from typing import Any

from hal.clock import Clock, Deadline

INLINE_BYTES = 16_384  # below this a pipe is as fast as shared memory
SHORTEST_S = 0.001  # of a wait; 0 would be without end


class _Pickler(pickle.Pickler):
    def persistent_id(self, obj: Any) -> Any:
        # The two sides have different clocks, so the remaining time is sent.
        return obj.remaining_s() if isinstance(obj, Deadline) else None


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, buffers: list[Any], clock: Clock) -> None:
        super().__init__(io.BytesIO(data), buffers=buffers)
        self._clock = clock

    def persistent_load(self, pid: Any) -> Any:
        return Deadline.after(self._clock, float(pid))


class Channel:
    """One end of a connection.

    Args:
        connection: a connected Unix-socket connection of `multiprocessing`; the channel owns it.
        clock: the clock of received deadlines.
    """

    def __init__(self, connection: Connection, clock: Clock) -> None:
        self._connection = connection
        self._clock = clock
        self._outgoing: mmap.mmap | None = None
        self._incoming: mmap.mmap | None = None

    @classmethod
    def dial(cls, address: str, authkey: bytes, word: str, clock: Clock, *, timeout_s: float) -> tuple[Channel, Any]:
        """Connect to a listener of `multiprocessing` on a Unix socket and say a word; returns the channel and the answer.

        Raises:
            BlockingIOError: a step took longer than `timeout_s`.
            OSError: nothing listens there.
            EOFError: the peer has ended.
            multiprocessing.AuthenticationError: the keys differ.
        """
        with socket.socket(socket.AF_UNIX) as end:
            _limit_waits(end, max(timeout_s, SHORTEST_S))
            end.connect(address)
            channel = cls(Connection(os.dup(end.fileno())), clock)
            try:
                answer_challenge(channel._connection, authkey)
                deliver_challenge(channel._connection, authkey)
                channel.send(word)
                answer = channel.receive()
            except BaseException:
                channel.close()
                raise
            _limit_waits(end, 0.0)
        return channel, answer

    def send(self, message: Any) -> None:
        """Send one message; the peer must have received the previous one (calls alternate)."""
        big: list[pickle.PickleBuffer] = []
        stream = io.BytesIO()

        def stays_inside(buffer: pickle.PickleBuffer) -> bool:
            if buffer.raw().nbytes >= INLINE_BYTES:
                big.append(buffer)
                return False
            return True

        _Pickler(stream, protocol=5, buffer_callback=stays_inside).dump(message)
        sizes = [buffer.raw().nbytes for buffer in big]
        fresh = self._reserve(sum(sizes))
        self._connection.send_bytes(
            pickle.dumps((stream.getvalue(), sizes, len(self._outgoing or b""), fresh is not None))
        )
        if fresh is not None:
            reduction.send_handle(self._connection, fresh, 0)
            os.close(fresh)
        start = 0
        for buffer, size in zip(big, sizes, strict=True):
            assert self._outgoing is not None  # noqa: S101 - narrowing: sizes are not empty
            self._outgoing[start : start + size] = buffer.raw()
            start += size
        if big:
            self._connection.send_bytes(b"filled")

    def receive(self) -> Any:
        """Wait for the next message and return it.

        Raises:
            EOFError: the peer is gone.
        """
        data, sizes, capacity, is_fresh = pickle.loads(self._connection.recv_bytes())  # noqa: S301 - authenticated peer
        if is_fresh:
            handle = reduction.recv_handle(self._connection)
            self._incoming = mmap.mmap(handle, capacity)
            os.close(handle)
        buffers: list[bytearray] = []
        if sizes:
            self._connection.recv_bytes()
            start = 0
            for size in sizes:
                assert self._incoming is not None  # noqa: S101 - narrowing: the peer sent it first
                buffers.append(bytearray(self._incoming[start : start + size]))
                start += size
        return _Unpickler(data, buffers, self._clock).load()

    def poll(self, timeout_s: float) -> bool:
        """Return whether a message arrives within `timeout_s`."""
        return self._connection.poll(timeout_s)

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        self._connection.close()

    def _reserve(self, size: int) -> int | None:
        """Make the outgoing memory at least `size` bytes long; returns the descriptor if it is new, else None."""
        if size == 0 or (self._outgoing is not None and len(self._outgoing) >= size):
            return None
        handle = os.memfd_create("panelwright")
        os.ftruncate(handle, size)
        self._outgoing = mmap.mmap(handle, size)
        return handle


def _limit_waits(end: socket.socket, timeout_s: float) -> None:
    """Let the kernel end each wait for this socket after a time, 0 for never; the socket stays blocking."""
    seconds, fraction = divmod(timeout_s, 1.0)
    for option in (socket.SO_RCVTIMEO, socket.SO_SNDTIMEO):
        end.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", int(seconds), int(1e6 * fraction)))
