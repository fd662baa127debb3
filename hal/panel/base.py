"""Base class of all objects on a panel, with what each kind must define.

A kind is a subclass of `PanelObject` with a `kind: Literal[...]` field, registered under that name in the entry-point
group `panelwright.kinds`. Unless stated otherwise, the geometry holds in any state of the object, in the panel frame.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import Field, ValidationError, model_validator

from hal.fault_words import ONE_LINE
from hal.panel.angles import fault
from hal.panel.form import Cap, Envelope, Face, Relief, Rim
from hal.panel.goals import GAUGE_SHARE, Goal, Shown
from hal.panel.limits import Limits, Priority, beyond_range
from hal.panel.parts import Name, Positive, Vector2, Vector3
from hal.panel.questions import Question, Taught
from hal.strict import Strict


class PanelObject(Strict, ABC):
    """Object on the panel; `position_m` is its centre on the plate (x, y)."""

    kind: str
    name: Name
    label: str = ""
    position_m: Vector2
    limits: Annotated[Limits | None, Field(description="of its value; beyond them an alarm is raised")] = None
    normal: Annotated[
        tuple[str, ...] | None, Field(min_length=1, description="its normal states; any other raises an alarm")
    ] = None
    stale_after_s: Annotated[
        Positive | None, Field(description="age of its newest valid reading from which an alarm is raised")
    ] = None
    priority: Annotated[Priority, Field(description="of its alarms")] = "medium"
    what_to_do: Annotated[str, Field(max_length=500, pattern=ONE_LINE, description="shown with its alarms")] = ""
    forbidden: Annotated[bool, Field(description="nothing operates it")] = False
    confirm: Annotated[bool, Field(description="it is operated only when the request names it a second time")] = False

    value_is_angle: ClassVar[bool] = False
    """Whether a value of the object is an angle in radians rather than a value of a scale."""
    turns_round: ClassVar[bool] = False
    """Whether it may turn more than once round; an image shows its angle within one turn only."""
    is_round: ClassVar[bool] = False
    """Whether its outline is drawn as a circle where it has no `rim`."""
    can_be_lit: ClassVar[bool] = False
    """Whether a button may light it."""
    asked: ClassVar[tuple[Question, ...]] = ()
    """Questions that teaching a panel with such an object must ask, in addition to its name."""
    places_are_lengths: ClassVar[bool] = False
    """Whether the positions on its scale are lengths in metres rather than angles."""
    turns_about_click: ClassVar[bool] = False
    """Whether teaching uses the clicked point as its centre, rather than the centre of its outline."""

    @model_validator(mode="after")
    def _its_alarms_can_be_meant(self) -> PanelObject:
        states, faults = self.states_shown, []
        if self.limits is not None and states:
            hint = f"write normal = [...] with some of its states: {', '.join(states)}"
            faults.append(fault(("limits",), self.name, f"a {self.kind} shows states and no value", hint))
        for name, told in beyond_range(self).items():
            faults.append(fault(("limits", name), self.name, told, "stay within that range"))
        if self.normal is not None and not states and (self.full_scale is not None or self.value_is_angle):
            faults.append(fault(("normal",), self.name, f"a {self.kind} shows a value and no state", "write limits"))
        if states and set(states) <= set(self.normal or ()):
            told = "every state is normal, so there is never an alarm"
            faults.append(fault(("normal",), self.name, told, "leave it out, or name fewer states"))
        for k, state in enumerate(self.normal or ()):
            if states and state not in states:
                hint = f"its states: {', '.join(states)}"
                faults.append(fault(("normal", k), state, f"{self.name} has no state {state!r}", hint))
        if faults:
            raise ValidationError.from_exception_data(self.name, faults)
        return self

    @property
    def states_shown(self) -> tuple[str, ...]:
        """States that a look can tell apart; empty for an object that shows a value."""
        return tuple(self.resting_angles)

    @property
    def point_m(self) -> Vector3:
        """Centre of the object on the plate, in the panel frame."""
        return (self.position_m[0], self.position_m[1], 0.0)

    @property
    @abstractmethod
    def face(self) -> Face:
        """Part of an image that shows the object, and the height of the plane in which its reader looks at it."""

    @property
    @abstractmethod
    def half_footprint_m(self) -> Vector2:
        """Half width and half height of the upright rectangle on the plate that contains it in any state."""

    @property
    def half_foot_m(self) -> Vector2:
        """Half the sides of the area that it covers on the plate, turned like its envelope; no part may overlap it."""
        return self.half_footprint_m

    @abstractmethod
    def envelope(self, shown: Shown | None = None) -> Envelope:
        """Return the box that contains it in any state or, if that is smaller, as it is `shown`."""

    @property
    def rim(self) -> Rim | None:
        """Edge that is visible in every state; None if the panel file does not describe the fixed parts."""
        return None

    @property
    def relief(self) -> Relief | None:
        """Appearance in a range image; None if it is not searched for in range images."""
        return None

    @property
    def cap(self) -> Cap | None:
        """Cap whose height tells its state; None if it has none."""
        return None

    @property
    def goal(self) -> Goal | None:
        """Goals that it can be set to; None for an object that is only read."""
        return None

    @property
    def shown_by(self) -> str:
        """Name of the object that shows whether operating this one had an effect."""
        return self.name

    @property
    def mission_rank(self) -> float | None:
        """Rank in a mission without orders, which operates one object per kind, lowest rank first; None: left out."""
        return None

    @property
    def full_scale(self) -> float | None:
        """Difference between the largest and the smallest value; None if the values have no such range."""
        return None

    @property
    def resting_angles(self) -> Mapping[str, float]:
        """Angle of each state, rad clockwise from up; empty if the states are not angles."""
        return {}

    def angle_of(self, shown: Shown) -> float | None:
        """Return the angle that is shown, rad clockwise from up: the value if that is one, or the angle of the state."""
        if self.value_is_angle and shown.value is not None:
            return shown.value
        return None if shown.state is None else self.resting_angles.get(shown.state)

    def is_right(self, said: Shown, truth: Shown) -> bool:
        """Return whether a reading is correct: states and texts must be equal, values within 2 % of full scale."""
        if truth.state is not None:
            return said.state == truth.state
        if truth.text is not None:
            return said.text is not None and said.text.strip() == truth.text.strip()
        if said.value is None or truth.value is None:
            return False
        return bool(abs(said.value - truth.value) <= GAUGE_SHARE * (self.full_scale or 1.0))

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys of its table in a panel file, except kind, name and position, from what was taught."""
        raise NotImplementedError(f"a {cls.__name__} cannot be taught: its model does not define `keys_of`")
