"""Sections of the cell file for what happens in the simulated world while it runs, for drills and tests."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.calibration import Vector3
from hal.strict import Strict


class When(Strict):
    """Begins at a simulated time, or later, when the finger tips first come near an object of the panel."""

    at_s: Annotated[float, Field(ge=0.0, description="simulated time before which it does not begin")] = 0.0
    near: Annotated[
        str | None, Field(description="object of the panel; it begins when the finger tips come near it")
    ] = None
    near_m: Annotated[float, Field(gt=0.0, le=1.0, description="distance of the tips from the object that counts")] = (
        0.05
    )
    delay_s: Annotated[float, Field(ge=0.0, le=600.0, description="how long after that it begins")] = 0.0


class EventSection(When):
    """`[[simulation.events]]`: the panel moves, or an object is blocked, dark or missing."""

    kind: Annotated[
        Literal["panel-moves", "blocked", "lamp-out", "missing"],
        Field(
            description="`panel-moves`: the whole panel moves by `shift_m` and `turn_rad`; `blocked`: the object's moving"
            " part does not give way; `lamp-out`: the lamp or border light stays dark; `missing`: the object is gone"
        ),
    ]
    object: Annotated[str | None, Field(description="object or border light; not for `panel-moves`")] = None
    shift_m: Annotated[Vector3, Field(description="displacement in panel axes")] = (0.0, 0.0, 0.0)
    turn_rad: Annotated[Vector3, Field(description="rotation vector in panel axes; a door swings about y")] = (
        0.0,
        0.0,
        0.0,
    )
    about_m: Annotated[Vector3, Field(description="point of the panel about which it turns")] = (0.0, 0.0, 0.0)
    duration_s: Annotated[float, Field(ge=0.0, le=60.0, description="how long the motion takes")] = 0.2

    @model_validator(mode="after")
    def _names_what_it_is_about(self) -> EventSection:
        if (self.kind == "panel-moves") == (self.object is not None):
            raise ValueError("`object` is needed for blocked, lamp-out and missing, and not for panel-moves")
        return self
