"""Says of another process of this machine whether it runs, is suspended or has ended, and what its threads did."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path


class ProcessState(StrEnum):
    """What the operating system says of a process; each value completes a sentence about it."""

    RUNS = "runs"
    SUSPENDED = "is suspended by a signal or a debugger"
    ENDED = "has ended"


def process_state(pid: int) -> ProcessState:
    """Return the state of a process; where there is no /proc, a suspended process seems to run."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return _state_without_proc(pid)
    except OSError:
        return ProcessState.ENDED  # it ended while the file was read
    letter = stat.rpartition(")")[2].split()[0]  # the name before it may hold blanks and brackets
    if letter in "tT":
        return ProcessState.SUSPENDED
    return ProcessState.ENDED if letter in "ZXx" else ProcessState.RUNS


def _state_without_proc(pid: int) -> ProcessState:
    try:
        os.kill(pid, 0)
    except PermissionError:
        return ProcessState.RUNS
    except OSError:
        return ProcessState.ENDED
    return ProcessState.RUNS


COMPUTES, MOVES = 300, 0  # of 1000, which Linux adds to the share of the memory that a process uses


def set_memory_priority(score: int) -> None:
    """Tell Linux which processes to end first when the memory runs out: those with the highest score.

    A process without privileges may raise its score, and lower it again to what it was. Elsewhere this does nothing.
    """
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(f"{score}\n", encoding="ascii")


@dataclass(frozen=True, slots=True, kw_only=True)
class ThreadTimes:
    """What a thread has had of the machine since it began.

    Attributes:
        state: letter of the operating system: R runs or could run, D waits in the kernel (for a disk), S sleeps.
        computed_s: time on a processor.
        waited_s: time in which it could have run and no processor was free, up to its newest turn.
        turns: how often it has had a processor.
    """

    state: str
    computed_s: float
    waited_s: float
    turns: int


def threads_of(pid: int) -> dict[int, ThreadTimes]:
    """Return the threads of a process by id; empty where the operating system does not tell their times."""
    try:
        names = [int(task.name) for task in Path(f"/proc/{pid}/task").iterdir()]
    except OSError:
        return {}
    threads = {name: thread_times(pid, name) for name in names}
    return {name: times for name, times in threads.items() if times is not None}


def thread_times(pid: int, thread: int) -> ThreadTimes | None:
    """Return the times of one thread; None when it has ended, or where the operating system does not tell them."""
    folder = Path(f"/proc/{pid}/task/{thread}")
    try:
        computed, waited, turns = (folder / "schedstat").read_text(encoding="ascii").split()
        stat = (folder / "stat").read_text(encoding="utf-8", errors="replace")
    except (OSError, ValueError):
        return None
    letter = stat.rpartition(")")[2].split()[0]
    return ThreadTimes(state=letter, computed_s=1e-9 * int(computed), waited_s=1e-9 * int(waited), turns=int(turns))
