"""Drivers on bad and good wires: `python -m benchmarks.drivers [--seconds S] [--only PART,...]`.

Parts: faults (device x fault x every 3rd and 20th frame), latency (over a bare port), rtu (ratio to pymodbus), decode,
stamps, reconnect, ur, csp, kill, fuzz. Each line: what, pass line, measured, PASS or FAIL.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import random
import statistics
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import psutil

from drivers import dxl2, rtde
from drivers.bota import framer as bota_framer
from drivers.emulators import (
    bota,
    cia402,
    dynamixel,
    ft300,
    lms200,
    modbus_io,
    netft,
    robotiq_2f,
    rplidar,
    scip,
    scripted,
    tfmini,
    ur,
)
from drivers.emulators.base import WireEmulator
from drivers.emulators.beams import line_m
from drivers.emulators.faults import WireFault
from drivers.ft300 import stream_framer
from drivers.lms200 import framer as lms_framer
from drivers.rplidar import NodeParser, decode
from drivers.scip import ScipParser, decode_ranges_mm
from drivers.tfmini import data_framer
from drivers.transport.framing import Framer
from drivers.transport.modbus import ModbusRtu
from drivers.transport.serial_link import open_serial
from hal.clock import Deadline, WallClock
from hal.devices import RangeImage
from hal.errors import CellError
from hal.readings import Quality, Stamped
from hal.registry import Context, connect

CLOCK = WallClock()
READ_S = 0.3
SLACK_S = 0.05
YOUNG_S = 0.6  # a true value no older than this counts as fresh; the stamp must say how old it is


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """One device to try: far side, driver, options, and whether a value is one of the last true ones."""

    name: str
    start: Callable[[Any, dict[str, Any]], WireEmulator]
    backing: Callable[[], Any]
    driver: str
    is_true: Callable[[Any, Any], bool]
    options: dict[str, Any]
    far_options: dict[str, Any]
    faults: tuple[WireFault, ...] = tuple(WireFault)


def deadline(duration_s: float = READ_S) -> Deadline:
    """From now."""
    return Deadline.after(CLOCK, duration_s)


def true_wrench(value: Any, backing: Any) -> bool:
    """All six components of one of the last 100 readings."""
    index = round(value.force_n[0] / 0.01)
    true = scripted.scripted_wrench(index)
    got, want = [*value.force_n, *value.torque_nm], [*true.force_n, *true.torque_nm]
    return backing.reads - 100 <= index <= backing.reads and bool(np.allclose(got, want, atol=0.0052))


def true_distance(value: float, backing: Any) -> bool:
    """A whole millimetre step of one of the last 100 readings."""
    steps = (value - backing.first_m) / 0.001
    index = backing.reads % 1000
    return bool(abs(steps - round(steps)) < 1e-6 and (index - round(steps)) % 1000 <= 100)


def true_scan(angles: Callable[[int], Any]) -> Callable[[RangeImage, Any], bool]:
    """Beam for beam one of the last 60 scans."""

    def is_true(value: RangeImage, backing: Any) -> bool:
        angle_rad = angles(value.depth_m.shape[1])
        c = backing.capabilities()
        for index in range(max(1, backing.reads - 60), backing.reads + 1):
            true = line_m(RangeImage(depth_m=scripted.scripted_scan(index)), c, angle_rad)
            if np.allclose(value.depth_m[0], true, atol=6e-4):
                return True
        return False

    return is_true


def scip_angles(count: int) -> Any:
    """URG-04LX."""
    return (np.arange(count) + 44.0 - 384.0) * (2 * np.pi / 1024)


def sick_angles(count: int) -> Any:
    """180 degrees."""
    return np.radians(np.linspace(-90.0, 90.0, count))


def turn_angles(count: int) -> Any:
    """A turn, signed."""
    return (np.arange(count) * (2 * np.pi / count) + np.pi) % (2 * np.pi) - np.pi


def true_joints(value: Any, backing: Any) -> bool:
    """Where the arm stands."""
    return bool(np.array_equal(value.position_rad, backing.position_rad))


def near_joints(value: Any, backing: Any) -> bool:
    """Where the arm stands, to the last count of the servos."""
    return bool(np.allclose(value.position_rad, backing.position_rad, atol=0.0008))


def true_width(value: Any, backing: Any) -> bool:
    """The jaws rest on a thing of 40 mm."""
    return bool(abs(value.width_m - 0.04) < 4e-4 and backing.reads > 0)


def true_lights(value: Any, backing: Any) -> bool:
    """What is lit."""
    return bool(value == backing.on)


WITHOUT_CRC = tuple(f for f in WireFault if f is not WireFault.CRC)
FAST_SCAN = {"scans_per_minute": 2400}
BENCHES = (
    Bench(
        name="tfmini",
        start=tfmini.start,
        backing=scripted.ScriptedProximity,
        driver="serial:tfmini",
        is_true=true_distance,
        options={},
        far_options={},
    ),
    Bench(
        name="ft300 stream",
        start=ft300.start,
        backing=scripted.ScriptedForceTorque,
        driver="serial:ft300",
        is_true=true_wrench,
        options={},
        far_options={},
    ),
    Bench(
        name="ft300 modbus",
        start=ft300.start,
        backing=scripted.ScriptedForceTorque,
        driver="modbus:ft300",
        is_true=true_wrench,
        options={},
        far_options={},
    ),
    Bench(
        name="robotiq_2f",
        start=robotiq_2f.start,
        backing=lambda: scripted.ScriptedGripper(object_m=0.04),
        driver="modbus:robotiq_2f",
        is_true=true_width,
        options={},
        far_options={},
    ),
    Bench(
        name="modbus_io tcp",
        start=modbus_io.start,
        backing=scripted.ScriptedLights,
        driver="modbus:lights",
        is_true=true_lights,
        options={},
        far_options={"transport": "tcp"},
    ),
    Bench(
        name="modbus_io rtu",
        start=modbus_io.start,
        backing=scripted.ScriptedLights,
        driver="modbus:lights",
        is_true=true_lights,
        options={},
        far_options={"transport": "rtu"},
    ),
    Bench(
        name="netft",
        start=netft.start,
        backing=scripted.ScriptedForceTorque,
        driver="udp:netft",
        is_true=true_wrench,
        options={},
        far_options={},
    ),
    Bench(
        name="bota",
        start=bota.start,
        backing=scripted.ScriptedForceTorque,
        driver="serial:bota",
        is_true=true_wrench,
        options={},
        far_options={},
    ),
    Bench(
        name="scip serial",
        start=scip.start,
        backing=scripted.ScriptedScanner,
        driver="scip:scanner",
        is_true=true_scan(scip_angles),
        options={},
        far_options={**FAST_SCAN, "transport": "serial"},
    ),
    Bench(
        name="scip tcp",
        start=scip.start,
        backing=scripted.ScriptedScanner,
        driver="scip:scanner",
        is_true=true_scan(scip_angles),
        options={},
        far_options=FAST_SCAN,
    ),
    Bench(
        name="lms200",
        start=lms200.start,
        backing=scripted.ScriptedScanner,
        driver="serial:lms200",
        is_true=true_scan(sick_angles),
        options={},
        far_options={},
    ),
    Bench(
        name="rplidar",
        start=rplidar.start,
        backing=scripted.ScriptedScanner,
        driver="serial:rplidar",
        is_true=true_scan(turn_angles),
        options={"scan_rate_hz": 20.0},
        far_options={"scan_rate_hz": 40.0},
        faults=WITHOUT_CRC,
    ),
    Bench(
        name="ur",
        start=ur.start,
        backing=scripted.ScriptedArm,
        driver="ur:rtde",
        is_true=true_joints,
        options={"rate_hz": 125.0},
        far_options={},
    ),
    Bench(
        name="cia402",
        start=cia402.start,
        backing=scripted.ScriptedArm,
        driver="can:cia402",
        is_true=near_joints,
        options={},
        far_options={},
    ),
    Bench(
        name="dynamixel",
        start=dynamixel.start,
        backing=scripted.ScriptedArm,
        driver="serial:dynamixel",
        is_true=near_joints,
        options={},
        far_options={},
    ),
)


@contextmanager
def running(bench: Bench, far_options: dict[str, Any]) -> Iterator[tuple[Any, Any, Any]]:
    """Driver, far side and the device behind it."""
    backing = bench.backing()
    far_side = bench.start(backing, {**bench.far_options, **far_options})
    device = None
    try:
        device = connect(Context(name="dut"), bench.driver, {**far_side.address, **bench.options})
        yield device, far_side, backing
    finally:
        if device is not None:
            device.close()
        far_side.close()


@dataclass(slots=True)
class Cell:
    """Counts of one cell of the fault matrix."""

    good: int = 0
    errors: int = 0
    wrong: int = 0
    stale: int = 0
    late_calls: int = 0
    untyped: int = 0


def fault_cell(bench: Bench, fault: WireFault, every: int, seconds: float) -> Cell:
    """Read over a bad wire for some time."""
    cell = Cell()
    options = {"fault": str(fault), "every": every, "seed": every, "delay_s": 0.15, "silent_s": 0.15, "away_s": 0.05}
    rest = threading.Event()
    try:
        with running(bench, options) as (device, _, backing):
            end_s = time.monotonic() + seconds
            while time.monotonic() < end_s:
                _one_read(bench, device, backing, cell)
                rest.wait(0.002)
    except CellError:
        cell.errors += 1  # it could not be connected, and said so
    return cell


def _one_read(bench: Bench, device: Any, backing: Any, cell: Cell) -> None:
    started_s = time.monotonic()
    sample: Stamped[Any] | None = None
    try:
        sample = device.newest(deadline())
    except CellError:
        cell.errors += 1
    except Exception as error:
        cell.untyped += 1
        print(f"    untyped: {error!r}")
    took_s = time.monotonic() - started_s
    cell.late_calls += took_s > READ_S + SLACK_S
    if sample is None or sample.quality is Quality.INVALID:
        return
    cell.good += 1
    cell.stale += sample.age_s(CLOCK.now_s()) > device.max_age_s + SLACK_S + took_s
    cell.wrong += not bench.is_true(sample.value, backing)


def line(what: str, limit: str, measured: str, is_good: bool) -> None:
    """One row of the table."""
    print(f"{what:<52} {limit:>22} {measured:>34}  {'PASS' if is_good else 'FAIL'}", flush=True)


def part_faults(seconds: float) -> None:
    """The fault matrix."""
    for bench in BENCHES:
        for every in (3, 20):
            total = Cell()
            silent: list[str] = []
            for fault in bench.faults:
                cell = fault_cell(bench, fault, every, seconds)
                for field in Cell.__dataclass_fields__:
                    setattr(total, field, getattr(total, field) + getattr(cell, field))
                if cell.good == 0:
                    silent.append(str(fault))
            is_good = total.wrong == total.stale == total.late_calls == total.untyped == 0
            measured = f"{total.wrong} / {total.stale} / {total.late_calls} of {total.good} + {total.errors} err"
            line(f"{bench.name}, every {every}: wrong / stale / late", "0 / 0 / 0", measured, is_good)
            if silent:
                print(f"    no good sample at all under: {', '.join(silent)}")


def percentiles(samples_s: list[float]) -> tuple[float, float]:
    """p50 and p99 in microseconds."""
    ordered = sorted(samples_s)
    return 1e6 * statistics.median(ordered), 1e6 * ordered[int(0.99 * len(ordered))]


def part_latency(seconds: float) -> None:
    """A register read by the driver's bus against the same bytes over a bare pyserial port, alternating in one run."""
    import serial

    far_side = ft300.start(scripted.ScriptedForceTorque(), {})
    request = bytes.fromhex("090400b40006") + struct.pack("<H", _crc(bytes.fromhex("090400b40006")))
    bare_s: list[float] = []
    ours_s: list[float] = []
    end_s = time.monotonic() + seconds
    try:
        while time.monotonic() < end_s:
            port = serial.Serial(far_side.address["port"], 19_200, timeout=1, exclusive=True)
            for _ in range(200):
                started_s = time.perf_counter()
                port.write(request)
                port.read(17)
                bare_s.append(time.perf_counter() - started_s)
            port.close()
            link = open_serial(far_side.address["port"], baud=19_200, device="bench")
            master = ModbusRtu(link, timeout_s=1.0, gap_s=0.0)
            for _ in range(200):
                started_s = time.perf_counter()
                master.read_registers(unit=9, address=180, count=6, until_s=time.monotonic() + 1.0, function=4)
                ours_s.append(time.perf_counter() - started_s)
            link.close()
    finally:
        far_side.close()
    bare, ours = percentiles(bare_s), percentiles(ours_s)
    over = (ours[0] - bare[0], ours[1] - bare[1])
    measured = f"{over[0]:+.0f} / {over[1]:+.0f} us (bare {bare[0]:.0f} / {bare[1]:.0f})"
    line("RTU call over bare pyserial, p50 / p99", "+80 / +300 us", measured, over[0] <= 80 and over[1] <= 300)
    with running(BENCHES[2], {}) as (device, _, _):
        reads_s = []
        for _ in range(5000):
            started_s = time.perf_counter()
            device.read_wrench(deadline=deadline())
            reads_s.append(time.perf_counter() - started_s)
    p50, p99 = percentiles(reads_s)
    line(
        "driver read from its mailbox, p50 / p99",
        "+80 / +300 us",
        f"{p50:.0f} / {p99:.0f} us",
        p50 <= 80 and p99 <= 300,
    )


