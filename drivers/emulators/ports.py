"""Ports of the emulators: a pty under a stable name, a TCP listener, a UDP socket; all for this host only."""

from __future__ import annotations

import errno
import os
import pty
import select
import shutil
import socket
import tempfile
import termios
import time
import tty
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

LOOPBACK = "127.0.0.1"
OUTPUT_SPEED = 5  # index in the list that `tcgetattr` returns
Peer = Any  # identifies a peer of a port: a connection, an address, or None where there is only one


class FarPort(Protocol):
    """Port of an emulator, at the other end of the driver's link."""

    @property
    def address(self) -> dict[str, Any]:
        """Return the driver options that make a driver connect to this port."""
        ...

    def receive(self, timeout_s: float) -> list[tuple[Peer, bytes]]:
        """Return the received bytes of each peer; wait for at most `timeout_s` seconds."""
        ...

    def send(self, peer: Peer, data: bytes) -> None:
        """Send the bytes; they are lost if no one receives them, as on a real line."""
        ...

    def vanish(self) -> None:
        """Unplug the port."""
        ...

    def appear(self) -> None:
        """Plug the port in again."""
        ...

    def close(self) -> None:
        """Close the port for good."""
        ...


class PtyPort:
    """Pseudo terminal whose slave has a stable name by a symbolic link, as in `/dev/serial/by-id`."""

    def __init__(self, name: str) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="panelwright-"))
        self.path = self._folder / name
        self._fds: tuple[int, int] | None = None
        self._held: list[int] = []
        self.appear()

    @property
    def address(self) -> dict[str, Any]:
        """Return `{"port": PATH}`."""
        return {"port": str(self.path)}

    def appear(self) -> None:
        """Open a new pseudo terminal under the same name."""
        master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        fresh = self.path.with_suffix(".new")
        fresh.symlink_to(os.ttyname(slave))
        fresh.replace(self.path)
        self._fds = (master, slave)  # the slave stays open here, so that the master never reads a hang-up

    def vanish(self) -> None:
        """Close the pseudo terminal and remove its name."""
        self.path.unlink(missing_ok=True)
        fds, self._fds = self._fds, None
        for fd in fds or ():
            os.close(fd)

    def receive(self, timeout_s: float) -> list[tuple[Peer, bytes]]:
        """Return the bytes written by the process that has the slave open."""
        if self._fds is None:
            time.sleep(max(0.0, timeout_s))
            return []
        master = self._fds[0]
        try:
            if not select.select([master], [], [], max(0.0, timeout_s))[0]:
                return []
            data = os.read(master, 65_536)
        except OSError:  # the port may vanish while this waits
            return []
        return [(None, data)] if data else []

    def send(self, peer: Peer, data: bytes) -> None:  # noqa: ARG002  # a line has one peer
        """Write what fits into the line's buffer; the rest is lost."""
        if self._fds is None:
            return
        with suppress(BlockingIOError):
            os.write(self._fds[0], data)

    def speed(self) -> int:
        """Return the baud rate that the driver has set, as a `termios` constant."""
        if self._fds is None:
            return 0
        attributes = termios.tcgetattr(self._fds[1])
        return int(attributes[OUTPUT_SPEED])

    def close(self) -> None:
        """Close the pseudo terminal and remove its folder."""
        self.vanish()
        shutil.rmtree(self._folder, ignore_errors=True)


class TcpPort:
    """TCP listener on loopback; each connection is a peer."""

    def __init__(self, port: int = 0, *, key: str = "port") -> None:
        self._key = key
        self._port = port
        self._listener: socket.socket | None = None
        self._peers: list[socket.socket] = []
        self.appear()

    @property
    def address(self) -> dict[str, Any]:
        """`{"host": "127.0.0.1", "port": N}`"""
        return {"host": LOOPBACK, self._key: self._port}

    @property
    def peers(self) -> tuple[socket.socket, ...]:
        """Return the open connections."""
        return tuple(self._peers)

    def appear(self) -> None:
        """Listen, always on the same port number."""
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((LOOPBACK, self._port))
        listener.listen(8)
        listener.setblocking(False)
        self._port = listener.getsockname()[1]
        self._listener = listener

    def vanish(self) -> None:
        """Close all connections and refuse new ones."""
        if self._listener is not None:
            self._listener.close()
        self._listener = None
        for peer in self._peers:
            peer.close()
        self._peers.clear()

    def receive(self, timeout_s: float) -> list[tuple[Peer, bytes]]:
        """Return the received bytes of each connection; a new connection is reported with empty bytes."""
        if self._listener is None:
            time.sleep(max(0.0, timeout_s))
            return []
        ready = select.select([self._listener, *self._peers], [], [], max(0.0, timeout_s))[0]
        return [item for sock in ready for item in self._take(sock)]

    def _take(self, sock: socket.socket) -> list[tuple[Peer, bytes]]:
        try:
            if sock is self._listener:
                peer, _ = sock.accept()
                peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                peer.setblocking(False)
                self._peers.append(peer)
                return [(peer, b"")]
            data = sock.recv(65_536)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if data:
            return [(sock, data)]
        self._peers.remove(sock)
        sock.close()
        return []

    def send(self, peer: Peer, data: bytes) -> None:
        """Send to one connection, or to all if `peer` is None."""
        for sock in self._peers if peer is None else [peer]:
            with suppress(OSError):
                sock.sendall(data)

    def close(self) -> None:
        """Close all connections and the listener for good."""
        self.vanish()


class UdpPort:
    """UDP socket on loopback; each sender's address is a peer."""

    def __init__(self, port: int = 0) -> None:
        self._port = port
        self._sock: socket.socket | None = None
        self.appear()

    @property
    def address(self) -> dict[str, Any]:
        """`{"host": "127.0.0.1", "port": N}`"""
        return {"host": LOOPBACK, "port": self._port}

    def appear(self) -> None:
        """Bind, always to the same port number."""
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((LOOPBACK, self._port))
        sock.setblocking(False)
        self._port = sock.getsockname()[1]
        self._sock = sock

    def vanish(self) -> None:
        """Close the socket."""
        if self._sock is not None:
            self._sock.close()
        self._sock = None

    def receive(self, timeout_s: float) -> list[tuple[Peer, bytes]]:
        """Return at most one received datagram."""
        if self._sock is None:
            time.sleep(max(0.0, timeout_s))
            return []
        if not select.select([self._sock], [], [], max(0.0, timeout_s))[0]:
            return []
        try:
            data, peer = self._sock.recvfrom(65_536)
        except OSError:
            return []
        return [(peer, data)]

    def send(self, peer: Peer, data: bytes) -> None:
        """Send one datagram to `peer`."""
        if self._sock is None or peer is None or not data:
            return
        try:
            self._sock.sendto(data, peer)
        except OSError as error:
            if error.errno not in (errno.ECONNREFUSED, errno.EAGAIN):
                raise

    def close(self) -> None:
        """Close the socket for good."""
        self.vanish()
