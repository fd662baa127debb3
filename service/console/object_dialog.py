"""One object: its newest reading, its history, and its work: read now, and set to a target in its own terms."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

from nicegui import ui

from hal.panel import NumberGoal, PanelObject, StateGoal
from service.access.keys import Role
from service.client import FINAL
from service.console.mirror import Mirror
from service.console.page_frame import attempt, button, clock
from service.console.texts import say, word
from service.console.values import (
    Reading,
    age,
    attribute,
    confidence,
    label_of,
    limits_for_people,
    number,
    shown,
    sigma,
    target_for_api,
)

POLL_S = 0.1
TREND_W, TREND_H = 480, 90


class ObjectDialog:
    """The dialog of one page; `show` opens it for an object."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._name = ""
        self._target: str | float | None = None
        self._dialog = ui.dialog().props("no-esc-dismiss")  # the Esc key is the stop
        with self._dialog, ui.card().classes("dialog"):
            self._facts = ui.html("", sanitize=False)
            self._work = ui.element("div")
            self._told = ui.html("", sanitize=False, tag="p").props("role=status")
            with ui.element("div").classes("row"):
                button(say("object.close"), self._dialog.close, look="plain")
        ui.timer(0.25, self._renew)

    @property
    def _object(self) -> PanelObject | None:
        panel = self._mirror.panel
        return next((one for one in panel.objects if one.name == self._name), None) if panel is not None else None

    async def show(self, name: str) -> None:
        """Open the dialog for the object of this name."""
        self._name = name
        if self._object is None:
            return
        self._told.set_content("")
        self._history_html = ""
        self._renew(even_if_closed=True)
        self._offer()
        self._dialog.open()
        await self._load_history()

    def _renew(self, *, even_if_closed: bool = False) -> None:
        one = self._object
        if one is None or not (self._dialog.value or even_if_closed):
            return
        reading, alarm = self._mirror.readings().get(one.name), self._mirror.alarms().get(one.name)
        content = _facts(one, reading, alarm) + self._history_html
        if content != self._facts.content:
            self._facts.set_content(content)

    async def _load_history(self) -> None:
        one = self._object
        if one is None:
            return
        page = await attempt(lambda: self._mirror.client.get(f"/v1/history/{one.name}?limit=1000"))
        if page is not None and self._name == one.name:
            self._history_html = history_html(one, page["readings"])
            self._renew()

    def _offer(self) -> None:
        one = self._object
        assert one is not None  # noqa: S101 - narrowing: `show` checked it
        self._work.clear()
        with self._work:
            if not self._mirror.may(Role.OPERATOR):
                ui.html(attribute(say("object.look_only", label=label_of(one))), sanitize=False, tag="p").classes(
                    "quiet"
                )
                return
            ui.html(attribute(say("object.read_says", label=label_of(one))), sanitize=False, tag="p").classes("quiet")
            with ui.element("div").classes("row"):
                button(say("object.read"), self._read)
                if one.goal is not None and not one.forbidden:
                    button(say("object.set"), self._ask_target, look="plain")
            if one.goal is None or one.forbidden:
                key = "object.read_only" if one.goal is None else "object.forbidden"
                ui.html(attribute(say(key, label=label_of(one))), sanitize=False, tag="p").classes("quiet")

    def _ask_target(self) -> None:
        one = self._object
        if one is None or one.goal is None or one.forbidden:
            return
        goal = one.goal
        self._work.clear()
        with self._work:
            if isinstance(goal, StateGoal) and not goal.states[1:]:
                self._confirm(goal.usual)
                return
            field = _target_field(goal)
            with ui.element("div").classes("row").style("margin-top:.6rem"):
                button(say("object.set"), lambda: self._take(goal, field.value))
                button(say("object.no"), self._offer, look="plain")

    def _take(self, goal: StateGoal | NumberGoal, given: Any) -> None:
        if isinstance(goal, NumberGoal):
            low, high, _unit = limits_for_people(goal)
            try:
                wanted = float(given)
            except (TypeError, ValueError):
                wanted = float("nan")
            if not low <= wanted <= high:
                self._told.set_content(attribute(say("object.bad_number", low=f"{low:g}", high=f"{high:g}")))
                return
            self._confirm(target_for_api(goal, wanted))
        else:
            self._confirm(str(given))

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
        active = self._mirror.active
        if active is not None:
            self._told.set_content(attribute(say("object.busy", verb=word("verb", active["verb"]))))
            return
        self._offer()
        client, label = self._mirror.client, label_of(one)
        task = await attempt(lambda: client.post(path, body))
        while task is not None and task["state"] not in FINAL:
            step = task["step"] or say("task.queued")
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


