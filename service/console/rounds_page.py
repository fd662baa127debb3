"""Rounds: a calendar of what ran, what was missed and what comes next, and the rounds themselves."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from itertools import islice, takewhile
from typing import Any
from urllib.parse import quote

from nicegui import ui

from service.access.keys import Role
from service.console.mirror import Mirror
from service.console.page_frame import Place, attempt, button, clock, live, page_frame, picks, table
from service.console.texts import say, word
from service.console.values import attribute
from service.rounds.schedule import times_after

WEEKS = 3  # the last one, this one and the next one
AHEAD_S = 14 * 86_400.0
MOST_RUNS = 1000
MOST_TIMES = 5000  # of one round ahead: a fortnight of one every five minutes
MOST_LISTED = 4  # times of one round on one day; more are counted
RENEW_S = 30.0
LOOKS = {
    "succeeded": "good",
    "failed": "bad",
    "missed": "bad",
    "interrupted": "warn",
    "cancelled": "warn",
    "next": "quiet",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One run of a round in the calendar; `state` is that of the API, or `next`."""

    round: str
    due_s: float
    state: str
    why: str = ""


def install(place: Place) -> None:
    """Add the page at `/rounds`."""

    @ui.page("/rounds", title=f"{say('nav.rounds')} · {say('title')}")
    def rounds_page() -> None:
        mirror = place.mirror
        calendar = _Calendar(mirror)
        with page_frame(place, "rounds"):
            with ui.element("section").classes("card"):
                ui.html(say("rounds.calendar"), sanitize=False, tag="h2")
                live(ui.html("", sanitize=False), calendar.shown)
            with ui.element("section").classes("card"):
                ui.html(say("rounds.heading"), sanitize=False, tag="h2")
                listed = picks(ui.html("", sanitize=False).classes("stack"), calendar.remove, what="round")
                live(listed, lambda: round_table(mirror))
                if mirror.may(Role.MAINTAINER):
                    _Form(mirror)
        ui.timer(0.1, calendar.load, once=True)
        ui.timer(RENEW_S, calendar.load)


class _Calendar:
    """The runs of all rounds as one browser sees them."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._entries: list[Entry] = []
        self._html = ""

    async def load(self) -> None:
        """Ask for the runs, and work out the times that come."""
        found = await attempt(lambda: self._mirror.client.get("/v1/rounds"))
        if found is None:
            return
        now_s, entries = time.time(), list[Entry]()
        for one in found["rounds"]:
            name = one["name"]
            path = f"/v1/rounds/{name}/runs?limit={MOST_RUNS}"
            runs = await attempt(lambda path=path: self._mirror.client.get(path))  # type: ignore[misc]
            entries += [
                Entry(round=name, due_s=run["due_s"], state=run["state"], why=run["why"])
                for run in (runs or {"runs": []})["runs"]
            ]
            entries += await asyncio.to_thread(ahead, one, now_s)
        self._html = calendar_html(entries, now_s=now_s)

    async def remove(self, name: str) -> None:
        """Remove a round that the cell file does not define."""
        await attempt(lambda: self._mirror.client.fetch("DELETE", f"/v1/rounds/{name}"))
        self._mirror.hurry()
        await self.load()

    def shown(self) -> str:
        """Return the calendar as HTML."""
        return self._html


def ahead(one: dict[str, Any], now_s: float) -> list[Entry]:
    """Return the times of a round that come in the next fortnight."""
    coming = takewhile(lambda due_s: due_s <= now_s + AHEAD_S, times_after(one["cron"], one["zone"], now_s))
    return [Entry(round=one["name"], due_s=due_s, state="next") for due_s in islice(coming, MOST_TIMES)]


def calendar_html(entries: Iterable[Entry], *, now_s: float) -> str:
    """Return three weeks around now as HTML, a box for each day, in the time of the cell's machine."""
    today = datetime.fromtimestamp(now_s).date()
    first = today - timedelta(days=today.weekday() + 7)
    by_day: dict[date, list[Entry]] = {}
    for entry in entries:
        by_day.setdefault(datetime.fromtimestamp(entry.due_s).date(), []).append(entry)
    days = [first + timedelta(days=k) for k in range(7 * WEEKS)]
    return f'<ol class="calendar">{"".join(_day(day, by_day.get(day, []), today) for day in days)}</ol>'


