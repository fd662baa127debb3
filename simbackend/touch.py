"""`sim:touch`: contact switches on the two fingers."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from hal.clock import Deadline
from hal.devices import DeviceKind, TouchCapabilities
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes
from simbackend.client import Frame
from simbackend.device import VALID, SimDevice, SimOptions, parse

Contacts = tuple[bool, ...]


class TouchOptions(SimOptions):
    """`threshold_n`: contact force that closes a switch."""

    threshold_n: Annotated[float, Field(gt=0, le=50, description="contact force that closes a switch")] = 0.5


class SimTouch(SimDevice[Contacts]):
    """Contact switches with two channels: left and right finger."""

    def __init__(self, context: Context, options: TouchOptions) -> None:
        super().__init__(context, DeviceKind.TOUCH, options)
        self._threshold_n = options.threshold_n

    def capabilities(self) -> TouchCapabilities:
        """Return channels and threshold."""
        return TouchCapabilities(channels=("left", "right"), threshold_n=self._threshold_n, rate_hz=self._world.rate_hz)

    def read_contacts(self, *, deadline: Deadline) -> Stamped[Contacts]:
        """Return the newest state of each channel."""
        return self._sample(deadline)

    def _measure(self, frame: Frame, bias: float) -> tuple[Contacts, Quality, Cause]:
        return tuple(force + bias >= self._threshold_n for force in frame.snapshot.pad_force_n.tolist()), *VALID


@takes(TouchOptions)
def connect(context: Context, options: dict[str, Any]) -> SimTouch:
    """Entry point `sim:touch`."""
    return SimTouch(context, parse(options, TouchOptions, context))
