"""The life cycle of one alarm, as in ISA-18.2 and IEC 62682.

```
            rises                  acknowledged                clears
  normal ─────────► unacknowledged ────────────► acknowledged ────────► normal
                      │        ▲                                          ▲
               clears ▼        │ rises                                    │ acknowledged
                    returned-unacknowledged ──────────────────────────────┘

  any of these ── shelve (until a time) ──► shelved ── unshelve, or the time has come ──► unacknowledged or normal
  any of these, or shelved ── take out of service ──► out-of-service ── put back ──► unacknowledged or normal
```

While an alarm is shelved or out of service, its condition is still followed, and decides what comes afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from service.errors import NotPossibleNow


class State(StrEnum):
    """State of an alarm."""

    NORMAL = "normal"
    UNACKNOWLEDGED = "unacknowledged"
    ACKNOWLEDGED = "acknowledged"
    RETURNED = "returned-unacknowledged"
    SHELVED = "shelved"
    OUT_OF_SERVICE = "out-of-service"


SUPPRESSED = (State.SHELVED, State.OUT_OF_SERVICE)
RISES = {State.NORMAL: State.UNACKNOWLEDGED, State.RETURNED: State.UNACKNOWLEDGED}
CLEARS = {State.UNACKNOWLEDGED: State.RETURNED, State.ACKNOWLEDGED: State.NORMAL}
ACKNOWLEDGES = {State.UNACKNOWLEDGED: State.ACKNOWLEDGED, State.RETURNED: State.NORMAL}


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """One alarm of one object.

    Attributes:
        object, kind: `kind` is `low_low`, `low`, `high`, `high_high`, `rate`, `state`, `refused` or `stale`.
        is_active: whether its condition holds, whatever its state.
        says: the condition as a sentence; empty if it never held.
        straddles: whether the interval of the value reaches over the limit, so that the condition is not certain.
        changed_s, by, reason: when, by whom and why its state changed last, or when and how somebody commented on it; `by` is
            `the cell` for a reading or a time.
        key_name: the key that authorised that change; None for the cell, and while the service has no keys.
        raised_s: when its condition began to hold last; None if it never did.
        shelved_until_s: seconds since 1970; None unless it is shelved.
    """

    object: str
    kind: str
    state: State = State.NORMAL
    is_active: bool = False
    says: str = ""
    straddles: bool = False
    changed_s: float = 0.0
    by: str = ""
    key_name: str | None = None
    reason: str = ""
    raised_s: float | None = None
    shelved_until_s: float | None = None

    @property
    def id(self) -> str:
        """Name of the alarm, such as `pressure.high`."""
        return f"{self.object}.{self.kind}"

    def rises(self) -> Alarm:
        """Return the alarm after its condition began to hold."""
        return replace(self, is_active=True, state=RISES.get(self.state, self.state))

    def clears(self) -> Alarm:
        """Return the alarm after its condition ceased to hold."""
        return replace(self, is_active=False, state=CLEARS.get(self.state, self.state))

    def acknowledged(self) -> Alarm:
        """Return the alarm after a person has seen it.

        Raises:
            NotPossibleNow: there is nothing to acknowledge.
        """
        if self.state not in ACKNOWLEDGES:
            raise self._refusal("acknowledged", "only an unacknowledged alarm can be")
        return replace(self, state=ACKNOWLEDGES[self.state])

    def shelved(self, until_s: float) -> Alarm:
        """Return the alarm shelved until a time; one that is shelved already gets the new time.

        Raises:
            NotPossibleNow: it is out of service.
        """
        if self.state is State.OUT_OF_SERVICE:
            raise self._refusal("shelved", "put it back in service first")
        return replace(self, state=State.SHELVED, shelved_until_s=until_s)

    def unshelved(self) -> Alarm:
        """Return the alarm after its shelving has ended.

        Raises:
            NotPossibleNow: it is not shelved.
        """
        if self.state is not State.SHELVED:
            raise self._refusal("unshelved", "only a shelved alarm can be")
        return self._back()

    def out_of_service(self) -> Alarm:
        """Return the alarm after it was taken out of service.

        Raises:
            NotPossibleNow: it is out of service already.
        """
        if self.state is State.OUT_OF_SERVICE:
            raise self._refusal("taken out of service", "it is already")
        return replace(self, state=State.OUT_OF_SERVICE, shelved_until_s=None)

    def in_service(self) -> Alarm:
        """Return the alarm after it was put back in service.

        Raises:
            NotPossibleNow: it is in service.
        """
        if self.state is not State.OUT_OF_SERVICE:
            raise self._refusal("put back in service", "it is in service")
        return self._back()

    def _back(self) -> Alarm:
        state = State.UNACKNOWLEDGED if self.is_active else State.NORMAL
        return replace(self, state=state, shelved_until_s=None)

    def _refusal(self, what: str, hint: str) -> NotPossibleNow:
        return NotPossibleNow(f"alarm {self.id} is {self.state} and cannot be {what}", hint=hint, state=str(self.state))
