"""Reads the emulators by the clients of other projects and by ours, on good and on faulty links."""

from __future__ import annotations

import contextlib
import logging
import math
import multiprocessing
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from importlib import import_module
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.drivers.bench import Bench
from benchmarks.drivers.benches import bench
from benchmarks.drivers.report import deadline, line
from drivers.dynamixel.client import DynamixelClient
from drivers.emulators import dynamixel
from drivers.emulators.faults import FaultOptions, FaultPlan, WireFault
from drivers.transport.serial_link import open_serial
from hal.devices import JointState, RangeImage
from hal.readings import Quality
from hal.registry import Context, connect

FAULTS = (WireFault.CRC, WireFault.SPLIT, WireFault.DELAY, WireFault.DISCONNECT)
EVERY, LATE_S, SPLIT_S, AWAY_S = 20, 0.15, 0.05, 0.1
BAUD, POSITION, POSITION_BYTES, STATE, STATE_BYTES = 1_000_000, 132, 4, 126, 10
Read = Callable[[], Any]
Way = Callable[[Bench, Any, Any], contextlib.AbstractContextManager[Read]]
"""Connects to an emulator; its value waits for a new sample and returns it."""


def part_peers(seconds: float) -> None:
    """Print rates of true, wrong and failed reads, and whether a client ends without data."""
    for name, ways in PEERS.items():
        for who in ways:
            rate, *_ = _isolated(name, who, None, seconds)
            line(f"{name}, {who}: good samples/s", "", f"{rate:.0f}", is_good=True)
            for fault in FAULTS:
                good, wrong, failed, end = _isolated(name, who, fault, seconds)
                measured = f"{good:.1f}/s, {wrong:.0f} wrong, {failed:.0f} failed{', ' + end if end else ''}"
                line(f"    every {EVERY}th frame: {fault}", "0 wrong", measured, is_good=not wrong and not end)


def _isolated(name: str, who: str, fault: WireFault | None, seconds: float) -> tuple[float, float, float, str]:
    """Measure in a process of its own, because a peer may hang, or hold the interpreter's lock."""
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    item = bench(name)
    options = {"fault": fault, "every": EVERY, "delay_s": LATE_S, "split_s": SPLIT_S, "away_s": AWAY_S}
    with contextlib.ExitStack() as stack:
        address: dict[str, Any] | None = None
        if name in PORTS:  # this peer holds the interpreter's lock while it connects
            far_side = item.start(item.backing(), {**item.far_options, **PORTS[name], **(options if fault else {})})
            address = stack.enter_context(closing(far_side)).address
        arguments = (theirs, name, who, options if fault else {}, seconds, address)
        child = multiprocessing.get_context("spawn").Process(target=_measure, args=arguments)
        child.start()
        theirs.close()
        found: tuple[float, float, float, str] = (0.0, 0.0, 0.0, "hung")
        if ours.poll(4 * seconds + 30.0):
            try:
                found = ours.recv()
            except EOFError:
                found = (0.0, 0.0, 0.0, "ended by an error")
        child.kill()
        child.join()
    return found


def _measure(
    answer: Connection, name: str, who: str, options: dict[str, Any], seconds: float, address: dict[str, Any] | None
) -> None:
    logging.disable(logging.CRITICAL)
    item = bench(name)
    backing = item.backing()
    far_side: Any = SimpleNamespace(address=address)
    if address is None:
        far_side = item.start(backing, item.far_options)
    good = wrong = failed = 0
    last_s = time.monotonic()
    with PEERS[name][who](item, far_side, backing) as read:
        read()
        if options and address is None:
            far_side.plan = FaultPlan(FaultOptions(**options))
        started_s = last_s = time.monotonic()
        while time.monotonic() < started_s + seconds:
            asked_s = time.monotonic()
            try:
                value = read()
            except Exception:
                failed += 1
                threading.Event().wait(0.005)
                continue
            is_late = item.taken_s is not None and item.taken_s(value, backing) < asked_s - STALE_S[name]
            is_good = bool(item.is_true(value, backing)) and not is_late
            good, wrong = good + is_good, wrong + (not is_good)
            last_s = time.monotonic() if is_good else last_s
        took_s = time.monotonic() - started_s
        end = "no good sample in the last second" if time.monotonic() - last_s > 1.0 else ""
        answer.send((good / took_s, float(wrong), float(failed), end))


@contextmanager
def driver(item: Bench, far_side: Any, backing: Any) -> Iterator[Read]:  # noqa: ARG001  # one form for all ways
    """Read by the driver; each read waits for a sample that is new."""
    device: Any = connect(Context(name="dut"), item.driver, {**far_side.address, **item.options})
    with closing(device):
        last = -1

        def read() -> Any:
            nonlocal last
            while True:
                sample = device.newest(deadline(0.3))
                if sample.sequence != last and sample.quality is not Quality.INVALID:
                    last = sample.sequence
                    return sample.value
                threading.Event().wait(0.0005)

        yield read


