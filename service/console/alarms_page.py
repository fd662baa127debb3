"""The alarms, those that need a person first: acknowledge, shelve, take out of service."""

from __future__ import annotations

import time
from typing import Any

from nicegui import ui

from service.access.keys import Role
from service.console.mirror import Mirror
from service.console.mission_words import name_of
from service.console.page_frame import Place, attempt, button, clock, live, open_dialog, page_frame, picks, table
from service.console.texts import say, word
from service.console.values import attribute

HOUR_S = 3600.0
SHELVED_FOR_H = (1, 8, 24, 7 * 24)
LOOKS = {"urgent": "bad", "high": "bad", "medium": "warn", "low": ""}
DEEDS = {
    "unacknowledged": ("acknowledge", "comment", "shelve", "out-of-service"),
    "returned-unacknowledged": ("acknowledge", "comment", "shelve", "out-of-service"),
    "acknowledged": ("comment", "shelve", "out-of-service"),
    "shelved": ("unshelve", "comment", "out-of-service"),
    "out-of-service": ("in-service", "comment"),
}
MAINTAINERS = ("out-of-service", "in-service")
ASKS_WHY = ("comment", "shelve", "out-of-service")


def install(place: Place) -> None:
    """Add the page at `/alarms`."""

    @ui.page("/alarms", title=f"{say('nav.alarms')} · {say('title')}")
    def alarms_page() -> None:
        mirror = place.mirror
        with page_frame(place, "alarms"):
            with ui.element("section").classes("card"):
                ui.html(say("alarms.heading"), sanitize=False, tag="h2")
                desk = _Desk(mirror)
                listed = ui.html("", sanitize=False).classes("stack")
                live(picks(listed, desk.do, what="deed"), lambda: alarm_table(mirror), of=mirror)
            with ui.element("section").classes("card"):
                ui.html(say("alarms.doubts"), sanitize=False, tag="h2")
                ui.html(say("alarms.doubts.says"), sanitize=False, tag="p").classes("quiet")
                live(ui.html("", sanitize=False).classes("told"), lambda: _doubts(mirror), of=mirror)


def alarm_table(mirror: Mirror) -> str:
    """Return all alarms as a table, with a button for each thing that can be done about it."""
    rows = [_row(alarm, mirror) for alarm in mirror.said("alarms", {"alarms": []})["alarms"]]
    columns = ["priority", "object", "what", "state", "since", "last", "deeds"]
    return table(columns, rows, name=say("alarms.heading"), empty=say("alarms.none"))


def _row(alarm: dict[str, Any], mirror: Mirror) -> str:
    label = name_of(mirror.panel, alarm["object"])
    state = word("alarm", alarm["state"])
    if alarm["shelved_until_s"] is not None:
        state += f" {say('alarms.until', when=clock(alarm['shelved_until_s']))}"
    holds = say("alarms.holds" if alarm["is_active"] else "alarms.gone")
    buttons = "".join(
        f'<button type="button" class="plain" data-deed="{deed} {attribute(alarm["id"])}" '
        f'aria-label="{attribute(say(f"alarms.do.{deed}"))} {attribute(label)} {attribute(alarm["kind"])}">'
        f"{attribute(say(f'alarms.do.{deed}'))}</button> "
        for deed in DEEDS.get(alarm["state"], ())
        if mirror.may(Role.MAINTAINER if deed in MAINTAINERS else Role.OPERATOR)
    )
    is_told = alarm["reason"] in ("", alarm["says"])
    last = alarm["by"] if is_told else say("alarms.by", by=alarm["by"], reason=alarm["reason"])
    return (
        f'<tr><td><span class="chip {LOOKS[alarm["priority"]]}">{attribute(alarm["priority"])}</span></td>'
        f"<td><b>{attribute(label)}</b></td><td>{attribute(alarm['says'])}<br>"
        f'<span class="quiet">{attribute(alarm["what_to_do"])}</span></td>'
        f'<td>{attribute(state)}<br><span class="quiet">{holds}</span></td>'
        f'<td data-head="{attribute(say("column.since"))}">{clock(alarm["raised_s"])}</td>'
        f'<td data-head="{attribute(say("column.last"))}">{attribute(last)}</td><td class="deeds">{buttons}</td></tr>'
    )


def _doubts(mirror: Mirror) -> str:
    doubts = mirror.said("alarms", {"straddled": []})["straddled"]
    return (
        "".join(f"<p>{attribute(one['says'])}</p>" for one in doubts)
        or f'<p class="quiet">{say("alarms.doubts.none")}</p>'
    )


class _Desk:
    """What one browser does about alarms; a reason is asked for where the service wants one."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._you = you_field(mirror)
        self._dialog = ui.dialog().props("no-esc-dismiss")  # the Esc key is the stop
        with self._dialog, ui.card().classes("dialog"):
            self._asked = ui.element("div")
            self._told = ui.html("", sanitize=False, tag="p").classes("bad").props("role=status")

    async def do(self, what: str) -> None:
        """Do what a button says, such as `acknowledge pressure.high`, or ask for the reason first."""
        deed, _, alarm = what.partition(" ")
        if deed not in ASKS_WHY:
            await self._send(deed, alarm, {})
            return
        question = say(f"alarms.ask.{deed}", label=name_of(self._mirror.panel, alarm.partition(".")[0]))
        self._told.set_content("")
        self._asked.clear()
        with self._asked:
            ui.html(attribute(question), sanitize=False, tag="p")
            hours = _hours() if deed == "shelve" else None
            reason = ui.input(label=say("alarms.reason")).props("outlined maxlength=500")

            async def go() -> None:
                why = str(reason.value or "").strip()
                if not why:
                    self._told.set_content(say("alarms.reason.missing"))
                    return
                until = {} if hours is None else {"until_s": time.time() + HOUR_S * float(hours.value)}
                await self._send(deed, alarm, {"reason": why, **until})
                self._dialog.close()

            with ui.element("div").classes("row").style("margin-top:.6rem"):
                button(say(f"alarms.confirm.{deed}"), go)
                button(say("object.no"), self._dialog.close, look="plain")
        open_dialog(self._dialog, question)

    async def _send(self, deed: str, alarm: str, body: dict[str, Any]) -> None:
        who = str(self._you.value or "").strip()
        if not who:
            ui.notify(say("alarms.you.missing"), type="warning")
            return
        await attempt(lambda: self._mirror.client.post(f"/v1/alarms/{alarm}/{deed}", {"by": who, **body}))
        self._mirror.hurry()


def you_field(mirror: Mirror) -> Any:
    """Return the field for the name under which something is recorded; who is logged in has a name, and gives none."""
    field = ui.input(label=say("alarms.you"), value=mirror.person.name).props("outlined dense maxlength=80")
    field.set_visibility(mirror.person.name is None)
    return field.style("max-width:20rem")


def _hours() -> Any:
    """Return a field for how long an alarm is shelved, in hours."""
    told = {
        hours: say("alarms.hours", hours=hours) if hours <= 24 else say("alarms.days", days=hours // 24)
        for hours in SHELVED_FOR_H
    }
    return (
        ui.select(told, value=SHELVED_FOR_H[1], label=say("alarms.for")).props("outlined").style("margin-bottom:.6rem")
    )
