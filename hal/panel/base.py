"""What every object on a panel is, and what its kind must say of it.

A kind is a subclass of `PanelObject` with a `kind: Literal[...]` field, registered under that name in the entry-point
group `panelwright.kinds`. What is said here holds in any state of the object, in the frame of the panel.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from hal.panel.form import Envelope, Face, Relief, Rim
from hal.panel.goals import GAUGE_SHARE, Goal, Shown
from hal.panel.parts import Name, Vector2, Vector3
from hal.panel.questions import Question, Taught
from hal.strict import Strict


class PanelObject(Strict, ABC):
    """An object on the panel. `position_m` is its middle on the plate (x, y)."""

    kind: str
    name: Name
    label: str = ""
    position_m: Vector2

    value_is_angle: ClassVar[bool] = False
    """Whether a value of the object is an angle in radians rather than a value of a scale."""
    is_round: ClassVar[bool] = False
    """Whether its outline is drawn as a circle where it has no `rim`."""
    asked: ClassVar[tuple[Question, ...]] = ()
    """What must be asked, beside the name, when a panel with such an object is taught."""
    places_are_lengths: ClassVar[bool] = False
    """Whether the places of its scale are metres rather than angles."""
    turns_about_click: ClassVar[bool] = False
    """Whether teaching takes the place that was clicked for its middle, rather than the middle of its outline."""

    @property
    def point_m(self) -> Vector3:
        """The middle of the object on the plate, in the panel frame."""
        return (self.position_m[0], self.position_m[1], 0.0)

    @property
    @abstractmethod
    def face(self) -> Face:
        """What a picture of it must hold, and the height of the plane that its reader looks at."""

    @property
    @abstractmethod
    def half_footprint_m(self) -> Vector2:
        """Half width and half height of the upright rectangle on the plate that holds it in any state."""

    @property
    def half_foot_m(self) -> Vector2:
        """Half the sides of what stands on the plate itself, turned as its envelope is; nothing else may stand there."""
        return self.half_footprint_m

    @abstractmethod
    def envelope(self, angle_rad: float | None = None) -> Envelope:
        """The box that holds it in any state, or, if that is smaller, where it stands at `angle_rad`."""

    @property
    def rim(self) -> Rim | None:
        """The edge that every state shows; None where the panel file leaves the fixed parts open."""
        return None

    @property
    def relief(self) -> Relief | None:
        """How a range image shows it; None where it is not looked for in one."""
        return None

    @property
    def goal(self) -> Goal | None:
        """What may be asked of it; None for an object that is only read."""
        return None

    @property
    def shown_by(self) -> str:
        """The name of the object that shows whether this one was worked."""
        return self.name

    @property
    def mission_rank(self) -> float | None:
        """Place among what a mission without orders works: one object of each kind, lowest first; None: left alone."""
        return None

    @property
    def full_scale(self) -> float | None:
        """The greatest less the least value; None where values have no such range."""
        return None

    @property
    def resting_angles(self) -> Mapping[str, float]:
        """Angle of each state, rad clockwise from up; empty where states are no angles."""
        return {}

    def is_right(self, said: Shown, truth: Shown) -> bool:
        """Whether what was said of it is true: states and texts exactly, values within 2 % of full scale."""
        if truth.state is not None:
            return said.state == truth.state
        if truth.text is not None:
            return said.text is not None and said.text.strip() == truth.text.strip()
        if said.value is None or truth.value is None:
            return False
        return bool(abs(said.value - truth.value) <= GAUGE_SHARE * (self.full_scale or 1.0))

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """The keys of its table in a panel file, beside kind, name and position, from what was clicked and answered."""
        raise NotImplementedError(f"nothing is known of how to teach a {cls.__name__}")
