"""Every driver with a far side: how it is started, and whether a value is one of the last true ones."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

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
    tfmini_i,
    ur,
)
from drivers.emulators.base import WireEmulator
from drivers.emulators.beams import line_m
from drivers.emulators.faults import WireFault
from hal.clock import Deadline
from hal.devices import JointState, RangeImage, Wrench
from hal.readings import Stamped
from hal.registry import Context, connect


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
    taken_s: Callable[[Any, Any], float] | None = None
    """When a value was taken (monotonic), where the value tells and the protocol lets a driver know."""


class MovingArm(scripted.ScriptedArm):
    """An arm whose joints tell the time: each rises at the same speed, for some seconds, and begins anew."""

    SPEED_RAD_PER_S, TURN_S = 0.5, 4.0

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Where it is now."""
        stamped = super().read_state(deadline=deadline)
        moved_rad = self.SPEED_RAD_PER_S * (time.monotonic() % self.TURN_S)
        return replace(stamped, value=replace(stamped.value, position_rad=self.position_rad + moved_rad))

    def seconds(self, value: JointState) -> Any:
        """Seconds since the beginning that each joint tells."""
        return (value.position_rad - self.position_rad) / self.SPEED_RAD_PER_S

    def taken_s(self, value: JointState) -> float:
        """The oldest joint's time; it was not longer ago than one turn, and rounding may bring it before now."""
        now_s = time.monotonic() + SAME_MOMENT_S
        return now_s - float(np.max((now_s - self.seconds(value)) % self.TURN_S))


class TimedForceTorque(scripted.ScriptedForceTorque):
    """Remembers when each reading was taken."""

    def __init__(self) -> None:
        super().__init__()
        self._read_s: deque[float] = deque(maxlen=4096)

    def count(self, deadline: Deadline) -> tuple[int, float]:
        """Index of this read and its time."""
        self._read_s.append(time.monotonic())
        return super().count(deadline)

    def taken_s(self, value: Wrench) -> float:
        """By the index that the force tells."""
        ago = self.reads - round(value.force_n[0] / 0.01)
        return self._read_s[-1 - ago]


def taken_s(value: Any, backing: Any) -> float:
    """What the backing remembers."""
    when_s: float = backing.taken_s(value)
    return when_s


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


def true_centimetres(value: float, backing: Any) -> bool:
    """One of the last 100 readings, to the centimetre."""
    true_m = backing.first_m + 0.001 * (np.arange(backing.reads - 100, backing.reads + 1) % 1000)
    return bool(np.min(np.abs(np.round(true_m, 2) - value)) < 1e-6)


def true_express(value: RangeImage, backing: Any) -> bool:
    """One of the last 60 scans; its 384 measurements fall into 360 sectors, so each beam may be its neighbour's."""
    c, seen_m = backing.capabilities(), value.depth_m[0]
    seen = np.isfinite(seen_m)
    for index in range(max(1, backing.reads - 60), backing.reads + 1):
        line = line_m(RangeImage(depth_m=scripted.scripted_scan(index)), c, turn_angles(len(seen_m)))
        near = np.stack([np.roll(line, shift) for shift in (-2, -1, 0, 1, 2)])[:, seen]
        low, high = np.fmin.reduce(near), np.fmax.reduce(near)
        if np.all((seen_m[seen] >= low - 1e-3) & (seen_m[seen] <= high + 1e-3)):
            return True
    return False


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
    """All joints of one moment, to the last count of the servos."""
    seconds = backing.seconds(value)
    apart_s = (seconds - seconds[0] + backing.TURN_S / 2.0) % backing.TURN_S - backing.TURN_S / 2.0
    return bool(np.ptp(apart_s) < SAME_MOMENT_S)


def true_width(value: Any, backing: Any) -> bool:
    """The jaws rest on a thing of 40 mm."""
    return bool(abs(value.width_m - 0.04) < 4e-4 and backing.reads > 0)


def true_lights(value: Any, backing: Any) -> bool:
    """What is lit."""
    return bool(value == backing.on)


SAME_MOMENT_S = 0.008  # two counts of a servo at the speed of `MovingArm` are 6 ms
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
        name="tfmini modbus",
        start=tfmini_i.start_modbus,
        backing=scripted.ScriptedProximity,
        driver="modbus:tfmini",
        is_true=true_centimetres,
        options={},
        far_options={},
    ),
    Bench(
        name="tfmini can",
        start=tfmini_i.start_can,
        backing=scripted.ScriptedProximity,
        driver="can:tfmini",
        is_true=true_centimetres,
        options={},
        far_options={},
        faults=WITHOUT_CRC,
    ),
    Bench(
        name="ft300 stream",
        start=ft300.start,
        backing=TimedForceTorque,
        driver="serial:ft300",
        is_true=true_wrench,
        options={},
        far_options={},
    ),
    Bench(
        name="ft300 modbus",
        start=ft300.start,
        backing=TimedForceTorque,
        driver="modbus:ft300",
        taken_s=taken_s,
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
        backing=TimedForceTorque,
        driver="udp:netft",
        is_true=true_wrench,
        options={},
        far_options={},
    ),
    Bench(
        name="bota",
        start=bota.start,
        backing=TimedForceTorque,
        driver="serial:bota",
        taken_s=taken_s,
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
        name="rplidar express",
        start=rplidar.start,
        backing=scripted.ScriptedScanner,
        driver="serial:rplidar",
        is_true=true_express,
        options={"scan_rate_hz": 20.0, "mode": "express"},
        far_options={"scan_rate_hz": 40.0, "nodes": 384},
    ),
    Bench(
        name="ur",
        start=ur.start,
        backing=MovingArm,
        driver="ur:rtde",
        taken_s=taken_s,
        is_true=true_joints,
        options={"rate_hz": 125.0},
        far_options={},
    ),
    Bench(
        name="cia402",
        start=cia402.start,
        backing=MovingArm,
        driver="can:cia402",
        taken_s=taken_s,
        is_true=true_joints,
        options={},
        far_options={},
    ),
    Bench(
        name="dynamixel",
        start=dynamixel.start,
        backing=MovingArm,
        driver="serial:dynamixel",
        taken_s=taken_s,
        is_true=true_joints,
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


def bench(name: str) -> Bench:
    """The bench of that name."""
    return next(item for item in BENCHES if item.name == name)
