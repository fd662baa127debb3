"""Tests of the life cycle of an alarm against a model that keeps the facts apart, and against planted defects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.alarms import lifecycle
from service.alarms.lifecycle import Alarm, State
from service.errors import NotPossibleNow

EVENTS = ("rises", "clears", "acknowledged", "shelved", "unshelved", "out_of_service", "in_service")


@dataclass
class Facts:
    """What an operator knows about an alarm, as separate facts; the state is derived from them."""

    holds: bool = False
    seen: bool = True  # nothing waits for an acknowledgement
    shelved: bool = False
    out: bool = False

    @property
    def state(self) -> State:
        if self.out:
            return State.OUT_OF_SERVICE
        if self.shelved:
            return State.SHELVED
        if self.holds:
            return State.ACKNOWLEDGED if self.seen else State.UNACKNOWLEDGED
        return State.NORMAL if self.seen else State.RETURNED

    def happens(self, event: str) -> bool:
        """Apply an event; returns False if it is not possible, and then nothing has changed."""
        hidden = self.shelved or self.out
        if event == "rises":
            self.seen = self.seen and (self.holds or hidden)
            self.holds = True
        elif event == "clears":
            self.holds = False
        elif event == "acknowledged":
            if hidden or self.seen:
                return False
            self.seen = True
        elif event == "shelved":
            if self.out:
                return False
            self.shelved = self.seen = True
        elif event == "unshelved":
            if not self.shelved or self.out:
                return False
            self.shelved, self.seen = False, not self.holds
        elif event == "out_of_service":
            if self.out:
                return False
            self.out, self.shelved, self.seen = True, False, True
        else:
            if not self.out:
                return False
            self.out, self.seen = False, not self.holds
        return True


def after(alarm: Alarm, event: str) -> Alarm:
    """Return the alarm after an event."""
    return alarm.shelved(99.0) if event == "shelved" else getattr(alarm, event)()


def follow(events: list[str]) -> None:
    """Check that alarm and model agree after every event."""
    alarm, facts = Alarm(object="pressure", kind="high"), Facts()
    for event in events:
        before = alarm
        try:
            alarm = after(alarm, event)
            was_possible = True
        except NotPossibleNow as error:
            was_possible = False
            assert error.what.startswith("alarm pressure.high is ") and error.hint
        assert facts.happens(event) == was_possible, event
        assert (alarm.state, alarm.is_active) == (facts.state, facts.holds), event
        assert (alarm.shelved_until_s is not None) == (alarm.state is State.SHELVED)
        assert was_possible or alarm == before


@given(st.lists(st.sampled_from(EVENTS), max_size=30))
def test_the_life_cycle_agrees_with_the_facts(events: list[str]) -> None:
    follow(events)


DEFECTS: dict[str, tuple[str, Callable[[Alarm], Alarm]]] = {
    "a return is acknowledged by itself": ("clears", lambda a: replace(a, is_active=False, state=State.NORMAL)),
    "an acknowledged return stays": ("acknowledged", lambda a: replace(a, state=State.ACKNOWLEDGED)),
    "a shelved alarm rings": ("rises", lambda a: replace(a, is_active=True, state=State.UNACKNOWLEDGED)),
    "a shelved condition is forgotten": ("unshelved", lambda a: replace(a, state=State.NORMAL, shelved_until_s=None)),
    "back in service it is silent": ("in_service", lambda a: replace(a, state=State.NORMAL)),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_the_model_finds_planted_defects(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    method, wrong = DEFECTS[name]
    monkeypatch.setattr(lifecycle.Alarm, method, wrong)

    @given(st.lists(st.sampled_from(EVENTS), max_size=8))
    def run(events: list[str]) -> None:
        follow(events)

    with pytest.raises(AssertionError):
        run()