def _crc(data: bytes) -> int:
    from drivers.transport.checks import crc_modbus

    return crc_modbus(data)


def part_rtu(seconds: float) -> None:
    """Reads a second against pymodbus on the same emulator."""
    from pymodbus.client import ModbusSerialClient

    far_side = ft300.start(scripted.ScriptedForceTorque(), {})
    try:
        path = far_side.address["port"]
        client: Any = ModbusSerialClient(path, baudrate=115_200, timeout=1, retries=0)
        client.connect()
        theirs = rate(lambda: client.read_input_registers(180, count=3, device_id=9), seconds)
        client.close()
        link = open_serial(path, baud=115_200, device="bench")
        master = ModbusRtu(link, timeout_s=1.0, gap_s=0.0)
        ours = rate(
            lambda: master.read_registers(unit=9, address=180, count=3, until_s=time.monotonic() + 1.0, function=4),
            seconds,
        )
        link.close()
    finally:
        far_side.close()
    ratio = ours / theirs
    line("RTU reads/s, ratio to pymodbus", "4x", f"{ratio:.1f}x ({ours:.0f} to {theirs:.0f} /s)", ratio >= 4)


def rate(work: Callable[[], Any], seconds: float) -> float:
    """Calls a second."""
    count, end_s = 0, time.monotonic() + seconds
    while time.monotonic() < end_s:
        work()
        count += 1
    return count / seconds


