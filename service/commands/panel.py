"""`panelwright panel …`: checks a panel file, and lists the objects of one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from service.commands.common import console
from service.terminal import find_cell

if TYPE_CHECKING:
    from hal.panel import PanelObject

app = typer.Typer(help="Check a panel file, and list its objects.", no_args_is_help=True)
File = Annotated[Path, typer.Argument(help="Panel file (TOML), such as panels/bench.toml.")]


@app.command()
def check(file: File) -> None:
    """Check a panel file; every fault is named with its place and its remedy. No service is needed."""
    from hal.panel import load_panel

    panel = load_panel(find_cell(file))
    console.print(f"{file} describes panel {panel.name}: {len(panel.objects)} objects", style="green", markup=False)
    for part in panel.to_measure:
        console.print(f"still to measure: {part}", style="yellow", markup=False)
    if panel.to_measure:
        raise typer.Exit(1)


@app.command("list")
def list_objects(file: File) -> None:
    """List the objects of a panel file: what they show, what they can be set to, and their alarms."""
    from hal.panel import load_panel

    table = Table("object", "kind", "label", "can be set to", "alarms", box=None, pad_edge=False)
    for one in load_panel(find_cell(file)).objects:
        table.add_row(*(escape(part) for part in (one.name, one.kind, one.label, _targets(one), _alarms(one))))
    console.print(table)


def _targets(one: PanelObject) -> str:
    from hal.panel import NumberGoal

    if one.goal is None:
        return ""
    if one.forbidden:
        return "forbidden"
    if isinstance(one.goal, NumberGoal):
        return f"{one.goal.low:g} to {one.goal.high:g} {one.goal.unit}".rstrip()
    return ", ".join(one.goal.states)


def _alarms(one: PanelObject) -> str:
    limits = [] if one.limits is None else [f"{name} {value:g}" for name, value in one.limits.given.items()]
    normal = [] if one.normal is None else [f"not {' or '.join(one.normal)}"]
    stale = [] if one.stale_after_s is None else [f"older than {one.stale_after_s:g} s"]
    return ", ".join([*limits, *normal, *stale])
