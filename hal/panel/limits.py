"""Limits and normal states of an object, beyond which an alarm is raised; words as in ISA-18.2 and IEC 62682."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from hal.panel.parts import NotNegative, Positive
from hal.panel.turn import meant_otherwise
from hal.strict import Strict

if TYPE_CHECKING:
    from hal.panel.base import PanelObject

Priority = Literal["low", "medium", "high", "urgent"]
LONGEST_DELAY_S = 7 * 86_400.0
ORDER = ("low_low", "low", "high", "high_high")


class Limits(Strict):
    """Limits of a value, in the unit of the object's scale (radians for an angle)."""

    low_low: float | None = None
    low: float | None = None
    high: float | None = None
    high_high: float | None = None
    deadband: Annotated[
        NotNegative, Field(description="an alarm ends when the value is inside of its limit by this much")
    ] = 0.0
    delay_s: Annotated[
        NotNegative,
        Field(le=LONGEST_DELAY_S, description="how long a value must be beyond a limit before an alarm"),
    ] = 0.0
    rate_per_s: Annotated[Positive | None, Field(description="greatest change per second between two readings")] = None

    @model_validator(mode="after")
    def _are_in_order(self) -> Limits:
        given = self.given
        if not given and self.rate_per_s is None:
            raise meant_otherwise("no limit is given", "give low_low, low, high, high_high or rate_per_s")
        faults = {
            f"{name} = {value:g} is not below {next_name} = {next_value:g}": "the order is low_low < low < high < high_high"
            for (name, value), (next_name, next_value) in pairwise(given.items())
            if value >= next_value
        }
        above = [value for name, value in given.items() if name.startswith("high")]
        below = [value for name, value in given.items() if name.startswith("low")]
        if above and below and self.deadband > 0.0 and self.deadband >= min(above) - max(below):
            what = f"deadband = {self.deadband:g} is not smaller than the room between the limits"
            faults[what] = "an alarm could never end: give a smaller deadband"
        if faults:
            raise meant_otherwise("; ".join(faults), "; ".join(dict.fromkeys(faults.values())))
        return self

    @property
    def given(self) -> dict[str, float]:
        """The limits that are set, by name, from the lowest to the highest."""
        return {name: value for name in ORDER if (value := getattr(self, name)) is not None}


def unit_of(panel_object: PanelObject) -> str:
    """Return the unit of an object's values; empty if it has none."""
    if panel_object.value_is_angle:
        return "rad"
    scale = getattr(panel_object, "scale", None)
    return str(getattr(panel_object if scale is None else scale, "unit", ""))


def range_of(panel_object: PanelObject) -> tuple[float, float] | None:
    """Return the smallest and the largest value that an object can show; None if it has no such range."""
    goal = panel_object.goal if panel_object.value_is_angle else None
    scale = getattr(panel_object, "scale", None) or panel_object
    low = getattr(scale, "minimum", None) if goal is None else getattr(goal, "low", None)
    high = getattr(scale, "maximum", None) if goal is None else getattr(goal, "high", None)
    return None if low is None or high is None else (float(low), float(high))


def beyond_range(panel_object: PanelObject) -> dict[str, str]:
    """Return what is wrong with limits beyond which, or inside of which, no value of the object can be; by the limit's key."""
    found, limits = range_of(panel_object), panel_object.limits
    if found is None or limits is None:
        return {}
    low, high = found
    shows = f"{panel_object.name} shows {low:g} to {high:g} {unit_of(panel_object)}".rstrip()
    faults = {
        name: f"{shows}, and no value is beyond {limit:g}"
        for name, limit in limits.given.items()
        if not (low <= limit < high if name.startswith("high") else low < limit <= high)
    }
    room = [limit - low if name.startswith("high") else high - limit for name, limit in limits.given.items()]
    if not faults and room and limits.deadband > min(room):
        faults["deadband"] = f"{shows}, and no value is {limits.deadband:g} inside of each limit"
    return faults
