"""Remote I/O over Modbus TCP or RTU (Moxa ioLogik E1200 map): lights, touch, proximity switches, stop input.

Outputs are coils from 0, inputs discrete inputs from 0; one request reads all inputs, so their values are consistent.
Devices on the same link share one bus.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated, Any, ClassVar, Self, TypeVar

from pydantic import Field, model_validator

from drivers.kinds.digital_points import require_same_number, wanted_lights
from drivers.transport.link import WireError, now_s
from drivers.transport.modbus import ModbusMaster
from drivers.transport.modbus_bus import ModbusDevice, ModbusOptions
from drivers.transport.options import Seconds, read_options
from hal.clock import Deadline
from hal.devices import DeviceKind, LightsCapabilities, ProximityCapabilities, TouchCapabilities
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes

Point = Annotated[int, Field(ge=0, le=255)]
T = TypeVar("T")
CLOSE_S = 0.08


class IoOptions(ModbusOptions):
    """Options that all points of a remote I/O share: `port = 502` with `host` for TCP, a path for RTU."""

    shared_as: ClassVar[str | None] = "remote I/O"
    inputs: Annotated[
        int, Field(ge=1, le=256, description="number of discrete inputs that are read in one request")
    ] = 8

    @model_validator(mode="after")
    def _points_exist(self) -> Self:
        wired = self.wired()
        if wired and max(wired) >= self.inputs:
            most = f"the driver reads only inputs 0 to {self.inputs - 1} (key `inputs`)"
            raise ValueError(f"input {max(wired)} is used, but {most}: increase `inputs` or correct the number")
        return self

    def wired(self) -> tuple[int, ...]:
        """Return the numbers of the inputs in use."""
        return ()


class LightsOptions(IoOptions):
    """Options of `modbus:lights`: the coil and the feedback input of each light, in the panel's order.

    `channels` names them; by default they have the names in the cell's panel file.
    """

    channels: Annotated[
        tuple[str, ...] | None, Field(description="names of the lights; those of the cell's panel file if not given")
    ] = None
    outputs: Annotated[tuple[Point, ...], Field(description="coil of each light")] = (0, 1, 2, 3)
    feedback: Annotated[
        tuple[Point, ...], Field(description="discrete input that reports whether each light is lit")
    ] = (0, 1, 2, 3)
    settle_s: Annotated[Seconds, Field(description="time from switching to a true feedback")] = 0.05
    stop_input: Annotated[
        Point | None,
        Field(description="discrete input of the stop circuit, which opens for a stop; none if it is not wired"),
    ] = 7

    @model_validator(mode="after")
    def _one_point_a_light(self) -> Self:
        require_same_number("channels, outputs and feedback", self.channels, self.outputs, self.feedback)
        return self

    def wired(self) -> tuple[int, ...]:
        """Return the feedback inputs and the stop input."""
        return self.feedback if self.stop_input is None else (*self.feedback, self.stop_input)


class TouchOptions(IoOptions):
    """Options of `modbus:touch`: one input per pad."""

    channels: Annotated[tuple[str, ...], Field(description="names of the pads")] = ("left", "right")
    contacts: Annotated[tuple[Point, ...], Field(description="discrete input of each pad")] = (4, 5)
    threshold_n: Annotated[float, Field(gt=0, description="contact force that closes a pad")] = 1.0

    @model_validator(mode="after")
    def _one_point_a_pad(self) -> Self:
        require_same_number("channels and contacts", self.channels, self.contacts)
        return self

    def wired(self) -> tuple[int, ...]:
        """Return the inputs of the touch pads."""
        return self.contacts


class SwitchOptions(IoOptions):
    """Options of `modbus:proximity`: a proximity switch as a sensor of one distance."""

    input: Annotated[Point, Field(description="discrete input of the switch")] = 6
    switching_distance_m: Annotated[float, Field(gt=0, description="distance at which the switch closes")] = 0.02
    sigma_m: Annotated[float, Field(gt=0, description="scatter of that distance, one sigma")] = 0.002

    def wired(self) -> tuple[int, ...]:
        """Return the input of the switch."""
        return (self.input,)


class IoDevice(ModbusDevice[T]):
    """Some inputs of a remote I/O, read together."""

    def __init__(self, context: Context, options: IoOptions) -> None:
        super().__init__(context, options)
        self._io = options

    def take_reading(self, client: ModbusMaster) -> None:
        """Read all inputs in one request."""
        io = self._io
        inputs = client.read_bits(unit=io.unit, address=0, count=io.inputs, until_s=now_s() + client.attempt_s)
        self.take(inputs, self.exchanges.taken_s(client.asked_s, now_s()))

    @abstractmethod
    def take(self, inputs: tuple[bool, ...], valid_s: float) -> None:
        """Publish the value that these inputs represent."""


class IoLights(IoDevice[tuple[bool, ...]]):
    """Border lights of the panel: outputs switch them, inputs report whether they are lit."""

    kind = DeviceKind.LIGHTS

    def __init__(self, context: Context, options: LightsOptions) -> None:
        super().__init__(context, options)
        self._options = options
        self._channels = options.channels or _panel_lights(context, len(options.outputs))
        self._wanted: tuple[bool, ...] | None = None
        self._commanded_s = -math.inf

    def capabilities(self) -> LightsCapabilities:
        """Return the channel names given by the options."""
        return LightsCapabilities(channels=self._channels, settle_s=self._options.settle_s)

    def set_on(self, on: Sequence[bool], *, deadline: Deadline) -> tuple[bool, ...]:
        """Switch all lights and wait for the device's acknowledgement."""
        wanted = wanted_lights(self.name, self._channels, on)
        self.call(lambda client, until_s: self._write(client, wanted, until_s), deadline)
        self._wanted = wanted
        self._commanded_s = self.context.clock.now_s()
        return wanted

    def read_on(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Return the newest feedback, never from before the last command."""
        oldest_s = self.context.clock.now_s() - self.max_age_s
        return self.newest(deadline, not_before_s=max(oldest_s, self._commanded_s))

    def prepare(self, client: ModbusMaster) -> None:
        """Restore the last commanded state of the lights after a loss."""
        if self._wanted is not None:
            client.meet(self._io.unit)  # inputs are read by another function
            self._write(client, self._wanted, now_s() + client.attempt_s)

    def take(self, inputs: tuple[bool, ...], valid_s: float) -> None:
        """Publish the feedback; degraded while the stop circuit is open."""
        stop = self._options.stop_input
        is_healthy = stop is None or inputs[stop]
        self.publish(
            tuple(inputs[i] for i in self._options.feedback),
            valid_s=valid_s,
            quality=Quality.VALID if is_healthy else Quality.DEGRADED,
            cause=Cause.NONE if is_healthy else Cause.DEVICE,
        )

    def release(self) -> None:
        """Switch the lights off, if the link still works, and detach from the bus."""
        with suppress(WireError):
            off = (False,) * len(self._channels)
            self.bus.call(lambda client, until_s: self._write(client, off, until_s), now_s() + CLOSE_S)
        super().release()

    def _write(self, client: ModbusMaster, wanted: tuple[bool, ...], until_s: float) -> None:
        outputs = self._options.outputs
        if outputs == tuple(range(outputs[0], outputs[0] + len(outputs))):
            client.write_coils(unit=self._io.unit, address=outputs[0], values=wanted, until_s=until_s)
            return
        for output, value in zip(outputs, wanted, strict=True):
            client.write_coils(unit=self._io.unit, address=output, values=[value], until_s=until_s)


def _panel_lights(context: Context, count: int) -> tuple[str, ...]:
    names = tuple(light.name for light in context.cell.panel.lights) if context.cell is not None else ()
    return names if len(names) == count else tuple(f"light_{i}" for i in range(count))


class IoTouch(IoDevice[tuple[bool, ...]]):
    """Contact switches on inputs."""

    kind = DeviceKind.TOUCH

    def __init__(self, context: Context, options: TouchOptions) -> None:
        super().__init__(context, options)
        self._options = options

    def capabilities(self) -> TouchCapabilities:
        """Return channel names and threshold given by the options."""
        o = self._options
        return TouchCapabilities(channels=o.channels, threshold_n=o.threshold_n, rate_hz=o.rate_hz)

    def read_contacts(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Return the newest state of the pads."""
        return self.newest(deadline)

    def take(self, inputs: tuple[bool, ...], valid_s: float) -> None:
        """Publish the states of the pads' inputs."""
        self.publish(tuple(inputs[i] for i in self._options.contacts), valid_s=valid_s)


class IoSwitch(IoDevice[float]):
    """Proximity switch: it detects one distance and gives no value beyond it."""

    kind = DeviceKind.PROXIMITY

    def __init__(self, context: Context, options: SwitchOptions) -> None:
        super().__init__(context, options)
        self._options = options

    def capabilities(self) -> ProximityCapabilities:
        """Return a range of one distance."""
        o = self._options
        return ProximityCapabilities(
            min_range_m=0.0, max_range_m=o.switching_distance_m, sigma_m=o.sigma_m, rate_hz=o.rate_hz
        )

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Return the switching distance while on (degraded, as the surface may be nearer), else an invalid reading."""
        return self.newest(deadline)

    def take(self, inputs: tuple[bool, ...], valid_s: float) -> None:
        """Publish the reading: when on, the surface is at most the switching distance away."""
        is_near = inputs[self._options.input]
        self.publish(
            self._options.switching_distance_m if is_near else math.nan,
            valid_s=valid_s,
            quality=Quality.DEGRADED if is_near else Quality.INVALID,
            cause=Cause.SATURATED if is_near else Cause.OUT_OF_RANGE,
        )


@takes(LightsOptions)
def connect_lights(context: Context, options: dict[str, Any]) -> IoLights:
    """Entry point `modbus:lights`."""
    device = IoLights(context, read_options(context, options, LightsOptions))
    device.join()
    return device


@takes(TouchOptions)
def connect_touch(context: Context, options: dict[str, Any]) -> IoTouch:
    """Entry point `modbus:touch`."""
    device = IoTouch(context, read_options(context, options, TouchOptions))
    device.join()
    return device


@takes(SwitchOptions)
def connect_switch(context: Context, options: dict[str, Any]) -> IoSwitch:
    """Entry point `modbus:proximity`."""
    device = IoSwitch(context, read_options(context, options, SwitchOptions))
    device.join()
    return device
