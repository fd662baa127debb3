"""Reads the angles of a panel file: radians, or degrees under keys that end in `_deg`."""

from __future__ import annotations

import math
from typing import Annotated, Any, get_args

from pydantic import AfterValidator, BaseModel, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError
from pydantic_core.core_schema import ErrorType

from hal.panel.parts import Scale
from hal.panel.turn import TURN_RAD, beyond, meant_otherwise
from hal.strict import unknown_key_hint

UNITLESS = {"at_min", "at_max", "table"}  # keys of a scale, whose positions are angles or lengths by its kind
KNOWN_TYPES = frozenset(get_args(ErrorType))
Location = tuple[str | int, ...]


def fault(at: Location, given: object, what: str, hint: str) -> InitErrorDetails:
    """Return a fault of a file: the location, the value there, what is wrong with it, and a hint."""
    return InitErrorDetails(type=meant_otherwise(what, hint), loc=at, input=given)


def again(item: Any, model: type[BaseModel]) -> InitErrorDetails:
    """Return a fault that `model` has found, in a form that can be raised together with others."""
    context = dict(item.get("ctx", {}))
    if item["type"] == "extra_forbidden":
        context["hint"] = unknown_key_hint(model, item["loc"])
    elif item["type"] in KNOWN_TYPES:
        return InitErrorDetails(type=item["type"], loc=item["loc"], input=item["input"], ctx=context)
    kind = PydanticCustomError(item["type"], "{message}", {**context, "message": item["msg"]})
    return InitErrorDetails(type=kind, loc=item["loc"], input=item["input"])


def in_radians(table: Any, known: frozenset[str], at: Location = ()) -> tuple[Any, list[InitErrorDetails]]:
    """Return a table of a panel file with every angle in radians, and the faults of angles that are given twice.

    Args:
        known: keys of the models that will read the table. A key that is not known even after conversion stays
            unchanged, so that the model refuses it under its own name.
    """
    if isinstance(table, list):
        pairs = [in_radians(item, known, (*at, k)) for k, item in enumerate(table)]
        return [item for item, _ in pairs], [one for _, faults in pairs for one in faults]
    if not isinstance(table, dict):
        return table, []
    out: dict[str, Any] = {}
    faults: list[InitErrorDetails] = []
    for key, value in table.items():
        stem = key.removesuffix("_deg")
        target = stem if stem in UNITLESS else f"{stem}_rad"
        if stem == key or target not in known:
            out[key], more = in_radians(value, known, (*at, key))
            faults += more
        elif target in table:
            what = f"the same angle is given as {target} and as {key}"
            faults.append(fault((*at, key), value, what, f"keep one of {target} and {key}"))
        else:
            out[target] = _radians(value, is_table=stem == "table")
    return out, faults


def _radians(value: Any, *, is_table: bool) -> Any:
    """Convert degrees to radians; a value that is not a number stays unchanged, so that its model refuses it."""
    if is_table and isinstance(value, list):  # pairs of place and value
        return [[_radians(p[0], is_table=False), *p[1:]] if isinstance(p, list) and p else p for p in value]
    return math.radians(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


def _is_a_pointers(scale: Scale) -> Scale:
    """Check a scale whose positions are angles: its ends and the span between them must be within a full turn."""
    places: list[tuple[Location, float]] = [(("at_min",), scale.at_min), (("at_max",), scale.at_max)]
    places += [(("table", k, 0), place) for k, (place, _) in enumerate(scale.table)]
    faults = [
        InitErrorDetails(type=beyond(str(at[0]), place), loc=at, input=place)
        for at, place in places
        if abs(place) > TURN_RAD
    ]
    if not faults and abs(scale.at_max - scale.at_min) > TURN_RAD:
        what = f"from {scale.at_min:g} to {scale.at_max:g} rad is more than a full turn"
        hint = f"angles are radians: if these are degrees, write at_min_deg = {scale.at_min:g}, at_max_deg = {scale.at_max:g}"
        faults.append(fault(("at_max",), scale.at_max, what, hint))
    if faults:
        raise ValidationError.from_exception_data("scale", faults)
    return scale


PointerScale = Annotated[Scale, AfterValidator(_is_a_pointers)]
"""Scale whose positions are angles in radians, clockwise from straight up."""
