"""Robotiq FT 300 and 300-S force/torque sensors: the 100 Hz stream, or registers over Modbus RTU (FT-300 manual, p 65).

Neither way has a time stamp; the time used is arrival minus the frame's time on the line, or the middle of the
exchange.
"""

from __future__ import annotations

import struct
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers.kinds.force_torque import RangeOptions, capabilities
from drivers.transport.checks import crc_modbus
from drivers.transport.framing import Framer
from drivers.transport.link import Link, NoAnswer, Refused, drain_until_quiet, now_s
from drivers.transport.modbus import ModbusMaster, ModbusRtu
from drivers.transport.modbus_bus import ModbusDevice, ModbusOptions
from drivers.transport.options import SerialOptions, read_options, serial_opener
from drivers.transport.stream import StreamDevice
from drivers.transport.timebase import FrameTimes
from hal.clock import Deadline
from hal.devices import DeviceKind, ForceTorqueCapabilities, Wrench
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes

FRAME_BYTES = 16
STREAM_RATE_HZ = 100.0
COUNTS_PER_N, COUNTS_PER_NM = 100.0, 1000.0
WRENCH_REGISTER, FIRMWARE_REGISTER, STREAM_REGISTER = 180, 500, 410
START_STREAM = 0x0200
STOP_S, STOP_BURST = 0.6, 50  # FF bytes for about half a second stop a stream
LISTEN_S = 0.08  # a line silent for this long has no stream, as in the manufacturer's code
STREAMING_FRAMES = 2
ANSWER_S = 0.3


class StreamOptions(SerialOptions, RangeOptions):
    """Options of `serial:ft300`."""

    baud: Annotated[int, Field(ge=300, le=4_500_000)] = 19_200
    unit: Annotated[
        int,
        Field(
            ge=1,
            le=247,
            description="Modbus address of the sensor, to which the command that starts the stream is sent",
        ),
    ] = 9
    max_age_s: Annotated[float, Field(gt=0, le=1, description="an older sample is not returned")] = (
        0.16  # Robotiq's own code gives up after 160 ms
    )


class PollOptions(ModbusOptions, RangeOptions):
    """Options of `modbus:ft300`."""

    baud: Annotated[int, Field(ge=300, le=4_500_000)] = 19_200
    unit: Annotated[int, Field(ge=1, le=247)] = 9
    rate_hz: Annotated[float, Field(gt=0, le=100)] = 50.0


def wrench(counts: tuple[int, ...]) -> Wrench:
    """Return the wrench in newtons and newton metres from the six signed counts."""
    return Wrench(
        force_n=np.array(counts[:3], dtype=float) / COUNTS_PER_N,
        torque_nm=np.array(counts[3:6], dtype=float) / COUNTS_PER_NM,
    )


def stream_framer() -> Framer:
    """Return a framer for `20 4E`, six counts and CRC, little-endian."""
    return Framer(b"\x20\x4e", FRAME_BYTES, lambda f: crc_modbus(f[:-2]) == f[-2] | f[-1] << 8)


def condition(value: Wrench, options: RangeOptions) -> tuple[Quality, Cause]:
    """Return quality and cause; a wrench beyond the measuring range is saturated."""
    is_over = bool(
        np.any(np.abs(value.force_n) > options.force_range_n)
        or np.any(np.abs(value.torque_nm) > options.torque_range_nm)
    )
    return (Quality.INVALID, Cause.SATURATED) if is_over else (Quality.VALID, Cause.NONE)


def identify(master: ModbusMaster, unit: int) -> None:
    """Check that the device is the sensor by its firmware registers; without them, its table must hold a wrench.

    Raises:
        NoAnswer, Refused, LinkLost: the device is not the sensor, or is absent.
    """
    until_s = now_s() + max(ANSWER_S, master.attempt_s)
    try:
        master.read_registers(unit=unit, address=FIRMWARE_REGISTER, count=3, until_s=until_s)
    except Refused:
        master.read_registers(unit=unit, address=WRENCH_REGISTER, count=6, until_s=until_s)


