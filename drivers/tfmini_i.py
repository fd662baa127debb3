"""Benewake TFmini-i over Modbus RTU and over CAN, TF03 over CAN (SJ-PM-TFmini-i A01; TF02-i BP-UM-22 A03, p 7).

Readings are judged as for the TFmini-Plus. Both links carry the sensor's millisecond clock, except with the TF03.
"""

from __future__ import annotations

import struct
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.tfmini import EchoOptions
from drivers.transport.can_frames import CanFrame, FrameReader
from drivers.transport.canbus import CanOptions, can_opener
from drivers.transport.link import Link, now_s
from drivers.transport.modbus import ModbusMaster
from drivers.transport.modbus_bus import ModbusDevice, ModbusOptions
from drivers.transport.options import read_options
from drivers.transport.stream import StreamDevice
from drivers.transport.timebase import FrameTimes, HostTime, Unwrapper
from hal.clock import Deadline
from hal.devices import DeviceKind, ProximityCapabilities
from hal.readings import Stamped
from hal.registry import Context, takes

READING_REGISTER, FIRMWARE_REGISTER = 0, 6
CM = 0.01
STAMP_BITS, STAMP_S = 32, 0.001
WITH_CLOCK_BYTES, WITHOUT_CLOCK_BYTES = 8, 6
# Polls at the sensor's own rate come at one fixed time after its measurements, and nothing shows how long that is. At this
# share of the period they come later by another time each, and in 0.3 s one of them comes right after a measurement.
POLL_PERIOD_RATIO = 0.97


class ModbusTfminiOptions(ModbusOptions, EchoOptions):
    """Options of `modbus:tfmini`."""


class CanTfminiOptions(CanOptions, EchoOptions):
    """Options of `can:tfmini`; `id` is the CAN identifier of the sensor. The manual does not state the byte order."""

    bitrate: Annotated[
        int, Field(ge=5_000, le=1_000_000, description="bit rate of the bus, bit/s; a TF03 has 1000000")
    ] = 250_000
    id: Annotated[int, Field(ge=0, le=0x7FF, description="CAN identifier of the sensor's frames")] = 3
    byte_order: Annotated[
        Literal["little", "big"], Field(description="order of the bytes of a number; the manual does not state it")
    ] = "little"
    rate_hz: Annotated[float, Field(gt=0, le=1000, description="measurements per second that the sensor is set to")] = (
        100.0
    )

    @property
    def stations(self) -> tuple[str, ...]:
        """Return the identifier of the sensor's frames."""
        return (f"identifier 0x{self.id:03X}",)


class SensorClock:
    """Converts the sensor's clock to the host's, and detects repeated stamps."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start again, because the link was reopened."""
        self._device = Unwrapper(bits=STAMP_BITS, tick_s=STAMP_S)
        self._host = HostTime()
        self._last_ms: int | None = None

    def is_new(self, stamp_ms: int) -> bool:
        """Return whether this measurement has not been seen before."""
        is_new = stamp_ms != self._last_ms
        self._last_ms = stamp_ms
        return is_new

    def times_s(self, stamp_ms: int, arrived_s: float) -> tuple[float, float]:
        """Return the measurement's time on the sensor's clock and on the host's."""
        device_s = self._device.seconds(stamp_ms)
        return device_s, self._host.host_s(device_s=device_s, arrived_s=arrived_s)


