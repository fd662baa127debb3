"""Universal Robots arm: state over RTDE, motion by a URScript program that follows RTDE input registers.

The program monitors the host: if the heartbeat register does not change for `watchdog_s` it brakes and ends, so the arm
stops when the host dies. Only `enable` starts the program; a lost connection does not restart it.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from drivers.kinds.arms import KinematicsOptions, SetPointFilter, capabilities, ur10e
from drivers.transport.capture import inside
from drivers.transport.device import SLICE_S, wall_until
from drivers.transport.link import Link, LinkLost, WireError, drain, now_s
from drivers.transport.options import CONNECT_TIMEOUT_S, PortNumber, read_options, tcp_opener
from drivers.transport.socket_link import SocketLink, open_tcp
from drivers.transport.stream import StreamDevice
from drivers.transport.timebase import HostTime
from drivers.ur import rtde
from drivers.ur.ownership import MARKS, Ownership, marks, owner_by_marks
from drivers.ur.program import BEATS, FAR_BEATS, FIRST_REGISTER, JOINTS, RAD_PER_COUNT, servo_program
from drivers.ur.session import ANSWER_S, InUse, RtdeSession
from hal.arrays import Array
from hal.clock import Deadline, WallClock
from hal.devices import ArmCapabilities, DeviceKind, JointState
from hal.errors import DeviceFault, MotionRefused
from hal.readings import Stamped
from hal.registry import Context, takes

OUTPUTS = ("timestamp", "actual_q", "actual_qd", "robot_mode", "safety_mode", "runtime_state")
INPUTS = (*(f"input_int_register_{FIRST_REGISTER + i}" for i in range(JOINTS + 1)), *MARKS)
RUNNING, PLAYING = 7, 2
SAFE_MODES = (1, 2)  # normal, reduced
PROGRAM_START_S = 1.0
MOVING_RAD_PER_S = 1e-3


class UrOptions(rtde.RtdeOptions):
    """Options of `ur:rtde`."""

    owns: ClassVar[tuple[str, ...]] = ("the arm",)
    script_port: Annotated[PortNumber, Field(description="TCP port that takes the servo program")] = 30_003
    rate_hz: Annotated[
        float,
        Field(
            gt=0, le=500, description="records per second that the controller is asked for; an e-Series has up to 500"
        ),
    ] = 500.0
    kinematics: Annotated[
        KinematicsOptions, Field(description="links, limits and speeds of the arm; those of a UR10e if not given")
    ] = Field(default_factory=ur10e)
    brake_rad_per_s2: Annotated[
        float, Field(gt=0, le=40, description="deceleration with which the servo program stops each joint")
    ] = 4.0
    servo_gain: Annotated[
        int, Field(ge=100, le=2000, description="`gain` of servoj: stiffness with which set-points are followed")
    ] = 500
    lookahead_s: Annotated[
        float, Field(ge=0.03, le=0.2, description="`lookahead_time` of servoj: time over which set-points are smoothed")
    ] = 0.05
    watchdog_s: Annotated[
        float,
        Field(ge=0.02, le=2, description="time without a set-point after which the servo program brakes by itself"),
    ] = 0.1

    def known_arm(self) -> ArmCapabilities:
        """Return the kinematics and limits given by `kinematics`."""
        return capabilities(self.kinematics, command_rate_hz=self.rate_hz, watchdog_s=self.watchdog_s)

    @model_validator(mode="after")
    def _has_six_joints(self) -> Self:
        if len(self.kinematics.links) != JOINTS:
            raise ValueError(f"kinematics: an arm of this maker has {JOINTS} joints, not {len(self.kinematics.links)}")
        return self


@dataclass(frozen=True, slots=True, kw_only=True)
class Modes:
    """Modes reported by the controller."""

    robot: int
    safety: int
    runtime: int


class Ur(StreamDevice[JointState]):
    """Universal Robots arm."""

    kind = DeviceKind.ARM

    def __init__(self, context: Context, options: UrOptions) -> None:
        opener, name = tcp_opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=name, max_age_s=max(5.0 / options.rate_hz, 0.02))
        self._options = options
        self._filter = SetPointFilter(context.name, options.kinematics, command_rate_hz=options.rate_hz)
        self._session = RtdeSession(answer_s=self.patience * ANSWER_S)
        self._ownership = Ownership(context, options.owns[0])
        self._marks = (0, 0)
        self._is_marked = False
        self._host = HostTime()
        self._last_device_s = 0.0
        self._modes = Modes(robot=0, safety=0, runtime=0)
        self._was_playing = False
        self._enabled_s = 0.0
        self._beat = int(1e3 * now_s()) % BEATS  # not where another session's heartbeat ended
        self._script: Link | None = None
        self._scripting = threading.Lock()  # one thread at a time on the script port
        self._commands = threading.Lock()

    def capabilities(self) -> ArmCapabilities:
        """Return the capabilities given by the options."""
        return capabilities(
            self._options.kinematics, command_rate_hz=self._options.rate_hz, watchdog_s=self._options.watchdog_s
        )

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Return the newest measured joint state."""
        return self.newest(deadline)

    def enable(self, *, deadline: Deadline) -> None:
        """Start the servo program at the measured position.

        Raises:
            DeviceFault: the robot is not running, or its safety system stopped it; a person must resolve that.
            MotionRefused: a stop came meanwhile.
        """
        closings = self._filter.closings
        measured = self.newest(deadline).value.position_rad
        self._require_healthy()
        with self._commands:
            self._beat = (self._beat + FAR_BEATS) % BEATS
            self._send_registers(measured, deadline)  # first, so that the program starts at the arm's position
            self._run_script(self._program(), deadline)
            self._was_playing, self._enabled_s = False, now_s()
            try:
                self._filter.begin(measured, closings=closings)
            except MotionRefused:
                self._brake(deadline)  # the program may have arrived after the stop itself
                raise

    def _program(self) -> str:
        o = self._options
        return servo_program(
            first_beat=self._beat,
            watchdog_s=o.watchdog_s,
            lookahead_s=o.lookahead_s,
            gain=o.servo_gain,
            brake_rad_per_s2=o.brake_rad_per_s2,
        )

    def command_position(self, position_rad: Array, *, deadline: Deadline) -> Array:
        """Write one set-point and the next heartbeat into the registers."""
        self.require_open()
        with self._commands:
            sent = self._filter.passed(position_rad, now_s())
            self._require_healthy()
            self._require_program()
            self._beat += 1
            self._send_registers(sent, deadline)
            return sent

    def stop(self, *, deadline: Deadline) -> None:
        """Brake: `stopj` replaces the servo program."""
        self.require_open()
        self._filter.close()
        self._brake(deadline)

    def _brake(self, deadline: Deadline) -> None:
        self._run_script(f"stopj({self._options.brake_rad_per_s2})\n", deadline)

    def start(self, link: Link) -> None:
        """Take the arm, set up recipes and start the stream; motion stays disabled.

        Raises:
            DeviceUnavailable: another process or another client of the controller has the arm.
        """
        self._filter.close()
        connection = inside(link, SocketLink)
        if connection is not None:  # else a replay
            self._ownership.take(connection)
            self._marks = marks(connection)
        try:
            self._session.begin(link, outputs=OUTPUTS, rate_hz=self._options.rate_hz, inputs=INPUTS)
        except InUse:
            if connection is None:
                raise
            _, (host, port) = connection.addresses
            owner = owner_by_marks(host, port, answer_s=self.patience * ANSWER_S, device=self.name)
            raise self._ownership.refusal(host, port, owner) from None
        self._is_marked = False
        self._host.reset()
        self._last_device_s = 0.0

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each data package, and drain the script port."""
        for values in self._session.take(chunk):
            self._take(values, arrived_s)
        if self._scripting.acquire(blocking=False):  # a thread that writes a script drains the port itself
            try:
                self._drain_script()
            finally:
                self._scripting.release()

    def _drain_script(self) -> None:
        if self._script is not None:
            with suppress(WireError):
                drain(self._script)

    def _take(self, values: dict[str, Any], arrived_s: float) -> None:
        device_s = float(values["timestamp"])
        period_s = 1.0 / self._options.rate_hz
        steps = round((device_s - self._last_device_s) / period_s) if self._last_device_s else 1
        self._last_device_s = device_s
        self._modes = Modes(robot=values["robot_mode"], safety=values["safety_mode"], runtime=values["runtime_state"])
        self._was_playing = self._was_playing or self._modes.runtime == PLAYING
        velocity = np.array(values["actual_qd"])
        self.publish(
            JointState(
                position_rad=np.array(values["actual_q"]),
                velocity_rad_per_s=velocity,
                is_enabled=self._filter.is_open and self._is_healthy() and not self._has_ended(),
                is_moving=bool(np.any(np.abs(velocity) > MOVING_RAD_PER_S)),
            ),
            valid_s=self._host.host_s(device_s=device_s, arrived_s=arrived_s),
            device_time_s=device_s,
            missed=max(0, steps - 1) if steps < 100 else 0,
        )

        if not self._is_marked and self._modes.runtime != PLAYING:  # a program that still runs reads the registers
            self._mark(np.array(values["actual_q"]))

    def _mark(self, measured_rad: Array) -> None:
        """Name this process to other clients of the controller."""
        link, inputs = self.port.link, self._session.inputs
        if link is None or inputs is None or not self._commands.acquire(blocking=False):
            return
        try:
            with suppress(WireError):
                link.write(self._registers(inputs, measured_rad), now_s() + SLICE_S)
                self._is_marked = True
        finally:
            self._commands.release()

    def lost(self, error: Exception) -> None:
        """Stop the motion and report the loss of the link."""
        self._filter.close()
        super().lost(error)

    def release(self) -> None:
        """Brake if the arm was enabled, then disconnect."""
        if self._filter.is_open:
            self._filter.close()
            with suppress(Exception):
                self._brake(Deadline.after(WallClock(), 0.05))
        super().release()
        self._close_script()
        self._ownership.release()

    def _is_healthy(self) -> bool:
        return self._modes.robot == RUNNING and self._modes.safety in SAFE_MODES

    def _require_healthy(self) -> None:
        if not self._is_healthy():
            self._filter.close()
            raise DeviceFault(
                f"{self.name} is not ready: robot mode {self._modes.robot}, safety mode {self._modes.safety}",
                hint="look at the pendant: power on, release the brakes, unlock a protective stop",
                device=self.name,
            )

    def _has_ended(self) -> bool:
        """Return whether the program was seen running and runs no more."""
        return self._was_playing and self._modes.runtime != PLAYING

    def _require_program(self) -> None:
        if self._modes.runtime == PLAYING:
            return
        if self._has_ended():
            what, hint = "has ended (watchdog or pendant)", "enable again, and send set-points without a pause"
        elif now_s() - self._enabled_s > self.patience * PROGRAM_START_S:
            what, hint = "does not start", "set the robot to remote control"
        else:
            return
        self._filter.close()
        raise MotionRefused(f"{self.name}: the servo program {what}", hint=hint, device=self.name)

    def _send_registers(self, position_rad: Array, deadline: Deadline) -> None:
        link, inputs = self.port.link, self._session.inputs
        try:
            if link is None or inputs is None:
                raise LinkLost("the RTDE connection is down")
            link.write(self._registers(inputs, position_rad), wall_until(deadline))
        except WireError as error:
            raise self.translate(error) from error
        self._is_marked = True

    def _registers(self, inputs: rtde.Recipe, position_rad: Array) -> bytes:
        counts = [round(q / RAD_PER_COUNT) for q in position_rad]
        return inputs.pack([self._beat, *counts, *self._marks])

    def _run_script(self, text: str, deadline: Deadline) -> None:
        until_s = wall_until(deadline)
        with self._scripting:
            try:
                self._write_script(text, until_s)
            except WireError:
                self._close_script()  # the port hung up since the last program
                try:
                    self._write_script(text, until_s)
                except WireError as error:
                    raise self.translate(error) from error

    def _close_script(self) -> None:
        script, self._script = self._script, None
        if script is not None:
            script.close()

    def _write_script(self, text: str, until_s: float) -> None:
        if self._script is None:
            o = self._options
            timeout_s = max(0.01, min(CONNECT_TIMEOUT_S, until_s - now_s()))
            self._script = open_tcp(o.host, o.script_port, timeout_s=timeout_s, device=self.name)
        drain(self._script)
        self._script.write(text.encode(), until_s)


@takes(UrOptions)
def connect(context: Context, options: dict[str, Any]) -> Ur:
    """Entry point `ur:rtde`."""
    device = Ur(context, read_options(context, options, UrOptions))
    device.join()
    return device
