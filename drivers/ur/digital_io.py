"""Lights and touch on the digital inputs and outputs of a Universal Robots controller, over RTDE (UR RTDE guide).

The controller serves several RTDE clients, so these run beside the arm's own. Only one client may own
`standard_digital_output`; another one that wants it is refused with IN_USE.
"""

from __future__ import annotations

import math
import threading
from abc import abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, model_validator

from drivers.kinds.digital_points import require_same_number, wanted_lights
from drivers.transport.capture import inside
from drivers.transport.device import wall_until
from drivers.transport.link import Link, LinkLost, WireError, now_s
from drivers.transport.options import Seconds, read_options, tcp_opener
from drivers.transport.socket_link import SocketLink
from drivers.transport.stream import StreamDevice
from drivers.transport.timebase import HostTime
from drivers.ur import rtde
from drivers.ur.ownership import Ownership
from drivers.ur.session import ANSWER_S, RtdeSession
from hal.clock import Deadline
from hal.devices import DeviceKind, LightsCapabilities, TouchCapabilities
from hal.readings import Stamped
from hal.registry import Context, takes

OUTPUTS = ("actual_digital_input_bits", "actual_digital_output_bits", "timestamp")
INPUTS = ("standard_digital_output_mask", "standard_digital_output")
CLOSE_S = 0.08
Bits = tuple[bool, ...]
Output = Annotated[int, Field(ge=0, le=7)]
Point = Annotated[int, Field(ge=0, le=63)]


class UrIoOptions(rtde.RtdeOptions):
    """Keys that lights and touch share."""

    rate_hz: Annotated[
        float, Field(gt=0, le=500, description="records per second that the controller is asked for")
    ] = 125.0


class UrLightsOptions(UrIoOptions):
    """Options of `ur:lights`: an output for each light, and the `feedback` inputs that report whether it is lit;
    without them the state of the output is reported."""

    owns: ClassVar[tuple[str, ...]] = ("the digital outputs",)
    channels: Annotated[tuple[str, ...], Field(description="names of the lights")] = (
        "top_left",
        "top_right",
        "bottom_right",
        "bottom_left",
    )
    outputs: Annotated[tuple[Output, ...], Field(description="standard digital output of each light")] = (0, 1, 2, 3)
    feedback: Annotated[
        tuple[Point, ...] | None,
        Field(
            description="digital input that reports whether each light is lit; without it the state of the output is reported"
        ),
    ] = None
    settle_s: Annotated[Seconds, Field(description="time from switching to a true feedback")] = 0.05

    @model_validator(mode="after")
    def _one_point_a_light(self) -> Self:
        require_same_number("channels, outputs and feedback", self.channels, self.outputs, self.feedback)
        return self


class UrTouchOptions(UrIoOptions):
    """Options of `ur:touch`: an input for each pad; 16 and 17 are the tool's."""

    channels: Annotated[tuple[str, ...], Field(description="names of the pads")] = ("left", "right")
    contacts: Annotated[tuple[Point, ...], Field(description="digital input of each pad; 16 and 17 are the tool's")] = (
        16,
        17,
    )
    threshold_n: Annotated[float, Field(gt=0, description="contact force that closes a pad")] = 1.0

    @model_validator(mode="after")
    def _one_point_a_pad(self) -> Self:
        require_same_number("channels and contacts", self.channels, self.contacts)
        return self


