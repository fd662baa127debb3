"""A mission file as a form: what is changed here is changed in the file's text, whose comments and order stay."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import tomlkit
from nicegui import ui
from tomlkit.exceptions import ParseError, TOMLKitError

from hal.panel import NumberGoal, Panel, StateGoal
from hal.panel.limits import unit_of
from service.console.mirror import Mirror
from service.console.page_frame import button
from service.console.texts import say
from service.console.values import attribute, label_of

KINDS = ("inspect", "feel", "set", "require", "wait_until", "choose", "repeat", "call")
NUMBERS = {"feel": ("touches",), "wait_until": ("timeout_s", "every_s"), "repeat": ("times",)}
WHOLE = ("touches", "times")
CONDITIONS = {"require": "conditions", "wait_until": "conditions", "choose": "when", "repeat": "until"}
WITH_STEPS = ("choose", "repeat")
TARGETS = ("state", "value", "angle_rad")
RELATIONS = ("below", "above", "state")
KEPT = ("name", "kind", "needs", "on_failure", "tries")  # of a step whose kind is changed
Table = Any  # a table of tomlkit, which behaves as a dict


class MissionForm:
    """The form of a mission.

    Args:
        on_change: takes the file's text after each change.
    """

    def __init__(self, mirror: Mirror, on_change: Callable[[str], None]) -> None:
        self._mirror = mirror
        self._on_change = on_change
        self._text: str | None = None
        self._document: Any = None
        self._holder = ui.element("div").classes("told mission-form")

    def show(self, text: str) -> None:
        """Show the form of a text, unless it is the text that the form itself has made."""
        if text == self._text:
            return
        self._text = text
        try:
            self._document = tomlkit.parse(text)
        except (ParseError, TOMLKitError, ValueError, RecursionError):
            self._document = None
        self._build()

    def _tell(self, *, is_new_shape: bool = False) -> None:
        self._text = tomlkit.dumps(self._document)
        self._on_change(self._text)
        if is_new_shape:
            self._build()

    def _build(self) -> None:
        self._holder.clear()
        with self._holder:
            if self._document is None:
                ui.html(f'<p class="quiet">{say("editor.no_form")}</p>', sanitize=False)
                return
            _field("editor.mission", self._document.get("title", ""), self._putter(self._document, "title"))
            steps = self._steps()
            for number, step in enumerate(steps):
                if isinstance(step, dict):
                    with (
                        ui.element("div")
                        .classes("step")
                        .props(f'role=group aria-label="{say("editor.step", number=number + 1)}"')
                    ):
                        self._step(number, step, len(steps))
            button(say("editor.add"), self._add, look="plain")

    def _steps(self) -> list[Any]:
        steps = self._document.get("steps", [])
        return steps if isinstance(steps, list) else []

    def _step(self, number: int, step: Table, count: int) -> None:
        kind = str(step.get("kind", ""))
        with ui.element("div").classes("row"):
            ui.html(say("editor.step", number=number + 1), sanitize=False, tag="h3")
            for key, to, is_possible in (("up", number - 1, number > 0), ("down", number + 1, number + 1 < count)):
                if is_possible:
                    self._button(f"editor.move.{key}", number, partial(self._move, number, to))
            if count > 1:
                self._button("editor.remove", number, lambda: self._remove(number))
        with ui.element("div").classes("fields"):
            _choice("editor.kind", {one: say(f"editor.kind.{one}") for one in KINDS}, kind, self._kind_of(step))
            _field("editor.name", step.get("name", ""), self._putter(step, "name"))
            for key in NUMBERS.get(kind, ()):
                _number(f"editor.number.{key}", step.get(key), self._putter(step, key), is_whole=key in WHOLE)
            self._own_fields(kind, step)
            told = {one: say(f"editor.on_failure.{one}") for one in ("stop", "skip", "retry")}
            _choice("editor.on_failure", told, str(step.get("on_failure", "stop")), self._putter(step, "on_failure"))
        if kind in CONDITIONS:
            self._conditions(number, step, CONDITIONS[kind])
        elif step.get("needs"):
            self._conditions(number, step, "needs")
        if kind in WITH_STEPS:
            ui.html(say("editor.inner"), sanitize=False, tag="p").classes("quiet")

    def _own_fields(self, kind: str, step: Table) -> None:
        panel = self._mirror.panel
        labels = {} if panel is None else {one.name: label_of(one) for one in panel.objects}
        if kind == "inspect":
            chosen = [one for one in step.get("objects", []) if one in labels]
            told = say("editor.objects")
            field = ui.select(labels, value=chosen, label=told, multiple=True, on_change=_calls(self._objects_of(step)))
            field.props("outlined dense options-dense use-chips")
        elif kind == "call":
            names = [one["name"] for one in self._mirror.said("mission_files", {"files": []})["files"]]
            _choice(
                "editor.call", {one: one for one in names}, str(step.get("mission", "")), self._putter(step, "mission")
            )
        elif kind == "set":
            goals = {} if panel is None else {one.name: label_of(one) for one in panel.objects if one.goal is not None}
            _choice("editor.each", goals, str(step.get("object", "")), self._object_of(step))
            self._target(step, panel)

    def _target(self, step: Table, panel: Panel | None) -> None:
        one = (
            next((one for one in panel.objects if one.name == step.get("object")), None) if panel is not None else None
        )
        if one is None or one.goal is None or step.get("other"):
            return
        key, goal = one.goal.key, one.goal
        if isinstance(goal, StateGoal):
            told = say("editor.target", unit="")
            _choice(told, {s: s for s in goal.states}, str(step.get(key, "")), self._putter(step, key), is_text=True)
        elif isinstance(goal, NumberGoal):
            told = say("editor.target", unit="rad" if one.value_is_angle else unit_of(one) or "")
            _number(told, step.get(key), self._putter(step, key), is_text=True)
        if one.confirm:
            _field("editor.confirm", step.get("confirm", ""), self._putter(step, "confirm"))

    def _conditions(self, number: int, step: Table, key: str) -> None:
        ui.html(say("editor.conditions"), sanitize=False, tag="p").classes("quiet")
        found = step.get(key, [])
        for k, one in enumerate(found if isinstance(found, list) else []):
            if isinstance(one, dict):
                with ui.element("div").classes("fields"):
                    self._condition(number, one, partial(self._drop, step, key, k))
        self._button("editor.add_condition", number, lambda: self._add_condition(step, key))

    def _condition(self, number: int, one: Table, drop: Callable[[], None]) -> None:
        panel = self._mirror.panel
        labels = {} if panel is None else {other.name: label_of(other) for other in panel.objects}
        relation = next((key for key in RELATIONS if key in one), "below")

        def put(name: str, relation: str, than: str) -> None:
            shown = next((other for other in panel.objects if other.name == name), None) if panel is not None else None
            for key in (*RELATIONS, "unit"):
                one.pop(key, None)
            one["object"] = name
            one[relation] = than if relation == "state" else _as_number(than)
            if relation != "state" and shown is not None and unit_of(shown):
                one["unit"] = unit_of(shown)
            self._tell()

        def changed() -> None:
            put(str(which.value or ""), str(how.value), str(than.value or ""))

        which = _choice("editor.object", labels, str(one.get("object", "")), lambda _: changed())
        how = _choice("editor.is", {key: say(f"editor.is.{key}") for key in RELATIONS}, relation, lambda _: changed())
        than = _field("editor.than", str(one.get(relation, "")), lambda _: changed())
        self._button("editor.remove_condition", number, drop)

    def _button(self, key: str, number: int, deed: Callable[[], None]) -> None:
        """Add a button of a step, whose number a screen reader tells with it."""
        label = f"{say(key)}, {say('editor.step', number=number + 1)}"
        button(say(key), deed, look="plain").props(f'aria-label="{attribute(label)}"')

    def _putter(self, table: Table, key: str) -> Callable[[Any], None]:
        def put(value: Any) -> None:
            if value in (None, ""):
                table.pop(key, None)
            else:
                table[key] = value
            self._tell()

        return put

    def _objects_of(self, step: Table) -> Callable[[Any], None]:
        return lambda names: self._putter(step, "objects")(list(names) or None)

    def _object_of(self, step: Table) -> Callable[[Any], None]:
        def put(name: Any) -> None:
            for key in (*TARGETS, "each_kind", "confirm"):
                step.pop(key, None)
            step["object"] = name
            self._tell(is_new_shape=True)

        return put

    def _kind_of(self, step: Table) -> Callable[[Any], None]:
        def put(kind: Any) -> None:
            for key in [key for key in step if key not in KEPT]:
                step.pop(key)
            step["kind"] = kind
            self._tell(is_new_shape=True)

        return put

    def _move(self, number: int, to: int) -> None:
        steps = self._steps()
        steps.insert(to, steps.pop(number))
        self._tell(is_new_shape=True)

    def _remove(self, number: int) -> None:
        self._steps().pop(number)
        self._tell(is_new_shape=True)

    def _add(self) -> None:
        taken = {str(step.get("name")) for step in self._steps() if isinstance(step, dict)}
        name = next(name for k in range(1, len(taken) + 2) if (name := f"step_{k}") not in taken)
        step = tomlkit.table()
        step.update({"kind": "inspect", "name": name})
        if "steps" not in self._document:
            self._document["steps"] = tomlkit.aot()
        self._steps().append(step)
        self._tell(is_new_shape=True)

    def _add_condition(self, step: Table, key: str) -> None:
        one = tomlkit.inline_table()
        one.update({"object": "", "below": 0.0})
        if key not in step:
            step[key] = tomlkit.array()
        step[key].append(one)
        self._tell(is_new_shape=True)

    def _drop(self, step: Table, key: str, number: int) -> None:
        step[key].pop(number)
        if not step[key]:
            step.pop(key)
        self._tell(is_new_shape=True)


def _calls(put: Callable[[Any], None]) -> Callable[[Any], None]:
    return lambda event: put(event.value)


def _field(key: str, value: Any, put: Callable[[Any], None]) -> Any:
    return ui.input(label=say(key), value=str(value), on_change=_calls(put)).props("outlined dense debounce=200")


def _number(key: str, value: Any, put: Callable[[Any], None], *, is_whole: bool = False, is_text: bool = False) -> Any:
    label = key if is_text else say(key)
    given = value if isinstance(value, int | float) and not isinstance(value, bool) else None
    number = ui.number(
        label=label,
        value=given,
        on_change=_calls(lambda found: put(None if found is None else int(found) if is_whole else float(found))),
    )
    return number.props("outlined dense debounce=200")


def _choice(key: str, options: dict[str, str], value: str, put: Callable[[Any], None], *, is_text: bool = False) -> Any:
    """Return a field with a list; a value that the list does not have is shown as empty, and stays in the file."""
    label, chosen = key if is_text else say(key), value if value in options else None
    return ui.select(options, value=chosen, label=label, on_change=_calls(put)).props("outlined dense options-dense")


def _as_number(text: str) -> float | str:
    """Return the number that a text says; the text itself if it says none, which the service then names as a fault."""
    try:
        return float(text)
    except ValueError:
        return text
