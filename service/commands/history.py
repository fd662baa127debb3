"""`panelwright history`: shows the readings of one object over time, as a table, a CSV file or a plot."""

from __future__ import annotations

import re
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlencode

import typer
from rich.markup import escape
from rich.table import Table

from hal.errors import InvalidRequest
from service.client import Client
from service.commands.common import Url, UrlDefault, client_of, console

SPAN = re.compile(r"(\d+(?:\.\d+)?)([smhdw])")
SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
SPANS = 200  # of a plot
INK, SOFT, RED = "#1c2733", "#9fb3c8", "#c0392b"


def history(
    name: Annotated[str, typer.Argument(metavar="OBJECT", help="Object of the panel file.")],
    *,
    since: Annotated[str, typer.Option(help="How far back: a number and s, m, h, d or w, such as 7d.")] = "7d",
    last: Annotated[int, typer.Option(min=1, max=1000, help="Number of readings in the table, the newest ones.")] = 30,
    csv: Annotated[Path | None, typer.Option("--csv", help="Write all readings of that time to this CSV file.")] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the trend into this PNG file.")] = None,
    folder: Annotated[
        Path | None, typer.Option("--from", help="Ask a folder that `site collect` has filled, instead of a service.")
    ] = None,
    cell: Annotated[str | None, typer.Option("--of", help="With --from: only this cell.")] = None,
    url: Url = UrlDefault,
) -> None:
    """Show the readings of one object from the history of a running service, or of a site; times are UTC."""
    if folder is not None:
        history_of_site(folder, name, since=since, last=last, csv=csv, plot=plot, cell=cell)
        return
    client, since_s = client_of(url), max(0.0, time.time() - seconds_of(since))
    if csv is not None:
        query = urlencode({"object": name, "since_s": f"{since_s:.3f}"})
        csv.write_bytes(client.fetch("GET", f"/v1/history/export?{query}"))
        console.print(f"readings: {csv}", markup=False)
    readings = _readings(client, name, since_s)
    if plot is not None:
        trend = client.get(f"/v1/history/{name}?since_s={since_s:.3f}&buckets={SPANS}")["buckets"]
        plot.write_bytes(drawn(name, trend, unit=readings[-1]["unit"] if readings else ""))
        console.print(f"trend: {plot}", markup=False)
    if not readings:
        console.print(f"no reading of {name} since {since} ago", style="yellow")
        return
    console.print(_table(readings[-last:]))


def seconds_of(text: str) -> float:
    """Return a span such as `7d` or `90m` in seconds.

    Raises:
        InvalidRequest: the text is not a number with s, m, h, d or w.
    """
    found = SPAN.fullmatch(text.strip())
    if found is None:
        raise InvalidRequest(f"{text!r} is no span of time", hint="a number and s, m, h, d or w, such as 7d or 90m")
    return float(found[1]) * SECONDS[found[2]]


def _readings(client: Client, name: str, since_s: float) -> list[dict[str, Any]]:
    """Return all readings since then, page by page."""
    found: list[dict[str, Any]] = []
    after: int | None = 0
    while after is not None:
        page = client.get(f"/v1/history/{name}?since_s={since_s:.3f}&after={after}&limit=1000")
        found += page["readings"]
        after = page["next_after"]
    return found


def history_of_site(
    folder: Path, name: str, *, since: str, last: int, csv: Path | None, plot: Path | None, cell: str | None
) -> None:
    """Show the readings of one object in all cells of a folder, or in one."""
    from csv import DictWriter

    from service.site.ask import readings_of, trends_of

    now_s = time.time()
    since_s = max(0.0, now_s - seconds_of(since))
    readings = readings_of(folder, name, since_s=since_s, cell=cell)
    if not readings:
        console.print(f"no reading of {name} since {since} ago in {folder}", style="yellow")
        return
    if csv is not None:
        with csv.open("w", newline="", encoding="utf-8") as file:
            writer = DictWriter(file, fieldnames=list(readings[0]))
            writer.writeheader()
            writer.writerows(readings)
        console.print(f"readings: {csv}", markup=False)
    if plot is not None:
        trends = trends_of(folder, name, since_s=since_s, until_s=now_s, buckets=SPANS, cell=cell)
        plot.write_bytes(drawn_of_cells(name, trends, unit=readings[-1]["unit"]))
        console.print(f"trend: {plot}", markup=False)
    console.print(_table(readings[-last:], has_cells=True))


