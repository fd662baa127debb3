"""Claim of a device for one process among all of this machine, which names its owner to the others.

The claim is the name of a Unix socket in Linux's abstract namespace, which only one process can bind. Unlike a lock file it
needs no folder that all services may write to, and the kernel releases it when the process ends, however it ends. A second
name holds the owner's description, which others read from the kernel's list of sockets.
"""

from __future__ import annotations

import errno
import os
import socket
import sys
from hashlib import sha256
from pathlib import Path

SOCKETS = Path("/proc/net/unix")
LONGEST_NAME = 100  # bytes; the kernel takes 107


class TakenBy(Exception):
    """Another process holds the claim.

    Attributes:
        owner: its description, or a general one when it cannot be read.
    """

    def __init__(self, owner: str) -> None:
        super().__init__(f"taken by {owner}")
        self.owner = owner


class HostClaim:
    """Claim that a process can take, and holds until it releases it or ends; on other systems than Linux it does nothing.

    Args:
        owner: description of the owner; the process's number precedes it.
    """

    def __init__(self, owner: str) -> None:
        self._owner = owner
        self._held: dict[str, tuple[socket.socket, socket.socket]] = {}

    def take(self, resource: str) -> None:
        """Take `resource`; a second call for the same one does nothing.

        Raises:
            TakenBy: another holder has it.
        """
        if resource in self._held or sys.platform != "linux":
            return
        try:
            claim = _bound(f"panelwright claim {_short(resource)}")
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise TakenBy(_owner_of(resource)) from None
            raise
        self._held[resource] = (claim, _bound(f"{_described(resource)}process {os.getpid()}, {self._owner}"))

    def release(self) -> None:
        """Release all that was taken; a second call does nothing."""
        while self._held:
            _, sockets = self._held.popitem()
            for sock in sockets:
                sock.close()


def _short(resource: str) -> str:
    return sha256(resource.encode()).hexdigest()[:16]


def _described(resource: str) -> str:
    return f"panelwright owner {_short(resource)}: "


def _bound(name: str) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        sock.bind(b"\0" + name.encode()[:LONGEST_NAME])
    except OSError:
        sock.close()
        raise
    return sock


def _owner_of(resource: str) -> str:
    marker = "@" + _described(resource)
    try:
        lines = SOCKETS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    owners = [line.partition(marker)[2] for line in lines if marker in line]
    return owners[0] if owners else "another program on this machine"
