"""One owner for each part of a controller: among the processes of this machine, and among the clients of the controller.

On this machine a claim of the host decides, so that the second process is refused before it changes anything. Between
machines the controller decides: an RTDE input belongs to the client that asked for it first, and a second one is refused
with IN_USE. The owner of the arm writes its address and process into two registers, which the second one reads.
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Callable

from drivers.transport.host_claim import HostClaim, TakenBy
from drivers.transport.link import Link, WireError, now_s
from drivers.transport.options import CONNECT_TIMEOUT_S
from drivers.transport.socket_link import SocketLink, open_tcp
from drivers.ur.program import FIRST_REGISTER, JOINTS
from drivers.ur.session import RtdeSession
from hal.errors import CellError, DeviceUnavailable
from hal.registry import Context

MARKS = tuple(f"input_int_register_{FIRST_REGISTER + JOINTS + i}" for i in (1, 2))  # address and process of the owner
RATE_HZ = 125.0
UNKNOWN = "another RTDE client, which cannot be named"


class Ownership:
    """Takes one part of a controller for a device, and names who has it otherwise.

    Args:
        part: `the arm` or `the digital outputs`.
    """

    def __init__(self, context: Context, part: str) -> None:
        cell = f" of cell {context.cell.file.cell.name}" if context.cell is not None else ""
        self._device, self._part = context.name, part
        self._claim = HostClaim(f"{context.name}{cell}")
        self.release: Callable[[], None] = self._claim.release

    def take(self, link: SocketLink) -> None:
        """Take the part among the processes of this machine.

        Raises:
            DeviceUnavailable: another process has it; the error names it.
        """
        _, (host, port) = link.addresses
        try:
            self._claim.take(f"{host}:{port}/{self._part}")
        except TakenBy as taken:
            raise self.refusal(host, port, taken.owner) from None

    def refusal(self, host: str, port: int, owner: str) -> DeviceUnavailable:
        """Return the error of a part that `owner` has."""
        return DeviceUnavailable(
            f"{self._device}: {self._part} of the controller at {host}:{port} is taken by {owner}",
            hint="end that program; if it has lost its connection, the controller releases the part when it notices that",
            device=self._device,
            owner=owner,
        )


def marks(link: SocketLink) -> tuple[int, int]:
    """Return what the owner writes into `MARKS`: the IPv4 address of its end of the link (0 for another), its process."""
    (host, _), _ = link.addresses
    try:
        address: int = struct.unpack(">i", socket.inet_aton(host))[0]
    except OSError:
        address = 0
    return address, os.getpid()


def named(address: int, process: int) -> str:
    """Return the owner that these marks name, in words."""
    if not address:
        return UNKNOWN
    return f"process {process} on {socket.inet_ntoa(struct.pack('>i', address))}"


def owner_by_marks(host: str, port: int, *, answer_s: float, device: str) -> str:
    """Return who has marked the controller as its own, over a connection of its own."""
    try:
        link = open_tcp(host, port, timeout_s=CONNECT_TIMEOUT_S, device=device)
    except CellError:
        return UNKNOWN
    try:
        return _read_owner(link, answer_s)
    except WireError:
        return UNKNOWN
    finally:
        link.close()


def _read_owner(link: Link, answer_s: float) -> str:
    session = RtdeSession(answer_s=answer_s)
    session.begin(link, outputs=(*MARKS, "timestamp"), rate_hz=RATE_HZ)
    until_s = now_s() + answer_s
    while chunk := link.read(until_s):
        for values in session.take(chunk):
            return named(*(int(values[mark]) for mark in MARKS))
    return UNKNOWN
