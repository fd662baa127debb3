"""Measures repeated unplugging, and the effect of all devices together on loops in the same process."""

from __future__ import annotations

import asyncio
import threading
import time
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import psutil

from benchmarks.drivers.bench import Bench
from benchmarks.drivers.benches import BENCHES, bench, running
from benchmarks.drivers.far_process import far_process
from benchmarks.drivers.realtime import PRIORITIES, realtime
from benchmarks.drivers.report import deadline, line
from hal.errors import CellError
from hal.registry import Context, connect

UNPLUGS = 100
GIVE_UP_S = 10.0
CONTROL_S, EVENT_S = 0.002, 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class Unplugging:
    """How long a driver needed after each return of its port, and what leaked meanwhile."""

    back_s: tuple[float, ...]
    leaked_descriptors: int
    leaked_threads: int


def part_reconnect(seconds: float) -> None:  # noqa: ARG001  # a number of unplugs, however long they take
    """Measure the time from the port's return to the first valid sample, and leaks of descriptors and threads."""
    for name in ("tfmini", "modbus_io rtu", "scip tcp", "bota", "cia402", "tfmini can"):
        found = unplugging(bench(name), UNPLUGS)
        leaked = (found.leaked_descriptors, found.leaked_threads)
        measured = f"{max(found.back_s):.2f} s of {UNPLUGS}; leak {leaked}"
        is_good = max(found.back_s) <= 1 and leaked == (0, 0)
        line(f"{name}: back after unplugging, worst; leaks", "1 s; (0, 0)", measured, is_good)


def unplugging(item: Bench, times: int) -> Unplugging:
    """Unplug the far side of a driver repeatedly, for 20 ms each time."""
    process, back_s = psutil.Process(), list[float]()
    with running(item, {}) as (device, far_side, _):
        device.newest(deadline(2.0))
        descriptors, threads = process.num_fds(), threading.active_count()
        for _ in range(times):
            far_side.unplug(away_s=0.02)
            back_s.append(_back_after(device, time.monotonic()))
        return Unplugging(
            back_s=tuple(back_s),
            leaked_descriptors=process.num_fds() - descriptors,
            leaked_threads=threading.active_count() - threads,
        )


def _back_after(device: Any, returned_s: float) -> float:
    """Return when the first new sample came, at most `GIVE_UP_S`."""
    rest = threading.Event()
    while time.monotonic() - returned_s < GIVE_UP_S:
        with suppress(CellError):
            device.newest(deadline(0.2), not_before_s=returned_s)
            break
        rest.wait(0.001)
    return time.monotonic() - returned_s


def part_isolation(seconds: float) -> None:
    """Measure a 500 Hz control loop and an event loop beside all drivers, with running, silent or disconnected devices.

    This is done at ordinary priority, where a busy machine delays the loops anyway (the floor is the same loops without
    drivers), and at real-time priority.
    """
    names = tuple(
        item.name
        for item in BENCHES
        if item.far_options.get("transport") != "virtual"
        and item.is_plugged
        and not item.is_alone
        and item.make is None
    )  # a virtual bus is in one process only; a file and a lone program take no orders
    for priority, word in PRIORITIES:
        with far_process(*names) as far, realtime(priority, far.pid) as is_given, ExitStack() as stack:
            if not is_given:
                line(f"{len(names)} devices, {word}", "5 ms", "real-time priority is not allowed here", is_good=False)
                continue
            floor = _lateness(seconds / 4)
            for name in names:
                item = bench(name)
                options = {**far.addresses[name], **item.options}
                stack.enter_context(closing(connect(Context(name=name.replace(" ", "_")), item.driver, options)))
            for fault in ("none", "silent", "disconnected"):
                far.order(f"inject {fault}")
                control_ms, event_ms = _lateness(seconds / 4)
                what = "running" if fault == "none" else fault
                measured = f"{control_ms:.1f} / {event_ms:.1f} ms (floor {floor[0]:.1f} / {floor[1]:.1f})"
                is_good = max(control_ms, event_ms) <= 5.0
                line(f"{len(names)} devices {what}, {word}: control / event p99.9", "5 ms", measured, is_good)
            far.order("inject none")


def _lateness(seconds: float) -> tuple[float, float]:
    """Return how late a control loop and an event loop wake: p99.9 in ms."""
    control_s: list[float] = []
    thread = threading.Thread(target=lambda: _control(seconds, control_s))
    thread.start()
    event_s = asyncio.run(_event(seconds))
    thread.join()
    return 1e3 * float(np.quantile(control_s, 0.999)), 1e3 * float(np.quantile(event_s, 0.999))


def _control(seconds: float, late_s: list[float]) -> None:
    due_s = time.monotonic()
    end_s = due_s + seconds
    while due_s < end_s:
        due_s += CONTROL_S
        time.sleep(max(0.0, due_s - time.monotonic()))
        late_s.append(max(0.0, time.monotonic() - due_s))
        due_s = max(due_s, time.monotonic() - CONTROL_S)


async def _event(seconds: float) -> list[float]:
    late_s, end_s = [], time.monotonic() + seconds
    while (started_s := time.monotonic()) < end_s:
        await asyncio.sleep(EVENT_S)
        late_s.append(max(0.0, time.monotonic() - started_s - EVENT_S))
    return late_s
