"""Two-finger gripper on a Dynamixel XM430 servo, beside an arm on the same bus or alone (XM430-W350 e-Manual).

The servo works in current-based position mode: it moves to a position with at most the goal current, so the current
sets the grip force. Torque is switched on when the device is connected, and never again automatically.
"""

from __future__ import annotations

import struct
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from drivers.dynamixel.client import (
    ALWAYS,
    PACKET_BYTES,
    STATUS_RETURN,
    BusOptions,
    DynamixelClient,
    dynamixel_bus,
    naming_alerts,
)
from drivers.kinds.grippers import require_finite, require_stroke
from drivers.transport.bus import PolledDevice
from drivers.transport.link import Refused, now_s
from drivers.transport.options import read_options
from drivers.transport.timebase import HostTime, Unwrapper
from hal.clock import Deadline
from hal.devices import DeviceKind, GripperCapabilities, GripperState
from hal.errors import DeviceFault, DeviceTimeout, DeviceUnavailable
from hal.readings import Stamped
from hal.registry import Context, takes

MODE, TORQUE, WATCHDOG, GOAL_CURRENT, PROFILE_VELOCITY, GOAL, STATE = 11, 64, 98, 102, 112, 116, 120
BLOCK = struct.Struct("<H4xhii")  # tick, moving, PWM, current, velocity, position
TICK_BITS, TICK_S = 15, 0.001
GRIP_MODE = 5
A_PER_COUNT = 0.00269
TURNS_PER_S_PER_COUNT = 0.229 / 60.0
COUNTS_PER_TURN = 4096
WATCHDOG_TICK_S = 0.02
MOVING_COUNTS = 3  # velocity counts: 0.7 rpm
AT_GOAL_COUNTS = 12
HOLDING_PART = 0.5  # fraction of the goal current, at rest and short of the goal
LIMIT_CURRENT = 1193
CONNECT_S = 4.0


class GripperOptions(BusOptions):
    """Options of `serial:dynamixel_gripper`; measure the counts at the ends of the stroke and the force per ampere on
    the gripper as built."""

    id: Annotated[int, Field(ge=0, le=252, description="id of the servo")] = 7
    rate_hz: Annotated[float, Field(gt=0, le=200, description="polls per second")] = 50.0
    watchdog_s: Annotated[
        float, Field(ge=0.02, le=2.5, description="time without a command after which the servo stops by itself")
    ] = 0.5
    stroke_m: Annotated[float, Field(gt=0, le=0.3, description="width between the jaws when open; measure it")] = 0.08
    closed_count: Annotated[
        int, Field(ge=-(2**20), le=2**20, description="position count when fully closed; measure it")
    ] = 2048
    open_count: Annotated[
        int, Field(ge=-(2**20), le=2**20, description="position count when fully open; measure it")
    ] = 3072
    newtons_per_ampere: Annotated[
        float, Field(gt=0, description="grip force per ampere of servo current; measure it")
    ] = 60.0
    max_force_n: Annotated[float, Field(gt=0, description="largest grip force that may be commanded")] = 60.0
    activate: Annotated[
        bool, Field(description="whether connecting switches the torque on, with the measured position as the goal")
    ] = True

    @model_validator(mode="after")
    def _has_a_stroke(self) -> Self:
        require_stroke(self.open_count, self.closed_count)
        return self

    @property
    def servos(self) -> tuple[int, ...]:
        """Return the id of the only servo."""
        return (self.id,)


