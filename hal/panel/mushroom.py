"""Emergency mushrooms."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from hal.panel.families import Round
from hal.panel.form import Cap, Relief
from hal.panel.goals import StateGoal
from hal.panel.parts import LATCHED_SHARE, NotNegative, Positive


class Mushroom(Round):
    """Emergency mushroom; pressing it latches. States `pressed` and `released`."""

    kind: Literal["mushroom"] = "mushroom"
    radius_m: Positive = 0.020
    height_m: Positive = 0.026
    travel_m: Positive = 0.006
    spring_n_per_m: Positive = 2000.0
    preload_n: NotNegative = 8.0
    confirm: Annotated[bool, Field(description="it is operated only when the request names it a second time")] = True

    is_round: ClassVar[bool] = True

    @property
    def states_shown(self) -> tuple[str, ...]:
        """States that a look can tell apart."""
        return "pressed", "released"

    @property
    def pressed_depth_m(self) -> float:
        """Depth of a latched head below a released one."""
        return LATCHED_SHARE * self.travel_m

    @property
    def cap(self) -> Cap:
        """Its cap."""
        return Cap(radius_m=self.radius_m, height_m=self.height_m, pressed_depth_m=self.pressed_depth_m)

    @property
    def goal(self) -> StateGoal:
        """The state `pressed`; only a person may release it."""
        return StateGoal(states=("pressed",), usual="pressed")

    @property
    def relief(self) -> Relief:
        """A head, the upper half of its height, on a stem half as wide."""
        up, head_m = [0.0, 0.0, 1.0], 0.5 * self.height_m
        top: dict[str, Any] = {"direction": up, "size_m": self.radius_m}
        cap = {"name": "cap", "moves": True, "type": "plane", "point_m": [0, 0, self.height_m], **top}
        middle = [0, 0, self.height_m - 0.5 * head_m]
        wall = {"name": "wall", "moves": True, "type": "cylinder", "point_m": middle, **top, "length_m": head_m}
        return Relief(
            surfaces=(cap, wall),
            height_m=self.height_m,
            motion="slide",
            low=-self.travel_m,
            high=0.0,
            pressed_depth_m=self.pressed_depth_m,
        )
