"""One object: its newest reading, its history, and its work: read now, set to a target in its own terms, set its limits."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

from nicegui import ui

from hal.panel import NumberGoal, PanelObject, StateGoal
from service.access.keys import Role
from service.client import FINAL
from service.console.limits_form import LimitsForm
from service.console.mirror import Mirror
from service.console.mission_words import did
from service.console.object_facts import facts_html, history_html
from service.console.page_frame import attempt, button, open_dialog
from service.console.service_form import ServiceForm
from service.console.teach_page import PATH as TEACH
from service.console.texts import say, word
from service.console.values import attribute, label_of, limits_for_people, number, shown, target_for_api

POLL_S = 0.1
RENEW_S = 0.05
DAY_S = 86_400.0
SPANS_S = (None, 31 * DAY_S, DAY_S, 3600.0, 600.0)  # the longest whose readings come in one page is shown


class ObjectDialog:
    """The dialog of one page; `show` opens it for an object."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._name = ""
        self._version = -1
        self._dialog = ui.dialog().props("no-esc-dismiss")  # the Esc key is the stop
        with self._dialog, ui.card().classes("dialog"):
            self._facts = ui.html("", sanitize=False)
            self._work = ui.element("div")
            self._told = ui.html("", sanitize=False, tag="p").props("role=status")
            self._limits = LimitsForm(mirror)
            self._service = ServiceForm(mirror)
            self._history = ui.html("", sanitize=False)
            with ui.element("div").classes("row end"):
                button(say("object.close"), self._dialog.close, look="plain")
        ui.timer(RENEW_S, self._renew)

    @property
    def _object(self) -> PanelObject | None:
        panel = self._mirror.panel
        return next((one for one in panel.objects if one.name == self._name), None) if panel is not None else None

    async def show(self, name: str) -> None:
        """Open the dialog for the object of this name."""
        self._name = name
        one = self._object
        if one is None:
            return
        self._told.set_content("")
        self._history.set_content("")
        self._version = -1
        self._renew(even_if_closed=True)
        self._offer()
        self._limits.show(one)
        open_dialog(self._dialog, label_of(one))
        await self._service.show(one)
        await self._load_history()

    def _renew(self, *, even_if_closed: bool = False) -> None:
        if not (self._dialog.value or even_if_closed) or self._version == self._mirror.version:
            return
        self._version = self._mirror.version
        one = self._object
        if one is None:
            return
        content = facts_html(one, self._mirror.readings().get(one.name), self._mirror.alarms().get(one.name))
        if content != self._facts.content:
            self._facts.set_content(content)

    async def _load_history(self) -> None:
        one = self._object
        if one is None:
            return
        newest = self._mirror.readings().get(one.name)
        for span_s in SPANS_S:
            since = "" if span_s is None or newest is None else f"&since_s={newest['utc_s'] - span_s}"
            path = f"/v1/history/{one.name}?limit=1000{since}"
            page = await attempt(partial(self._mirror.client.get, path))
            if page is None or self._name != one.name:
                return
            if page["next_after"] is None:
                break
        self._history.set_content(history_html(one, page["readings"]))

    def _offer(self) -> None:
        one = self._object
        assert one is not None  # noqa: S101 - narrowing: `show` checked it
        self._work.clear()
        with self._work:
            if not self._mirror.may(Role.OPERATOR):
                _line(say("object.look_only", label=label_of(one)))
                return
            with ui.element("div").classes("row work"):
                button(say("object.read"), self._read)
                if one.goal is not None and not one.forbidden:
                    self._offer_targets(one, one.goal)
                if self._mirror.may(Role.MAINTAINER):
                    button(say("object.teach"), partial(ui.navigate.to, TEACH), look="plain")
            _line(say("object.read_says", label=label_of(one)))
            if one.goal is None or one.forbidden:
                _line(say("object.read_only" if one.goal is None else "object.forbidden", label=label_of(one)))

    def _offer_targets(self, one: PanelObject, goal: StateGoal | NumberGoal) -> None:
        """Offer a button for each state that it can be set to, or a field for a number."""
        if isinstance(goal, NumberGoal):
            low, high, unit = limits_for_people(goal)
            label = say("object.target_number", low=f"{low:g}", high=f"{high:g}", unit=unit)
            field = ui.number(label=label, value=None, min=low, max=high).props("outlined dense").classes("target")
            field.on("keydown.enter", lambda: self._take(goal, field.value))
            button(say("object.set"), lambda: self._take(goal, field.value), look="plain")
            return
        now = shown(one, self._mirror.readings().get(one.name))
        states = [state for state in goal.states if state != now] if goal.states[1:] else [goal.usual]
        for state in states:
            key = "object.set_to" if goal.states[1:] else "object.set_once"
            button(say(key, target=state), partial(self._confirm, state), look="plain")

    def _take(self, goal: NumberGoal, given: Any) -> None:
        low, high, _unit = limits_for_people(goal)
        try:
            wanted = float(given)
        except (TypeError, ValueError):
            wanted = float("nan")
        if not low <= wanted <= high:
            self._told.set_content(attribute(say("object.bad_number", low=f"{low:g}", high=f"{high:g}")))
            return
        self._confirm(target_for_api(goal, wanted))

    def _confirm(self, target: str | float | None) -> None:
        """Say what will move, and ask."""
        one = self._object
        assert one is not None  # noqa: S101 - narrowing: it was open
        assert one.goal is not None  # noqa: S101 - narrowing: only then a target was asked for
        keeps_state = isinstance(one.goal, NumberGoal) or len(one.goal.states) > 1
        words = (
            number(one, target, {"unit": getattr(one.goal, "unit", "")}) if isinstance(target, float) else str(target)
        )
        now = shown(one, self._mirror.readings().get(one.name))
        key = "object.ask" if keeps_state else "object.ask_once"
        self._told.set_content("")
        self._work.clear()
        with self._work:
            ui.html(attribute(say(key, label=label_of(one), now=now, target=words)), sanitize=False, tag="p").props(
                "role=alert"
            )
            body = {"object": one.name} if not keeps_state else {"object": one.name, one.goal.key: target}
            again = None
            if one.confirm:
                again = ui.input(label=say("object.name_again", label=label_of(one), name=one.name)).props("outlined")

            async def work() -> None:
                named = {} if again is None else {"confirm": str(again.value or "-")}
                await self._do("/v1/manipulate", {**body, **named})

            with ui.element("div").classes("row"):
                button(say("object.yes"), work, look="do danger")
                button(say("object.no"), self._offer, look="plain")

    async def _read(self) -> None:
        await self._do("/v1/inspect", {"objects": [self._name]})

    async def _do(self, path: str, body: dict[str, Any]) -> None:
        """Start a task and follow it in the dialog; the newest reading comes with the history."""
        one = self._object
        if one is None:
            return
        await self._mirror.ask_now("tasks")  # a task that ended a moment ago must refuse nothing
        active = self._mirror.active
        if active is not None:
            self._told.set_content(attribute(say("object.busy", verb=word("verb", active["verb"]))))
            return
        self._offer()
        client, label = self._mirror.client, label_of(one)
        task = await attempt(lambda: client.post(path, body))
        while task is not None and task["state"] not in FINAL:
            step = did(task["step"], "", self._mirror.panel) if task["step"] else say("task.queued")
            self._told.set_content(attribute(say("object.working", label=label, step=step)))
            await asyncio.sleep(POLL_S)
            task = await attempt(partial(client.get, f"/v1/tasks/{task['id']}"))
        if task is None:
            return
        self._mirror.hurry()
        await self._load_history()
        if task["state"] == "succeeded":
            newest = {one["object"]: one for one in (await client.get("/v1/history"))["newest"]}.get(one.name)
            self._told.set_content(attribute(say("object.done", label=label, value=shown(one, newest))))
            return
        problem = task["problem"] or {"detail": word("state", task["state"]), "hint": ""}
        told = f"{say('task.failed', label=label, what=problem['detail'])} {say('try', hint=problem['hint'])}"
        self._told.set_content(attribute(told))


def _line(text: str) -> None:
    ui.html(attribute(text), sanitize=False, tag="p").classes("quiet")
