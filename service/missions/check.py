"""Checks a mission against the panel: all faults at once, with file, key and remedy, before anything moves."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from pydantic import TypeAdapter, ValidationError

from hal.entry_points import registered
from hal.errors import CellError, InvalidRequest
from hal.panel import Panel, PanelObject
from hal.panel.kinds import SKILLS, has_part
from hal.strict import FieldFault
from service.missions.condition_check import faulty_conditions
from service.schema.mission_file import (
    CallStep,
    ChooseStep,
    InspectStep,
    MissionFile,
    RepeatStep,
    RequireStep,
    SetStep,
    Step,
    WaitStep,
)
from service.schema.requests import ActionBody

Load = Callable[[str], MissionFile]
ONE_STEP: TypeAdapter[Step] = TypeAdapter(Step)
MOST_RUNS = 10_000  # steps that one mission may run, counted with its repetitions and calls


@dataclass(frozen=True, slots=True, kw_only=True)
class Checked:
    """A mission that fits the panel, with the missions that it calls, by name."""

    mission: MissionFile
    library: Mapping[str, MissionFile]


def check_mission(mission: MissionFile, panel: Panel, load: Load, *, source: str) -> Checked:
    """Check a mission and all that it calls.

    Args:
        load: returns the mission file of a name; raises `CellError`.
        source: name of the mission in errors.

    Raises:
        InvalidRequest: names every fault.
    """
    library: dict[str, MissionFile] = {}
    faults = [(source, fault) for fault in _faults_of(mission.steps, "steps", panel)]
    waiting = [(source, key, name) for key, name in _calls(mission.steps, "steps")]
    calls = {source: {name for _, _, name in waiting}}
    while waiting:
        caller, key, name = waiting.pop(0)
        if name in library:
            continue
        try:
            library[name] = load(name)
        except CellError as error:
            faults.append((caller, FieldFault(f"{key}.mission", error.what, error.hint)))
            more = error.details.get("faults", [])[1:]
            faults += [(f"missions/{name}.toml", FieldFault("", str(fault), "see above")) for fault in more]
            continue
        below = list(_calls(library[name].steps, "steps"))
        calls[name] = {called for _, called in below}
        faults += [(f"missions/{name}.toml", fault) for fault in _faults_of(library[name].steps, "steps", panel)]
        waiting += [(f"missions/{name}.toml", inner, called) for inner, called in below]
    faults += [(source, fault) for fault in _circles(calls)]
    if not faults and (runs := _runs(mission.steps, library)) > MOST_RUNS:
        told = f"with all repetitions and calls it has {runs:.4g} steps, and at most {MOST_RUNS} are run"
        faults.append((source, FieldFault("steps", told, "repeat less often")))
    if faults:
        raise _refusal(faults)
    return Checked(mission=mission, library=library)


def _runs(steps: Sequence[Step], library: Mapping[str, MissionFile], known: dict[str, int] | None = None) -> int:
    """Return how many steps are run at most; `known` has the counts of called missions, each of which is counted once."""
    counts = {} if known is None else known
    found = 0
    for step in steps:
        match step:
            case ChooseStep():
                found += 1 + max(_runs(step.then, library, counts), _runs(step.otherwise, library, counts))
            case RepeatStep():
                found += 1 + step.times * _runs(step.steps, library, counts)
            case CallStep():
                if step.mission not in counts:
                    counts[step.mission] = _runs(library[step.mission].steps, library, counts)
                found += 1 + counts[step.mission]
            case _:
                found += 1
    return found


def _refusal(faults: Sequence[tuple[str, FieldFault]]) -> InvalidRequest:
    told = [f"{source}: {fault}" for source, fault in faults]
    source, first = faults[0]
    more = f" (and {len(told) - 1} more {'fault' if len(told) == 2 else 'faults'})" if len(told) > 1 else ""
    return InvalidRequest(
        f"{source}: {first.key}: {first.text}{more}", hint=first.hint, file=source, key=first.key, faults=told
    )


def faults_of_valid_steps(steps: object, panel: Panel, load: Load, at: str = "steps") -> list[FieldFault]:
    """Return what panel and other missions contradict in plain data of steps, of which some may be malformed.

    A malformed step is passed over, and the steps within it are not.

    Args:
        load: returns the mission file of a name; raises `CellError`.
        at: key of the steps.
    """
    found: list[FieldFault] = []
    for k, plain in enumerate(steps if isinstance(steps, list) else ()):
        key = f"{at}.{k}"
        try:
            step = ONE_STEP.validate_json(json.dumps(plain, default=str), strict=True)
        except ValidationError:
            for inner in ("then", "otherwise", "steps") if isinstance(plain, dict) else ():
                found += faults_of_valid_steps(plain.get(inner), panel, load, f"{key}.{inner}")
            continue
        found += _faults_of_step(step, key, panel)
        for called, name in _calls((step,), at):
            try:
                load(name)
            except CellError as error:
                place = called.removeprefix(f"{at}.0")
                found.append(FieldFault(f"{key}{place}.mission", error.what, error.hint))
    return found


def operable(panel_object: PanelObject, action: ActionBody) -> None:
    """Raise `InvalidRequest` for a control that is forbidden, or that is to be named a second time and is not."""
    name = panel_object.name
    if panel_object.forbidden:
        raise InvalidRequest(f"{name} is forbidden in the panel file", hint="a person operates it; leave it out")
    if action.confirm is not None and action.confirm != name:
        what = f"confirm names {action.confirm!r}, and the object is {name!r}"
        raise InvalidRequest(what, hint=f"write confirm = {name!r} if that is meant")
    if panel_object.confirm and action.confirm is None:
        what = f"{name} is a {panel_object.kind} that is operated only when it is named twice"
        raise InvalidRequest(what, hint=f"add confirm = {name!r} if that is meant")


def target_of(panel_object: PanelObject, action: ActionBody) -> str | float:
    """Return the target of an action; the usual target of the kind when the request names none.

    Raises:
        InvalidRequest: the object cannot or may not be operated, or has no such state or value.
    """
    goal = panel_object.goal
    if goal is None or not has_part(SKILLS, panel_object.kind):
        raise InvalidRequest(
            f"{panel_object.name} is a {panel_object.kind}, which cannot be operated: it is read only",
            hint=f"kinds that can be: {', '.join(registered(SKILLS))}",
        )
    for other in sorted({"state", "value", "angle_rad"} - {goal.key}):  # refused, because its meaning would be a guess
        if getattr(action, other) is not None:
            hint = f"give {goal.key}, and leave {other} out"
            what = f"{panel_object.name} is a {panel_object.kind}: it takes {goal.key}, not {other}"
            raise InvalidRequest(what, hint=hint)
    target = goal.checked(panel_object.name, getattr(action, goal.key))
    operable(panel_object, action)
    return target


def _faults_of(steps: Sequence[Step], at: str, panel: Panel) -> Iterator[FieldFault]:
    for k, step in enumerate(steps):
        yield from _faults_of_step(step, f"{at}.{k}", panel)


def _faults_of_step(step: Step, key: str, panel: Panel) -> Iterator[FieldFault]:
    yield from faulty_conditions(step.needs, f"{key}.needs", panel)
    match step:
        case InspectStep():
            names = step.objects or ()
            for j, name in enumerate(names):
                yield from _said(f"{key}.objects.{j}", partial(panel.object, name))
                if name in names[:j]:
                    yield FieldFault(f"{key}.objects.{j}", f"{name} is named already", "leave it out")
        case SetStep(object=str(name)):
            yield from _said(f"{key}.object", partial(_check_set, step, name, panel))
        case RequireStep() | WaitStep():
            yield from faulty_conditions(step.conditions, f"{key}.conditions", panel)
        case ChooseStep():
            yield from faulty_conditions(step.when, f"{key}.when", panel)
            yield from _faults_of(step.then, f"{key}.then", panel)
            yield from _faults_of(step.otherwise, f"{key}.otherwise", panel)
        case RepeatStep():
            yield from faulty_conditions(step.until, f"{key}.until", panel)
            yield from _faults_of(step.steps, f"{key}.steps", panel)


def _check_set(step: SetStep, name: str, panel: Panel) -> None:
    panel_object = panel.object(name)
    if not step.other:
        target_of(panel_object, step.action())
        return
    if panel_object.goal is None:
        raise InvalidRequest(f"{panel_object.name} cannot be operated: it is read only", hint="leave the step out")
    operable(panel_object, step.action())


def _said(key: str, work: Callable[[], object]) -> Iterator[FieldFault]:
    try:
        work()
    except InvalidRequest as error:
        yield FieldFault(key, error.what, error.hint)


def _calls(steps: Sequence[Step], at: str) -> Iterator[tuple[str, str]]:
    """Yield the key and the mission of each call, also within other steps."""
    for k, step in enumerate(steps):
        key = f"{at}.{k}"
        match step:
            case CallStep():
                yield key, step.mission
            case ChooseStep():
                yield from _calls(step.then, f"{key}.then")
                yield from _calls(step.otherwise, f"{key}.otherwise")
            case RepeatStep():
                yield from _calls(step.steps, f"{key}.steps")


def _circles(calls: Mapping[str, set[str]]) -> Iterator[FieldFault]:
    """Yield a fault for each mission that calls itself, directly or through others."""
    for name in calls:
        seen: set[str] = set()
        waiting = set(calls[name])
        while waiting:
            one = waiting.pop()
            if one not in seen:
                seen.add(one)
                waiting |= calls.get(one, set())
        if name in seen:
            yield FieldFault("steps", f"mission {name!r} calls itself", "take one call of the circle out")
