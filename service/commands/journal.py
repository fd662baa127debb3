"""`panelwright journal`: shows who asked for, started and stopped what and when, and checks the hash chain."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from service.commands.common import console
from service.errors import FileFault
from service.tasks.journal_reader import Record, read_records, verify_chain

WIDTH = 120  # of the text of a row; `--json` gives all of it
STYLES = {"stop": "red", "task-ended": "green", "journal-dropped": "yellow"}


def journal(
    *,
    runs: Annotated[Path, typer.Option(help="Folder of the service: its journal is RUNS/.service.")] = Path("runs"),
    last: Annotated[int, typer.Option(min=1, help="Number of rows to show, the newest ones.")] = 30,
    kind: Annotated[
        list[str] | None,
        typer.Option(help="Only rows of this kind (stop, task-started, …); may be given several times."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print each complete row as one JSON object.")] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Check the hash chain for changed, removed and inserted rows.")
    ] = False,
) -> None:
    """Show the journal of a running or ended service, oldest row first; times are UTC."""
    path = runs / ".service" / "journal.sqlite"
    if not path.is_file():
        raise FileFault(f"there is no journal {path}", hint="give the service's folder: --runs FOLDER")
    records = read_records(path, kinds=tuple(kind or ()), limit=last)
    if kind and not records and not as_json:
        seen = sorted({record.kind for record in read_records(path)})
        console.print(f"no row is of kind {', '.join(kind)}; there are {', '.join(seen) or 'none'}", style="yellow")
    for record in records:
        if as_json:
            console.print(json.dumps(asdict(record)), markup=False)
        else:
            console.print(_line(record))
    if verify:
        count = verify_chain(path)
        console.print(f"{count} rows, the chain is intact", style="green")


def _line(record: Record) -> str:
    when = datetime.fromtimestamp(record.wall_time_s, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]
    style = STYLES.get(record.kind, "bold")
    return f"{record.id:>7}  [dim]{when}[/]  [{style}]{escape(f'{record.kind:<16}')}[/] {escape(_told(record))}"


def _told(record: Record) -> str:
    """Return the content of a row as one line of text."""
    words = ", ".join(f"{key} {_short(value)}" for key, value in record.data.items() if value is not None)
    words = " ".join(words.split())  # a hint may have several lines
    return words if len(words) <= WIDTH else words[: WIDTH - 1] + "…"


def _short(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"), ensure_ascii=False)
