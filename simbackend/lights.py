"""`sim:lights`: the switched border lights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hal.clock import Deadline
from hal.devices import DeviceKind, LightsCapabilities
from hal.errors import InvalidRequest
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes
from simbackend.client import Frame
from simbackend.device import VALID, SimDevice, SimOptions, parse

SETTLE_S = 0.02


class SimLights(SimDevice[tuple[bool, ...]]):
    """Four border lights of the panel file, in its order."""

    def __init__(self, context: Context, options: SimOptions) -> None:
        super().__init__(context, DeviceKind.LIGHTS, options)
        self._channels = tuple(light.name for light in self._world.cell.panel.lights)

    def capabilities(self) -> LightsCapabilities:
        """Return the channels and the settling time of a lamp."""
        return LightsCapabilities(channels=self._channels, settle_s=SETTLE_S)

    def set_on(self, on: Sequence[bool], *, deadline: Deadline) -> tuple[bool, ...]:
        """Switch all channels with the next step.

        Raises:
            InvalidRequest: the number of values differs from the number of channels.
        """
        self._check(deadline)
        if len(on) != len(self._channels):
            raise InvalidRequest(
                f"{self._name} has {len(self._channels)} channels, not {len(on)}",
                hint="give one value per channel",
                device=self._name,
            )
        wanted = tuple(bool(x) for x in on)
        self._world.switch_lights(wanted)
        return wanted

    def read_on(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Return the newest feedback of each channel."""
        return self._sample(deadline)

    def _measure(self, frame: Frame, bias: float) -> tuple[tuple[bool, ...], Quality, Cause]:
        # A biased feedback input reports the opposite of the truth.
        return tuple(bool(x) != bool(bias) for x in frame.snapshot.lights_on[: len(self._channels)]), *VALID


@takes(SimOptions)
def connect(context: Context, options: dict[str, Any]) -> SimLights:
    """Entry point `sim:lights`."""
    return SimLights(context, parse(options, SimOptions, context))
