"""`panelwright rounds`: lists the rounds of a running service and their runs, adds and removes rounds."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any
from zoneinfo import ZoneInfo

import typer
from rich.markup import escape
from rich.table import Table

from service.commands.common import Url, UrlDefault, client_of, console

app = typer.Typer(help="List, add and remove the rounds of a running service.", invoke_without_command=True)
Name = Annotated[str, typer.Argument(metavar="ROUND", help="Name of the round.")]
STYLES = {"succeeded": "green", "failed": "red", "interrupted": "red", "missed": "yellow", "cancelled": "yellow"}


@app.callback()
def rounds(context: typer.Context, *, url: Url = UrlDefault) -> None:
    """List the rounds with their next time, each in its own time zone."""
    if context.invoked_subcommand is not None:
        return
    found = client_of(url).get("/v1/rounds")["rounds"]
    if not found:
        console.print("no round; `panelwright rounds add NAME --cron '0 6 * * *'` adds one", style="yellow")
        return
    table = Table("round", "mission", "cron", "next", "newest run", box=None, pad_edge=False)
    for one in found:
        following = _time(one["next_s"], one["zone"])
        if one["waiting_s"] is not None:
            following = f"due since {_time(one['waiting_s'], one['zone'])}, waits: {one['waits_for'] or 'begins now'}"
        words = (
            one["name"],
            one["mission"],
            f"{one['cron']} {one['zone']}",
            following,
            _told(one["newest"], one["zone"]),
        )
        table.add_row(*(escape(word) for word in words))
    console.print(table)


@app.command()
def runs(
    name: Name,
    *,
    last: Annotated[int, typer.Option(min=1, max=1000, help="Number of runs, the newest ones.")] = 20,
    url: Url = UrlDefault,
) -> None:
    """List the runs of a round, newest first; times are UTC."""
    table = Table("due", "state", "begun", "ended", "task", "why", box=None, pad_edge=False)
    for one in client_of(url).get(f"/v1/rounds/{name}/runs?limit={last}")["runs"]:
        times = [_time(one[key], "UTC") for key in ("due_s", "begun_s", "ended_s")]
        words = (times[0], one["state"], *times[1:], one["task"] or "", one["why"])
        table.add_row(*(escape(word) for word in words), style=STYLES.get(one["state"], ""))
    console.print(table)


@app.command()
def add(
    name: Name,
    *,
    cron: Annotated[str, typer.Option(help="Minute, hour, day of the month, month and day of the week.")],
    mission: Annotated[str, typer.Option(help="Name of a mission file.")] = "inspect",
    zone: Annotated[str, typer.Option(help="IANA time zone, such as Europe/Vienna.")] = "UTC",
    window_s: Annotated[
        float, typer.Option(help="A run that could not begin in time may begin this much later.")
    ] = 3600.0,
    missed: Annotated[str, typer.Option(help="After the window: `late` or `skip`.")] = "skip",
    forbidden_by: Annotated[
        list[str] | None, typer.Option(help="Alarm that keeps it from beginning; may be repeated.")
    ] = None,
    url: Url = UrlDefault,
) -> None:
    """Add or replace a round; those of the cell file are changed there."""
    body = {"name": name, "cron": cron, "mission": mission, "zone": zone, "window_s": window_s, "missed": missed}
    client_of(url).fetch("PUT", f"/v1/rounds/{name}", {**body, "forbidden_by": forbidden_by or []})
    console.print(f"round {name} is kept", markup=False)


@app.command()
def remove(name: Name, *, url: Url = UrlDefault) -> None:
    """Remove a round that the cell file does not define; its runs stay in the record."""
    client_of(url).fetch("DELETE", f"/v1/rounds/{name}")
    console.print(f"round {name} is removed", markup=False)


def _told(run: dict[str, Any] | None, zone: str) -> str:
    return "" if run is None else f"{run['state']} {_time(run['due_s'], zone)}"


def _time(utc_s: float | None, zone: str) -> str:
    if utc_s is None:
        return ""
    return datetime.fromtimestamp(utc_s, UTC).astimezone(ZoneInfo(zone)).strftime("%Y-%m-%d %H:%M")