def cpu_rate(work: Callable[[], Any], seconds: float) -> float:
    """Calls a second of this process's own time: what an idle machine would give."""
    count, start_s = 0, time.process_time()
    while time.process_time() - start_s < seconds:
        for _ in range(10):
            work()
        count += 10
    return count / (time.process_time() - start_s)


def part_decode(seconds: float) -> None:
    """Points and frames a second of processor time."""
    data = scip.encode_ranges(np.arange(1081) % 4000)
    points = cpu_rate(lambda: decode_ranges_mm(data), seconds) * 1081
    line("SCIP ranges decoded, points/s", "20 M", f"{points / 1e6:.0f} M", points >= 20e6)
    turn = rplidar.encode_turn(np.arange(3600) * 2 * np.pi / 3600, np.full(3600, 1.0))
    nodes = np.frombuffer(turn * 4, np.uint8).reshape(-1, 5)
    points = cpu_rate(lambda: decode(nodes), seconds) * len(nodes)
    line("RPLIDAR measurements decoded, points/s", "20 M", f"{points / 1e6:.0f} M", points >= 20e6)
    frames = b"".join(tfmini.data_frame(i, 500) for i in range(500))
    count = cpu_rate(lambda: data_framer().feed(frames), seconds) * 500
    line("TFmini frames/s (9 bytes, sum)", "100 k", f"{count / 1e3:.0f} k", count >= 100e3)
    frames = b"".join(ft300.stream_frame([i, 2, 3, 4, 5, 6]) for i in range(500))
    count = cpu_rate(lambda: stream_framer().feed(frames), seconds) * 500
    line("FT 300 frames/s (16 bytes, CRC)", "100 k", f"{count / 1e3:.0f} k", count >= 100e3)


