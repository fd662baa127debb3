"""Base class of simulated object kinds: initial state, model, mechanism, printing on the plate, and true state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from hal.panel import PanelObject
from hal.panel.kinds import BODIES, part_of
from hal.simulated import ObjectTruth
from simbackend.bodies.parts import ObjectModel
from simbackend.canvas import Canvas
from simbackend.mechanisms import Friction, Mechanism

K = TypeVar("K", bound=PanelObject)


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Initial state of an object.

    Attributes:
        place: joint position (rad clockwise, or m along the track), or needle angle of an instrument.
        is_on: whether the lamp is lit or the button latched.
        text: the text on a display.
        value: the quantity that `place` or `text` represents.
    """

    place: float = 0.0
    is_on: bool = False
    text: str | None = None
    value: float | None = None


class Body(ABC, Generic[K]):
    """Simulated body of one kind. It holds no state: one instance serves all objects of the kind."""

    @abstractmethod
    def start(self, panel_object: K, u: float) -> Start:
        """Return the initial state; `u`, uniform from 0 to 1, selects one of all possible states."""

    @abstractmethod
    def model(self, panel_object: K, start: Start) -> ObjectModel:
        """Return the links and pictures of the object."""

    @abstractmethod
    def print_on(self, canvas: Canvas, panel_object: K) -> None:
        """Print the object's surroundings on the plate: label, marks, state names."""

    @abstractmethod
    def truth(self, panel_object: K, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return the true state for the judge of a finished mission; `is_lit` applies to objects with a `shine`."""

    def showing(self, panel_object: K, value: float) -> Start | None:
        """Return the state in which it shows a value of the process behind the panel; None for what shows none."""
        return None

    def mechanism(self, engine: Any, body: int, panel_object: K, start: Start, effort_ratio: float) -> Mechanism:
        """Return the mechanism of its joint; by default that of an instrument's needle.

        Args:
            engine: a connected PyBullet client.
            effort_ratio: friction, spring or detent force of the built object relative to the panel file.
        """
        return Friction(engine=engine, body=body, effort=1.0)


def body_of(kind: str) -> Body[Any]:
    """Return the body of a kind.

    Raises:
        Unsupported: the kind is not simulated.
    """
    body: Body[Any] = part_of(BODIES, kind)
    return body


def is_shown(panel_object: PanelObject) -> bool:
    """Return whether the simulated object can be made to show a value."""
    return body_of(panel_object.kind).showing(panel_object, 0.0) is not None


def place_of(mechanism: Mechanism | None) -> float:
    """Return the joint position, or 0 for an object without a joint."""
    return 0.0 if mechanism is None else mechanism.place()


def picked(items: Sequence[Any], u: float) -> Any:
    """Return the item of a sequence at the fraction `u` of its length."""
    return items[int(u * len(items))]