def _target_field(goal: StateGoal | NumberGoal) -> Any:
    """Return a field for a target: the states to choose from, or a number with its limits and unit."""
    if isinstance(goal, StateGoal):
        return ui.select(list(goal.states), value=goal.usual or goal.states[0], label=say("object.target")).props(
            "outlined"
        )
    low, high, unit = limits_for_people(goal)
    label = say("object.target_number", low=f"{low:g}", high=f"{high:g}", unit=unit)
    return ui.number(label=label, value=None, min=low, max=high).props("outlined")


def _facts(one: PanelObject, reading: Reading | None, alarm: dict[str, Any] | None) -> str:
    parts = [f"<h2>{attribute(label_of(one))} <span class='quiet'>{attribute(one.kind.replace('_', ' '))}</span></h2>"]
    value = shown(one, reading)
    parts.append(f'<p style="font-size:1.7rem;margin:.2rem 0"><b id="dialog-value">{attribute(value)}</b> ')
    parts.append(
        f'<span class="quiet">{attribute(sigma(one, reading))} {confidence(reading)} {age(reading)}</span></p>'
    )
    if reading is not None:
        if reading["quality"] != "valid":
            parts.append(f'<p class="warn">{attribute(say("object.refused", cause=reading["cause"]))}</p>')
        where = say(
            "object.from", verb=word("verb", reading["verb"]), phase=reading["phase"] or clock(reading["utc_s"])
        )
        parts.append(f'<p class="quiet">{attribute(where)}</p>')
    if alarm is not None:
        told = say("object.alarm", says=alarm["says"], what_to_do=alarm["what_to_do"])
        parts.append(f'<p class="bad">{attribute(told)}</p>')
    return "".join(parts)


def history_html(one: PanelObject, readings: list[Reading]) -> str:
    """Return the trend of the values, and the last pictures."""
    if not readings:
        return f'<p class="quiet">{say("object.no_history")}</p>'
    crops = [
        f'<img src="/relay{attribute(row["crop_url"])}" alt="{attribute(say("object.crop", when=clock(row["utc_s"])))}" '
        f'title="{attribute(clock(row["utc_s"]))}: {attribute(shown(one, row))}">'
        for row in readings[:-7:-1]
        if row["crop_url"]
    ]
    pictures = f'<h2>{say("object.pictures")}</h2><div class="crops">{"".join(crops)}</div>' if crops else ""
    more = f'<p><a href="/history?object={one.name}">{say("history.more")}</a></p>'
    return f"<h2>{say('object.history')}</h2>{_trend(one, readings)}{more}{pictures}"


def _trend(one: PanelObject, readings: list[Reading]) -> str:
    """Return values over time as a line, states as a list of changes."""
    valued = [row for row in readings if row["value"] is not None and row["state"] is None]
    if len(valued) < 2:
        changes = [row for k, row in enumerate(readings) if k == 0 or shown(one, row) != shown(one, readings[k - 1])]
        lines = "".join(
            f"<li>{attribute(clock(row['utc_s']))} · {attribute(shown(one, row))}</li>" for row in changes[:-9:-1]
        )
        return f"<ul>{lines}</ul>"
    times, values = [row["utc_s"] for row in valued], [row["value"] for row in valued]
    low, high, since, span = min(values), max(values), times[0], max(times[-1] - times[0], 1.0)
    height = max(high - low, 0.05 * (one.full_scale or 0.0), 1e-9)  # the noise of a steady value stays a flat line
    top = (high + low + height) / 2
    points = " ".join(
        f"{TREND_W * (t - since) / span:.1f},{6 + (TREND_H - 12) * (top - v) / height:.1f}"
        for t, v in zip(times, values, strict=True)
    )
    label = say("object.trend", count=len(valued), first=clock(times[0]), last=clock(times[-1]))
    ends = f"{attribute(number(one, low, valued[0]))} – {attribute(number(one, high, valued[0]))}"
    return (
        f'<svg viewBox="0 0 {TREND_W} {TREND_H}" role="img" aria-label="{attribute(label)}" width="100%">'
        f'<polyline class="trend" points="{points}"/></svg><p class="quiet">{ends} · {attribute(label)}</p>'
    )
