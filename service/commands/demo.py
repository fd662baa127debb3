"""`panelwright demo`: runs the whole mission on a cell through the HTTP server and writes a report."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from service.client import ApiError, Client
from service.commands.common import DEFAULT_CELL, CellOption, SeedOption, console, read_cell
from service.commands.shutdown import INTERRUPTED, leave, one_interrupt
from service.commands.tasks import follow
from service.commands.warm import compile_first
from service.commands.week import WEEK, run_week

JUDGE_S = 30  # longest wait for a verdict


def demo(
    *,
    cell: CellOption = DEFAULT_CELL,
    seed: SeedOption = None,
    mission: Annotated[str, typer.Option(help="Name of the mission file; the shipped ones: demo, inspect.")] = "demo",
    judge: Annotated[
        bool, typer.Option("--judge", help="Compare the report with the simulator's truth afterwards.")
    ] = False,
    port: Annotated[int, typer.Option(min=0, max=65534, help="HTTP port; 0 takes a free one.")] = 0,
    runs: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("runs"),
    inline: Annotated[bool, typer.Option("--inline", help="Cell and stop port in this process (debugging).")] = False,
    week: Annotated[
        bool, typer.Option("--week", help="Run a simulated week of rounds in minutes, and check what it leaves.")
    ] = False,
    days: Annotated[float, typer.Option(min=1.0, max=366.0, help="Length of that week.")] = 7.0,
) -> None:
    """Run a mission file on a cell and write a report; the exit code is 1 when an action was not confirmed."""
    if week:
        run_week(cell, seed, runs=runs / WEEK, days=days, port=port, inline=inline)
    from service.serve import Options, Panelwright, exit_on_sigterm

    started_s, before = time.monotonic(), reports(runs)
    loaded = read_cell(cell, seed)
    compile_first()
    exit_on_sigterm()
    panelwright = Panelwright(loaded, Options(port=port, runs_dir=runs, inline=inline))
    console.print(f"cell [bold]{loaded.name}[/], seed {loaded.file.cell.seed}: starting")
    code = 1
    with one_interrupt():
        try:
            panelwright.start()
            console.print(f"ready after {time.monotonic() - started_s:.1f} s at {panelwright.url}")
            code = 0 if _mission(panelwright.client(), runs, mission, judge=judge) else 1
        except KeyboardInterrupt:
            console.print("Ctrl-C: stopping the arm and ending all processes")
            code = INTERRUPTED
        finally:
            panelwright.close()
        if code == INTERRUPTED:
            _tell_what_is_left(runs, before)
        console.print(f"{time.monotonic() - started_s:.1f} s in all")
        leave(code)


def _mission(client: Client, runs: Path, file: str, *, judge: bool) -> bool:
    stop = client.get("/v1/stop")
    if stop["is_latched"]:  # a cell with real devices starts latched; whoever runs the demo states that it is clear
        client.post("/v1/stop/reset", {"seen_count": stop["count"]})
    task = follow(client, client.post("/v1/missions", {"file": file})["id"])
    result = task["result"] or {"actions": [], "succeeded": False}
    if result["actions"]:
        console.print(_actions(result["actions"]))
    mission = reported(client.get("/v1/missions")["missions"], task["id"])
    if mission is not None:
        if judge:
            console.print(judged(client, mission))
        console.print(f"report: [bold]{runs / mission / 'report.html'}[/]")
    lag_s = client.get("/v1/info")["event_loop_lag_p99_s"]
    console.print(f"event-loop lag of the last minute: {1e3 * lag_s:.1f} ms (p99)")
    return bool(result["succeeded"])


def reported(missions: list[dict[str, Any]], task_id: str) -> str | None:
    """Return the name of the mission that the task ran; None when it ended before there was anything to report."""
    return next((mission["name"] for mission in missions if mission["name"].endswith(f"-{task_id}")), None)


def judged(client: Client, mission: str) -> str:
    """Return the verdict on a mission as text, or the reason why it cannot be judged."""
    try:
        task = client.post(f"/v1/judge?wait_s={JUDGE_S}", {"mission": mission})
    except ApiError as error:
        return escape(error.for_people())
    if task["result"] is not None:
        return _verdict(task["result"])
    problem = task["problem"] or {"detail": f"no verdict within {JUDGE_S} s", "hint": f"see task {task['id']}"}
    return escape(f"judge: {problem['detail']}; try: {problem['hint']}")


def reports(runs: Path) -> set[Path]:
    """Return all reports in a folder."""
    return set(runs.glob("*/report.html"))


def _tell_what_is_left(runs: Path, before: set[Path]) -> None:
    """Print the path of the report that an interrupted mission has written."""
    for report in sorted(reports(runs) - before):
        console.print(f"report of everything measured so far: [bold]{report}[/]")


def _actions(actions: list[dict[str, Any]]) -> Table:
    table = Table("object", "target", "outcome", "before", "after", "peak", box=None, pad_edge=False)
    for action in actions:
        style = "green" if action["confirmed"] else "red"
        outcome = f"[{style}]{action['outcome']}{', confirmed' if action['confirmed'] else ''}[/]"
        words = [escape(str(action[key])) for key in ("object", "target", "before", "after")]
        table.add_row(*words[:2], outcome, *words[2:], f"{action['peak_force_n'] or 0.0:.0f} N")
    return table


def _verdict(verdict: dict[str, Any]) -> str:
    style = "green" if verdict["agrees"] else "red"
    words = "agrees with the report" if verdict["agrees"] else "CONTRADICTS the report"
    pose = "no pose to judge"
    if verdict["pose_error_m"] is not None:
        error_mm, error_deg = 1e3 * verdict["pose_error_m"], math.degrees(verdict["pose_error_rad"])
        inside = "inside" if verdict["inside_95"] else "outside"
        pose = f"pose off by {error_mm:.2f} mm and {error_deg:.2f} deg, {inside} its 95 % ellipsoid"
    right = f"{verdict['readings_right']} of {verdict['readings_given']} readings right"
    moved = "".join(
        f"; [red]{m['name']} changed without being operated, {m['truth']}[/]" for m in verdict["moved_unasked"]
    )
    return f"judge: [{style}]{words}[/]; {right}; {pose}{moved}"
