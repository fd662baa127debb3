"""Kinds of implausible device behaviour, and their descriptions."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from hal.errors import DeviceError, DeviceFault, StaleReading
from hal.readings import Cause


class Symptom(StrEnum):
    """How the readings of a device contradict what is possible."""

    FROZEN = "frozen"  # the same reading to the last bit under new time stamps
    BIASED = "biased"  # off by the same amount again and again
    NUMB = "numb"  # shows nothing where another device feels or sees something
    PHANTOM = "phantom"  # shows something where nothing can be
    DISOBEYS = "disobeys"  # is not where it was commanded to be


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One device whose readings are not plausible.

    Attributes:
        what: a sentence with the device's name and the numbers that contradict each other.
        remedy: what a person should do about it, in the imperative; empty where the caller's error says it.
    """

    device: str
    symptom: Symptom
    what: str
    remedy: str

    @property
    def cause(self) -> str:
        """`what` and `remedy` as two sentences, for reports that have one line."""
        return f"{self.what}. {self.remedy[:1].upper()}{self.remedy[1:]}" if self.remedy else self.what

    def error(self) -> DeviceError:
        """Return the error for a caller: `StaleReading` for a frozen device, else `DeviceFault`."""
        if self.symptom is Symptom.FROZEN:
            return StaleReading(self.what, hint=self.remedy, device=self.device, cause=str(Cause.FROZEN))
        return DeviceFault(self.what, hint=self.remedy, device=self.device)
