"""Checks conditions against the panel: what they ask of each object, and whether anything could ever meet them together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from hal.errors import InvalidRequest
from hal.panel import Panel, PanelObject
from hal.panel.limits import range_of, unit_of
from hal.strict import FieldFault
from service.schema.mission_file import Condition


def faulty_conditions(conditions: Sequence[Condition], at: str, panel: Panel) -> Iterator[FieldFault]:
    """Yield what is wrong with the conditions of a step; `at` is their key."""
    sound: list[tuple[str, Condition]] = []
    for k, condition in enumerate(conditions):
        key = f"{at}.{k}"
        try:
            panel_object = panel.object(condition.object)
        except InvalidRequest as error:
            yield FieldFault(f"{key}.object", error.what, error.hint)
            continue
        faults = list(_of_one(condition, key, panel_object))
        yield from faults
        if not faults:
            yield from _contradicted(condition, key, sound)
            sound.append((key, condition))


def _of_one(condition: Condition, key: str, panel_object: PanelObject) -> Iterator[FieldFault]:
    name, states, unit = panel_object.name, panel_object.states_shown, unit_of(panel_object)
    if condition.state is not None:
        if not states and panel_object.full_scale is not None:
            yield FieldFault(f"{key}.state", f"{name} shows a value and no state", "give below or above")
        elif states and condition.state not in states:
            yield FieldFault(f"{key}.state", f"{name} has no state {condition.state!r}", f"states: {', '.join(states)}")
        return
    if states:
        hint = f"give state; its states: {', '.join(states)}"
        yield FieldFault(key, f"{name} shows states and no value", hint)
        return
    if condition.unit != (unit or None):
        told = f"the unit of {name} is {unit!r}" if unit else f"{name} has no unit"
        given = "none is given" if condition.unit is None else f"{condition.unit!r} is given"
        yield FieldFault(f"{key}.unit", f"{told}, and {given}", f"write unit = {unit!r}" if unit else "leave unit out")
    yield from _of_range(condition, key, panel_object)


def _of_range(condition: Condition, key: str, panel_object: PanelObject) -> Iterator[FieldFault]:
    """Yield a number that no value, or every value, of the object's scale is below or above."""
    found = range_of(panel_object)
    if found is None:
        return
    low, high = found
    shows = f"{panel_object.name} shows {low:g} to {high:g} {unit_of(panel_object)}".rstrip()
    for word, limit in (("below", condition.below), ("above", condition.above)):
        if limit is not None and not low < limit < high:
            each = "every value" if (limit >= high) == (word == "below") else "no value"
            yield FieldFault(f"{key}.{word}", f"{shows}, so {each} is {word} {limit:g}", "give a number between these")


def _contradicted(condition: Condition, key: str, others: Sequence[tuple[str, Condition]]) -> Iterator[FieldFault]:
    """Yield an earlier condition on the same object that cannot be met together with this one."""
    for other_key, other in others:
        if other.object != condition.object:
            continue
        above = max((one.above for one in (condition, other) if one.above is not None), default=None)
        below = min((one.below for one in (condition, other) if one.below is not None), default=None)
        is_empty = above is not None and below is not None and above >= below
        if is_empty or condition.state != other.state:
            yield FieldFault(key, f"it can never be met together with {other_key}", "leave one of the two out")
            return
