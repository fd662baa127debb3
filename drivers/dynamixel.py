"""An arm of Dynamixel XM430 servos on one half-duplex bus (ROBOTIS e-Manual, protocol 2.0 and XM430-W350).

Torque comes on by `enable` alone and never by itself. Each servo's bus watchdog (98) is armed while torque is on: when
the host falls silent it stops the servo and refuses goals until it is cleared.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers import dxl2
from drivers.arms import Array, KinematicsOptions, SetPointFilter, capabilities
from drivers.transport.bus import Bus, PolledDevice
from drivers.transport.device import wall_until
from drivers.transport.link import BadAnswer, Link, NoAnswer, Refused, WireError, drain, now_s
from drivers.transport.options import SerialOptions, read_options, serial_opener
from hal.clock import Deadline
from hal.devices import ArmCapabilities, DeviceKind, JointState
from hal.errors import DeviceFault
from hal.readings import Stamped
from hal.registry import Context

MODEL, MODE, TORQUE, HARDWARE_ERROR, BUS_WATCHDOG, GOAL, STATE = 0, 11, 64, 70, 98, 116, 126
STATE_BYTES = 10  # current16 velocity32 position32
POSITION_MODE = 3
COUNTS_PER_TURN, CENTRE = 4096, 2048
RAD_PER_COUNT = math.tau / COUNTS_PER_TURN
RAD_PER_S_PER_COUNT = 0.229 * math.tau / 60.0
WATCHDOG_TICK_S, WATCHDOG_TRIPPED = 0.02, 0xFF
WATCHDOG_EVERY = 10  # polls
CONNECT_S = 4.0
MOVING_RAD_PER_S = 0.03
HARDWARE_BITS = {0: "supply voltage", 2: "overheating", 3: "encoder", 4: "electrical shock", 5: "overload"}


class DynamixelOptions(SerialOptions):
    """Options of `serial:dynamixel`; `directions` turns joints round, `zero_counts` is where each joint is at 0 rad."""

    baud: Annotated[int, Field(ge=9600, le=4_500_000)] = 1_000_000
    ids: tuple[Annotated[int, Field(ge=0, le=252)], ...] = (1, 2, 3, 4, 5, 6)
    directions: tuple[int, ...] | None = None
    zero_counts: tuple[int, ...] | None = None
    rate_hz: Annotated[float, Field(gt=0, le=500)] = 100.0
    timeout_s: Annotated[float, Field(gt=0, le=1)] = 0.03
    watchdog_s: Annotated[float, Field(ge=0.02, le=2.5)] = 0.1
    is_fast: bool = True
    kinematics: KinematicsOptions


class DynamixelClient:
    """Requests and status packets; what comes back must be from who was asked, in size and order.

    After a lost answer the line is drained for one time-out, as a status packet does not tell what it answers.
    """

    def __init__(self, link: Link, *, timeout_s: float) -> None:
        self._link = link
        self._timeout_s = timeout_s
        self._is_late = False

    def read(self, id_: int, address: int, length: int, until_s: float) -> bytes:
        """A block of one servo."""
        return self._ask(dxl2.read(id_, address, length), [id_], length, until_s)[id_]

    def write(self, id_: int, address: int, data: bytes, until_s: float) -> None:
        """A block of one servo, acknowledged."""
        self._ask(dxl2.write(id_, address, data), [id_], 0, until_s)

    def sync_read(self, ids: tuple[int, ...], address: int, length: int, until_s: float) -> dict[int, bytes]:
        """The same block of all servos, one packet each."""
        return self._ask(dxl2.sync_read(address, length, ids), list(ids), length, until_s)

    def fast_sync_read(self, ids: tuple[int, ...], address: int, length: int, until_s: float) -> dict[int, bytes]:
        """The same block of all servos in one packet."""
        packets = self._exchange(dxl2.sync_read(address, length, ids, fast=True), 1, until_s)
        data = packets[0].parameters
        step = length + 4  # error, id, data, and a CRC over everything so far
        least = len(ids) * step - 2  # the last CRC is the packet's own
        if len(data) < least:
            raise BadAnswer(f"{len(ids)} servos answer {len(data)} bytes instead of {least}")
        blocks = {}
        for i, id_ in enumerate(ids):
            error, got = data[i * step], data[i * step + 1]
            if got != id_ or packets[0].id != dxl2.BROADCAST:
                raise BadAnswer(f"servo {got} answers in place of {id_}")
            self._check(id_, error)
            blocks[id_] = data[i * step + 2 : i * step + 2 + length]
        return blocks

    def sync_write(self, address: int, length: int, values: dict[int, bytes], until_s: float) -> None:
        """A block of each servo; nobody answers."""
        self._link.write(dxl2.sync_write(address, length, values), until_s)

    def _ask(self, request: bytes, ids: list[int], length: int, until_s: float) -> dict[int, bytes]:
        packets = self._exchange(request, len(ids), until_s)
        for packet, id_ in zip(packets, ids, strict=True):
            if packet.id != id_ or len(packet.parameters) < 1:
                raise BadAnswer(f"servo {packet.id} answers in place of {id_}")
            self._check(id_, packet.parameters[0])
            if len(packet.parameters) != 1 + length:
                raise BadAnswer(f"servo {id_} answers {len(packet.parameters) - 1} bytes instead of {length}")
        return {packet.id: packet.parameters[1:] for packet in packets}

    def _exchange(self, request: bytes, count: int, until_s: float) -> list[dxl2.Packet]:
        """Ask again after a lost answer while there is time."""
        while True:
            try:
                return self._attempt(request, count, until_s)
            except NoAnswer:
                if until_s - now_s() < 0.5 * self._timeout_s:
                    raise

    def _attempt(self, request: bytes, count: int, until_s: float) -> list[dxl2.Packet]:
        if self._is_late:
            quarantine_s = min(now_s() + self._timeout_s, until_s)
            while now_s() < quarantine_s:
                self._link.read(quarantine_s)
            self._is_late = False
        drain(self._link)
        self._link.write(request, until_s)
        framer = dxl2.framer()
        found: list[dxl2.Packet] = []
        end_s = min(until_s, now_s() + self._timeout_s)
        while len(found) < count:
            chunk = self._link.read(end_s)
            if not chunk:
                self._is_late = True
                raise NoAnswer(f"{count - len(found)} of {count} servos do not answer")
            packets = [_unpacked(frame) for frame in framer.feed(chunk)]
            found += [packet for packet in packets if packet.instruction == dxl2.STATUS]  # others are our own echo
        return found[:count]

    @staticmethod
    def _check(id_: int, error: int) -> None:
        if error & ~dxl2.ALERT:
            text = dxl2.ERRORS.get(error & ~dxl2.ALERT, "not in the manual")
            raise Refused(f"servo {id_}: error {error & ~dxl2.ALERT} ({text})", code=error)
        if error & dxl2.ALERT:
            raise Refused(f"servo {id_}: hardware alert; only a reboot helps", code=error)


def _unpacked(frame: bytes) -> dxl2.Packet:
    """Fast sync answers are not stuffed, so taking stuffing off could damage them."""
    if frame[4] == dxl2.BROADCAST and frame[7] == dxl2.STATUS:
        return dxl2.Packet(frame[4], frame[7], frame[8:])  # with the last CRC, so that all blocks have one size
    return dxl2.decode(frame)


class DynamixelArm(PolledDevice[JointState, DynamixelClient]):
    """The arm."""

    kind = DeviceKind.ARM

    def __init__(self, context: Context, options: DynamixelOptions) -> None:
        opener, name = serial_opener(options, context.name)

        def make() -> Bus[DynamixelClient]:
            return Bus(name, open_link=opener, client=lambda link: DynamixelClient(link, timeout_s=options.timeout_s))

        bus: Bus[DynamixelClient] = context.shared.get(f"dynamixel {name}", make)
        super().__init__(context, bus, rate_hz=options.rate_hz, max_age_s=max(4.0 / options.rate_hz, 0.04))
        self._options = options
        n = len(options.ids)
        self._direction = np.array(options.directions or (1,) * n, dtype=float)
        self._zero = np.array(options.zero_counts or (CENTRE,) * n, dtype=float)
        self._filter = SetPointFilter(context.name, options.kinematics, command_rate_hz=options.rate_hz)
        self._polls = 0
        self._pending: deque[dict[int, bytes]] = deque(maxlen=1)  # the newest goals, not yet sent

    def capabilities(self) -> ArmCapabilities:
        """From the options."""
        o = self._options
        return capabilities(o.kinematics, command_rate_hz=o.rate_hz, watchdog_s=o.watchdog_s)

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Newest measured joints."""
        return self.newest(deadline)

    def enable(self, *, deadline: Deadline) -> None:
        """Torque on with the measured position as goal; arms the bus watchdogs."""
        measured = self.newest(deadline).value.position_rad
        self._pending.clear()
        self.call(lambda client, until_s: self._torque_on(client, measured, until_s), deadline)
        self._filter.begin(measured)

    def command_position(self, position_rad: Array, *, deadline: Deadline) -> Array:
        """One goal for all servos in one packet; on a bus that stays busy it goes out before the next poll."""
        self.require_open()
        sent = self._filter.passed(position_rad, now_s())
        self._pending.append(self._goals(sent))
        until_s = wall_until(deadline)
        try:
            self.bus.call(self._send_pending, until_s)
        except NoAnswer:
            return sent  # a servo that answers late must not end a motion
        except WireError as error:
            self.errors += 1
            raise self.translate(error) from error
        return sent

    def _send_pending(self, client: DynamixelClient, until_s: float) -> None:
        if self._pending and self._filter.is_open:
            client.sync_write(GOAL, 4, self._pending.pop(), until_s)

    def stop(self, *, deadline: Deadline) -> None:
        """Hold where the arm is: torque stays on, so that it does not fall; goals are refused until `enable`."""
        self.require_open()
        was_open = self._filter.is_open
        self._filter.begin(None)
        self._pending.clear()
        if was_open:
            here = self._goals(self.newest(deadline).value.position_rad)
            self.call(lambda client, until_s: client.sync_write(GOAL, 4, here, until_s), deadline)

    def set_up(self, client: DynamixelClient) -> None:
        """Each servo must answer; motion stays off until `enable`."""
        self._filter.begin(None)
        for id_ in self._options.ids:
            until_s = now_s() + 4 * self._options.timeout_s
            client.read(id_, MODEL, 2, until_s)
            mode = client.read(id_, MODE, 1, until_s)[0]
            if mode != POSITION_MODE:
                raise Refused(f"servo {id_} is in mode {mode}, not {POSITION_MODE} (position)", code=mode)

    def poll(self, client: DynamixelClient) -> None:
        """Current, velocity and position of all servos, stamped in the middle of the exchange."""
        o = self._options
        self._send_pending(client, now_s() + o.timeout_s)
        asked_s = now_s()
        until_s = asked_s + 2 * o.timeout_s
        ask = client.fast_sync_read if o.is_fast else client.sync_read
        blocks = ask(o.ids, STATE, STATE_BYTES, until_s)
        rows = np.array([struct.unpack("<hii", blocks[id_]) for id_ in o.ids], dtype=float)
        self._polls += 1
        if self._filter.is_open and self._polls % WATCHDOG_EVERY == 0:
            self._watch(client, until_s)
        velocity = rows[:, 1] * RAD_PER_S_PER_COUNT * self._direction
        self.publish(
            JointState(
                position_rad=(rows[:, 2] - self._zero) * RAD_PER_COUNT * self._direction,
                velocity_rad_per_s=velocity,
                is_enabled=self._filter.is_open,
                is_moving=bool(np.any(np.abs(velocity) > MOVING_RAD_PER_S)),
            ),
            valid_s=0.5 * (asked_s + now_s()),
        )

    def _watch(self, client: DynamixelClient, until_s: float) -> None:
        """A tripped watchdog refuses goals without a word, as nobody answers a sync write."""
        limits = client.sync_read(self._options.ids, BUS_WATCHDOG, 1, until_s)
        tripped = [id_ for id_, data in limits.items() if data[0] == WATCHDOG_TRIPPED]
        if tripped:
            raise Refused(f"the bus watchdog of servo {tripped[0]} has tripped; enable again", code=WATCHDOG_TRIPPED)

    def fail(self, error: Exception) -> None:
        """A servo's error report or a lost bus takes the motion with it."""
        if not isinstance(error, NoAnswer | BadAnswer):
            self._filter.begin(None)
        super().fail(error)

    def _torque_on(self, client: DynamixelClient, measured: Array, until_s: float) -> None:
        ids = self._options.ids
        for id_ in ids:
            fault = client.read(id_, HARDWARE_ERROR, 1, until_s)[0]
            if fault:
                parts = [text for bit, text in HARDWARE_BITS.items() if fault >> bit & 1]
                raise DeviceFault(
                    f"{self.name}: servo {id_} reports {', '.join(parts) or fault}",
                    hint="cure the cause, then reboot the servo",
                    device=self.name,
                )
            client.write(id_, BUS_WATCHDOG, b"\x00", until_s)  # clears a tripped one
        client.sync_write(GOAL, 4, self._goals(measured), until_s)
        for id_ in ids:
            client.write(id_, TORQUE, b"\x01", until_s)
        ticks = max(1, min(127, round(self._options.watchdog_s / WATCHDOG_TICK_S)))
        for id_ in ids:
            client.write(id_, BUS_WATCHDOG, bytes([ticks]), until_s)

    def _goals(self, position_rad: Array) -> dict[int, bytes]:
        counts = np.round(position_rad / RAD_PER_COUNT * self._direction + self._zero).astype(int)
        return {id_: struct.pack("<i", int(c)) for id_, c in zip(self._options.ids, counts, strict=True)}


def connect(context: Context, options: dict[str, Any]) -> DynamixelArm:
    """Entry point `serial:dynamixel`."""
    device = DynamixelArm(context, read_options(context, options, DynamixelOptions))
    device.join(CONNECT_S)
    return device
