"""Compares time stamps with the emulator's log of when each frame was sent."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from benchmarks.drivers.benches import bench
from benchmarks.drivers.far_process import far_process
from benchmarks.drivers.report import line
from hal.arrays import Array
from hal.registry import Context, connect

TALKERS = ("tfmini", "ft300 stream", "netft", "bota", "scip serial", "lms200")


def part_stamps(seconds: float) -> None:
    """Measure the distance of each stamp to the nearest frame of the log; the emulator runs in another process."""
    for name in TALKERS:
        stamps_s, log_s = _record(name, min(seconds, 10.0))
        within = stamps_s[(stamps_s > log_s[0]) & (stamps_s < log_s[-1])]
        error_s = np.min(np.abs(log_s[np.newaxis, :] - within[:, np.newaxis]), axis=1)
        p99_ms = 1e3 * float(np.quantile(error_s, 0.99))
        line(f"{name}: stamp error, p99 of {len(within)}", "2 ms", f"{p99_ms:.2f} ms", p99_ms <= 2.0)


def _record(name: str, seconds: float) -> tuple[Array, Array]:
    item, stamps_s = bench(name), list[float]()
    with far_process(name) as far:
        device: Any = connect(Context(name="dut"), item.driver, {**far.addresses[name], **item.options})
        rest, seen, end_s = threading.Event(), 0, time.monotonic() + seconds
        while time.monotonic() < end_s:
            rest.wait(0.05)
            for sample in device.mailbox.since(seen)[0]:
                seen = sample.sequence
                stamps_s.append(sample.host_time_s)
        log_s = far.order(f"log {name}")
        device.close()
    return np.array(stamps_s), np.array(log_s)