def _end_stream(link: Link) -> None:
    until_s = now_s() + STOP_S
    while now_s() < until_s:
        link.write(b"\xff" * STOP_BURST, until_s + ANSWER_S)
        drain_until_quiet(link, quiet_s=0.025, until_s=now_s() + 0.025)
    drain_until_quiet(link, quiet_s=0.05, until_s=now_s() + ANSWER_S)


class Ft300Stream(StreamDevice[Wrench]):
    """Sensor in streaming mode: 100 frames per second."""

    kind = DeviceKind.FORCE_TORQUE

    def __init__(self, context: Context, options: StreamOptions) -> None:
        opener, name = serial_opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=name, max_age_s=options.max_age_s)
        self._options = options
        self._framer = stream_framer()
        self._bad_before = 0
        self._times = FrameTimes(period_s=1.0 / STREAM_RATE_HZ, frame_bytes=FRAME_BYTES)

    def capabilities(self) -> ForceTorqueCapabilities:
        """Return the capabilities given by the options."""
        return capabilities(self._options, STREAM_RATE_HZ)

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        """Return the newest raw wrench."""
        return self.newest(deadline)

    def start(self, link: Link) -> None:
        """Take over a running stream.

        Otherwise stop any output, check that the device is the sensor, and start the stream.
        """
        self._framer.reset()
        self._times.reset()
        heard, frames, until_s = 0, 0, now_s() + LISTEN_S
        while chunk := link.read(until_s):
            heard += len(chunk)
            frames += len(self._framer.feed(chunk))
            if frames >= STREAMING_FRAMES:
                return
        if heard:
            _end_stream(link)
        master, unit = ModbusRtu(link, timeout_s=ANSWER_S), self._options.unit
        try:
            identify(master, unit)
        except NoAnswer:
            _end_stream(link)  # the silence may have been a pause in a stream
            identify(master, unit)
        start = [START_STREAM]
        master.write_registers(unit=unit, address=STREAM_REGISTER, values=start, until_s=now_s() + ANSWER_S)
        self._framer.reset()

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each complete frame."""
        for frame, valid_s in self._times.stamped(self._framer.feed(chunk), arrived_s=arrived_s, byte_s=self.byte_s):
            self._publish(frame, valid_s)

    def _publish(self, frame: bytes, valid_s: float) -> None:
        value = wrench(struct.unpack("<6h", frame[2:14]))
        quality, cause = condition(value, self._options)
        bad, self._bad_before = self._framer.counts.bad - self._bad_before, self._framer.counts.bad
        self.publish(value, valid_s=valid_s, quality=quality, cause=cause, missed=bad)


class Ft300Registers(ModbusDevice[Wrench]):
    """Sensor as a Modbus slave, beside others on its bus."""

    kind = DeviceKind.FORCE_TORQUE

    def __init__(self, context: Context, options: PollOptions) -> None:
        super().__init__(context, options)
        self._options = options

    def capabilities(self) -> ForceTorqueCapabilities:
        """Return the capabilities given by the options."""
        return capabilities(self._options, self._options.rate_hz)

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        """Return the newest raw wrench."""
        return self.newest(deadline)

    def prepare(self, client: ModbusMaster) -> None:
        """Check that the device is the sensor."""
        client.meet(self._options.unit)  # wrenches have six registers
        identify(client, self._options.unit)

    def take_reading(self, client: ModbusMaster) -> None:
        """Read the six registers."""
        unit, until_s = self._options.unit, now_s() + client.attempt_s
        words = client.read_registers(unit=unit, address=WRENCH_REGISTER, count=6, until_s=until_s)
        value = wrench(struct.unpack(">6h", struct.pack(">6H", *words)))
        quality, cause = condition(value, self._options)
        valid_s = self.exchanges.taken_s(client.asked_s, now_s())
        self.publish(value, valid_s=valid_s, quality=quality, cause=cause)


@takes(StreamOptions)
def connect_stream(context: Context, options: dict[str, Any]) -> Ft300Stream:
    """Entry point `serial:ft300`."""
    device = Ft300Stream(context, read_options(context, options, StreamOptions))
    device.join()
    return device


@takes(PollOptions)
def connect_registers(context: Context, options: dict[str, Any]) -> Ft300Registers:
    """Entry point `modbus:ft300`."""
    device = Ft300Registers(context, read_options(context, options, PollOptions))
    device.join()
    return device
