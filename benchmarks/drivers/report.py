"""Functions that the parts share: rows of the table, deadlines, percentiles, rates."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

from hal.clock import Deadline, WallClock

CLOCK = WallClock()
READ_S = 0.3


def deadline(duration_s: float = READ_S) -> Deadline:
    """Return a deadline that begins now."""
    return Deadline.after(CLOCK, duration_s)


def line(what: str, limit: str, measured: str, is_good: bool) -> None:
    """Print one row of the table."""
    print(f"{what:<52} {limit:>22} {measured:>34}  {'PASS' if is_good else 'FAIL'}", flush=True)


def percentiles(samples_s: list[float]) -> tuple[float, float]:
    """Return p50 and p99 in microseconds."""
    ordered = sorted(samples_s)
    return 1e6 * statistics.median(ordered), 1e6 * ordered[int(0.99 * len(ordered))]


def cpu_rate(work: Callable[[], Any], seconds: float) -> float:
    """Return the calls per second of this process's CPU time, as on an idle machine."""
    count, start_s = 0, time.process_time()
    while time.process_time() - start_s < seconds:
        for _ in range(10):
            work()
        count += 10
    return count / (time.process_time() - start_s)
