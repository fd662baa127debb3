"""Missions in plain words: what a step will do, and what a running mission does."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from hal.panel import Panel
from service.console.texts import ENGLISH, say
from service.console.values import attribute, label_of

Step = dict[str, Any]


def name_of(panel: Panel | None, name: str) -> str:
    """Return the label of an object for people; its name if the panel does not have it."""
    found = next((one for one in panel.objects if one.name == name), None) if panel is not None else None
    return name if found is None else label_of(found)


def listed(parts: list[str]) -> str:
    """Return several words as one phrase."""
    return parts[0] if len(parts) == 1 else say("and", first=", ".join(parts[:-1]), last=parts[-1])


def step_list(steps: list[Step], panel: Panel | None) -> str:
    """Return the steps of a mission as an HTML list."""
    return "<ol>" + "".join(f"<li>{''.join(_step(step, panel))}</li>" for step in steps) + "</ol>"


def _step(step: Step, panel: Panel | None) -> Iterator[str]:
    yield attribute(_sentence(step, panel))
    if step.get("needs"):
        yield " " + attribute(say("step.needs", conditions=conditions(step["needs"], panel)))
    if step["on_failure"] != "stop":
        yield " " + attribute(say(f"step.on_failure.{step['on_failure']}", tries=step["tries"]))
    for key in ("then", "steps"):
        if step.get(key):
            yield step_list(step[key], panel)
    if step.get("otherwise"):
        yield attribute(say("step.choose.otherwise")) + step_list(step["otherwise"], panel)


def _sentence(step: Step, panel: Panel | None) -> str:
    kind = step["kind"]
    if kind == "inspect":
        names = [name_of(panel, name) for name in step.get("objects", [])]
        return say("step.inspect", objects=listed(names)) if names else say("step.inspect.all")
    if kind == "set":
        return _setting(step, panel)
    asked = step.get("conditions") or step.get("when") or step.get("until") or []
    key = "step.repeat.until" if kind == "repeat" and asked else f"step.{kind}"
    return say(
        key,
        conditions=conditions(asked, panel) if asked else "",
        times=step.get("times"),
        touches=step.get("touches"),
        mission=step.get("mission"),
        timeout=lasting(step.get("timeout_s", 0.0)),
    )


def _setting(step: Step, panel: Panel | None) -> str:
    if step["each_kind"]:
        return say("step.set.each_kind")
    one = name_of(panel, step["object"])
    if step["other"]:
        return say("step.set.other", object=one)
    target = next((step[key] for key in ("state", "value", "angle_rad") if key in step), None)
    if target is None:
        return say("step.set.once", object=one)
    return say("step.set", object=one, target=target if isinstance(target, str) else f"{target:g}")


def conditions(asked: list[dict[str, Any]], panel: Panel | None) -> str:
    """Return conditions as one phrase."""
    return listed([_condition(one, panel) for one in asked])


def _condition(one: dict[str, Any], panel: Panel | None) -> str:
    name = name_of(panel, one["object"])
    if "state" in one:
        return say("condition.state", object=name, state=one["state"])
    low, high = (f"{one[key]:g} {one.get('unit', '')}".rstrip() if key in one else "" for key in ("above", "below"))
    if low and high:
        return say("condition.between", object=name, low=low, high=high)
    return say("condition.above", object=name, number=low) if low else say("condition.below", object=name, number=high)


def lasting(seconds: float) -> str:
    """Return a duration for people."""
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"


def did(step: str, detail: str, panel: Panel | None) -> str:
    """Return what a task does now as a sentence; a word of the service that is new here is shown as it is."""
    first, _, rest = step.partition(" ")
    known = {} if panel is None else {one.name: label_of(one) for one in panel.objects}
    if f"did.{step}" in ENGLISH:
        told = say(f"did.{step}")
    elif first == "step":
        told = say("did.step", name=rest)
    elif first == "work" and rest in known:
        told = say("did.work", object=known[rest])
    else:
        told = re.sub(r"\w+", lambda found: known.get(found[0], found[0]), step[:1].upper() + step[1:])
    names = [known.get(part, part) for part in detail.split(", ")] if detail else []
    return f"{told}: {', '.join(names)}" if names else told


def is_plan(task: dict[str, Any]) -> bool:
    """Return whether a task is a dry run, which tells nothing of the panel."""
    return bool(task["request"].get("dry_run"))