def _table(readings: list[dict[str, Any]], *, has_cells: bool = False) -> Table:
    first = ("cell", "time") if has_cells else ("time",)
    table = Table(*first, "shows", "sigma", "confidence", "told", "by", box=None, pad_edge=False)
    for one in readings:
        sigma = "" if one["sigma"] is None else f"{one['sigma']:.2g}"
        style = "" if one["quality"] == "valid" else "yellow"
        by = one["mission"] or f"{one['verb']} {one['task']}"
        when = (one["cell"], _time(one["utc_s"])) if has_cells else (_time(one["utc_s"]),)
        words = (*when, _shown(one), sigma, f"{one['confidence']:.2f}", one["told"] or "", by)
        table.add_row(*(escape(word) for word in words), style=style)
    return table


def _shown(one: dict[str, Any]) -> str:
    if one["quality"] != "valid":
        return f"refused: {one['cause']}"
    if one["text"] is not None or one["state"] is not None:
        return str(one["text"] or one["state"])
    return f"{one['value']:.4g} {one['unit']}".strip()


def _time(utc_s: float) -> str:
    return datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%d %H:%M:%S")


def drawn(name: str, trend: list[dict[str, Any]], *, unit: str) -> bytes:
    """Return the trend of an object as PNG: mean with its extremes, or the states as a line of dots; refusals below."""
    from service.report.plots import figure_png, sheet

    figure = sheet(3.4)
    axes: Any = figure.subplots()  # matplotlib takes times, but its annotations do not say so
    moments = [datetime.fromtimestamp((one["since_s"] + one["until_s"]) / 2, UTC) for one in trend]
    if any(one["mean"] is not None for one in trend):
        _draw_values(axes, moments, trend)
        axes.set_ylabel(unit or "value")
    else:
        shown = [(moment, state) for moment, one in zip(moments, trend, strict=True) for state in one["states"]]
        axes.plot([moment for moment, _ in shown], [state for _, state in shown], "o", ms=4, color=INK)
    refused = [moment for moment, one in zip(moments, trend, strict=True) if one["refused"]]
    if refused:
        axes.plot(refused, [0.02] * len(refused), "x", ms=5, color=RED, transform=axes.get_xaxis_transform())
    axes.set_title(f"{name} (UTC){'; crosses are refused readings' if refused else ''}", fontsize=9, color=INK)
    figure.autofmt_xdate()
    return figure_png(figure)


def drawn_of_cells(name: str, trends: dict[str, list[dict[str, Any]]], *, unit: str) -> bytes:
    """Return the trends of an object in several cells as PNG: the mean of each span, or its states as dots."""
    from service.report.plots import figure_png, sheet

    figure = sheet(3.4)
    axes: Any = figure.subplots()
    for cell, trend in trends.items():
        known = [(_middle(one), one["mean"]) for one in trend if one["mean"] is not None]
        known = known or [(_middle(one), state) for one in trend for state in one["states"]]
        axes.plot([when for when, _ in known], [value for _, value in known], ".-", ms=4, lw=1, label=cell)
    axes.set_title(f"{name} (UTC)", fontsize=9, color=INK)
    axes.set_ylabel(unit)
    axes.legend(fontsize=8)
    figure.autofmt_xdate()
    return figure_png(figure)


def _middle(one: dict[str, Any]) -> datetime:
    return datetime.fromtimestamp((one["since_s"] + one["until_s"]) / 2, UTC)


def _draw_values(axes: Any, moments: list[datetime], trend: list[dict[str, Any]]) -> None:
    known = [(moment, one) for moment, one in zip(moments, trend, strict=True) if one["mean"] is not None]
    when = [moment for moment, _ in known]
    axes.fill_between(
        when, [one["minimum"] for _, one in known], [one["maximum"] for _, one in known], color=SOFT, alpha=0.5, lw=0
    )
    axes.plot(when, [one["mean"] for _, one in known], ".-", ms=4, lw=1, color=INK)
