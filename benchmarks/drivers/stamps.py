"""Compares time stamps with the emulator's log of when each frame was sent."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.drivers.bench import Bench
from benchmarks.drivers.benches import bench, running
from benchmarks.drivers.far_process import far_process
from benchmarks.drivers.report import line
from hal.arrays import Array
from hal.registry import Context, connect

TALKERS = ("tfmini", "ft300 stream", "netft", "bota", "scip serial", "lms200")


def part_stamps(seconds: float) -> None:
    """Measure the distance of each stamp to the nearest frame of the log; the emulator runs in another process."""
    for name in TALKERS:
        error_s = stamp_errors_s(bench(name), min(seconds, 10.0))
        p99_ms = 1e3 * float(np.quantile(error_s, 0.99))
        line(f"{name}: stamp error, p99 of {len(error_s)}", "2 ms", f"{p99_ms:.2f} ms", p99_ms <= 2.0)


def stamp_errors_s(item: Bench, seconds: float) -> Array:
    """Return how wrong each time stamp was, in seconds, by the log of sent frames or by when the value was taken."""
    if item.stamps == "taken" and item.taken_s is not None:
        return _errors_by_value(item, item.taken_s, seconds)
    if item.stamps == "device":
        return _errors_by_device(item, seconds)
    stamps_s, log_s = (_record_here if item.stamps == "own log" else _record)(item, seconds)
    within = stamps_s[(stamps_s > log_s[0]) & (stamps_s < log_s[-1])]
    errors_s: Array = np.min(np.abs(log_s[np.newaxis, :] - within[:, np.newaxis]), axis=1)
    return errors_s


def _errors_by_value(item: Bench, taken_s: Callable[[Any, Any], float], seconds: float) -> Array:
    """Compare stamps with the time that each value encodes; driver and emulator share this process."""
    errors_s, seen = list[float](), 0
    with running(item, {}) as (device, _, backing):
        rest, end_s = threading.Event(), time.monotonic() + seconds
        while time.monotonic() < end_s:
            rest.wait(0.02)
            for sample in device.mailbox.since(seen)[0]:
                seen = sample.sequence
                errors_s.append(abs(sample.host_time_s - taken_s(sample.value, backing)))
    return np.array(errors_s)


def _errors_by_device(item: Bench, seconds: float) -> Array:
    """Compare stamps, which date the beginning of an exposure, with those of a camera that has this machine's clock."""
    errors_s, seen = list[float](), 0
    with running(item, {}) as (device, _, _):
        rest, end_s = threading.Event(), time.monotonic() + seconds
        while time.monotonic() < end_s:
            rest.wait(0.02)
            for sample in device.mailbox.since(seen)[0]:
                seen = sample.sequence
                exposed_s = sample.device_time_s - (time.time() - time.monotonic())
                errors_s.append(abs(sample.host_time_s + sample.value.exposure_s - exposed_s))
    return np.array(errors_s)


def _record(item: Bench, seconds: float) -> tuple[Array, Array]:
    """Return the driver's stamps, and when the emulator in another process sent its frames."""
    with far_process(item.name) as far:
        device: Any = connect(Context(name="dut"), item.driver, {**far.addresses[item.name], **item.options})
        stamps_s = _stamps_of(device, seconds)
        log_s = far.order(f"log {item.name}")
        device.close()
    return stamps_s, np.array(log_s)


def _record_here(item: Bench, seconds: float) -> tuple[Array, Array]:
    """Return the same of an emulator in this process."""
    with running(item, {}) as (device, far_side, _):
        return _stamps_of(device, seconds), np.array([sent_s for sent_s, _ in list(far_side.sent)])


def _stamps_of(device: Any, seconds: float) -> Array:
    stamps_s, rest, seen, end_s = list[float](), threading.Event(), 0, time.monotonic() + seconds
    while time.monotonic() < end_s:
        rest.wait(0.05)
        for sample in device.mailbox.since(seen)[0]:
            seen = sample.sequence
            stamps_s.append(sample.host_time_s)
    return np.array(stamps_s)