def part_stamps(seconds: float) -> None:
    """Stamp against the emulator's own log of when each frame left."""
    for bench in (BENCHES[0], BENCHES[6], BENCHES[7]):
        errors_s: list[float] = []
        with running(bench, {}) as (device, far_side, _):
            rest, end_s, seen = threading.Event(), time.monotonic() + seconds, 0
            while time.monotonic() < end_s:
                rest.wait(0.05)
                samples, _ = device.mailbox.since(seen)
                log = np.array([t for t, _ in list(far_side.sent)])
                for sample in samples[:-1]:
                    seen = sample.sequence
                    errors_s.append(float(np.min(np.abs(log - sample.host_time_s))))
        p99 = sorted(errors_s)[int(0.99 * len(errors_s))] * 1e3
        line(f"{bench.name}: stamp error, p99 of {len(errors_s)}", "2 ms", f"{p99:.2f} ms", p99 <= 2.0)


def part_reconnect(seconds: float) -> None:
    """Unplug in a row; time to the first valid sample after the port has returned; leaks."""
    unplugs = max(10, int(seconds * 10))
    process = psutil.Process()
    for bench in (BENCHES[0], BENCHES[5], BENCHES[9]):
        back_s: list[float] = []
        with running(bench, {}) as (device, far_side, _):
            device.newest(deadline(2.0))
            before = (process.num_fds(), threading.active_count())
            for _ in range(unplugs):
                far_side.unplug(away_s=0.02)
                returned_s, rest = time.monotonic(), threading.Event()
                while True:
                    try:
                        if device.newest(deadline(0.2), not_before_s=returned_s):
                            break
                    except CellError:
                        rest.wait(0.001)
                back_s.append(time.monotonic() - returned_s)
            after = (process.num_fds(), threading.active_count())
        leaked = (after[0] - before[0], after[1] - before[1])
        measured = f"{max(back_s):.2f} s of {unplugs}; leak {leaked}"
        line(
            f"{bench.name}: back after unplugging, worst; leaks",
            "1 s; (0, 0)",
            measured,
            max(back_s) <= 1 and leaked == (0, 0),
        )


