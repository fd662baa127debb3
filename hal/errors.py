"""The tree of errors; each names the object, the cause and the remedy, and says whether to try again."""

from __future__ import annotations

from enum import StrEnum
from typing import Any, ClassVar

REINSTALL = "install panelwright anew: `make setup` in a checkout, else `pip install --force-reinstall panelwright`"
"""The remedy when a package that the product needs is missing or is of the wrong version."""


class Retry(StrEnum):
    """May the caller send the same request again?"""

    SAFE = "safe"
    AFTER_FIX = "after-fix"
    NEVER = "never"


class CellError(Exception):
    """Root of every error that reaches a caller.

    Args:
        what: the thing and the cause, one sentence without a full stop.
        hint: what to do about it.
        details: facts for programs (plain JSON values), e.g. `{"device": "wrist_ft"}`.
    """

    retry: ClassVar[Retry] = Retry.NEVER

    def __init__(self, what: str, *, hint: str, **details: Any) -> None:
        super().__init__(what)
        self.what = what
        self.hint = hint
        self.details = details

    def __reduce__(self) -> tuple[Any, ...]:
        # Errors are sent between processes; the default would lose the keyword arguments.
        return _rebuild, (type(self), self.what, self.hint, self.details)

    @property
    def type_name(self) -> str:
        """Stable name for problem documents and reports, e.g. `device-timeout`."""
        name = type(self).__name__
        return "".join("-" + c.lower() if c.isupper() else c for c in name).lstrip("-")

    def for_people(self) -> str:
        """Several lines for a terminal: what, the facts, what to try, whether to retry."""
        lines = [f"{type(self).__name__}: {self.what}"]
        return "\n".join([*lines, *detail_lines(self.details), f"  try    {self.hint}", f"  retry  {self.retry}"])


def detail_lines(details: dict[str, Any]) -> list[str]:
    """Return an error's details for a terminal, one per line, without the fault that the first line already has."""
    lines: list[str] = []
    for key, value in details.items():
        if key == "faults":
            lines += [f"  also   {fault}" for fault in value[1:]]
        else:
            lines.append(f"  {key:<6} {value}")
    return lines


def _rebuild(kind: type[CellError], what: str, hint: str, details: dict[str, Any]) -> CellError:
    error = kind.__new__(kind)
    CellError.__init__(error, what, hint=hint, **details)
    return error


class ConfigError(CellError):
    """A cell, panel or calibration file is wrong; names file and key path."""

    retry = Retry.AFTER_FIX


class InvalidRequest(CellError):
    """The caller asked for something that makes no sense; nothing moved."""

    retry = Retry.AFTER_FIX


class Unsupported(CellError):
    """This backend does not have that capability; another one, in the cell file, may."""

    retry = Retry.AFTER_FIX


class DeviceError(CellError):
    """Something about one device; `details["device"]` names it."""


class DeviceUnavailable(DeviceError):
    """The device is not connected."""

    retry = Retry.SAFE


class DeviceTimeout(DeviceError):
    """A device stayed silent for the whole deadline."""

    retry = Retry.SAFE


class DeviceFault(DeviceError):
    """The device answered, and says that it is broken."""

    retry = Retry.AFTER_FIX


class StaleReading(DeviceError):
    """The newest reading is too old, frozen or marked invalid, so it was not used."""

    retry = Retry.SAFE


class MotionError(CellError):
    """A motion did not happen or ended early."""


class MotionRefused(MotionError):
    """Nothing moved: stopped, no lease, outside limits, or not finite."""

    retry = Retry.AFTER_FIX


class Unreachable(MotionError):
    """No collision-free arm configuration or path exists."""


class Stopped(MotionError):
    """The software stop is latched; reset it and command again."""

    retry = Retry.AFTER_FIX


class Cancelled(CellError):
    """The caller cancelled the task; the arm was stopped first."""

    retry = Retry.SAFE


class LeaseError(CellError):
    """Another client holds the cell, or the lease has lapsed."""

    retry = Retry.AFTER_FIX


class PerceptionError(CellError):
    """The sensors worked, but the answer cannot be given."""

    retry = Retry.SAFE


class NotFound(PerceptionError):
    """The thing looked for is not in the data."""


class Ambiguous(PerceptionError):
    """More than one answer fits; more data would decide."""


class NotObservable(PerceptionError):
    """The data leave a direction free; the message says which."""
