"""Push buttons."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from hal.panel.families import Round
from hal.panel.form import Cap
from hal.panel.goals import StateGoal
from hal.panel.parts import LATCHED_SHARE, Name, NotNegative, Positive
from hal.panel.questions import COLOURS, Question, Taught

PRESSED_ONCE = "pressed once"
"""Goal of a button that springs back and works no lamp: it keeps no state that a look could confirm."""


class Button(Round):
    """Push button; `latching` ones stay in. States `pressed` and `released`."""

    kind: Literal["button"] = "button"
    height_m: Positive = 0.008
    travel_m: Positive = 0.005
    spring_n_per_m: Positive = 1000.0
    preload_n: NotNegative = 2.0
    latching: bool = False
    colour: Literal["red", "green", "amber", "blue", "white", "black"] = "green"
    lights_lamp: Name | None = None

    is_round: ClassVar[bool] = True
    asked: ClassVar[tuple[Question, ...]] = (
        Question(key="colour", text="Which colour?", choices=(*COLOURS, "black"), default="green"),
        Question(key="latching", text="Does it stay in when pressed?", choices=("no", "yes"), default="no"),
    )

    @property
    def states_shown(self) -> tuple[str, ...]:
        """States that a look can tell apart."""
        return "pressed", "released"

    @property
    def pressed_depth_m(self) -> float:
        """Depth below the released cap at which it is read as pressed, that is, held down or latched."""
        return LATCHED_SHARE * self.travel_m if self.latching else self.travel_m

    @property
    def cap(self) -> Cap:
        """Its cap."""
        return Cap(radius_m=self.radius_m, height_m=self.height_m, pressed_depth_m=self.pressed_depth_m)

    @property
    def goal(self) -> StateGoal:
        """States of its lamp, or of the cap itself if it latches; else to be pressed once, whose proof is felt."""
        if self.lights_lamp is not None:
            return StateGoal(states=("on", "off"), usual="on")
        if self.latching:
            return StateGoal(states=("pressed", "released"), usual="pressed")
        return StateGoal(states=(), usual=PRESSED_ONCE)

    @property
    def shown_by(self) -> str:
        """The name of its lamp, if any, because a button springs back and its effect is what counts."""
        return self.name if self.lights_lamp is None else self.lights_lamp

    @property
    def mission_rank(self) -> float | None:
        """Rank of buttons with a lamp, then of latching ones; None for others, whose state cannot be confirmed."""
        if self.lights_lamp is not None:
            return 3.0
        return 3.5 if self.latching else None

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for radius, colour and whether it latches."""
        return {
            **super().keys_of(taught),
            "colour": taught.text("colour"),
            "latching": taught.text("latching") == "yes",
        }