class ModbusTfmini(ModbusDevice[float]):
    """Distance sensor of a finger on a shared two-wire bus."""

    kind = DeviceKind.PROXIMITY

    def __init__(self, context: Context, options: ModbusTfminiOptions) -> None:
        super().__init__(context, options)
        self._options = options
        self._clock = SensorClock()

    @property
    def period_s(self) -> float:
        """Return the time between two polls, a little less than that between two measurements."""
        return POLL_PERIOD_RATIO / self.rate_hz

    def capabilities(self) -> ProximityCapabilities:
        """Return the capabilities given by the options."""
        return self._options.capabilities(self._options.rate_hz)

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Return the newest distance; invalid and NaN when the echo is too weak or out of range."""
        return self.newest(deadline)

    def prepare(self, client: ModbusMaster) -> None:
        """Check by the firmware registers that the device is the sensor."""
        self._clock.reset()
        client.meet(self._options.unit)  # readings have five registers
        until_s = now_s() + client.attempt_s
        client.read_registers(unit=self._options.unit, address=FIRMWARE_REGISTER, count=2, until_s=until_s)

    def take_reading(self, client: ModbusMaster) -> None:
        """Read distance, strength and clock in one request; skip a measurement that was read before."""
        unit, until_s = self._options.unit, now_s() + client.attempt_s
        words = client.read_registers(unit=unit, address=READING_REGISTER, count=5, until_s=until_s)
        raw, strength, _, high, low = words
        stamp_ms = high << 16 | low
        if not self._clock.is_new(stamp_ms):
            return
        device_s, valid_s = self._clock.times_s(stamp_ms, self.exchanges.taken_s(client.asked_s, now_s()))
        value, quality, cause = self._options.judge(raw * CM, strength)
        self.publish(value, valid_s=valid_s, device_time_s=device_s, quality=quality, cause=cause)


class CanTfmini(StreamDevice[float]):
    """Distance sensor of a finger that streams on a CAN bus."""

    kind = DeviceKind.PROXIMITY

    def __init__(self, context: Context, options: CanTfminiOptions) -> None:
        opener, name = can_opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=name, max_age_s=max(3.0 / options.rate_hz, 0.05))
        self._options = options
        self._frames = FrameReader()
        self._clock = SensorClock()
        self._times = FrameTimes(period_s=1.0 / options.rate_hz, frame_bytes=0)  # the adapter has another byte time
        order = "<" if options.byte_order == "little" else ">"
        self._with_clock, self._without_clock = struct.Struct(order + "HHI"), struct.Struct(order + "HH")

    def capabilities(self) -> ProximityCapabilities:
        """Return the capabilities given by the options."""
        return self._options.capabilities(self._options.rate_hz)

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Return the newest distance; invalid and NaN when the echo is too weak or out of range."""
        return self.newest(deadline)

    def start(self, link: Link) -> None:  # noqa: ARG002  # nothing is sent
        """Start again with the clocks; the sensor streams without being asked."""
        self._frames.reset()
        self._clock.reset()
        self._times.reset()

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each of the sensor's frames; frames of other nodes or of another length are ignored."""
        for frame in self._frames.feed(chunk, arrived_s):
            if frame.id == self._options.id:
                self._take(frame)

    def _take(self, frame: CanFrame) -> None:
        device_s, arrived_s = None, frame.arrived_s
        if len(frame.data) == WITH_CLOCK_BYTES:
            raw, strength, stamp_ms = self._with_clock.unpack(frame.data)
            if not self._clock.is_new(stamp_ms):
                return
            device_s, arrived_s = self._clock.times_s(stamp_ms, arrived_s)
        elif len(frame.data) == WITHOUT_CLOCK_BYTES:
            if not (fresh := self._times.stamped([frame.data], arrived_s=arrived_s, byte_s=0.0)):
                return
            raw, strength = self._without_clock.unpack_from(frame.data)
            arrived_s = fresh[0][1]
        else:
            self.errors += 1
            return
        value, quality, cause = self._options.judge(raw * CM, strength)
        self.publish(value, valid_s=arrived_s, device_time_s=device_s, quality=quality, cause=cause)


@takes(ModbusTfminiOptions)
def connect_modbus(context: Context, options: dict[str, Any]) -> ModbusTfmini:
    """Entry point `modbus:tfmini`."""
    device = ModbusTfmini(context, read_options(context, options, ModbusTfminiOptions))
    device.join()
    return device


@takes(CanTfminiOptions)
def connect_can(context: Context, options: dict[str, Any]) -> CanTfmini:
    """Entry point `can:tfmini`."""
    device = CanTfmini(context, read_options(context, options, CanTfminiOptions))
    device.join()
    return device
