"""Opens ports again while an answer of the session before is still on its way, and looks whose answer is taken."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from contextlib import closing

from benchmarks.drivers.report import line
from benchmarks.drivers.truths import MovingArm, TimedForceTorque
from drivers.dynamixel.client import DynamixelClient
from drivers.emulators import dynamixel, ft300
from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions, FaultPlan, WireFault
from drivers.ft300 import wrench
from drivers.transport.link import Link, NoAnswer
from drivers.transport.modbus import ModbusRtu
from drivers.transport.serial_link import open_serial

AGAIN = 20
LATE_S, AWAY_S, TIMEOUT_S, ASK_S = 0.4, 0.25, 0.1, 1.0
LATE = FaultPlan(FaultOptions(fault=WireFault.DELAY, every=1, delay_s=LATE_S))
UNIT, WRENCH, STATE, STATE_BYTES = 9, 180, 126, 10
SAME_S = 0.01  # two counts of a servo at the speed of `MovingArm` are 6 ms
Ask = Callable[[Link, float], float]
"""Asks once on a fresh link, before a time limit, and returns when the answer's value was taken."""


def part_sessions(seconds: float) -> None:  # noqa: ARG001  # a number of openings, however long they take
    """Count first answers of a session that were computed before they were asked for."""
    wrenches, arm = TimedForceTorque(), MovingArm()

    def ask_rtu(link: Link, until_s: float) -> float:
        words = ModbusRtu(link, timeout_s=TIMEOUT_S).read_registers(
            unit=UNIT, address=WRENCH, count=6, until_s=until_s, function=4
        )
        return wrenches.taken_s(wrench(struct.unpack(">6h", struct.pack(">6H", *words))))

    def ask_servo(link: Link, until_s: float) -> float:
        block = DynamixelClient(link, timeout_s=TIMEOUT_S).read(1, STATE, STATE_BYTES, until_s)
        counts = int.from_bytes(block[-4:], "little", signed=True)
        now_s, angle_rad = time.monotonic(), (counts - 2048) * dynamixel.RAD_PER_COUNT
        moved_s = (angle_rad - float(arm.position_rad[0])) / arm.SPEED_RAD_PER_S
        return now_s + SAME_S - (now_s + SAME_S - moved_s) % arm.TURN_S

    _part("Modbus RTU", ft300.start(wrenches, {}), ask_rtu)
    _part("Dynamixel", dynamixel.start(arm, {}), ask_servo)


def _part(name: str, far_side: WireEmulator, ask: Ask) -> None:
    on_time = far_side.plan
    stale = lost = 0
    with closing(far_side):
        path = far_side.address["port"]
        for _ in range(AGAIN):
            with closing(open_serial(path, baud=115_200, device="bench")) as link:
                ask(link, time.monotonic() + ASK_S)
                asked_s, far_side.plan = time.monotonic(), LATE
                try:
                    ask(link, asked_s + TIMEOUT_S)
                except NoAnswer:
                    far_side.plan = on_time
            time.sleep(AWAY_S)
            with closing(open_serial(path, baud=115_200, device="bench")) as link:
                asked_s = time.monotonic()
                try:
                    stale += ask(link, asked_s + ASK_S) < asked_s - SAME_S
                except NoAnswer:
                    lost += 1
            time.sleep(LATE_S)
    line(f"{name}: stale / no first answers of {AGAIN} sessions", "0 / 0", f"{stale} / {lost}", stale == lost == 0)
