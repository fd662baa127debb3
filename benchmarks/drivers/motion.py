"""Arms: state streams, synchronous set-points, and the device's own watchdog."""

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

from benchmarks.drivers.benches import Bench, bench, running
from benchmarks.drivers.far_process import FarProcess, far_process
from benchmarks.drivers.realtime import PRIORITIES, realtime
from benchmarks.drivers.report import deadline, line
from hal.errors import CellError
from hal.registry import Context, connect

CYCLE_S = 0.004


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
    """Six axes in cyclic synchronous position at 250 Hz: SYNCs that were not sent, the far side in its own process.

    Over a pty, whose bytes a kernel thread of ordinary priority carries, and over TCP, whose bytes the sender carries
    himself; as an ordinary process, where only the driver's owner thread asks for real-time priority, and with host and drives
    at real-time priority (`chrt -r 10`). Beside each stands what a bare loop of 250 Hz misses: no driver can do better.
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
    """Share of the periods that a loop of nothing but sleeping misses."""
    due_s = time.monotonic()
    end_s, missed, ticks = due_s + seconds, 0, 0
    while due_s < end_s:
        due_s += CYCLE_S
        time.sleep(max(0.0, due_s - time.monotonic()))
        late = int((time.monotonic() - due_s) / CYCLE_S)
        missed, ticks, due_s = missed + late, ticks + 1 + late, due_s + late * CYCLE_S
    return missed / ticks


def _cyclic_positions(far: FarProcess, seconds: float) -> tuple[int, int, int]:
    """SYNCs that the drives saw, that came too late to be sent, and that were held back for drives that owed answers."""
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
            except CellError:  # a machine that stood still for a second: the drives' watchdog was quicker
                device.enable(deadline=deadline(5.0))
            rest.wait(CYCLE_S)
        seen, missed, held = (counts() - before).tolist()
    return seen, missed, held


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
