"""Arms: state streams, synchronous set-points, and the device's own watchdog."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from contextlib import closing
from typing import Any

from benchmarks.drivers.benches import Bench, bench, running
from benchmarks.drivers.far_process import far_process
from benchmarks.drivers.report import deadline, line
from hal.registry import Context, connect


def part_ur(seconds: float) -> None:
    """500 Hz state stream: dropped packages."""
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
    """Six axes in cyclic synchronous position at 250 Hz: SYNCs that were not sent, the far side in its own process."""
    item, options = bench("cia402"), {"rate_hz": 250.0, "heartbeat_s": 1.0}
    with far_process("cia402") as far:
        device: Any = connect(Context(name="arm"), item.driver, {**far.addresses["cia402"], **options})
        with closing(device):
            device.enable(deadline=deadline(2.0))
            start = device.read_state(deadline=deadline()).value.position_rad
            rest, end_s = threading.Event(), time.monotonic() + seconds
            missed, seen = device.missed_syncs, far.order("count cia402 syncs")
            while time.monotonic() < end_s:
                device.command_position(start, deadline=deadline())
                rest.wait(0.004)
            missed, seen = device.missed_syncs - missed, far.order("count cia402 syncs") - seen
    share = missed / max(1, missed + seen)
    line(f"CiA-402, six axes CSP at 250 Hz, {seen} SYNCs: missed", "1e-3", f"{missed} ({share:.1e})", share <= 1e-3)


def part_kill(seconds: float) -> None:
    """Host process killed in motion: how long until the device's own watchdog stops the arm behind it."""
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
