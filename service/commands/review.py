"""`panelwright review`: lists the readings that wait for a person, and answers them."""

from __future__ import annotations

import getpass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from service.commands.common import Url, UrlDefault, client_of, console

app = typer.Typer(help="List and answer the readings that wait for a person.", invoke_without_command=True)


@app.callback()
def review(
    context: typer.Context,
    *,
    pictures: Annotated[Path | None, typer.Option(help="Write the picture of each reading to this folder.")] = None,
    last: Annotated[int, typer.Option(min=1, max=1000, help="Number of readings, the newest ones.")] = 20,
    url: Url = UrlDefault,
) -> None:
    """List the readings that wait, newest first, with what they may show; times are UTC."""
    if context.invoked_subcommand is not None:
        return
    client = client_of(url)
    found = client.get(f"/v1/review?limit={last}")
    if not found["readings"]:
        console.print("nothing waits", style="green")
        return
    table = Table("number", "object", "time", "may show", "why", box=None, pad_edge=False)
    for item in found["readings"]:
        one = item["reading"]
        moment = datetime.fromtimestamp(one["utc_s"], UTC).strftime("%Y-%m-%d %H:%M")
        words = (str(one["id"]), one["object"], moment, _guess(item), item["why"])
        table.add_row(*(escape(word) for word in words))
        if pictures is not None and one["crop_url"] is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            (pictures / f"{one['id']}-{one['object']}.png").write_bytes(client.fetch("GET", one["crop_url"]))
    console.print(table)
    console.print(
        f"{found['waiting']} wait; `panelwright review answer NUMBER right|wrong|unreadable --reason ...`", markup=False
    )


@app.command()
def answer(
    number: Annotated[int, typer.Argument(help="Number of the reading.")],
    verdict: Annotated[str, typer.Argument(help="right, wrong or unreadable.")],
    *,
    reason: Annotated[str, typer.Option(help="Why.")],
    value: Annotated[float | None, typer.Option(help="What it shows, of a wrong one.")] = None,
    state: Annotated[str | None, typer.Option(help="What it shows, of a wrong one.")] = None,
    text: Annotated[str | None, typer.Option(help="What it shows, of a wrong one.")] = None,
    by: Annotated[
        str | None, typer.Option(help="Who says so; by default the name of the user of this machine.")
    ] = None,
    url: Url = UrlDefault,
) -> None:
    """Say what a reading shows; what was read stays in the history beside it."""
    body: dict[str, Any] = {"by": by or getpass.getuser(), "verdict": verdict, "reason": reason}
    body |= {key: item for key, item in (("value", value), ("state", state), ("text", text)) if item is not None}
    client_of(url).post(f"/v1/review/{number}", body)
    console.print(f"reading {number} is answered: {verdict}", markup=False)


@app.command()
def teach(
    number: Annotated[int, typer.Argument(help="Number of an answered reading.")], *, url: Url = UrlDefault
) -> None:
    """Teach blind recognition what the object of an answered reading looks like."""
    taught = client_of(url).post(f"/v1/review/{number}/teach", {})
    told = f"wrote {taught['path']}" if taught["added"] else f"this look of {taught['name']} is known already"
    console.print(told, markup=False)


def _guess(item: dict[str, Any]) -> str:
    shown = [str(word) for word in (item["guess"] or {}).values() if word is not None][:1]
    rivals = [f"{rival['text']} ({rival['probability']:.0%})" for rival in item["rivals"][:3]]
    return ", ".join(shown + rivals)
