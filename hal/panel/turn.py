"""Checks angles for plausibility; an angle beyond a full turn was probably given in degrees."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import AfterValidator, Field, ValidationInfo
from pydantic_core import PydanticCustomError

TURN_RAD = 2.0 * math.pi + 0.01
MOST_TURNS = 10


def meant_otherwise(what: str, hint: str) -> PydanticCustomError:
    """Return the error for an implausible value, with a hint."""
    return PydanticCustomError("cannot_be_meant", "{what}", {"what": what, "hint": hint})


def beyond(key: str, angle_rad: float, most: str = "a full turn") -> PydanticCustomError:
    """Return the error for an angle that is too large to be plausible."""
    stem = key.removesuffix("_rad")
    hint = f"angles are radians: if this is degrees, write {stem}_deg = {angle_rad:g}"
    return meant_otherwise(f"{angle_rad:g} rad is beyond {most}", hint)


def _within_a_turn(angle_rad: float, info: ValidationInfo) -> float:
    if abs(angle_rad) > TURN_RAD:
        raise beyond(info.field_name or "angle_rad", angle_rad)
    return angle_rad


def _within_turns(angle_rad: float, info: ValidationInfo) -> float:
    if abs(angle_rad) > MOST_TURNS * TURN_RAD:
        raise beyond(info.field_name or "angle_rad", angle_rad, f"{MOST_TURNS} turns")
    return angle_rad


def below_a_quarter(angle_rad: float, info: ValidationInfo) -> float:
    """Return the angle if it is less than a quarter of a turn, else raise."""
    if angle_rad >= math.pi / 2:
        raise beyond(info.field_name or "angle_rad", angle_rad, "a quarter of a turn")
    return angle_rad


Angle = Annotated[float, AfterValidator(_within_a_turn)]
"""An angle in radians of at most a full turn to either side."""
Turns = Annotated[float, AfterValidator(_within_turns)]
"""An angle in radians of a part that may turn several times."""
Tilt = Annotated[float, Field(gt=0), AfterValidator(below_a_quarter)]
"""An angle in radians by which a part leans, more than 0 and less than a quarter of a turn."""
