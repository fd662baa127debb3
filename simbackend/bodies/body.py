"""What a kind of object needs to be simulated: how it is drawn from the seed, built, moved, printed and judged."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from hal.kinds import BODIES, part_of
from hal.panel import PanelObject
from hal.simulated import ObjectTruth
from simbackend.bodies.parts import ObjectModel
from simbackend.canvas import Canvas
from simbackend.mechanisms import Friction, Mechanism

K = TypeVar("K", bound=PanelObject)


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """What an object shows when the world begins.

    Attributes:
        place: joint position (rad clockwise, m along the track), needle angle of an instrument.
        is_on: lamp lit, button latched.
        text: what a display shows.
        value: the value behind `place` or `text`.
    """

    place: float = 0.0
    is_on: bool = False
    text: str | None = None
    value: float | None = None


class Body(ABC, Generic[K]):
    """The simulated body of one kind. It has no state: one instance serves every object of the kind."""

    @abstractmethod
    def start(self, panel_object: K, u: float) -> Start:
        """What the object shows at first; `u`, drawn evenly from 0 to 1, says which of all its states that is."""

    @abstractmethod
    def model(self, panel_object: K, start: Start) -> ObjectModel:
        """Its links and pictures."""

    @abstractmethod
    def print_on(self, canvas: Canvas, panel_object: K) -> None:
        """Print what stands about it on the plate: label, marks, names of places."""

    @abstractmethod
    def truth(self, panel_object: K, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """What it really shows now, for the judge of a finished mission; `is_lit` where it has a `shine`."""

    def mechanism(self, engine: Any, body: int, panel_object: K, start: Start, effort_ratio: float) -> Mechanism:
        """What holds its joint; a needle's movement unless the kind says otherwise.

        Args:
            engine: a connected PyBullet client.
            effort_ratio: friction, spring or detent of the built object over the panel file's.
        """
        return Friction(engine=engine, body=body, effort=1.0)


def body_of(kind: str) -> Body[Any]:
    """The body of a kind.

    Raises:
        Unsupported: the kind is not simulated.
    """
    body: Body[Any] = part_of(BODIES, kind)
    return body


def place_of(mechanism: Mechanism | None) -> float:
    """Joint position; 0 for what has no joint."""
    return 0.0 if mechanism is None else mechanism.place()


def picked(items: Sequence[Any], u: float) -> Any:
    """The item at the share `u` of a sequence."""
    return items[int(u * len(items))]
