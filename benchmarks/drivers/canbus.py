"""Measures CAN frames and SDO reads over a virtual bus and over slcan on a pty, in turns with the bare libraries."""

from __future__ import annotations

import os
import pty
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import Any
from uuid import uuid4

import can

from benchmarks.drivers.far_process import far_process
from benchmarks.drivers.report import line, percentiles
from drivers.cia402.setup import SDO_ANSWER, SDO_REQUEST, SdoClient, upload_request
from drivers.emulators import cia402, scripted
from drivers.tfmini_i import CanTfminiOptions
from drivers.transport.can_frames import HEAD, CanFrame
from drivers.transport.canbus import can_opener
from drivers.transport.link import Link, now_s
from drivers.transport.slcan import INTERFACE, line_of

FRAME = CanFrame(0x181, bytes(range(8)))
RECORD = HEAD.size + len(FRAME.data)
NODE, OBJECT = 1, 0x6060
TURN_S = 0.25  # short turns, so that both see the same load
QUEUED = 500  # frames on the virtual bus before its sender waits
OpenBus = Callable[[], can.BusABC]


def part_can(seconds: float) -> None:
    """Measure frames per second one way, SDO reads per second, and what our link adds to an exchange on the bare bus."""
    for what, flood in (("virtual", _flooded_virtual), ("slcan on a pty", _flooded_pty)):
        with flood() as (options, bare):
            ours, theirs = _frames(options, bare, seconds)
        measured = f"{ours:.0f}/s ({ours / theirs:.1f}x {theirs:.0f}/s of python-can's)"
        line(f"CAN frames one way, {what}", "5000/s", measured, ours >= 5000)
    with far_process("cia402") as far:
        path = far.addresses["cia402"]["channel"]
        own = _bus(path, "slcan", sleep_after_open=0)
        _reads("slcan on a pty", {"channel": path}, _bus(path, INTERFACE), seconds, own)
    with closing(cia402.start(scripted.ScriptedArm(), {"transport": "virtual"})) as far_side:
        channel = far_side.address["channel"]
        _reads("virtual", {"channel": channel, "interface": "virtual"}, _bus(channel, "virtual"), seconds)


def _bus(channel: str, interface: str, **more: Any) -> OpenBus:
    return lambda: can.Bus(channel, interface, ignore_config=True, bitrate=1_000_000, **more)


def _opened(options: dict[str, Any]) -> Link:
    return can_opener(CanTfminiOptions(bitrate=1_000_000, **options), "bench")[0]()


@contextmanager
def _flooded_virtual() -> Iterator[tuple[dict[str, Any], OpenBus]]:
    """Yield a bus on which a thread sends as fast as the receiver takes."""
    channel, ending = uuid4().hex, threading.Event()
    sender: Any = can.Bus(channel, "virtual", ignore_config=True)
    message = can.Message(arbitration_id=FRAME.id, data=FRAME.data, is_extended_id=False)

    def flood() -> None:
        while not ending.is_set():
            if sum(queue.qsize() for queue in sender.channel) < QUEUED:
                sender.send(message)
            else:
                ending.wait(1e-4)

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        yield {"channel": channel, "interface": "virtual"}, _bus(channel, "virtual")
    finally:
        ending.set()
        thread.join()
        sender.shutdown()


@contextmanager
def _flooded_pty() -> Iterator[tuple[dict[str, Any], OpenBus]]:
    """Yield a pty to which a process writes lines as fast as they are read."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    writer = os.fork()
    if not writer:
        try:
            while True:
                os.write(master, line_of(FRAME.id, FRAME.data))
        finally:
            os._exit(0)
    try:
        path = os.ttyname(slave)
        yield {"channel": path}, _bus(path, "slcan", sleep_after_open=0)
    finally:
        os.kill(writer, 9)
        os.waitpid(writer, 0)
        os.close(master)
        os.close(slave)


def _frames(options: dict[str, Any], bare: OpenBus, seconds: float) -> tuple[float, float]:
    """Return the frames per second by our link and by the bare bus."""
    ours = theirs = turns = 0
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        turns += 1
        with closing(_opened(options)) as link:
            ours += _counted(partial(_received, link))
        with bare() as bus:
            theirs += _counted(partial(_received_bare, bus))
    return ours / (turns * TURN_S), theirs / (turns * TURN_S)


def _received(link: Link) -> int:
    return len(link.read(now_s() + 1.0)) // RECORD


def _received_bare(bus: can.BusABC) -> int:
    return bus.recv(1.0) is not None


def _counted(work: Callable[[], int]) -> int:
    count, end_s = 0, time.monotonic() + TURN_S
    while time.monotonic() < end_s:
        count += work()
    return count


def _reads(what: str, options: dict[str, Any], bare: OpenBus, seconds: float, own: OpenBus | None = None) -> None:
    """Print SDO reads per second and, against the bare bus, the duration of one.

    Args:
        own: opens python-can's bus for the same adapter, if ours takes its place.
    """
    ours_s: list[float] = []
    bare_s: list[float] = []
    own_s: list[float] = []
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        with closing(_opened(options)) as link:
            ours_s += _timed(partial(SdoClient(link).upload, NODE, OBJECT, 0))
        for opened, times_s in ((bare, bare_s), (own, own_s)):
            if opened is not None:
                with opened() as bus:
                    times_s.extend(_timed(partial(_bare_read, bus)))
    per_s, own_per_s = len(ours_s) / sum(ours_s), len(own_s) / sum(own_s) if own_s else 0.0
    beside = f" ({per_s / own_per_s:.1f}x {own_per_s:.0f}/s of python-can's)" if own_s else ""
    line(f"SDO reads, {what}", "3000/s", f"{per_s:.0f}/s{beside}", per_s >= 3000)
    (p50, p99), (bare_p50, bare_p99) = percentiles(ours_s), percentiles(bare_s)
    is_good = p50 - bare_p50 <= 60 and p99 - bare_p99 <= 300
    measured = f"{p50 - bare_p50:+.0f} / {p99 - bare_p99:+.0f} us (bare {bare_p50:.0f} / {bare_p99:.0f})"
    line(f"SDO read over the bare bus, {what}, p50 / p99", "+60 / +300 us", measured, is_good)


def _timed(work: Callable[[], Any]) -> list[float]:
    times_s, end_s = [], time.monotonic() + TURN_S
    while (started_s := time.monotonic()) < end_s:
        work()
        times_s.append(time.monotonic() - started_s)
    return times_s


def _bare_read(bus: can.BusABC) -> None:
    request = upload_request(OBJECT, 0)
    bus.send(can.Message(arbitration_id=SDO_REQUEST + NODE, data=request, is_extended_id=False))
    while (answer := bus.recv(1.0)) is None or answer.arbitration_id != SDO_ANSWER + NODE:
        pass
