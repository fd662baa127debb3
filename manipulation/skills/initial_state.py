"""Where a control stood when it was last seen; a stroke begins there."""

from __future__ import annotations

from collections.abc import Callable

from hal.errors import InvalidRequest
from manipulation.skills.outcome import ObjectState, Verify


class InitialState:
    """Keeps an angle, or a value of a scale, by the newest look that showed it.

    Args:
        place_of: takes angle or value from a look; None when it shows neither.
        what: names the place to people.
        current: what the last look showed; without it `verify` is asked.
        verify: the caller's second look.
    """

    def __init__(
        self,
        place_of: Callable[[ObjectState], float | None],
        *,
        what: str,
        current: ObjectState | None,
        verify: Verify | None,
    ) -> None:
        self._place_of = place_of
        self._what = what
        self._verify = verify
        self._place: float | None = None
        if current is not None:
            self._place = place_of(current)
        elif verify is not None:
            self._look()

    @property
    def known(self) -> float:
        """Angle or value where the control stands.

        Raises:
            InvalidRequest: no look has shown it.
        """
        if self._place is None:
            raise InvalidRequest(f"{self._what} is not known", hint="read it first, or give `current`")
        return self._place

    def moved_to(self, place: float) -> float:
        """Keep where the control was moved to as the tool measured it; returns that."""
        self._place = place
        return place

    @property
    def verify(self) -> Verify | None:
        """The caller's second look, whose angle or value is kept; None when nobody looks."""
        return self._look if self._verify is not None else None

    def _look(self) -> ObjectState | None:
        seen = self._verify() if self._verify is not None else None
        place = self._place_of(seen) if seen is not None else None
        if place is not None:
            self._place = place
        return seen