def _joints(counts: list[int]) -> JointState:
    angle = (np.array(counts) - 2048) * dynamixel.RAD_PER_COUNT
    return JointState(position_rad=angle, velocity_rad_per_s=angle * 0.0)


@contextmanager
def our_client(item: Bench, far_side: Any, backing: Any) -> Iterator[Read]:  # noqa: ARG001  # one form for all ways
    """Read six servos at once, without the driver's poll rate; the port is not opened again."""
    with closing(open_serial(far_side.address["port"], baud=BAUD, device="bench")) as link:
        client = DynamixelClient(link, timeout_s=0.03)
        ids = tuple(far_side.servos)

        def read() -> JointState:
            blocks = client.fast_sync_read(ids, STATE, STATE_BYTES, time.monotonic() + 0.3)
            return _joints([int.from_bytes(blocks[id_][-4:], "little", signed=True) for id_ in ids])

        yield read


@contextmanager
def dynamixel_sdk(item: Bench, far_side: Any, backing: Any) -> Iterator[Read]:  # noqa: ARG001  # one form for all ways
    """Read six servos at once by the maker's package."""
    sdk = import_module("dynamixel_sdk")
    port, packet, ids = sdk.PortHandler(far_side.address["port"]), sdk.PacketHandler(2.0), tuple(far_side.servos)
    port.openPort()
    port.setBaudRate(BAUD)
    group = sdk.GroupSyncRead(port, packet, POSITION, POSITION_BYTES)
    for id_ in ids:
        group.addParam(id_)

    def read() -> JointState:
        if (result := group.fastSyncRead()) != sdk.COMM_SUCCESS:
            raise OSError(packet.getTxRxResult(result))
        return _joints([int(np.int32(np.uint32(group.getData(id_, POSITION, POSITION_BYTES)))) for id_ in ids])

    yield read


@contextmanager
def hokuyolx(item: Bench, far_side: Any, backing: Any) -> Iterator[Read]:  # noqa: ARG001  # one form for all ways
    """Read the stream of scans by the package hokuyolx; after an error it is begun again."""
    where = (far_side.address["host"], far_side.address["port"])
    laser = import_module("hokuyolx").HokuyoLX(addr=where, tsync=False, convert_time=False, timeout=1)
    scans = laser.iter_dist()

    def read() -> RangeImage:
        nonlocal scans
        try:
            scan_mm, _, _ = next(scans)
        except (Exception, StopIteration) as error:
            scans = laser.iter_dist()
            raise OSError(str(error)) from error
        return RangeImage(depth_m=np.where(scan_mm < 20, math.nan, scan_mm / 1000.0)[np.newaxis])

    yield read


@contextmanager
def rplidar_roboticia(item: Bench, far_side: Any, backing: Any) -> Iterator[Read]:  # noqa: ARG001  # one form for all
    """Read turns by the package rplidar-roboticia; a turn is put into the driver's sectors."""
    rplidar = import_module("rplidar")
    rplidar.serial.Serial.setDTR = lambda *_: None  # a pty has no such line
    lidar = rplidar.RPLidar(far_side.address["port"])
    turns = lidar.iter_scans(max_buf_meas=False, min_len=1)

    def read() -> RangeImage:
        nonlocal turns
        try:
            nodes = np.array(next(turns))
        except (
            Exception,
            StopIteration,
        ) as error:  # its iterator ends with the first error; begin another, as users do
            with contextlib.suppress(Exception):
                lidar.stop()
                lidar.clean_input()
            turns = lidar.iter_scans(max_buf_meas=False, min_len=1)
            raise OSError(str(error)) from error
        depth_m = np.full(360, math.nan)
        depth_m[np.round(nodes[:, 1]).astype(int) % 360] = nodes[:, 2] / 1000.0
        return RangeImage(depth_m=depth_m[np.newaxis])

    yield read


@contextmanager
def ur_rtde(item: Bench, far_side: Any, backing: Any) -> Iterator[Read]:  # noqa: ARG001  # one form for all ways
    """Read joints by the package ur-rtde."""
    receive = import_module("rtde_receive").RTDEReceiveInterface("127.0.0.1", 125.0, ["timestamp", "actual_q"])

    def read() -> JointState:
        angle = np.array(receive.getActualQ())
        threading.Event().wait(0.008)
        return JointState(position_rad=angle, velocity_rad_per_s=angle * 0.0)

    yield read


PORTS = {"ur": {"rtde_port": 30_004, "script_port": 30_002, "dashboard_port": 29_999}}
STALE_S = {"ur": 0.1, "dynamixel": 0.01}  # older than this when it was asked for: given as new, but it is not
PEERS: dict[str, dict[str, Way]] = {
    "dynamixel": {"dynamixel-sdk": dynamixel_sdk, "our client": our_client, "our driver": driver},
    "scip tcp": {"hokuyolx": hokuyolx, "our driver": driver},
    "rplidar": {"rplidar-roboticia": rplidar_roboticia, "our driver": driver},
    "ur": {"ur-rtde": ur_rtde, "our driver": driver},
}
