"""What was read over hours or years: values of several objects with their limits, pictures, and reports to search."""

from __future__ import annotations

import time
from datetime import datetime
from typing import Any

from nicegui import ui

from hal.panel import PanelObject
from service.console.comparison import Comparison
from service.console.mirror import Mirror
from service.console.missions_page import REPORT_COLUMNS, began_s, report_row
from service.console.page_frame import Place, attempt, button, clock, live, page_frame, picks, table
from service.console.texts import say, word
from service.console.trend_chart import SERIES_PER_TREND, Trend, of_buckets, of_readings, options_of
from service.console.values import Reading, attribute, label_of, shown, sigma

HOUR_S, DAY_S = 3600.0, 86_400.0
SPANS_S = {"hour": HOUR_S, "day": DAY_S, "week": 7 * DAY_S, "month": 31 * DAY_S, "year": 366 * DAY_S, "all": None}
MOST_SINGLE = 1000  # more readings than that are shown as spans of time
BUCKETS = 400
MOST_ROWS = 50
OUTCOMES = ("any", "succeeded", "failed")


def install(place: Place) -> None:
    """Add the page at `/history`; `?object=pressure` begins with that object."""

    @ui.page("/history", title=f"{say('nav.history')} · {say('title')}")
    def history_page(object: str = "") -> None:
        mirror = place.mirror
        with page_frame(place, "history"):
            with ui.element("section").classes("card"):
                ui.html(say("history.heading"), sanitize=False, tag="h2")
                _Trends(mirror, object)
            with ui.element("section").classes("card"):
                ui.html(say("compare.heading"), sanitize=False, tag="h2")
                Comparison(mirror)
            with ui.element("section").classes("card"):
                ui.html(say("history.reports"), sanitize=False, tag="h2")
                search = _Search(mirror)
                live(ui.html("", sanitize=False).classes("long"), search.found)