def part_ur(seconds: float) -> None:
    """500 Hz state stream: dropped packages."""
    with running(next(b for b in BENCHES if b.name == "ur"), {"rate_hz": 500.0}) as (device, far_side, _):
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
    """Six axes in cyclic synchronous position at 250 Hz: SYNCs sent more than a period late."""
    bench = next(b for b in BENCHES if b.name == "cia402")
    fast = dataclasses.replace(bench, options={"rate_hz": 250.0, "heartbeat_s": 1.0})
    with running(fast, {}) as (device, far_side, backing):
        device.enable(deadline=deadline(2.0))
        rest, start, end_s = threading.Event(), backing.position_rad.copy(), time.monotonic() + seconds
        missed, syncs = device.missed_syncs, far_side.syncs
        while time.monotonic() < end_s:
            device.command_position(start, deadline=deadline())
            rest.wait(0.004)
        missed, syncs = device.missed_syncs - missed, far_side.syncs - syncs
    share = missed / max(1, missed + syncs)
    line(f"CiA-402, six axes CSP at 250 Hz, {syncs} SYNCs: missed", "1e-3", f"{missed} ({share:.1e})", share <= 1e-3)


def part_kill(seconds: float) -> None:
    """Host process killed in motion: how long until the device's own watchdog stops the arm behind it."""
    for name in ("ur", "cia402", "dynamixel"):
        bench = next(b for b in BENCHES if b.name == name)
        stops_s = [_kill_once(bench) for _ in range(max(3, int(seconds / 2)))]
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


