"""Measures arms: state streams, synchronous set-points, and the device's own watchdog."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from contextlib import closing
from itertools import product
from typing import Any

import numpy as np

from benchmarks.drivers.bench import Bench
from benchmarks.drivers.benches import bench, running
from benchmarks.drivers.far_process import FarProcess, far_process
from benchmarks.drivers.realtime import PRIORITIES, realtime
from benchmarks.drivers.report import deadline, line
from hal.errors import CellError
from hal.registry import Context, connect

CYCLE_S = 0.004


def part_ur(seconds: float) -> None:
    """Count the dropped packages of a 500 Hz state stream."""
    with running(bench("ur"), {"rate_hz": 500.0}) as (device, far_side, _):
        rest = threading.Event()
        rest.wait(0.5)
        first, sent_before = device.mailbox.published, far_side.plan.frames
        rest.wait(seconds)
        got, sent = device.mailbox.published - first, far_side.plan.frames - sent_before
    line(
        f"UR at 500 Hz for {seconds:.0f} s: sent, dropped",
        "0 dropped",
        f"{sent} sent, {max(0, sent - got)} dropped",
        sent - got <= 1,
    )


def part_csp(seconds: float) -> None:
    """Count the SYNCs not sent to six axes in cyclic synchronous position at 250 Hz; the drives are in another process.

    The links are a pty, whose bytes are carried by a kernel thread of ordinary priority, and TCP, whose bytes are
    carried by the sender. The process has ordinary priority, where only the driver's owner thread requests real-time
    priority, or host and drives have real-time priority (`chrt -r 10`). The misses of a bare 250 Hz loop are given for
    comparison, because no driver can do better.
    """
    for (priority, word), transport in product(PRIORITIES, ("serial", "tcp")):
        what = f"CSP at 250 Hz, slcan over {transport}, {word}: SYNCs not sent"
        with far_process(f"cia402?transport={transport}") as far, realtime(priority, far.pid) as is_given:
            if not is_given:
                line(what, "1e-3", "real-time priority is not allowed here", is_good=False)
                continue
            floor, (seen, missed, held) = _bare_loop(min(seconds, 5.0)), _cyclic_positions(far, seconds)
        share = (missed + held) / max(1, missed + held + seen)
        measured = f"{missed} late + {held} held of {seen} ({share:.1e}; floor {floor:.1e})"
        line(what, "1e-3", measured, share <= 1e-3)


def _bare_loop(seconds: float) -> float:
    """Return the fraction of periods that a loop that only sleeps misses."""
    due_s = time.monotonic()
    end_s, missed, ticks = due_s + seconds, 0, 0
    while due_s < end_s:
        due_s += CYCLE_S
        time.sleep(max(0.0, due_s - time.monotonic()))
        late = int((time.monotonic() - due_s) / CYCLE_S)
        missed, ticks, due_s = missed + late, ticks + 1 + late, due_s + late * CYCLE_S
    return missed / ticks


def _cyclic_positions(far: FarProcess, seconds: float) -> tuple[int, int, int]:
    """Return the numbers of SYNCs that the drives received, that were too late to send, and that waited for answers."""
    item, options = bench("cia402"), {"rate_hz": 1.0 / CYCLE_S, "heartbeat_s": 1.0}
    device: Any = connect(Context(name="arm"), item.driver, {**far.addresses["cia402"], **options})
    with closing(device):
        device.enable(deadline=deadline(2.0))
        start = device.read_state(deadline=deadline()).value.position_rad
        rest, end_s = threading.Event(), time.monotonic() + seconds

        def counts() -> np.ndarray:
            return np.array([far.order("count cia402 syncs"), device.missed_syncs, device.held_syncs])

        before = counts()
        while time.monotonic() < end_s:
            try:
                device.command_position(start, deadline=deadline())
            except CellError:  # the machine stood still for a second, so the drives' watchdog tripped
                device.enable(deadline=deadline(5.0))
            rest.wait(CYCLE_S)
        seen, missed, held = (counts() - before).tolist()
    return seen, missed, held


def part_kill(seconds: float) -> None:
    """Kill the host process during a motion and measure how long the device's own watchdog takes to stop the arm."""
    for name in ("ur", "cia402", "dynamixel"):
        stops_s = [_kill_once(bench(name)) for _ in range(max(3, int(seconds / 2)))]
        measured = f"{1e3 * max(stops_s):.0f} ms of {len(stops_s)}"
        line(f"{name}: host killed, arm stopped, worst", "300 ms", measured, max(stops_s) <= 0.3)


HOST = """
import json, sys, time
from hal.clock import Deadline, WallClock
from hal.errors import CellError
from hal.registry import Context, connect
driver, options = json.loads(sys.argv[1])
clock = WallClock()
arm = connect(Context(name="arm"), driver, options)
arm.enable(deadline=Deadline.after(clock, 2.0))
here = arm.read_state(deadline=Deadline.after(clock, 1.0)).value.position_rad
while True:
    try:
        arm.command_position(here, deadline=Deadline.after(clock, 1.0))
    except CellError:  # a busy machine: the watchdog was quicker than this process
        arm.enable(deadline=Deadline.after(clock, 2.0))
    print("moving", flush=True)
    time.sleep(0.01)
"""


def _kill_once(arm: Bench) -> float:
    backing = arm.backing()
    far_side = arm.start(backing, arm.far_options)
    options = {**far_side.address, **arm.options}
    host = subprocess.Popen(
        [sys.executable, "-c", HOST, json.dumps([arm.driver, options])], stdout=subprocess.PIPE, text=True
    )
    rest = threading.Event()
    try:
        while backing.commands < 5:
            assert host.stdout is not None
            if not host.stdout.readline():
                raise RuntimeError("the host process ended before it moved the arm")
        host.kill()
        killed_s = time.monotonic()
        while backing.is_enabled and time.monotonic() < killed_s + 5.0:
            rest.wait(0.001)
        return time.monotonic() - killed_s
    finally:
        host.kill()
        host.wait()
        far_side.close()
