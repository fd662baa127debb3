"""What a skill works on: an object of the panel file, and where it stood when it was last seen."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from hal.errors import InvalidRequest
from hal.panel import PanelObject
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import ObjectState, Verify

Subject = TypeVar("Subject", bound=PanelObject)


def object_of_kind(context: SkillContext, name: str, kind: type[Subject], called: str) -> Subject:
    """The object `name` of the panel file.

    Raises:
        InvalidRequest: there is none, or it is not of the kind, whose name for people is `called`.
    """
    panel_object = context.panel.object(name)
    if not isinstance(panel_object, kind):
        raise InvalidRequest(f"{name} is a {panel_object.kind}, not a {called}", hint="see the panel file")
    return panel_object


class InitialState:
    """An angle, or a value of the scale, by the newest look that told it; every stroke begins there."""

    def __init__(
        self,
        place_of: Callable[[ObjectState], float | None],
        *,
        what: str,
        current: ObjectState | None,
        verify: Verify | None,
    ) -> None:
        """`current` is what the last look said; without it `verify` is asked. `what` names the place to people."""
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
        """The place.

        Raises:
            InvalidRequest: no look has told it.
        """
        if self._place is None:
            raise InvalidRequest(f"{self._what} is not known", hint="read it first, or give `current`")
        return self._place

    def moved_to(self, place: float) -> float:
        """Keep where the object was moved to, by the tool's own measure; returns it."""
        self._place = place
        return place

    @property
    def verify(self) -> Verify | None:
        """The caller's second look; what it tells of the place is kept. None when nobody looks."""
        return self._look if self._verify is not None else None

    def _look(self) -> ObjectState | None:
        seen = self._verify() if self._verify is not None else None
        place = self._place_of(seen) if seen is not None else None
        if place is not None:
            self._place = place
        return seen
