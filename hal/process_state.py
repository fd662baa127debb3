"""Says of another process of this machine whether it runs, is suspended or has ended."""

from __future__ import annotations

import os
from contextlib import suppress
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
