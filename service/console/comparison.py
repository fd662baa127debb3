"""The newest reading of each object beside that of last time, or of a day, a week or a month before, with both pictures."""

from __future__ import annotations

import math

from nicegui import ui

from hal.errors import CellError
from hal.panel import PanelObject
from service.console.mirror import Mirror
from service.console.page_frame import clock, live, picks, table
from service.console.texts import say
from service.console.trend_chart import INTERVAL_SIGMAS
from service.console.values import Reading, attribute, label_of, number, shown

DAY_S = 86_400.0
AGAINST_S: dict[str, float | None] = {"time": None, "day": DAY_S, "week": 7 * DAY_S, "month": 30 * DAY_S}
READ_AGAIN = 40  # so often may one task read an object
RENEWED_S = 5.0
COLUMNS = ["object", "newest_reading", "before", "change"]


class Comparison:
    """The table of one browser; it is asked for again while it is seen, because readings come."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._against = "time"
        self._html = ""
        choices = picks(ui.html("", sanitize=False).classes("row"), self._choose, what="against")
        choices.props(f'role=group aria-label="{say("compare.against")}"')
        live(choices, self._choices)
        ui.html(say("compare.says"), sanitize=False, tag="p").classes("quiet")
        live(ui.html("", sanitize=False).classes("long"), lambda: self._html)
        ui.timer(0.2, self._load, once=True)
        ui.timer(RENEWED_S, self._load)

    async def _choose(self, against: str) -> None:
        self._against = against
        await self._load()

    def _choices(self) -> str:
        return "".join(
            f'<button type="button" class="plain toggle" data-against="{one}" '
            f'aria-pressed="{"true" if one == self._against else "false"}">{say(f"compare.against.{one}")}</button>'
            for one in AGAINST_S
        )

    async def _load(self) -> None:
        panel, newest, against = self._mirror.panel, self._mirror.readings(), self._against
        objects = [one for one in panel.objects if one.name in newest] if panel is not None else []
        before = [await self._before(newest[one.name], against) for one in objects]
        if against == self._against:
            rows = [row_of(one, newest[one.name], old) for one, old in zip(objects, before, strict=True)]
            self._html = table(COLUMNS, rows, name=say("compare.heading"), empty=say("compare.none"))

    async def _before(self, newest: Reading, against: str) -> Reading | None:
        """Return the reading to compare with; None if there is none, or the service does not answer."""
        span_s = AGAINST_S[against]
        how = f"last={READ_AGAIN}" if span_s is None else f"last=1&until_s={newest['utc_s'] - span_s}"
        try:
            page = await self._mirror.client.get(f"/v1/history/{newest['object']}?{how}")
        except CellError:
            return None  # the banner of the page tells it
        return earlier(newest, page["readings"]) if span_s is None else next(iter(page["readings"]), None)


def earlier(newest: Reading, readings: list[Reading]) -> Reading | None:
    """Return the newest of these readings that another task made before; a task may read an object several times."""
    others = [row for row in readings if row["task"] != newest["task"] and row["id"] < newest["id"]]
    return max(others, key=lambda row: int(row["id"]), default=None)


def row_of(one: PanelObject, newest: Reading, before: Reading | None) -> str:
    """Return the row of one object as HTML."""
    is_clear, change = change_of(one, newest, before)
    told = f"<b>{attribute(change)}</b>" if is_clear else attribute(change)
    cells = (attribute(label_of(one)), _cell(one, newest), "–" if before is None else _cell(one, before), told)
    return f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def change_of(one: PanelObject, newest: Reading, before: Reading | None) -> tuple[bool, str]:
    """Return whether an object has surely changed, and the change in words."""
    if before is None:
        return False, "–"
    if "valid" not in (newest["quality"], before["quality"]) or newest["quality"] != before["quality"]:
        return False, say("compare.unclear")
    if None not in (newest["value"], before["value"]) and newest["state"] is None and before["state"] is None:
        return _difference(one, newest, before)
    is_same = shown(one, newest) == shown(one, before)
    return not is_same, say("compare.same" if is_same else "compare.changed")


def _difference(one: PanelObject, newest: Reading, before: Reading) -> tuple[bool, str]:
    difference = newest["value"] - before["value"]
    sigma = math.hypot(newest["sigma"] or 0.0, before["sigma"] or 0.0)
    told = number(one, abs(difference), {**newest, "sigma": sigma})
    return abs(difference) > INTERVAL_SIGMAS * sigma, ("+" if difference >= 0 else "−") + told


def _cell(one: PanelObject, reading: Reading) -> str:
    picture = ""
    if reading["crop_url"] is not None:
        told = say("object.crop", when=clock(reading["utc_s"]))
        picture = f'<div class="crops"><img src="/relay{attribute(reading["crop_url"])}" alt="{attribute(told)}"></div>'
    when = f'<span class="quiet">{attribute(clock(reading["utc_s"]))}</span>'
    return f"<b>{attribute(shown(one, reading))}</b> {when}{picture}"