class DynamixelGripper(PolledDevice[GripperState, DynamixelClient]):
    """Two-finger gripper on a servo."""

    kind = DeviceKind.GRIPPER

    def __init__(self, context: Context, options: GripperOptions) -> None:
        bus = dynamixel_bus(context, options)
        super().__init__(context, bus, rate_hz=options.rate_hz, max_age_s=max(4.0 / options.rate_hz, 0.04))
        self._options = options
        self._goal: int | None = None
        self._goal_current = LIMIT_CURRENT
        self._clock = (Unwrapper(bits=TICK_BITS, tick_s=TICK_S), HostTime())

    def capabilities(self) -> GripperCapabilities:
        """Return the capabilities given by the options; the speed is the servo's own limit at 12 V."""
        o = self._options
        return GripperCapabilities(
            min_width_m=0.0, max_width_m=o.stroke_m, max_force_n=o.max_force_n, max_speed_m_per_s=self._speed(200)
        )

    def read_state(self, *, deadline: Deadline) -> Stamped[GripperState]:
        """Return the newest width, and the grip derived from the motor current."""
        return self.newest(deadline)

    def command(self, *, width_m: float, force_n: float, speed_m_per_s: float, deadline: Deadline) -> float:
        """Start a motion; return the width of the nearest count, in metres.

        Raises:
            InvalidRequest: a value is not finite. DeviceFault: torque is off.
        """
        require_finite(self.name, width_m, force_n, speed_m_per_s)
        o = self._options
        goal = self._count(min(max(width_m, 0.0), o.stroke_m))
        force_n = min(max(force_n, 0.0), o.max_force_n)
        current = min(max(round(force_n / o.newtons_per_ampere / A_PER_COUNT), 1), LIMIT_CURRENT)
        velocity = max(1, round(speed_m_per_s / self._speed(1)))
        ticks = bytes([max(1, min(127, round(o.watchdog_s / WATCHDOG_TICK_S)))])

        def work(client: DynamixelClient, until_s: float) -> None:
            with naming_alerts(client, (o.id,), until_s):
                has_torque = client.read(o.id, TORQUE, 1, until_s)[0]
            if not has_torque:
                raise DeviceFault(
                    f"the servo torque of {self.name} is off",
                    hint="connect the gripper again, which switches the torque on",
                    device=self.name,
                )
            client.write(o.id, WATCHDOG, b"\x00", until_s)  # a tripped watchdog rejects goals
            client.write(o.id, GOAL_CURRENT, struct.pack("<h", current), until_s)
            client.write(o.id, PROFILE_VELOCITY, struct.pack("<I", velocity), until_s)
            client.write(o.id, GOAL, struct.pack("<i", goal), until_s)
            client.write(o.id, WATCHDOG, ticks, until_s)

        self.call(work, deadline)
        self._goal, self._goal_current = goal, current
        return self._width_m(goal)

    def activate(self, deadline: Deadline) -> None:
        """Switch torque on with the measured position as goal, so nothing moves."""
        o = self._options

        def work(client: DynamixelClient, until_s: float) -> None:
            position = client.read(o.id, STATE, BLOCK.size, until_s)[-4:]
            client.write(o.id, WATCHDOG, b"\x00", until_s)
            client.write(o.id, TORQUE, b"\x01", until_s)
            client.write(o.id, GOAL, position, until_s)

        while True:
            try:
                self.call(work, deadline)
                return
            except (DeviceTimeout, DeviceUnavailable):  # a bad line only makes this slower
                if deadline.is_past():
                    raise
                self.bus.rest(self.period_s)

    def set_up(self, client: DynamixelClient) -> None:
        """Check that the servo answers and is in current-based position mode; torque stays as it is."""
        self._clock, o = (Unwrapper(bits=TICK_BITS, tick_s=TICK_S), HostTime()), self._options
        client.sync_write(STATUS_RETURN, 1, {o.id: ALWAYS}, now_s() + o.timeout_s)
        until_s = client.until_s(6, 2 * PACKET_BYTES)
        with naming_alerts(client, (o.id,), until_s):
            mode = client.read(o.id, MODE, 1, until_s)[0]
        if mode == GRIP_MODE:
            return
        if client.read(o.id, TORQUE, 1, until_s)[0]:
            what = f"servo {o.id} is in mode {mode}, not {GRIP_MODE} (grip), and its torque is on"
            raise Refused(what, code=mode, hint="switch its torque off, so that the driver can set the mode")
        client.write(o.id, MODE, bytes([GRIP_MODE]), until_s)

    def poll(self, client: DynamixelClient) -> None:
        """Read clock, current, velocity and position in one block.

        The clock distinguishes a late answer from a new one.
        """
        o = self._options
        until_s = client.until_s(2, BLOCK.size + 2 * PACKET_BYTES)
        with naming_alerts(client, (o.id,), client.until_s(3, 2 * PACKET_BYTES)):
            block = client.read(o.id, STATE, BLOCK.size, until_s)
        tick, current, velocity, position = BLOCK.unpack(block)
        ticks, host = self._clock
        device_s = ticks.seconds(tick)
        valid_s = host.host_s(device_s=device_s, arrived_s=self.exchanges.taken_s(client.asked_s, now_s()))
        is_moving = abs(velocity) >= MOVING_COUNTS
        is_short = self._goal is not None and abs(position - self._goal) > AT_GOAL_COUNTS
        is_holding = is_short and not is_moving and abs(current) >= HOLDING_PART * self._goal_current
        self.publish(
            GripperState(
                width_m=self._width_m(position),
                force_n=abs(current) * A_PER_COUNT * o.newtons_per_ampere if is_holding else 0.0,
                is_moving=is_moving,
                is_holding=is_holding,
            ),
            valid_s=valid_s,
            device_time_s=device_s,
        )

    def _speed(self, velocity: int) -> float:
        """Return the speed of a profile velocity, in m/s."""
        o = self._options
        return velocity * TURNS_PER_S_PER_COUNT * COUNTS_PER_TURN * o.stroke_m / abs(o.open_count - o.closed_count)

    def _count(self, width_m: float) -> int:
        o = self._options
        return round(o.closed_count + width_m / o.stroke_m * (o.open_count - o.closed_count))

    def _width_m(self, count: int) -> float:
        o = self._options
        return min(max((count - o.closed_count) / (o.open_count - o.closed_count), 0.0), 1.0) * o.stroke_m


@takes(GripperOptions)
def connect(context: Context, options: dict[str, Any]) -> DynamixelGripper:
    """Entry point `serial:dynamixel_gripper`; switches torque on unless told not to."""
    parsed = read_options(context, options, GripperOptions)
    device = DynamixelGripper(context, parsed)
    device.join(CONNECT_S)
    if not parsed.activate:
        return device
    try:
        device.activate(Deadline.after(context.clock, CONNECT_S))
    except BaseException:
        device.close()
        raise
    return device
