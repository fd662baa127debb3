"""Code shared by all simulated devices: stamps, health, and the five faults that can be injected."""

from __future__ import annotations

from typing import Annotated, Any, Generic, TypeVar

from pydantic import Field

from hal.clock import Deadline
from hal.devices import DeviceKind, Health
from hal.errors import DeviceTimeout, DeviceUnavailable
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context
from hal.simulated import Fault
from hal.simulated_events import When
from hal.strict import Strict, validate
from simbackend.client import Frame, WorldClient
from simbackend.events import begin_when
from simbackend.wire import Snapshot

T = TypeVar("T")
Options = TypeVar("Options", bound="SimOptions")


class FaultOption(When):
    """`fault = { kind = "stale", at_s = 3.0 }`: begins at a simulated time, or with `near` when the tips are there."""

    kind: Annotated[Fault, Field(description="fault that begins")]
    magnitude: Annotated[float, Field(description="size of a bias, in the unit of the reading")] = 0.0


class SimOptions(Strict):
    """Options of every simulated device."""

    fault: Annotated[FaultOption | None, Field(description="fault that begins at a simulated time")] = None


def parse(options: dict[str, Any], model: type[Options], context: Context) -> Options:
    """Return the options as their strict model.

    Raises:
        ConfigError: the message names the key.
    """
    return validate(options, model, source=f"devices.{context.name}.options")


class SimDevice(Generic[T]):
    """Device in the simulated world; a subclass defines what it `_measure`s and how a bias changes it.

    Noise depends on (seed, device, tick) only, so a second read, or a read from another thread, changes nothing.
    """

    def __init__(self, context: Context, kind: DeviceKind, options: SimOptions) -> None:
        self._name, self._kind = context.name, kind
        self._world = WorldClient.shared(context)
        self._fault: Fault | None = None
        self._magnitude = 0.0
        self._kept: Stamped[T] | None = None
        self._is_closed = False
        self._samples = self._errors = 0
        self._last_s: float | None = None
        if options.fault is not None:
            fault = options.fault
            begin_when(self._world, fault, lambda: self.inject_fault(fault.kind, magnitude=fault.magnitude))

    @property
    def name(self) -> str:
        """Return the device's name in the cell file."""
        return self._name

    @property
    def kind(self) -> DeviceKind:
        """Return the kind of device."""
        return self._kind

    def health(self) -> Health:
        """Return the state of the link and of the newest sample."""
        cause = {Fault.SILENT: Cause.TIMEOUT, Fault.DISCONNECTED: Cause.COMM}.get(
            self._fault or Fault.BIASED, Cause.NONE
        )
        connected = not self._is_closed and self._fault is not Fault.DISCONNECTED
        is_good = connected and cause is Cause.NONE
        return Health(
            connected=connected,
            quality=Quality.VALID if is_good else Quality.INVALID,
            cause=cause if connected or self._fault else Cause.COMM,
            samples=self._samples,
            errors=self._errors,
            last_sample_s=self._last_s,
        )

    def close(self) -> None:
        """Close the device, so that later calls raise `DeviceUnavailable`; the world itself belongs to the cell."""
        self._is_closed = True

    def inject_fault(self, fault: Fault | None, *, magnitude: float = 0.0) -> None:
        """Begin a fault, or end it with None. Stale and frozen devices keep their present sample."""
        self._kept = self._fresh(0.0) if fault in (Fault.STALE, Fault.FROZEN) else None
        self._fault, self._magnitude = fault, magnitude

    def _sample(self, deadline: Deadline) -> Stamped[T]:
        """Return the newest sample, as modified by the fault.

        Raises:
            DeviceTimeout: silent; raised at once, because waiting would not help and would advance the world.
            DeviceUnavailable: closed or disconnected.
        """
        self._check(deadline)
        kept = self._kept
        if kept is not None and self._fault is Fault.STALE:
            return kept
        if kept is not None and self._fault is Fault.FROZEN:
            return self._stamp(self._world.frame, kept.value, kept.quality, kept.cause)
        sample = self._fresh(self._magnitude if self._fault is Fault.BIASED else 0.0)
        self._samples += 1
        self._last_s = sample.host_time_s
        return sample

    def _check(self, deadline: Deadline) -> None:
        """Raise an error if the device is closed, disconnected or silent."""
        if self._is_closed or self._fault is Fault.DISCONNECTED:
            self._errors += 1
            what = "is closed" if self._is_closed else "is not connected"
            raise DeviceUnavailable(
                f"{self._name} {what}", hint="check the cable, or end the injected fault", device=self._name
            )
        if self._fault is Fault.SILENT:
            self._errors += 1
            waited_s = deadline.remaining_s()
            raise DeviceTimeout(
                f"{self._name} silent for {waited_s:.3f} s",
                hint="check power and cable, or end the injected fault",
                device=self._name,
                waited_s=waited_s,
            )

    def _fresh(self, bias: float) -> Stamped[T]:
        frame = self._world.frame
        value, quality, cause = self._measure(frame, bias)
        return self._stamp(frame, value, quality, cause)

    def _stamp(self, frame: Frame, value: T, quality: Quality, cause: Cause) -> Stamped[T]:
        tick = self._tick_of(frame.snapshot)
        lag_s = (frame.snapshot.tick - tick) / self._world.rate_hz
        return Stamped(
            value=value,
            host_time_s=frame.host_time_s - lag_s,
            device_time_s=frame.snapshot.stamp_s - lag_s,
            sequence=tick,
            quality=quality,
            cause=cause,
        )

    def _tick_of(self, snapshot: Snapshot) -> int:
        """Return the tick at which this device took the sample in a snapshot."""
        return snapshot.tick

    def _measure(self, frame: Frame, bias: float) -> tuple[T, Quality, Cause]:
        """Return the value at a frame, with the bias of an injected fault in the device's own unit."""
        raise NotImplementedError


VALID = (Quality.VALID, Cause.NONE)