def _day(day: date, entries: list[Entry], today: date) -> str:
    names = sorted({entry.round for entry in entries})
    lines = "".join(
        _lines(name, sorted((e for e in entries if e.round == name), key=lambda e: e.due_s)) for name in names
    )
    current = ' aria-current="date"' if day == today else ""
    look = "" if lines else ' class="bare"'
    told = say("rounds.day", weekday=say(f"weekday.{day.weekday()}"), day=day.isoformat()[5:])
    return f"<li{look}{current}><h3>{told}</h3>{lines}</li>"


def _lines(name: str, entries: list[Entry]) -> str:
    """Return the runs of a round on one day: each with its time, or their number where they are many."""
    if len(entries) <= MOST_LISTED:
        return "".join(_line(name, f"{datetime.fromtimestamp(one.due_s):%H:%M}", one.state, one.why) for one in entries)
    states = sorted({one.state for one in entries})
    return "".join(_line(name, f"{sum(e.state == state for e in entries)} ×", state, "") for state in states)


def _line(name: str, when: str, state: str, why: str) -> str:
    told = attribute(word("run", state))
    title = f' title="{attribute(why)}"' if why else ""
    return f'<p{title}><b>{when}</b> {attribute(name)} <span class="{LOOKS.get(state, "")}">{told}</span></p>'


def round_table(mirror: Mirror) -> str:
    """Return the rounds with what comes next, and a button to remove one that the cell file does not define."""
    rows = [_row(one, mirror) for one in mirror.said("rounds", {"rounds": []})["rounds"]]
    return table(
        ["round", "mission", "times", "next", "newest_run", "deeds"],
        rows,
        name=say("rounds.heading"),
        empty=say("rounds.none"),
    )


def _row(one: dict[str, Any], mirror: Mirror) -> str:
    following = clock(one["next_s"])
    if one["waiting_s"] is not None:
        following = say("rounds.waits", since=clock(one["waiting_s"]), why=one["waits_for"])
    newest, last = one["newest"], "–"
    if newest is not None:
        told = f"{clock(newest['due_s'])}: {word('run', newest['state'])}"
        last = f'<span class="{LOOKS.get(newest["state"], "")}">{attribute(told)}</span><br>'
        last += f'<span class="quiet">{attribute(newest["why"])}</span>'
    deed = f'<span class="quiet">{say("rounds.of_file")}</span>'
    if not one["is_of_file"]:
        deed = ""
        if mirror.may(Role.MAINTAINER):
            label = attribute(say("rounds.remove", name=one["name"]))
            deed = f'<button type="button" class="plain" data-round="{one["name"]}">{label}</button>'
    return (
        f"<tr><td><b>{attribute(one['name'])}</b></td><td>{attribute(one['mission'])}</td>"
        f'<td>{attribute(one["cron"])} <span class="quiet">{attribute(one["zone"])}</span></td>'
        f"<td>{attribute(following)}</td><td>{last}</td><td>{deed}</td></tr>"
    )


class _Form:
    """Adds a round, or replaces one of the same name."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        ui.html(say("rounds.add"), sanitize=False, tag="h3")
        with ui.element("div").classes("row search"):
            self._name = ui.input(label=say("rounds.name")).props("outlined dense maxlength=41")
            self._mission = ui.input(label=say("rounds.mission"), value="inspect").props("outlined dense maxlength=61")
            self._cron = ui.input(label=say("rounds.cron"), value="0 6 * * *").props("outlined dense maxlength=200")
            self._zone = ui.input(label=say("rounds.zone"), value="UTC").props("outlined dense maxlength=60")
            button(say("rounds.save"), self._save)
        ui.html(say("rounds.cron.says"), sanitize=False, tag="p").classes("quiet")

    async def _save(self) -> None:
        fields = {"name": self._name, "mission": self._mission, "cron": self._cron, "zone": self._zone}
        section = {key: str(one.value or "").strip() for key, one in fields.items()}
        path = f"/v1/rounds/{quote(section['name'] or '-', safe='')}"
        saved = await attempt(lambda: self._mirror.client.fetch("PUT", path, section))
        if saved is not None:
            self._name.set_value("")
            self._mirror.hurry()
