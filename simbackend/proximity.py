"""`sim:proximity`: an optical distance sensor beside a finger."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import Field

from hal.clock import Deadline
from hal.devices import DeviceKind, ProximityCapabilities
from hal.errors import ConfigError
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes
from simbackend.client import PROXIMITY_RANGE_M, Frame
from simbackend.device import VALID, SimDevice, SimOptions, parse
from simbackend.wire import PROXIMITY_TICKS, Snapshot

MIN_RANGE_M = 0.02


class ProximityOptions(SimOptions):
    """`sigma_m`: noise of one reading; `resolution_m`: its last digit."""

    sigma_m: Annotated[float, Field(ge=0, le=0.05, description="noise of one reading, one sigma")] = 0.0008
    resolution_m: Annotated[float, Field(gt=0, le=0.05, description="last digit of a reading")] = 0.0001


class SimProximity(SimDevice[float]):
    """Distance along the sensor's z axis, measured with a narrow cone of rays."""

    def __init__(self, context: Context, options: ProximityOptions) -> None:
        super().__init__(context, DeviceKind.PROXIMITY, options)
        self._options = options
        self._noise = self._world.draws.noise(context.name, 1)
        if context.name not in self._world.proximity:
            raise ConfigError(
                f"{context.name} is not in the cell file", hint="add it under [devices]", device=context.name
            )
        self._index = self._world.proximity.index(context.name)

    def capabilities(self) -> ProximityCapabilities:
        """Return range, noise and rate."""
        return ProximityCapabilities(
            min_range_m=MIN_RANGE_M,
            max_range_m=PROXIMITY_RANGE_M,
            sigma_m=self._options.sigma_m,
            rate_hz=self._world.rate_hz / PROXIMITY_TICKS,
        )

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Return the newest distance."""
        return self._sample(deadline)

    def _tick_of(self, snapshot: Snapshot) -> int:
        return snapshot.distance_tick

    def _measure(self, frame: Frame, bias: float) -> tuple[float, Quality, Cause]:
        true_m = float(frame.snapshot.distance_m[self._index])
        noise_m = self._options.sigma_m * float(self._noise.at(frame.snapshot.distance_tick)[0])
        distance_m = true_m + noise_m + bias
        if not MIN_RANGE_M <= distance_m <= PROXIMITY_RANGE_M:  # also true for NaN
            return math.nan, Quality.INVALID, Cause.OUT_OF_RANGE
        step_m = self._options.resolution_m
        return round(distance_m / step_m) * step_m, *VALID


@takes(ProximityOptions)
def connect(context: Context, options: dict[str, Any]) -> SimProximity:
    """Entry point `sim:proximity`."""
    return SimProximity(context, parse(options, ProximityOptions, context))
