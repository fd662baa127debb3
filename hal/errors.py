"""Tree of all errors; each names the object, the cause and the remedy, and states whether to try again."""

from __future__ import annotations

from enum import StrEnum
from typing import Any, ClassVar

REINSTALL = "reinstall panelwright: `make setup` in a checkout, else `pip install --force-reinstall panelwright`"
"""The remedy when a package that the product needs is missing or is of the wrong version."""


class Retry(StrEnum):
    """Whether the caller may send the same request again."""

    SAFE = "safe"
    AFTER_FIX = "after-fix"
    NEVER = "never"


class CellError(Exception):
    """Root of every error that reaches a caller.

    Args:
        what: the object and the cause, one sentence without a full stop.
        hint: the remedy.
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
        """Return the stable name for problem documents and reports, e.g. `device-timeout`."""
        name = type(self).__name__
        return "".join("-" + c.lower() if c.isupper() else c for c in name).lstrip("-")

    def for_people(self) -> str:
        """Return lines for a terminal: the error, its details, the remedy, and whether to retry."""
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
    """A cell, panel or calibration file is wrong; the error names the file and the key path."""

    retry = Retry.AFTER_FIX


class InvalidRequest(CellError):
    """The request makes no sense; nothing moved."""

    retry = Retry.AFTER_FIX


class NoRoom(InvalidRequest):
    """The hand does not fit at a control; names what is in the way and by how many millimetres; nothing moved."""


class OutOfReach(InvalidRequest):
    """A control is beyond the arm wherever the panel may stand; says by how many millimetres; nothing moved."""


class Unprovable(InvalidRequest):
    """No look and no touch could confirm the goal, so it is not begun; nothing moved."""


class Unsupported(CellError):
    """This backend lacks the capability; another one, chosen in the cell file, may have it."""

    retry = Retry.AFTER_FIX


class DeviceError(CellError):
    """Error of one device; `details["device"]` names it."""


class DeviceUnavailable(DeviceError):
    """The device is not connected."""

    retry = Retry.SAFE


class DeviceTimeout(DeviceError):
    """A device stayed silent for the whole deadline."""

    retry = Retry.SAFE


class DeviceFault(DeviceError):
    """The device answered and reports that it is broken."""

    retry = Retry.AFTER_FIX


class StaleReading(DeviceError):
    """The newest reading is too old, frozen or marked invalid, so it was not used."""

    retry = Retry.SAFE


class MotionError(CellError):
    """A motion did not happen or ended early."""


class MotionRefused(MotionError):
    """Nothing moved: the cell is stopped, the lease is missing, or a value is outside its limits or not finite."""

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
    """Another client holds the lease of the cell, or the lease has expired."""

    retry = Retry.AFTER_FIX


class PerceptionError(CellError):
    """The sensors worked, but their data do not give an answer."""

    retry = Retry.SAFE


class NotFound(PerceptionError):
    """The object looked for is not in the data."""


class Ambiguous(PerceptionError):
    """More than one answer fits the data; more data would decide."""


class NotObservable(PerceptionError):
    """The data do not determine one direction; the message states which."""
