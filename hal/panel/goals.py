"""Goals that a control can be set to: one of several states, or a number within limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hal.errors import InvalidRequest
from hal.panel.parts import Scale

GAUGE_SHARE = 0.02
"""Fraction of full scale; a reading or a control with a larger error counts as wrong."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """The reading of an object, as far as it is known: a value in the unit of its kind, a state, a text."""

    value: float | None = None
    state: str | None = None
    text: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StateGoal:
    """Goal that is one of several states.

    Attributes:
        states: none for a control that keeps no state; it can only be given its `usual` deed.
        usual: state that is meant if the request names none; None if the request must name one.
    """

    states: tuple[str, ...]
    usual: str | None = None

    key = "state"

    def checked(self, name: str, asked: str | float | None) -> str:
        """Return the requested state.

        Raises:
            InvalidRequest: no state is given, or the object called `name` has no such state.
        """
        state = self.usual if asked is None else asked
        hint = f"states: {', '.join(self.states)}"
        if state is None:
            raise InvalidRequest(f"{name} needs a state", hint=hint)
        if not self.states and state != self.usual:
            raise InvalidRequest(
                f"{name} keeps no state, so neither a look nor the fingers could confirm that it is {state!r}",
                hint=f"leave the state out: {name} is then {self.usual}, which the fingers confirm",
            )
        if self.states and state not in self.states:
            raise InvalidRequest(f"{name} has no state {state!r}", hint=hint)
        return str(state)

    def text(self, target: str | float) -> str:
        """Return the target as text for a report."""
        return str(target)

    def is_reached(self, target: str | float, truth: Shown) -> bool:
        """Return whether the object's true state is the target."""
        return truth.state == target

    def other_than(self, shown: Shown) -> str:
        """Return the first state that is not shown now."""
        return next((state for state in self.states if state != shown.state), self.usual or "")


@dataclass(frozen=True, slots=True, kw_only=True)
class NumberGoal:
    """A number from `low` to `high`, requested under `key`, that counts as reached within `tolerance`."""

    key: Literal["value", "angle_rad"]
    low: float
    high: float
    unit: str
    tolerance: float

    @classmethod
    def on(cls, scale: Scale) -> NumberGoal:
        """Return the goal of a control that may be set to any value of a scale, within 2 % of it."""
        low, high, tolerance = scale.minimum, scale.maximum, GAUGE_SHARE * scale.span
        return cls(key="value", low=low, high=high, unit=scale.unit, tolerance=tolerance)

    def checked(self, name: str, asked: str | float | None) -> float:
        """Return the requested number.

        Raises:
            InvalidRequest: no number is given, or it is not within the limits of the object called `name`.
        """
        hint = f"give {self.key} within that range"
        wanted = f"{name} needs {self.key} from {self.low:g} to {self.high:g} {self.unit}".rstrip()
        if not isinstance(asked, float | int):
            raise InvalidRequest(wanted, hint=hint)
        if not self.low <= asked <= self.high:
            end = "above" if asked > self.high else "below"
            by = f"{max(asked - self.high, self.low - asked):g} {self.unit}".rstrip()
            raise InvalidRequest(f"{wanted}: {asked:g} is {by} {end} the end of its way", hint=hint)
        return float(asked)

    def text(self, target: str | float) -> str:
        """Return the target as text for a report."""
        return f"{float(target):g}"

    def is_reached(self, target: str | float, truth: Shown) -> bool:
        """Return whether the object's true value is within the tolerance of the target."""
        return truth.value is not None and abs(truth.value - float(target)) <= self.tolerance

    def other_than(self, shown: Shown) -> float:
        """Return the value at 30 % or 70 % of the range, whichever is further from the present one."""
        span = self.high - self.low
        near, far = self.low + 0.3 * span, self.low + 0.7 * span
        value = self.low if shown.value is None else shown.value
        return far if abs(far - value) > abs(near - value) else near


Goal = StateGoal | NumberGoal