class UrIo(StreamDevice[Bits]):
    """Stream of all digital bits of a controller; the subclass interprets them."""

    inputs: tuple[str, ...] = ()

    def __init__(self, context: Context, options: UrIoOptions) -> None:
        opener, name = tcp_opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=name, max_age_s=max(5.0 / options.rate_hz, 0.05))
        self._rate_hz = options.rate_hz
        self._session = RtdeSession(answer_s=self.patience * ANSWER_S)
        self._host = HostTime()

    def start(self, link: Link) -> None:
        """Set up recipes and start the stream."""
        self._session.begin(link, outputs=OUTPUTS, rate_hz=self._rate_hz, inputs=self.inputs)
        self._host.reset()

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each package that is newer than the last one."""
        for values in self._session.take(chunk):
            device_s = float(values["timestamp"])
            self.publish(
                self.meaning(values["actual_digital_input_bits"], values["actual_digital_output_bits"]),
                valid_s=self._host.host_s(device_s=device_s, arrived_s=arrived_s),
                device_time_s=device_s,
            )

    @abstractmethod
    def meaning(self, inputs: int, outputs: int) -> Bits:
        """Return the value that these bits represent."""


class UrLights(UrIo):
    """Border lights of the panel on a controller's outputs."""

    kind = DeviceKind.LIGHTS
    inputs = INPUTS

    def __init__(self, context: Context, options: UrLightsOptions) -> None:
        super().__init__(context, options)
        self._options = options
        self._wanted: Bits | None = None
        self._commanded_s = -math.inf
        self._writing = threading.Lock()
        self._ownership = Ownership(context, options.owns[0])

    def capabilities(self) -> LightsCapabilities:
        """Return the channel names given by the options."""
        return LightsCapabilities(channels=self._options.channels, settle_s=self._options.settle_s)

    def set_on(self, on: Sequence[bool], *, deadline: Deadline) -> Bits:
        """Switch all lights; `read_on` reports the result.

        Raises:
            InvalidRequest: wrong number of lights. DeviceUnavailable, DeviceTimeout: the command could not be sent.
        """
        self.require_open()
        wanted = wanted_lights(self.name, self._options.channels, on)
        link = self.port.link
        try:
            if link is None:
                raise LinkLost("the link is down")
            self._switch(link, wanted, wall_until(deadline))
        except WireError as error:
            self.errors += 1
            raise self.translate(error) from error
        self._wanted, self._commanded_s = wanted, self.context.clock.now_s()
        return wanted

    def read_on(self, *, deadline: Deadline) -> Stamped[Bits]:
        """Return the newest feedback, never from before the last command."""
        oldest_s = self.context.clock.now_s() - self.max_age_s
        return self.newest(deadline, not_before_s=max(oldest_s, self._commanded_s))

    def start(self, link: Link) -> None:
        """Take the outputs, and restore the last commanded state of the lights after a loss.

        Raises:
            DeviceUnavailable: another process of this machine has the outputs.
        """
        connection = inside(link, SocketLink)
        if connection is not None:  # else a replay
            self._ownership.take(connection)
        super().start(link)
        if self._wanted is not None:
            self._switch(link, self._wanted, now_s() + ANSWER_S)

    def meaning(self, inputs: int, outputs: int) -> Bits:
        """Return the states of the feedback inputs, or of the outputs themselves."""
        o = self._options
        if o.feedback is None:
            return tuple(bool(outputs >> point & 1) for point in o.outputs)
        return tuple(bool(inputs >> point & 1) for point in o.feedback)

    def release(self) -> None:
        """Switch the lights off, if the link still works."""
        link = self.port.link
        if link is not None:
            with suppress(WireError):
                self._switch(link, (False,) * len(self._options.outputs), now_s() + CLOSE_S)
        super().release()
        self._ownership.release()

    def _switch(self, link: Link, wanted: Bits, until_s: float) -> None:
        orders = self._session.inputs
        if orders is None:
            raise LinkLost("the RTDE session with the controller is not set up yet")
        mask = sum(1 << output for output in self._options.outputs)
        word = sum(1 << output for output, is_on in zip(self._options.outputs, wanted, strict=True) if is_on)
        with self._writing:
            link.write(orders.pack([mask, word]), until_s)


class UrTouch(UrIo):
    """Contact switches on a controller's inputs."""

    kind = DeviceKind.TOUCH

    def __init__(self, context: Context, options: UrTouchOptions) -> None:
        super().__init__(context, options)
        self._options = options

    def capabilities(self) -> TouchCapabilities:
        """Return channel names and threshold given by the options."""
        o = self._options
        return TouchCapabilities(channels=o.channels, threshold_n=o.threshold_n, rate_hz=o.rate_hz)

    def read_contacts(self, *, deadline: Deadline) -> Stamped[Bits]:
        """Return the newest state of the pads."""
        return self.newest(deadline)

    def meaning(self, inputs: int, outputs: int) -> Bits:  # noqa: ARG002  # pads are inputs
        """Return the states of the pads' inputs."""
        return tuple(bool(inputs >> point & 1) for point in self._options.contacts)


@takes(UrLightsOptions)
def connect_lights(context: Context, options: dict[str, Any]) -> UrLights:
    """Entry point `ur:lights`."""
    device = UrLights(context, read_options(context, options, UrLightsOptions))
    device.join()
    return device


@takes(UrTouchOptions)
def connect_touch(context: Context, options: dict[str, Any]) -> UrTouch:
    """Entry point `ur:touch`."""
    device = UrTouch(context, read_options(context, options, UrTouchOptions))
    device.join()
    return device
