"""The processes of a service, as Linux shows them in /proc."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
MODULES = {"cell": b"service.processes.cell", "stop": b"service.processes.stop"}


@dataclass(frozen=True, slots=True)
class Process:
    """One process. `began` tells it apart from a later process with the same number."""

    pid: int
    began: int

    def is_alive(self) -> bool:
        """Return whether it still exists and is no zombie."""
        status = _status(self.pid)
        return status is not None and status[1] == self.began and status[2] != "Z"


def process_of(pid: int) -> Process | None:
    """Return the process with this number, or None."""
    status = _status(pid)
    return None if status is None else Process(pid, status[1])


def family_of(pid: int) -> dict[int, Process]:
    """Return a process with all its descendants by number; empty when it has ended."""
    children: dict[int, list[int]] = {}
    known: dict[int, Process] = {}
    for entry in PROC.iterdir():
        if entry.name.isdigit() and (status := _status(int(entry.name))) is not None:
            children.setdefault(status[0], []).append(int(entry.name))
            known[int(entry.name)] = Process(int(entry.name), status[1])
    found: dict[int, Process] = {}
    waiting = [pid] if pid in known else []
    while waiting:
        one = waiting.pop()
        found[one] = known[one]
        waiting += children.get(one, [])
    return found


def roles_of(pid: int) -> dict[str, Process]:
    """Return the processes of the service `pid` by role: service, cell, stop, and world, which is a child of the cell."""
    roles: dict[str, Process] = {}
    family = family_of(pid)
    for one, process in family.items():
        words = _command(one)
        for role, module in MODULES.items():
            if module in words and (role not in roles or process.began < roles[role].began):
                roles[role] = process  # a world that the cell forked has the words of the cell
    if pid in family:
        roles["service"] = family[pid]
    if "cell" in roles:
        below = [process for one, process in family_of(roles["cell"].pid).items() if one != roles["cell"].pid]
        if below:
            roles["world"] = max(below, key=lambda process: process.began)
    return roles


def _command(pid: int) -> list[bytes]:
    try:
        return (PROC / str(pid) / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return []


def _status(pid: int) -> tuple[int, int, str] | None:
    """Return parent, start time in clock ticks and state; None when there is no such process."""
    try:
        text = (PROC / str(pid) / "stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    fields = text.rpartition(")")[2].split()  # the name in brackets may have spaces
    return int(fields[1]), int(fields[19]), fields[0]