def _kill_once(bench: Bench) -> float:
    backing = bench.backing()
    far_side = bench.start(backing, bench.far_options)
    options = {**far_side.address, **bench.options}
    host = subprocess.Popen(
        [sys.executable, "-c", HOST, json.dumps([bench.driver, options])], stdout=subprocess.PIPE, text=True
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


def _accepts(frame: bytes) -> bool:
    return len(frame) > 0


def part_fuzz(seconds: float) -> None:
    """Random bytes with true headers in them through every parser."""
    makers: dict[str, Callable[[], Callable[[bytes], Any]]] = {
        "tfmini": lambda: data_framer().feed,
        "ft300": lambda: stream_framer().feed,
        "bota": lambda: bota_framer().feed,
        "lms200": lambda: lms_framer().feed,
        "dynamixel": lambda: dxl2.framer().feed,
        "rplidar": lambda: NodeParser().feed,
        "scip": lambda: lambda chunk: parser_scip.feed(chunk, "MD"),
        "rtde": lambda: rtde.PackageParser().feed,
        "false length": lambda: Framer(b"\xaa", lambda d: d[1] if len(d) > 1 else None, _accepts).feed,
    }
    parser_scip = ScipParser()
    chance = random.Random(1)
    headers = [b"\x59\x59", b"\x20\x4e", b"\xaa", b"\x02\x80", dxl2.HEADER, b"MD0000\n99b\n", b"\x00\x10U"]
    inputs = crashes = 0
    end_s = time.monotonic() + seconds
    feeds = {name: make() for name, make in makers.items()}
    while time.monotonic() < end_s:
        chunk = chance.choice(headers) + chance.randbytes(chance.randrange(40)) + chance.choice(headers)
        for name, feed in feeds.items():
            inputs += 1
            try:
                feed(chunk)
            except Exception as error:
                crashes += 1
                print(f"    {name}: {error!r} on {chunk.hex()}")
    line(
        f"fuzzing {len(feeds)} parsers: inputs, crashes",
        "1e6, 0",
        f"{inputs:.2g}, {crashes}",
        crashes == 0 and inputs >= 1e6,
    )


PARTS: dict[str, Callable[[float], None]] = {
    "latency": part_latency,
    "rtu": part_rtu,
    "decode": part_decode,
    "stamps": part_stamps,
    "reconnect": part_reconnect,
    "ur": part_ur,
    "csp": part_csp,
    "kill": part_kill,
    "fuzz": part_fuzz,
    "faults": part_faults,
}


def main() -> None:
    """Run the parts that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="for each cell and figure")
    parser.add_argument("--only", default=",".join(PARTS), help="comma list of parts")
    arguments = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; {arguments.seconds:.0f} s a figure")
    for name in arguments.only.split(","):
        if name not in PARTS:
            sys.exit(f"unknown part {name!r}; there are: {', '.join(PARTS)}")
        PARTS[name](arguments.seconds)


if __name__ == "__main__":
    main()
