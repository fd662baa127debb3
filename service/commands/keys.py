"""`panelwright keys add | list | revoke`: the keys of a service, in its folder on this machine."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from hal.errors import InvalidRequest
from service.access.keys import FILE, Commit, Key, KeyBook, Role
from service.commands.common import console

app = typer.Typer(help="Keys of the API: who may use a service, and in which role.", no_args_is_help=True)
Runs = Annotated[Path, typer.Option(help="Folder of the service: its keys are in RUNS/.service.")]
KeyName = Annotated[str, typer.Argument(help="Name of the key, which the journal shows: a person or a program.")]
RUNS = Path("runs")
UNITS_S = {"h": 3600.0, "d": 86_400.0}
PERIOD = re.compile(r"([1-9][0-9]{0,4})([hd])")


@app.command("add")
def add(
    name: KeyName,
    role: Annotated[Role, typer.Option(help="observer looks and stops, operator moves, maintainer changes the cell.")],
    valid_for: Annotated[
        str | None,
        typer.Option(help="Time until the key expires, such as 12h or 90d; it does not expire if not given."),
    ] = None,
    runs: Runs = RUNS,
) -> None:
    """Add a key and show it once; it works at once, also at a running service."""
    valid_s = None if valid_for is None else _seconds(valid_for)
    book = _book(runs)
    is_first = book.is_open
    with _journal(runs) as commit:
        secret = book.add(name, role, valid_s=valid_s, commit=commit)
    typer.echo(secret)  # alone on standard output, so that a script can store it
    note = f"key {escape(name)} ({role}): shown only now; keep it in a file of mode 0600 and use --key-file or PANELWRIGHT_KEY"
    _tell(note)
    if is_first:
        _tell("the service now needs a key for everything except a stop on its own machine")


@app.command("list")
def list_keys(runs: Runs = RUNS) -> None:
    """List the keys with their roles; the keys themselves are stored nowhere."""
    book = _book(runs)
    active = {key.name for key in book.active()}
    table = Table("name", "role", "state", "added", "expires", box=None, pad_edge=False)
    for key in book.all():
        table.add_row(escape(key.name), str(key.role), _state(key, active), _date(key.added_s), _date(key.expires_s))
    console.print(table)
    if book.is_open:
        console.print("there is no key: everybody on this machine may use the service, and it listens nowhere else")


@app.command("revoke")
def revoke(name: KeyName, runs: Runs = RUNS) -> None:
    """Make a key invalid at once, also at a running service."""
    with _journal(runs) as commit:
        _book(runs).revoke(name, commit=commit)
    console.print(f"key {escape(name)} is revoked")


def _book(runs: Path) -> KeyBook:
    return KeyBook(runs / ".service" / FILE)


@contextlib.contextmanager
def _journal(runs: Path) -> Iterator[Commit]:
    from service.tasks.journal import Journal

    journal = Journal(runs / ".service" / "journal.sqlite")
    try:
        yield journal.append
    finally:
        journal.close()


def _seconds(text: str) -> float:
    found = PERIOD.fullmatch(text)
    if found is None:
        raise InvalidRequest(f"{text[:20]!r} is no period", hint="a number with h for hours or d for days, such as 90d")
    return int(found[1]) * UNITS_S[found[2]]


def _state(key: Key, active: set[str]) -> str:
    if key.revoked_s is not None:
        return "[red]revoked[/]"
    return "[green]active[/]" if key.name in active else "[yellow]expired[/]"


def _date(time_s: float | None) -> str:
    return "never" if time_s is None else datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M")


def _tell(text: str) -> None:
    from rich.console import Console

    Console(stderr=True, highlight=False, soft_wrap=True).print(text)
