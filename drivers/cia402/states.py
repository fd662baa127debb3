"""States of a CiA-402 drive: decoding of the status word, and the next control word (CiA 402-2, 6.3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from drivers.cia402.sync import SyncCount


class DriveState(StrEnum):
    """The eight states of a CiA-402 drive."""

    NOT_READY = "not_ready"
    SWITCH_ON_DISABLED = "switch_on_disabled"
    READY = "ready"
    SWITCHED_ON = "switched_on"
    OPERATION_ENABLED = "operation_enabled"
    QUICK_STOP = "quick_stop"
    FAULT_REACTION = "fault_reaction"
    FAULT = "fault"


_PATTERNS = (
    (DriveState.NOT_READY, 0x4F, 0x00),
    (DriveState.SWITCH_ON_DISABLED, 0x4F, 0x40),
    (DriveState.READY, 0x6F, 0x21),
    (DriveState.SWITCHED_ON, 0x6F, 0x23),
    (DriveState.OPERATION_ENABLED, 0x6F, 0x27),
    (DriveState.QUICK_STOP, 0x6F, 0x07),
    (DriveState.FAULT_REACTION, 0x4F, 0x0F),
    (DriveState.FAULT, 0x4F, 0x08),
)
SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, DISABLE, FAULT_RESET = 0x06, 0x07, 0x0F, 0x02, 0x00, 0x80
_TOWARDS_ENABLED = {
    DriveState.SWITCH_ON_DISABLED: SHUTDOWN,
    DriveState.READY: SWITCH_ON,
    DriveState.SWITCHED_ON: ENABLE,
    DriveState.OPERATION_ENABLED: ENABLE,
    DriveState.QUICK_STOP: DISABLE,
}


def state_of(status_word: int) -> DriveState:
    """Return the state encoded in object 6041h; bits outside the masks are ignored."""
    return next((state for state, mask, value in _PATTERNS if status_word & mask == value), DriveState.NOT_READY)


def control_word(state: DriveState, is_wanted: bool, is_reset: bool) -> int:
    """Return the control word to send to a drive in this state.

    Args:
        is_wanted: whether the drive should be in `operation_enabled`; otherwise it is stopped quickly.
        is_reset: whether a fault may be reset.
    """
    if not is_wanted:
        return QUICK_STOP
    if state is DriveState.FAULT:
        return FAULT_RESET if is_reset else DISABLE
    return _TOWARDS_ENABLED.get(state, DISABLE)


@dataclass(slots=True)
class Axis:
    """Known state of one drive; only the owner thread writes it."""

    status: int | None = None
    increments: int = 0
    velocity: int = 0
    emergency: int = 0
    count: SyncCount = field(default_factory=SyncCount)

    @property
    def state(self) -> DriveState:
        """Return the state that the status word encodes."""
        return DriveState.NOT_READY if self.status is None else state_of(self.status)

    def __str__(self) -> str:
        return f"{self.state}" + (f", emergency {self.emergency:04X}h" if self.emergency else "")
