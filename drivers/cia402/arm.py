"""Six-axis arm of CiA-402 drives on CANopen in cyclic synchronous position mode, timed by SYNC (CiA 301, CiA 402-2).

The owner thread sends all targets and then SYNC at a fixed rate; the drives' states are sampled on that SYNC, which
gives their time stamp. Each drive monitors the host's heartbeat (1016h): if the host dies, the drives fault and brake
on their own. Only `enable` switches them on.
"""

from __future__ import annotations

import struct
import threading
from typing import Any

import numpy as np

from drivers.cia402.options import Cia402Options
from drivers.cia402.setup import PROBES, SDO_REQUEST, SDO_S, SdoClient, SetUp, upload_request
from drivers.cia402.states import Axis, DriveState, control_word
from drivers.kinds.arms import SetPointFilter, capabilities
from drivers.transport.can_frames import CanFrame, FrameReader, record
from drivers.transport.canbus import can_opener
from drivers.transport.device import wall_until
from drivers.transport.link import Link, NoAnswer, Refused, drain, now_s
from drivers.transport.options import read_options
from drivers.transport.stream import StreamDevice
from hal.arrays import Array
from hal.clock import Deadline
from hal.devices import ArmCapabilities, DeviceKind, JointState
from hal.errors import DeviceFault, DeviceTimeout
from hal.readings import Stamped
from hal.registry import Context, takes

NMT, SYNC, RPDO1, HEARTBEAT = 0x000, 0x080, 0x200, 0x700
START, PRE_OPERATIONAL = 0x01, 0x80
OPERATIONAL, BOOT_UP = 5, 0
IDLE_STATES = {4: "stopped", 0x7F: "pre-operational"}
STARTS_S = 0.2  # after the start command: older heartbeats may still be in transit
CONNECT_S = 6.0  # seven objects for each of six drives
MOVING_RAD_PER_S = 1e-3
MOST_OWED = 4  # unanswered SYNCs of one drive before the host waits for it
MOST_KNOWN = 64  # number of SYNCs whose time is kept


