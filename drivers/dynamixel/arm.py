"""Arm of Dynamixel XM430 servos on one half-duplex bus (ROBOTIS e-Manual, protocol 2.0 and XM430-W350).

Only `enable` switches torque on. Each servo's bus watchdog (98) is armed while torque is on: if the host goes silent,
the watchdog stops the servo, which then rejects goals until the watchdog is cleared.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from drivers.dynamixel.client import (
    ALWAYS,
    PACKET_BYTES,
    REBOOT,
    STATUS_RETURN,
    BusOptions,
    DynamixelClient,
    dynamixel_bus,
    fault_text,
    naming_alerts,
)
from drivers.kinds.arms import KinematicsOptions, SetPointFilter, capabilities, require_stations
from drivers.kinds.digital_points import require_same_number
from drivers.transport.bus import PolledDevice
from drivers.transport.device import wall_until
from drivers.transport.link import BadAnswer, NoAnswer, Refused, WireError, now_s
from drivers.transport.options import read_options
from hal.arrays import Array
from hal.clock import Deadline
from hal.devices import ArmCapabilities, DeviceKind, JointState
from hal.readings import Stamped
from hal.registry import Context, takes

MODE, TORQUE, BUS_WATCHDOG, GOAL, STATE = 11, 64, 98, 116, 126
STATE_BYTES = 10  # current16 velocity32 position32
POSITION_MODE = 3
COUNTS_PER_TURN, CENTRE = 4096, 2048
RAD_PER_COUNT = math.tau / COUNTS_PER_TURN
RAD_PER_S_PER_COUNT = 0.229 * math.tau / 60.0
WATCHDOG_TICK_S, WATCHDOG_TRIPPED = 0.02, 0xFF
WATCH_EVERY = 5  # polls
CONNECT_S = 4.0
MOVING_RAD_PER_S = 0.03
INSTRUCTION_UNKNOWN = 2


class DynamixelOptions(BusOptions):
    """Options of `serial:dynamixel`; `directions` inverts joints, `zero_counts` is the count of each joint at 0 rad."""

    ids: Annotated[
        tuple[Annotated[int, Field(ge=0, le=252)], ...], Field(description="id of the servo of each joint")
    ] = (1, 2, 3, 4, 5, 6)
    directions: Annotated[
        tuple[Literal[-1, 1], ...] | None,
        Field(description="-1 for each joint whose servo turns the other way; all 1 if not given"),
    ] = None
    zero_counts: Annotated[
        tuple[int, ...] | None, Field(description="position count of each servo at 0 rad; 2048 if not given")
    ] = None
    rate_hz: Annotated[float, Field(gt=0, le=500, description="polls per second")] = 100.0
    watchdog_s: Annotated[
        float, Field(ge=0.02, le=2.5, description="time without a command after which each servo stops by itself")
    ] = 0.1
    is_fast: Annotated[bool, Field(description="whether to try the fast sync read, which new firmware has")] = True
    kinematics: Annotated[KinematicsOptions, Field(description="links, limits and speeds of the arm")]

    def known_arm(self) -> ArmCapabilities:
        """Return the kinematics and limits given by `kinematics`."""
        return capabilities(self.kinematics, command_rate_hz=self.rate_hz, watchdog_s=self.watchdog_s)

    @model_validator(mode="after")
    def _one_servo_a_joint(self) -> Self:
        require_stations("ids", self.ids, self.kinematics)
        require_same_number("ids, directions and zero_counts", self.ids, self.directions, self.zero_counts)
        return self

    @property
    def servos(self) -> tuple[int, ...]:
        """Return one servo id per joint."""
        return self.ids


class DynamixelArm(PolledDevice[JointState, DynamixelClient]):
    """Arm of Dynamixel servos."""

    kind = DeviceKind.ARM

    def __init__(self, context: Context, options: DynamixelOptions) -> None:
        bus = dynamixel_bus(context, options)
        super().__init__(context, bus, rate_hz=options.rate_hz, max_age_s=max(4.0 / options.rate_hz, 0.04))
        self._options = options
        n = len(options.ids)
        self._direction = np.array(options.directions or (1,) * n, dtype=float)
        self._zero = np.array(options.zero_counts or (CENTRE,) * n, dtype=float)
        self._filter = SetPointFilter(context.name, options.kinematics, command_rate_hz=options.rate_hz)
        self._polls = 0
        self._is_fast = options.is_fast
        self._modes: tuple[DynamixelClient | None, dict[int, int]] = (None, {})  # modes read by an unfinished set-up
        self._pending: deque[dict[int, bytes]] = deque(maxlen=1)  # newest goals, not sent yet

    def capabilities(self) -> ArmCapabilities:
        """Return the capabilities given by the options."""
        o = self._options
        return capabilities(
            o.kinematics, command_rate_hz=o.rate_hz, watchdog_s=o.watchdog_s, resolution_rad=RAD_PER_COUNT
        )

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Return the newest measured joint state."""
        return self.newest(deadline)

    def enable(self, *, deadline: Deadline) -> None:
        """Switch torque on with the measured position as goal, and arm the bus watchdogs.

        Raises:
            MotionRefused: a stop came meanwhile; torque holds the arm where it is.
        """
        closings = self._filter.closings
        measured = self.newest(deadline).value.position_rad
        self._pending.clear()
        self.call(lambda client, until_s: self._torque_on(client, measured, until_s), deadline)
        self._filter.begin(measured, closings=closings)

    def command_position(self, position_rad: Array, *, deadline: Deadline) -> Array:
        """Send one goal for all servos in one packet; on a busy bus it goes out before the next poll."""
        self.require_open()
        sent = self._filter.passed(position_rad, now_s())
        self._pending.append(self._goals(sent))
        until_s = wall_until(deadline)
        try:
            self.bus.call(self._send_pending, until_s)
        except NoAnswer:
            return sent  # a late answer of one servo must not end a motion
        except WireError as error:
            self.errors += 1
            raise self.translate(error) from error
        return sent

    def _send_pending(self, client: DynamixelClient, until_s: float) -> None:
        if self._pending and self._filter.is_open:
            client.sync_write(GOAL, 4, self._pending.pop(), until_s)

    def stop(self, *, deadline: Deadline) -> None:
        """Hold the present position: torque stays on so that the arm does not fall.

        Goals are rejected until `enable`.
        """
        self.require_open()
        was_open = self._filter.is_open
        self._filter.close()
        self._pending.clear()
        if was_open:
            here = self._goals(self.newest(deadline).value.position_rad)
            self.call(lambda client, until_s: client.sync_write(GOAL, 4, here, until_s), deadline)

    def set_up(self, client: DynamixelClient) -> None:
        """Check that each servo answers; motion stays disabled until `enable`."""
        self._filter.close()
        ids = self._options.ids
        client.sync_write(STATUS_RETURN, 1, dict.fromkeys(ids, ALWAYS), now_s() + self._options.timeout_s)
        client.meet()
        with naming_alerts(client, ids, client.until_s(2 * len(ids), 2 * PACKET_BYTES)):
            modes = self._read_modes(client)
        for id_, mode in modes.items():
            if mode != POSITION_MODE:
                hint = f"write {POSITION_MODE} to its address {MODE} while its torque is off"
                raise Refused(f"servo {id_} is in mode {mode}, not {POSITION_MODE} (position)", code=mode, hint=hint)

    def _read_modes(self, client: DynamixelClient) -> dict[int, int]:
        """Read the modes of all servos at once or, on a bad line, one by one, resuming where the last attempt ended."""
        o = self._options
        modes = self._modes[1] if self._modes[0] is client else {}
        for is_fast in (True, False) if o.is_fast and not modes else (False,) * (not modes):
            self._is_fast = is_fast  # old firmware does not know fast reads: it stays silent or reports an error
            try:
                blocks = self._read_all(client, MODE, 1, attempts=2 if is_fast else 6)
                return {id_: block[0] for id_, block in blocks.items()}
            except NoAnswer:
                self._is_fast = o.is_fast
            except Refused as error:
                if not is_fast or error.code != INSTRUCTION_UNKNOWN:
                    raise
        self._modes = (client, modes)
        for id_ in set(o.ids) - set(modes):
            modes[id_] = client.read(id_, MODE, 1, client.until_s(4, 2 * PACKET_BYTES))[0]
        self._modes = (None, {})
        return modes

    def _read_all(
        self, client: DynamixelClient, address: int, length: int, *, attempts: int = 2, until_s: float | None = None
    ) -> dict[int, bytes]:
        ids = self._options.ids
        ask = client.fast_sync_read if self._is_fast else client.sync_read
        if until_s is None:
            until_s = client.until_s(attempts, len(ids) * (length + PACKET_BYTES) + 2 * PACKET_BYTES)
        return ask(ids, address, length, until_s)

    def poll(self, client: DynamixelClient) -> None:
        """Read current, velocity and position of all servos."""
        o = self._options
        self._send_pending(client, now_s() + o.timeout_s)
        with naming_alerts(client, o.ids, client.until_s(2 * len(o.ids), 2 * PACKET_BYTES)):
            blocks = self._read_all(client, STATE, STATE_BYTES)
        valid_s = self.exchanges.taken_s(client.asked_s, now_s())
        rows = np.array([struct.unpack("<hii", blocks[id_]) for id_ in o.ids], dtype=float)
        self._polls += 1
        if self._filter.is_open and self._polls % WATCH_EVERY == 0:
            self._watch(client)
        velocity = rows[:, 1] * RAD_PER_S_PER_COUNT * self._direction
        self.publish(
            JointState(
                position_rad=(rows[:, 2] - self._zero) * RAD_PER_COUNT * self._direction,
                velocity_rad_per_s=velocity,
                is_enabled=self._filter.is_open,
                is_moving=bool(np.any(np.abs(velocity) > MOVING_RAD_PER_S)),
            ),
            valid_s=valid_s,
        )

    def _watch(self, client: DynamixelClient) -> None:
        """Check for tripped watchdogs and lost torque.

        Sync writes are not acknowledged, so a servo with a tripped watchdog or without torque ignores goals silently.
        A servo that has restarted has neither torque nor an armed watchdog.
        """
        if self._polls % (2 * WATCH_EVERY):
            torque = self._read_all(client, TORQUE, 1)
            if limp := [id_ for id_, data in torque.items() if not data[0]]:
                raise Refused(
                    f"servo {limp[0]} has lost its torque",
                    code=0,
                    hint="check whether it has restarted, then enable the arm again",
                )
            return
        limits = self._read_all(client, BUS_WATCHDOG, 1)
        tripped = [id_ for id_, data in limits.items() if data[0] == WATCHDOG_TRIPPED]
        if tripped:
            what = f"the bus watchdog of servo {tripped[0]} has tripped"
            raise Refused(what, code=WATCHDOG_TRIPPED, hint="the bus was silent for too long; enable the arm again")

    def fail(self, error: Exception) -> None:
        """Stop the motion after a servo's error report or the loss of the bus."""
        if not isinstance(error, NoAnswer | BadAnswer):
            self._filter.close()
        super().fail(error)

    def _torque_on(self, client: DynamixelClient, measured: Array, until_s: float) -> None:
        ids = self._options.ids
        for id_ in ids:
            if fault := client.hardware_error(id_, until_s):
                raise Refused(f"servo {id_} reports {fault_text(fault)}", code=fault, hint=REBOOT)
            client.write(id_, BUS_WATCHDOG, b"\x00", until_s)  # clears a tripped watchdog
        client.sync_write(GOAL, 4, self._goals(measured), until_s)
        for id_ in ids:
            client.write(id_, TORQUE, b"\x01", until_s)
        ticks = max(1, min(127, round(self._options.watchdog_s / WATCHDOG_TICK_S)))
        idle = list(ids)
        while idle:  # all together: if armed one by one, the first would wait for the last
            client.sync_write(BUS_WATCHDOG, 1, dict.fromkeys(ids, bytes([ticks])), until_s)
            armed = self._read_all(client, BUS_WATCHDOG, 1, until_s=until_s)
            idle = [id_ for id_, data in armed.items() if data[0] != ticks]
            if idle and now_s() >= until_s:
                raise NoAnswer(f"the bus watchdog of servo {idle[0]} cannot be armed")

    def _goals(self, position_rad: Array) -> dict[int, bytes]:
        counts = np.round(position_rad / RAD_PER_COUNT * self._direction + self._zero).astype(int)
        return {id_: struct.pack("<i", int(c)) for id_, c in zip(self._options.ids, counts, strict=True)}


@takes(DynamixelOptions)
def connect(context: Context, options: dict[str, Any]) -> DynamixelArm:
    """Entry point `serial:dynamixel`."""
    device = DynamixelArm(context, read_options(context, options, DynamixelOptions))
    device.join(CONNECT_S)
    return device
