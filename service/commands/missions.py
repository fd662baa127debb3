"""`panelwright mission …`: lists, checks, plans, runs and takes up missions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from hal.errors import CellError
from service.commands.common import DEFAULT_CELL, CellOption, Url, UrlDefault, client_of, console
from service.commands.own_cell import run_task
from service.terminal import find_cell

app = typer.Typer(help="List, check, plan and run missions.", no_args_is_help=True)
Name = Annotated[str, typer.Argument(help="Name of a mission file, or the path of one.")]


@app.command("list")
def list_missions(cell: CellOption = DEFAULT_CELL) -> None:
    """List the mission files of a cell, with what is wrong with each."""
    from hal.config import load_cell
    from service.missions.files import checked_file, mission_paths

    loaded = load_cell(find_cell(cell))
    table = Table("mission", "title", "file", box=None, pad_edge=False)
    for name, path in sorted(mission_paths(loaded).items()):
        try:
            title = checked_file(name, loaded).mission.title
        except CellError as error:
            title = f"cannot be run: {error.what}"
        table.add_row(name, escape(title), escape(str(path)))
    console.print(table)


@app.command("check")
def check_mission(name: Name, cell: CellOption = DEFAULT_CELL) -> None:
    """Check a mission file against a cell's panel; nothing moves, and no service is needed."""
    from hal.config import load_cell
    from hal.strict import read_text
    from service.missions.files import FILE, checked, checked_file, parse_mission

    loaded = load_cell(find_cell(cell))
    if name.endswith(".toml"):
        checked(parse_mission(read_text(Path(name), FILE), loaded, source=name), loaded, source=name)
    else:
        checked_file(name, loaded)
    console.print(f"{name} fits panel {loaded.panel.name}", style="green")


@app.command("run")
def run_mission(
    name: Name,
    *,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only plan: nothing moves.")] = False,
    url: Url = UrlDefault,
) -> None:
    """Run a mission on a running service; the exit code is 1 when it did not succeed."""
    _run({**_body(name), "dry_run": dry_run}, url)


@app.command("resume")
def resume_mission(
    mission: Annotated[str, typer.Argument(help="Name of the earlier mission, as its report has it.")],
    url: Url = UrlDefault,
) -> None:
    """Take a mission up at its first unfinished step."""
    _run({"resume": mission}, url)


def _body(name: str) -> dict[str, Any]:
    """Return the part of the request that names the mission; the file of a path is sent with it."""
    if not name.endswith(".toml"):
        return {"file": name}
    from hal.strict import load_toml
    from service.schema.mission_file import MissionFile

    file = load_toml(Path(name), MissionFile, "mission file")
    return {"mission": file.model_dump(mode="json", by_alias=True, exclude_none=True)}


def _run(body: dict[str, Any], url: str) -> None:
    task = run_task(client_of(url), "/v1/missions", body)
    result = task["result"]
    if result is not None and result["plan"] is not None:
        console.print(_plan(result["plan"]))
    elif result is not None:
        console.print(_steps(result["steps"]))
    raise typer.Exit(0 if result is not None and result["succeeded"] else 1)


def _steps(steps: list[dict[str, Any]]) -> Table:
    table = Table("step", "kind", "outcome", "detail", box=None, pad_edge=False)
    for step in steps:
        table.add_row(*(escape(step[key]) for key in ("path", "kind", "outcome", "detail")))
    return table


def _plan(plan: dict[str, Any]) -> Table:
    place = "as it was located" if plan["located"] else "where the cell file expects the panel"
    title = f"{plan['expected_s']:.0f} s expected, of which {plan['contact_s']:.0f} s at controls; {place}"
    table = Table("step", "station", "way", title=title, title_justify="left", box=None, pad_edge=False)
    for one in plan["stations"]:
        way = f"{one['way_s']:.1f} s" if one["problem"] is None else f"[red]{escape(one['problem'])}[/]"
        table.add_row(escape(one["step"]), escape(one["what"]), way)
    return table
