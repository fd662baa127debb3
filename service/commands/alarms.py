"""`panelwright alarms`: lists the alarms of a running service, and acknowledges, shelves and suppresses them."""

from __future__ import annotations

import getpass
import time
from datetime import UTC, datetime
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from service.commands.common import Url, UrlDefault, client_of, console
from service.commands.history import seconds_of

app = typer.Typer(help="List, acknowledge and shelve the alarms of a running service.", invoke_without_command=True)
AlarmId = Annotated[str, typer.Argument(help="Name of the alarm, such as pressure.high.")]
By = Annotated[str | None, typer.Option(help="Who does it; by default the name of the user of this machine.")]
Reason = Annotated[str, typer.Option(help="Why.")]
STYLES = {"unacknowledged": "red", "returned-unacknowledged": "yellow", "acknowledged": "cyan"}


@app.callback()
def alarms(
    context: typer.Context,
    *,
    everything: Annotated[bool, typer.Option("--all", help="Also alarms that are normal.")] = False,
    url: Url = UrlDefault,
) -> None:
    """List the alarms, those that need a person first; times are UTC."""
    if context.invoked_subcommand is not None:
        return
    found = client_of(url).get(f"/v1/alarms?all={str(everything).lower()}")
    if not found["alarms"]:
        console.print("no alarm", style="green")
    else:
        console.print(_table(found["alarms"]))
    for doubt in found["straddled"]:
        console.print(f"unsure: {escape(doubt['says'])}", style="yellow")


@app.command()
def acknowledge(alarm: AlarmId, *, by: By = None, reason: Reason = "", url: Url = UrlDefault) -> None:
    """Say that you have seen an alarm."""
    _post(url, alarm, "acknowledge", {"by": by or getpass.getuser(), "reason": reason})


@app.command()
def comment(
    alarm: AlarmId,
    *,
    reason: Annotated[str, typer.Option(help="What you say about it.")],
    by: By = None,
    url: Url = UrlDefault,
) -> None:
    """Comment on an alarm; its state stays."""
    _post(url, alarm, "comment", {"by": by or getpass.getuser(), "reason": reason})


@app.command()
def shelve(
    alarm: AlarmId,
    *,
    span: Annotated[str, typer.Option("--for", help="How long: a number and s, m, h, d or w, such as 8h.")],
    reason: Annotated[str, typer.Option(help="Why.")],
    by: By = None,
    url: Url = UrlDefault,
) -> None:
    """Shelve an alarm for a time; its condition is still followed."""
    until_s = time.time() + seconds_of(span)
    _post(url, alarm, "shelve", {"by": by or getpass.getuser(), "reason": reason, "until_s": until_s})


@app.command()
def unshelve(alarm: AlarmId, *, by: By = None, reason: Reason = "", url: Url = UrlDefault) -> None:
    """End the shelving of an alarm."""
    _post(url, alarm, "unshelve", {"by": by or getpass.getuser(), "reason": reason})


@app.command("out-of-service")
def out_of_service(
    alarm: AlarmId, *, reason: Annotated[str, typer.Option(help="Why.")], by: By = None, url: Url = UrlDefault
) -> None:
    """Take an alarm out of service, for example while its instrument is repaired."""
    _post(url, alarm, "out-of-service", {"by": by or getpass.getuser(), "reason": reason})


@app.command("in-service")
def in_service(alarm: AlarmId, *, by: By = None, reason: Reason = "", url: Url = UrlDefault) -> None:
    """Put an alarm back in service."""
    _post(url, alarm, "in-service", {"by": by or getpass.getuser(), "reason": reason})


def _post(url: str, alarm: str, deed: str, body: dict[str, Any]) -> None:
    state = client_of(url).post(f"/v1/alarms/{alarm}/{deed}", body)["state"]
    console.print(f"{alarm} is {state}", markup=False)


def _table(found: list[dict[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False)
    for head in ("alarm", "state", "priority", "since"):
        table.add_column(head, overflow="fold", no_wrap=head != "alarm")
    table.add_column("what, and what to do")
    for one in found:
        since = datetime.fromtimestamp(one["changed_s"], UTC).strftime("%m-%d %H:%M") if one["changed_s"] else ""
        style = STYLES.get(one["state"], "dim")
        says = "\n".join(words for words in (one["says"], one["what_to_do"]) if words)
        words = (one["id"], one["state"], one["priority"], since, says)
        table.add_row(*(escape(word) for word in words), style=style)
    return table
