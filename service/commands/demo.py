"""`panelwright demo`: the whole mission on a cell, through the real HTTP server, with a report at the end."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from service.client import Client
from service.commands.common import DEFAULT_CELL, CellOption, SeedOption, console, read_cell
from service.commands.tasks import follow
from service.serve import Options, Panelwright

HEARTBEAT_RATIO = 0.25


def demo(
    *,
    cell: CellOption = DEFAULT_CELL,
    seed: SeedOption = None,
    judge: Annotated[
        bool, typer.Option("--judge", help="Afterwards compare the report with the simulator's truth.")
    ] = False,
    port: Annotated[int, typer.Option(min=0, max=65534, help="HTTP port; 0 takes a free one.")] = 0,
    runs: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("runs"),
    inline: Annotated[bool, typer.Option("--inline", help="Cell and stop port in this process (debugging).")] = False,
) -> None:
    """Run the whole mission and leave a report; exit code 1 when an action was not confirmed."""
    started_s = time.monotonic()
    loaded = read_cell(cell, seed)
    panelwright = Panelwright(loaded, Options(port=port, runs_dir=runs, inline=inline))
    console.print(f"cell [bold]{loaded.name}[/], seed {loaded.file.cell.seed}: starting")
    try:
        panelwright.start()
        console.print(f"ready after {time.monotonic() - started_s:.1f} s at {panelwright.url}")
        is_done = _mission(Client(url=panelwright.url), runs, judge=judge)
    except KeyboardInterrupt:
        console.print("stopped by Ctrl-C: arm stopped, processes ended")
        raise typer.Exit(130) from None
    finally:
        panelwright.close()
    console.print(f"{time.monotonic() - started_s:.1f} s in all")
    raise typer.Exit(0 if is_done else 1)


def _mission(client: Client, runs: Path, *, judge: bool) -> bool:
    stop = client.get("/v1/stop")
    if stop["is_latched"]:  # a cell with real parts starts latched; to run the demo is to say that it is clear
        client.post("/v1/stop/reset", {"seen_count": stop["count"]})
    task = follow(client, client.post("/v1/missions", {})["id"])
    if task["state"] != "succeeded":
        _show_reports(client, runs)
        return False
    result = task["result"]
    _show_actions(result)
    if judge:
        verdict = client.post("/v1/judge?wait_s=30", {"mission": result["mission"]})["result"]
        console.print_json(json.dumps(verdict))
    _show_reports(client, runs)
    return bool(result.get("all_confirmed", False))


def _show_actions(result: dict[str, Any]) -> None:
    for action in result.get("actions", []):
        style = "green" if action["outcome"] == "done" else "red"
        words = f"{action['object']} {action.get('target', '')}"
        console.print(f"  [{style}]{action['outcome']:<12}[/] {escape(words)}")


def _show_reports(client: Client, runs: Path) -> None:
    missions = client.get("/v1/missions")["missions"]
    if missions:
        console.print(f"report: {runs / missions[0]['name'] / 'report.html'}")
