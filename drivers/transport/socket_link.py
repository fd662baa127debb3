"""TCP and UDP links. A UDP link is connected, so datagrams from other senders never reach the driver."""

from __future__ import annotations

import errno
import os
import socket

from drivers.transport.fd_link import CHUNK_BYTES, FdLink
from drivers.transport.link import LinkLost
from hal.errors import DeviceUnavailable


class SocketLink(FdLink):
    """Link over an open, connected socket."""

    def __init__(self, sock: socket.socket, name: str) -> None:
        super().__init__(sock.fileno(), name)
        self._sock = sock

    @property
    def addresses(self) -> tuple[tuple[str, int], tuple[str, int]]:
        """Return host and port of this end, then those of the other end.

        Raises:
            LinkLost: the connection has been lost.
        """
        try:
            ours, theirs = self._sock.getsockname(), self._sock.getpeername()
        except OSError as error:
            raise LinkLost(f"{self.name}: {error}") from error
        return (str(ours[0]), int(ours[1])), (str(theirs[0]), int(theirs[1]))

    def _release(self, fd: int) -> None:  # noqa: ARG002  # the socket closes it
        self._sock.close()


class DatagramLink(SocketLink):
    """Connected UDP socket: each read returns one datagram."""

    def read(self, until_s: float) -> bytes:
        """Return one datagram; a remote device that is not up yet counts as silence, not as a lost link."""
        try:
            if self._has_bytes(until_s):
                data = self._sock.recv(CHUNK_BYTES)
                self.received += len(data)
                return data
        except (ConnectionRefusedError, BlockingIOError):
            return b""
        except (OSError, ValueError) as error:
            raise LinkLost(f"{self.name}: {error}") from error
        return b""

    def _write_all(self, data: bytes, until_s: float) -> None:
        try:
            super()._write_all(data, until_s)
        except ConnectionRefusedError:
            os.write(self._fd, data)  # the error belonged to an earlier datagram


def open_tcp(host: str, port: int, *, timeout_s: float, device: str) -> SocketLink:
    """Open a TCP connection within `timeout_s`.

    Raises:
        DeviceUnavailable: the connection could not be made.
    """
    try:
        sock = socket.create_connection((host, port), timeout=timeout_s)
    except OSError as error:
        raise _unavailable(host, port, device, error) from error
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setblocking(False)
    return SocketLink(sock, f"tcp {host}:{port}")


def open_udp(host: str, port: int, *, device: str) -> DatagramLink:
    """Open a UDP socket that exchanges datagrams with `host:port` only.

    Raises:
        DeviceUnavailable: the host's name cannot be resolved, or there is no route to it.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.connect((host, port))
    except OSError as error:
        sock.close()
        raise _unavailable(host, port, device, error) from error
    sock.setblocking(False)
    return DatagramLink(sock, f"udp {host}:{port}")


def _unavailable(host: str, port: int, device: str, error: OSError) -> DeviceUnavailable:
    if error.errno == errno.ECONNREFUSED:
        what, hint = f"{host}:{port} refuses the connection", "is the device's server on, and the port right?"
    elif isinstance(error, TimeoutError):
        what, hint = f"{host}:{port} does not answer", "check power, cable, address and firewall"
    else:
        what, hint = f"{host}:{port} cannot be reached: {error}", "check host and port"
    return DeviceUnavailable(f"{device}: {what}", hint=hint, device=device, link=f"{host}:{port}")
