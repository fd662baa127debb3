"""`panelwright demo --week`: a simulated week of rounds, with progress, checks and what to look at afterwards."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from rich.markup import escape
from rich.table import Table

from service.commands.common import console, find_cell
from service.commands.shutdown import INTERRUPTED, leave, one_interrupt
from service.commands.warm import compile_first

if TYPE_CHECKING:
    from collections.abc import Sequence

    from service.history.reading import StoredReading
    from service.plant import Plant
    from service.week.checks import Check
    from service.week.run import Lived

WEEK = "week"  # folder below that of the reports


def run_week(cell: Path, seed: int | None, *, runs: Path, days: float, port: int, inline: bool) -> NoReturn:
    """Run the week and end the process: exit code 0 if every check holds, else 1.

    Raises:
        CellError: the files cannot be written, or the cell cannot start.
    """
    from service.serve import exit_on_sigterm
    from service.week.checks import checks_of, left_by
    from service.week.files import keep_shown, write_plant
    from service.week.run import live_week, serve_week, times_of

    started_s, now_s = time.monotonic(), time.time()
    plant = write_plant(find_cell(cell), runs / "plant", seed=seed)
    compile_first()
    exit_on_sigterm()
    since_s, until_s, dues_s = times_of(days, now_s)
    panelwright, calendar = serve_week(plant, runs, since_s, inline=inline, port=port)
    console.print(
        f"{len(dues_s)} rounds from {_time(since_s)} to {_time(until_s)} UTC on the plant in {plant.parents[1]}"
    )
    code = 1
    with one_interrupt():
        try:
            panelwright.start()
            console.print(f"ready after {time.monotonic() - started_s:.1f} s at {panelwright.url}")
            service = panelwright.service

            def tell(number: int, count: int, lived: Lived) -> None:
                console.print(f"{number:3d} of {count}  {_line(lived, service.plant)}", highlight=False, soft_wrap=True)

            week = live_week(panelwright, calendar, days=days, now_s=now_s, tell=tell)
            keep_shown(plant, week.rounds[-1].truth)
            checks = list(checks_of(left_by(week, service.plant, service.cell.panel, plant, runs)))
            console.print(_table(checks))
            code = 0 if all(check.holds for check in checks) else 1
            console.print(f"{sum(check.holds for check in checks)} of {len(checks)} checks hold")
        except KeyboardInterrupt:
            console.print("Ctrl-C: stopping the arm and ending all processes")
            code = INTERRUPTED
        finally:
            panelwright.close()
        if code != INTERRUPTED:
            _say_what_is_left(plant, runs)
        console.print(f"{time.monotonic() - started_s:.1f} s in all")
        leave(code)


def _line(lived: Lived, plant: Plant) -> str:
    """Return a round in one line: its time, what it read, what it did, and the alarms."""
    from service.week.files import FLOW, PRESSURE, TEMPERATURE

    read = {one.object: one for one in plant.history.newest() if one.task == lived.run.task}
    words = [f"{name} {_shown(read.get(name))}" for name in (PRESSURE, FLOW, TEMPERATURE)]
    if lived.has_relieved:
        words.append("[bold]closed the valve[/]")
    if lived.run.why:
        words.append(f"[red]{lived.run.state}: {escape(lived.run.why)}[/]")
    words += [f"[yellow]{alarm.id} {alarm.state}[/]" for alarm in plant.alarms.all() if alarm.state != "normal"]
    waiting, _ = plant.review.waiting(limit=1)
    words += [f"{waiting} waiting for review"] if waiting else []
    return f"{_time(lived.due_s)}  {', '.join(words)}"


def _shown(reading: StoredReading | None) -> str:
    """Return what a round read of one instrument."""
    if reading is None:
        return "[red]not read[/]"
    if reading.value is None:
        return "[yellow]refused[/]"
    return f"{reading.value:.1f}"


def _table(checks: Sequence[Check]) -> Table:
    table = Table("", "check", "found", box=None, pad_edge=False)
    for check in checks:
        mark = "[green]holds[/]" if check.holds else "[red]FAILS[/]"
        table.add_row(mark, escape(check.says), escape(check.saw))
    return table


def _say_what_is_left(plant: Path, runs: Path) -> None:
    """Print how to look at the week."""
    console.print("\nwhat to look at:")
    serve = f"panelwright serve --cell {plant} --runs {runs}"
    steps = {
        serve: "the same plant with its history, on http://127.0.0.1:8460; then:",
        "panelwright alarms": "what was raised; `alarms acknowledge pressure.high` settles it",
        "panelwright history pressure --since 8d --plot pressure.png": "the trend",
        "panelwright review --pictures waiting": "what waits for a person, with its picture",
        "panelwright rounds runs patrol": "how the rounds went",
    }
    for command, why in steps.items():
        console.print(f"  {command:<{max(map(len, steps))}}  {why}", markup=False, soft_wrap=True)
    console.print(f"  reports: {runs}/*/report.html", markup=False, soft_wrap=True)


def _time(utc_s: float) -> str:
    return datetime.fromtimestamp(utc_s, UTC).strftime("%a %Y-%m-%d %H:%M")
