"""`panelwright site …`: many cells side by side, and their histories in one folder."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from hal.atomic_write import write_atomically
from service.commands.common import console

if TYPE_CHECKING:
    from collections.abc import Sequence

    from service.site.look import CellLook, Cells

app = typer.Typer(help="Show many cells side by side; collect and ask their histories.", no_args_is_help=True)
SiteOption = Annotated[Path, typer.Argument(metavar="SITE", help="Site file (TOML) that lists the cells.")]
MOST_WORDS = 3


@app.command()
def show(
    site: SiteOption,
    *,
    page: Annotated[Path | None, typer.Option(help="Also write the site as one page to this HTML file.")] = None,
    every: Annotated[
        float | None,
        typer.Option(min=1.0, help="Look again after so many seconds, until Ctrl-C; the page renews itself."),
    ] = None,
) -> None:
    """Show all cells of a site; the exit code is 1 when one does not answer."""
    from service.site.page import page_of

    cells = _cells(site)
    pause = threading.Event()
    while True:
        found = cells.look()
        console.print(_table(found))
        if page is not None:
            write_atomically(page, page_of(cells.site.name, found, time.time(), renew_s=every))
            console.print(f"page: {page}", markup=False, soft_wrap=True)
        if every is None:
            raise typer.Exit(0 if all(cell.answers for cell in found) else 1)
        try:
            pause.wait(every)
        except KeyboardInterrupt:
            raise typer.Exit(0) from None


@app.command("collect")
def collect_histories(
    site: SiteOption,
    *,
    into: Annotated[Path, typer.Option(help="Folder for the Parquet files, one for each cell and month.")],
) -> None:
    """Bring the histories of all cells into one folder (needs the extra `history`); call it again to bring what is new.

    The exit code is 1 when a cell does not answer; what it has given before stays.
    """
    from service.site.collect import collect

    is_whole = True
    for one in collect(_cells(site), into):
        is_whole = is_whole and not one.why
        told = f"[red]{escape(one.why)}[/]" if one.why else f"{one.readings} readings in {one.files} files"
        console.print(f"{one.name}: {told}", soft_wrap=True)
    raise typer.Exit(0 if is_whole else 1)


@app.command("ask")
def ask_histories(
    folder: Annotated[Path, typer.Argument(help="Folder that `site collect` has filled.")],
    sql: Annotated[str, typer.Argument(help="Question about the table `readings`, in DuckDB's SQL.")],
    *,
    csv: Annotated[bool, typer.Option("--csv", help="Print CSV instead of a table.")] = False,
) -> None:
    """Answer a question about the collected histories, such as "SELECT cell, COUNT(*) FROM readings GROUP BY cell"."""
    from service.site.ask import ask

    answer = ask(folder, sql)
    if csv:
        import csv as writer
        import sys

        writer.writer(sys.stdout).writerows([answer.columns, *answer.rows])
        return
    table = Table(*answer.columns, box=None, pad_edge=False)
    for row in answer.rows:
        table.add_row(*("" if value is None else escape(str(value)) for value in row))
    console.print(table)


def _cells(path: Path) -> Cells:
    from service.site.look import Cells
    from service.site.site_file import load_site

    return Cells(site=load_site(path), folder=path.absolute().parent)


def _table(cells: Sequence[CellLook]) -> Table:
    from service.site.page import age_of, time_of

    table = Table("cell", "state", "alarms", "review", "newest reading", "next round", box=None, pad_edge=False)
    for cell in cells:
        if not cell.answers:
            table.add_row(escape(cell.name), f"[red]does not answer: {escape(cell.why)}[/]", "", "", "", "")
            continue
        style = "green" if cell.state == "ready" else "red"
        unseen = [str(alarm["id"]) for alarm in cell.unseen]
        more = f" and {len(unseen) - MOST_WORDS} more" if len(unseen) > MOST_WORDS else ""
        told = f"[red]{escape(', '.join(unseen[:MOST_WORDS]) + more)}[/]" if unseen else f"{len(cell.alarms)} seen"
        newest, following = cell.newest_s, cell.next_round
        table.add_row(
            escape(cell.name),
            f"[{style}]{escape(cell.state)}[/]",
            told if cell.alarms else "none",
            f"{cell.waiting} wait" if cell.waiting else "",
            "none" if newest is None else f"{age_of(time.time() - newest)} ago",
            "" if following is None else escape(f"{following['name']} {time_of(following['next_s'])}"),
        )
    return table
