"""Readings: values with stamps, quality and cause; the age decides whether a value may be used."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, TypeVar

from hal.errors import StaleReading

T = TypeVar("T")


class Quality(StrEnum):
    """Whether the value may be used."""

    VALID = "valid"
    DEGRADED = "degraded"
    INVALID = "invalid"


class Cause(StrEnum):
    """The reason why the quality is not `valid`."""

    NONE = "none"
    TIMEOUT = "timeout"
    COMM = "comm"
    STALE = "stale"
    FROZEN = "frozen"
    OUT_OF_RANGE = "out-of-range"
    SATURATED = "saturated"
    DEVICE = "device"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stamped(Generic[T]):
    """A value as a device gave it.

    Attributes:
        value: in SI units.
        host_time_s: when the value was valid, on the cell's clock (monotonic or simulated).
        device_time_s: the device's own stamp, or None when it has no clock.
        sequence: rises by one per sample; a gap means a lost sample.
        detail: what the quality and the cause leave open, as a sentence for people, for example what is missing.
    """

    value: T
    host_time_s: float
    sequence: int
    device_time_s: float | None = None
    quality: Quality = Quality.VALID
    cause: Cause = Cause.NONE
    detail: str = ""

    def age_s(self, now_s: float) -> float:
        """Return the seconds since the value was valid."""
        return now_s - self.host_time_s

    def usable(self, *, now_s: float, max_age_s: float, device: str) -> T:
        """Return the value if it may be used for motion or fusion.

        Raises:
            StaleReading: the value is invalid or older than `max_age_s`.
        """
        if self.quality is Quality.INVALID:
            raise StaleReading(
                f"{device} reading is invalid ({self.cause})",
                hint=f"run `panelwright devices` and look at {device}",
                device=device,
                cause=str(self.cause),
            )
        if self.age_s(now_s) > max_age_s:
            raise StaleReading(
                f"{device} reading is {self.age_s(now_s):.3f} s old; at most {max_age_s:.3f} s is allowed",
                hint="check the device's rate and cable; a frozen device keeps its last stamp",
                device=device,
                cause=str(Cause.STALE),
            )
        return self.value
