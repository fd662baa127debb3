"""The place where a control was last seen, from which a stroke begins."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hal.errors import InvalidRequest
from manipulation.skills.outcome import ObjectState, Verify

LOOK_SHARE = 0.05  # of a period, by which an observation may lie outside of the places that are possible


class InitialState:
    """Keeps the angle or scale value of a control from the newest observation that showed it.

    Args:
        place_of: takes the angle or value from an observation; None when it shows neither.
        what: name of the quantity, for people.
        current: what the last observation showed; without it `verify` is asked.
        verify: the caller's read-back.
        period: observations show the place up to multiples of this; the one between the places that the control can be
            at is taken (see `moved_by`).

    Attributes:
        is_sure: whether every observation so far has shown one possible place, neither none nor several.
        sigma: one standard deviation of the newest observation that showed it.
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
        self._between = (0.0, 0.0)  # least and largest motion since the newest observation
        self.is_sure = True
        self.sigma = 0.0
        if current is not None:
            self._place, self.sigma = place_of(current), current.sigma
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

    def nearest(self, seen: ObjectState) -> float | None:
        """Return the place that an observation shows, with the whole periods of the known place; None if it shows none."""
        place = self._place_of(seen)
        if place is None or self._period is None:
            return place
        return place + self._period * round((self.known - place) / self._period)

    def moved_to(self, place: float) -> float:
        """Keep the place that the control was moved to, as measured by the tool, and return it."""
        self._place = place
        return place

    def moved_by(self, motion: float, *, least: float, largest: float) -> None:
        """Keep the place after a motion that was felt, and between which motions the true one must lie.

        A hand that turns round cannot have turned a control further than itself. With less than a period between the two
        limits the next observation shows the place, however wrong the felt motion was.
        """
        self._between = (self._between[0] + least - motion, self._between[1] + largest - motion)
        self._place = self.known + motion

    @property
    def verify(self) -> Verify | None:
        """The caller's read-back, which also updates the kept angle or value; None when there is no read-back."""
        return self._look if self._verify is not None else None

    def _look(self) -> ObjectState | None:
        seen = self._verify() if self._verify is not None else None
        place = self._place_of(seen) if seen is not None else None
        if place is not None and self._place is not None and self._period is not None:
            place = self._only_possible(place, self._place, self._period)
        if seen is not None and place is not None:
            self._place, self._between, self.sigma = place, (0.0, 0.0), seen.sigma
        return seen

    def _only_possible(self, seen: float, known: float, period: float) -> float:
        low, high = known + self._between[0] - LOOK_SHARE * period, known + self._between[1] + LOOK_SHARE * period
        first = int(np.ceil((low - seen) / period))
        possible = [seen + period * k for k in range(first, int(np.floor((high - seen) / period)) + 1)]
        self.is_sure = self.is_sure and len(possible) == 1
        return possible[0] if len(possible) == 1 else seen + period * round((known - seen) / period)