class _Trends:
    """The chart of one browser: which objects, which span, and the picture that was clicked."""

    def __init__(self, mirror: Mirror, first: str) -> None:
        self._mirror = mirror
        self._names: list[str] = [first] if first else []
        self._span: tuple[float | None, float | None] = (None, None)
        self._which = "all"
        self._trends: list[Trend] = []
        self._rows: list[tuple[PanelObject, Reading]] = []
        objects = picks(ui.html("", sanitize=False).classes("row"), self._toggle)
        objects.props(f'role=group aria-label="{say("history.objects")}"')
        live(objects, self._objects)
        spans = picks(ui.html("", sanitize=False).classes("row"), self._choose, what="span").style("margin:.6rem 0")
        spans.props(f'role=group aria-label="{say("history.span")}"')
        live(spans, self._spans)
        self._line = ui.html("", sanitize=False, tag="p").classes("quiet").props("role=status")
        with ui.element("div").props(f'role="img" aria-label="{attribute(say("history.chart"))}"'):
            self._chart = ui.echart({}, on_point_click=self._clicked).style("height:24rem;width:100%")
        self._picture = ui.html("", sanitize=False).props("aria-live=polite")
        live(ui.html("", sanitize=False).classes("long"), self._table)
        ui.timer(0.1, self._begin, once=True)

    async def _begin(self) -> None:
        panel, readings = self._mirror.panel, self._mirror.readings()
        if not self._names and panel is not None:
            valued = [one.name for one in panel.objects if (readings.get(one.name) or {}).get("value") is not None]
            self._names = (valued or [one.name for one in panel.objects])[:1]
        await self._load()

    async def _toggle(self, name: str) -> None:
        self._names = [one for one in self._names if one != name] if name in self._names else [*self._names, name]
        await self._load()

    async def _choose(self, span: str) -> None:
        length_s, self._which = SPANS_S[span], span
        self._span = (None, None) if length_s is None else (time.time() - length_s, None)
        await self._load()

    async def _clicked(self, event: Any) -> None:
        """Show the picture of a reading, or the readings of a span of time."""
        trend = self._trends[event.series_index // SERIES_PER_TREND]
        point = trend.points[event.data_index]
        if point.until_s > point.since_s:
            self._span, self._which = (point.since_s, point.until_s), ""
            await self._load()
            return
        told = say(
            "history.point", label=label_of(trend.panel_object), when=clock(point.at_s), value=f"{point.value:.4g}"
        )
        picture = say("history.no_picture")
        if point.crop_url is not None:
            picture = f'<img src="/relay{attribute(point.crop_url)}" alt="{attribute(told)}" style="max-height:16rem">'
        self._picture.set_content(f"<p>{attribute(told)}</p>{picture}")

    async def _load(self) -> None:
        """Ask for the readings of the chosen objects, down-sampled where there are many."""
        panel = self._mirror.panel
        chosen = [one for one in panel.objects if one.name in self._names] if panel is not None else []
        trends, rows, is_coarse = [], [], False
        for one in chosen:
            page = await attempt(lambda name=one.name: self._ask(name, f"limit={MOST_SINGLE}"))  # type: ignore[misc]
            if page is None:
                continue
            if page["next_after"] is not None:
                is_coarse = True
                page = await attempt(lambda name=one.name: self._ask(name, f"buckets={BUCKETS}"))  # type: ignore[misc]
                trends.append(of_buckets(one, page["buckets"] if page is not None else []))
                continue
            trends.append(of_readings(one, page["readings"]))
            rows += [(one, row) for row in page["readings"]]
        self._trends, self._rows = trends, sorted(rows, key=lambda pair: -pair[1]["utc_s"])[:MOST_ROWS]
        self._picture.set_content("")
        self._line.set_content(say("history.coarse" if is_coarse else "history.fine"))
        self._chart.options.clear()
        self._chart.options.update(options_of(trends))
        self._chart.update()

    async def _ask(self, name: str, how: str) -> Any:
        since_s, until_s = self._span
        limits = "".join(
            f"&{key}={at_s}" for key, at_s in (("since_s", since_s), ("until_s", until_s)) if at_s is not None
        )
        return await self._mirror.client.get(f"/v1/history/{name}?{how}{limits}")

    def _objects(self) -> str:
        panel = self._mirror.panel
        return "".join(
            f'<button type="button" class="plain toggle" data-object="{one.name}" '
            f'aria-pressed="{"true" if one.name in self._names else "false"}">{attribute(label_of(one))}</button>'
            for one in (panel.objects if panel is not None else ())
        )

    def _spans(self) -> str:
        return "".join(
            f'<button type="button" class="plain toggle" data-span="{span}" '
            f'aria-pressed="{"true" if span == self._which else "false"}">{say(f"history.span.{span}")}</button>'
            for span in SPANS_S
        )

    def _table(self) -> str:
        rows = [
            f"<tr><td>{clock(row['utc_s'])}</td><td>{attribute(label_of(one))}</td><td><b>{attribute(shown(one, row))}</b> "
            f'<span class="quiet">{attribute(row["cause"] or sigma(one, row))}</span></td>'
            f"<td>{attribute(word('verb', row['verb']))}</td><td>{_picture_link(row)}</td></tr>"
            for one, row in self._rows
        ]
        columns = ["read", "object", "value", "task", "picture"]
        return table(columns, rows, name=say("history.readings"), empty=say("history.none"))


def _picture_link(row: Reading) -> str:
    if row["crop_url"] is None:
        return "–"
    return f'<a href="/relay{attribute(row["crop_url"])}" target="_blank" rel="noopener">{say("history.picture")}</a>'


class _Search:
    """Reports of missions by object, outcome and date."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        with ui.element("div").classes("row search"):
            self._object = ui.input(label=say("history.search.object")).props("outlined dense")
            outcomes = {one: say(f"history.outcome.{one}") for one in OUTCOMES}
            self._outcome = ui.select(outcomes, value="any", label=say("history.search.outcome")).props(
                "outlined dense"
            )
            self._since = ui.input(label=say("history.search.since")).props("outlined dense type=date stack-label")
            self._until = ui.input(label=say("history.search.until")).props("outlined dense type=date stack-label")
            button(say("history.search.clear"), self._clear, look="plain")

    def _clear(self) -> None:
        for field in (self._object, self._since, self._until):
            field.set_value("")
        self._outcome.set_value("any")

    def found(self) -> str:
        """Return the reports that fit, newest first."""
        missions = self._mirror.said("missions", {"missions": []})["missions"]
        labels = (
            {one.name: label_of(one) for one in self._mirror.panel.objects} if self._mirror.panel is not None else {}
        )
        fitting = [
            mission
            for mission in missions
            if fits(
                mission,
                labels=labels,
                wanted=str(self._object.value or ""),
                outcome=str(self._outcome.value),
                since=str(self._since.value or ""),
                until=str(self._until.value or ""),
            )
        ]
        line = say("history.found", found=len(fitting), all=len(missions))
        rows = [report_row(mission) for mission in fitting[:MOST_ROWS]]
        return f'<p class="quiet">{line}</p>' + table(
            REPORT_COLUMNS[:-1], rows, name=say("history.reports"), empty=say("history.no_reports")
        )


def fits(mission: dict[str, Any], *, labels: dict[str, str], wanted: str, outcome: str, since: str, until: str) -> bool:
    """Return whether a mission read or worked an object like `wanted`, ended so, and began on these days."""
    text = wanted.strip().lower()
    if text and not any(text in name or text in labels.get(name, "").lower() for name in mission["objects"]):
        return False
    if outcome != "any" and mission["succeeded"] is not (outcome == "succeeded"):
        return False
    began = began_s(mission)
    day = "" if began is None else datetime.fromtimestamp(began).date().isoformat()
    return (not since or (day != "" and day >= since)) and (not until or (day != "" and day <= until))
