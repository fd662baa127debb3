"""The place where a control was last seen, from which a stroke begins."""

from __future__ import annotations

from collections.abc import Callable

from hal.errors import InvalidRequest
from manipulation.skills.outcome import ObjectState, Verify


class InitialState:
    """Keeps the angle or scale value of a control from the newest observation that showed it.

    Args:
        place_of: takes the angle or value from an observation; None when it shows neither.
        what: name of the quantity, for people.
        current: what the last observation showed; without it `verify` is asked.
        verify: the caller's read-back.
        period: observations show the place up to multiples of this; the one nearest to what is known is taken.
    """

    def __init__(
        self,
        place_of: Callable[[ObjectState], float | None],
        *,
        what: str,
        current: ObjectState | None,
        verify: Verify | None,
        period: float | None = None,
    ) -> None:
        self._place_of = place_of
        self._what = what
        self._verify = verify
        self._period = period
        self._place: float | None = None
        if current is not None:
            self._place = place_of(current)
        elif verify is not None:
            self._look()

    @property
    def known(self) -> float:
        """Angle or value of the control.

        Raises:
            InvalidRequest: no observation has shown it.
        """
        if self._place is None:
            raise InvalidRequest(f"{self._what} is not known", hint="read it first, or give `current`")
        return self._place

    def moved_to(self, place: float) -> float:
        """Keep the place that the control was moved to, as measured by the tool, and return it."""
        self._place = place
        return place

    @property
    def verify(self) -> Verify | None:
        """The caller's read-back, which also updates the kept angle or value; None when there is no read-back."""
        return self._look if self._verify is not None else None

    def _look(self) -> ObjectState | None:
        seen = self._verify() if self._verify is not None else None
        place = self._place_of(seen) if seen is not None else None
        if place is not None and self._place is not None and self._period is not None:
            place += self._period * round((self._place - place) / self._period)
        if place is not None:
            self._place = place
        return seen