class Cia402(StreamDevice[JointState]):
    """Six-axis arm of CiA-402 drives."""

    kind = DeviceKind.ARM

    def __init__(self, context: Context, options: Cia402Options) -> None:
        opener, name = can_opener(options, context.name)
        super().__init__(
            context,
            open_link=opener,
            link_name=name,
            max_age_s=max(4.0 / options.rate_hz, 0.04),
            realtime_priority=options.realtime_priority,
        )
        self._options = options
        self._frames = FrameReader()
        self._answer_s = self.patience * SDO_S
        self._rad = np.radians(options.degrees_per_increment)
        self._filter = SetPointFilter(context.name, options.kinematics, command_rate_hz=options.rate_hz)
        self._set_up = SetUp(
            options.nodes,
            consumer=options.host_node << 16 | round(1000 * options.heartbeat_s),
            producer_ms=round(500 * options.heartbeat_s),
            parameters=options.written(),
        )
        self._axes = {node: Axis() for node in options.nodes}
        self._targets = dict.fromkeys(options.nodes, 0)
        self._is_wanted = False  # the drives should be in operation enabled
        self._is_reset = False  # a fault reset has been requested
        self._commands = threading.RLock()
        self._started_s = self._next_sync_s = 0.0
        self._odd = ""
        self._syncs = self._published = 0
        self._sync_s = [0.0] * MOST_KNOWN
        self._next_beat_s = 0.0
        self.missed_syncs = 0
        self.held_syncs = 0

    def capabilities(self) -> ArmCapabilities:
        """Return the capabilities given by the options."""
        o = self._options
        return capabilities(o.kinematics, command_rate_hz=o.rate_hz, watchdog_s=o.heartbeat_s)

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Return the newest measured joints, all sampled on one SYNC."""
        return self.newest(deadline)

    def enable(self, *, deadline: Deadline) -> None:
        """Reset faults and bring all drives to operation enabled, with the measured position as target, so nothing jumps.

        Raises:
            DeviceFault: a drive stays in fault. DeviceTimeout: a drive is not enabled in time.
            MotionRefused: a stop came meanwhile.
        """
        closings = self._filter.closings
        measured = self.newest(deadline).value.position_rad
        with self._commands:
            self._filter.check_not_closed_since(closings)
            self._targets = self._increments(measured)
            self._is_reset = self._is_wanted = True
        rest, until_s = threading.Event(), wall_until(deadline)
        while not self._all_in(DriveState.OPERATION_ENABLED):
            self._filter.check_not_closed_since(closings)
            if now_s() >= until_s:
                self._switch_off()
                raise self._not_enabled()
            rest.wait(0.5 / self._options.rate_hz)
        self._filter.begin(measured, closings=closings)

    def command_position(self, position_rad: Array, *, deadline: Deadline) -> Array:  # noqa: ARG002  # never waits
        """Set the targets of the next SYNC; return them as limited."""
        self.require_open()
        with self._commands:
            if self._filter.is_open and not self._all_in(DriveState.OPERATION_ENABLED):
                self._switch_off()
                raise self._not_enabled()
            sent = self._filter.passed(position_rad, now_s())
            self._targets = self._increments(sent)
            return sent

    def _increments(self, position_rad: Array) -> dict[int, int]:
        return {node: round(q / self._rad) for node, q in zip(self._options.nodes, position_rad, strict=True)}

    def stop(self, *, deadline: Deadline) -> None:  # noqa: ARG002  # never waits
        """Command a quick stop of all drives with the next SYNC."""
        self.require_open()
        self._switch_off()

    def start(self, link: Link) -> None:
        """Open the channel, check and configure each drive, and start them; motion stays disabled."""
        o = self._options
        self._switch_off()
        self._frames.reset()
        drain(link)
        self._send(link, NMT, bytes([PRE_OPERATIONAL, 0]))
        self._set_up.run(SdoClient(link, answer_s=self._answer_s, restarted=self._set_up.forget))
        self._axes = {node: Axis() for node in o.nodes}
        self._syncs = self._published = 0
        self._odd = ""
        self._send(link, NMT, bytes([START, 0]))
        self._started_s = self._next_sync_s = self._next_beat_s = now_s()

    def _send(self, link: Link, id_: int, data: bytes = b"") -> None:
        link.write(record(CanFrame(id_, data)), now_s() + self._answer_s)

    def keep_going(self, link: Link) -> float:
        """Send heartbeat, targets and SYNC when they are due; return the time until the next, in seconds."""
        now = now_s()
        if now >= self._next_beat_s:
            self._next_beat_s = now + self._options.heartbeat_s / 4.0
            self._send(link, HEARTBEAT + self._options.host_node, bytes([OPERATIONAL]))
        if now >= self._next_sync_s:
            period_s = 1.0 / self._options.rate_hz
            late = int((now - self._next_sync_s) / period_s)
            self.missed_syncs += late
            self._next_sync_s += (late + 1) * period_s
            self.take_in(link, 0.0)  # data already received answers earlier SYNCs
            self._cycle(link)
        return max(0.0, min(self._next_sync_s, self._next_beat_s) - now_s())

    def _cycle(self, link: Link) -> None:
        with self._commands:
            words = {
                node: control_word(axis.state, self._is_wanted, self._is_reset) for node, axis in self._axes.items()
            }
            targets = self._targets
            self._is_reset = self._is_reset and any(axis.state is DriveState.FAULT for axis in self._axes.values())
        frames = [CanFrame(RPDO1 + n, struct.pack("<Hi", words[n], targets[n])) for n in self._options.nodes]
        now = now_s()
        probes = [frame for node, axis in self._axes.items() if (frame := self._probe(node, axis, now)) is not None]
        is_behind = any(axis.count.owed >= MOST_OWED or axis.count.needs_rest for axis in self._axes.values())
        # Further SYNCs would only queue up and make every answer older than the last.
        batch = probes if is_behind else [*probes, *frames, CanFrame(SYNC, b"")]
        link.write(b"".join(map(record, batch)), now + self._answer_s)
        if is_behind:
            self.held_syncs += 1
            return
        self._syncs += 1
        self._sync_s[self._syncs % MOST_KNOWN] = now
        for axis in self._axes.values():
            axis.count.synced()

    def _probe(self, node: int, axis: Axis, now: float) -> CanFrame | None:
        """Return an SDO request whose answer distinguishes late PDOs from lost ones, or None if no PDO is outstanding."""
        if not axis.count.wants_probe(now):
            return None
        axis.count.probed(now)
        return CanFrame(SDO_REQUEST + node, upload_request(*PROBES[axis.count.probes % len(PROBES)]))

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Collect the states of one SYNC, and handle emergency messages and drive restarts."""
        for frame in self._frames.feed(chunk, arrived_s):
            node = frame.id & 0x7F
            axis = self._axes.get(node)
            if axis is None:
                continue
            match frame.id & 0x780:
                case 0x180 if len(frame.data) == 6:
                    axis.status, increments = struct.unpack("<Hi", frame.data)
                    if axis.count.took(0, frame.data):
                        axis.increments = increments
                        self._publish_when_complete()
                case 0x280 if len(frame.data) == 6:
                    if axis.count.took(1, frame.data):
                        axis.velocity, _ = struct.unpack("<ih", frame.data)
                        self._publish_when_complete()
                case 0x580 if frame.data[1:4] == upload_request(*PROBES[axis.count.probes % len(PROBES)])[1:4]:
                    axis.count.probe_answered()
                    self._publish_when_complete()
                case 0x180 | 0x280:
                    self.errors += 1
                    self._odd = f"; node {node} sends PDOs of {len(frame.data)} bytes, not 6"
                case 0x080 if len(frame.data) == 8:
                    self._emergency(node, frame.data)
                case 0x700 if len(frame.data) == 1:
                    self._heard_beat(node, frame.data[0] & 0x7F, frame.arrived_s)

    def _heard_beat(self, node: int, state: int, arrived_s: float) -> None:
        """Handle a heartbeat: a drive that is not operational sends no PDOs, so there is no point in waiting for them."""
        if state == BOOT_UP:
            self._set_up.forget(node)
            raise NoAnswer(f"node {node} has restarted")
        if state in IDLE_STATES and arrived_s > self._started_s + STARTS_S:
            raise NoAnswer(f"node {node} says that it is {IDLE_STATES[state]}")

    def wire_counts(self) -> str:
        """Return the stream's counters, and which drives leave SYNCs unanswered."""
        silent = ", ".join(str(node) for node, axis in self._axes.items() if axis.count.owed >= MOST_OWED)
        return super().wire_counts() + self._odd + (f"; nodes that answer no SYNC: {silent}" if silent else "")

    def _emergency(self, node: int, data: bytes) -> None:
        code = self._axes[node].emergency = data[0] | data[1] << 8
        if code:  # code 0000 means that the error is gone
            self._switch_off()
            self.fail(Refused(f"node {node} reports emergency {code:04X}h", code=code))

    def _publish_when_complete(self) -> None:
        axes = [self._axes[node] for node in self._options.nodes]
        answered = axes[0].count.answered
        is_complete = all(axis.count.answered == answered for axis in axes)
        if answered is None or answered <= self._published or not is_complete:
            return
        self._published = answered
        velocity = np.array([axis.velocity for axis in axes]) * self._rad
        self.publish(
            JointState(
                position_rad=np.array([axis.increments for axis in axes]) * self._rad,
                velocity_rad_per_s=velocity,
                is_enabled=self._filter.is_open and self._all_in(DriveState.OPERATION_ENABLED),
                is_moving=bool(np.any(np.abs(velocity) > MOVING_RAD_PER_S)),
            ),
            valid_s=self._sync_s[answered % MOST_KNOWN],
        )

    def _all_in(self, state: DriveState) -> bool:
        return all(axis.state is state for axis in self._axes.values())

    def _switch_off(self) -> None:
        with self._commands:  # an `enable` that has passed its check must not switch the drives on after this
            self._is_wanted = self._is_reset = False
            self._filter.close()

    def _not_enabled(self) -> DeviceFault | DeviceTimeout:
        states = ", ".join(f"{node}: {axis}" for node, axis in self._axes.items())
        if any(axis.state is DriveState.FAULT for axis in self._axes.values()):
            hint = "read object 603Fh; enable again resets the fault"
            return DeviceFault(f"{self.name}: a drive is in fault ({states})", hint=hint, device=self.name)
        hint = "check the power stage and the enable inputs of the drives"
        return DeviceTimeout(
            f"{self.name}: the drives were not enabled in time ({states})", hint=hint, device=self.name
        )

    def lost(self, error: Exception) -> None:
        """Stop the motion and report the loss of the bus."""
        self._switch_off()
        super().lost(error)

    def release(self) -> None:
        """Command a quick stop for one or two cycles, then stop sending."""
        self._switch_off()
        threading.Event().wait(2.0 / self._options.rate_hz)
        super().release()


@takes(Cia402Options)
def connect(context: Context, options: dict[str, Any]) -> Cia402:
    """Entry point `can:cia402`."""
    device = Cia402(context, read_options(context, options, Cia402Options))
    device.join(CONNECT_S)
    return device
