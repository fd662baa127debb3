"""`panelwright task …` and `panelwright stop`: clients of a running service."""

from __future__ import annotations

import json
import time
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from service.client import Client
from service.commands.common import Url, UrlDefault, client_of, console, state_style
from service.commands.shutdown import INTERRUPTED

app = typer.Typer(help="List, show, watch and cancel tasks of a running service.", no_args_is_help=True)
TaskId = Annotated[str, typer.Argument(help="Id of the task, as `task list` shows it.")]


@app.command("list")
def list_tasks(url: Url = UrlDefault) -> None:
    """List the kept tasks, newest first."""
    table = Table("id", "verb", "state", "progress", "step", "age", box=None, pad_edge=False)
    for task in client_of(url).get("/v1/tasks")["tasks"]:
        style = state_style(task["state"])
        age_s = max(0.0, time.time() - task["created_s"])  # the wall clock may have been set back
        row = (task["id"], task["verb"], f"[{style}]{task['state']}[/]", f"{100 * task['fraction']:.0f} %")
        table.add_row(*row, escape(task["step"]), f"{age_s:.0f} s")
    console.print(table)


@app.command("show")
def show_task(task_id: TaskId, url: Url = UrlDefault) -> None:
    """Show one task with result and problem, as JSON."""
    console.print_json(json.dumps(client_of(url).get(f"/v1/tasks/{task_id}")))


@app.command("watch")
def watch_task(task_id: TaskId, url: Url = UrlDefault) -> None:
    """Show the progress of a task until it ends."""
    client = client_of(url)
    try:
        task = follow(client, task_id)
    except KeyboardInterrupt:
        cancel = client.addressed(f"`panelwright task cancel {task_id}`")
        console.print(f"task {task_id} goes on: {cancel} stops the arm and ends it")
        raise typer.Exit(INTERRUPTED) from None
    raise typer.Exit(0 if task["state"] == "succeeded" else 1)


@app.command("cancel")
def cancel_task(task_id: TaskId, url: Url = UrlDefault) -> None:
    """Stop the arm and end a task."""
    task = client_of(url).post(f"/v1/tasks/{task_id}/cancel?wait_s=5")
    console.print(f"{task_id} {task['state']}")


def follow(client: Client, task_id: str) -> dict[str, Any]:
    """Show a task's progress until it ends; returns the task. Without a terminal, print one line per step."""
    (_follow_on_terminal if console.is_terminal else _follow_in_log)(client, task_id)
    task: dict[str, Any] = client.get(f"/v1/tasks/{task_id}")
    console.print(f"task {task_id} [{state_style(task['state'])}]{task['state']}[/]")
    if task["problem"] is not None:
        console.print(f"  {escape(task['problem']['detail'])}\n  try    {escape(task['problem']['hint'])}")
    return task


def _follow_on_terminal(client: Client, task_id: str) -> None:
    columns = (SpinnerColumn(), TextColumn("{task.description:<44.44}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("queued", total=1.0)
        for event in client.events(task_id):
            progress.update(bar, completed=event["fraction"], description=escape(_words(event)))


def _follow_in_log(client: Client, task_id: str) -> None:
    begun_s = client.get(f"/v1/tasks/{task_id}")["created_s"]  # so that everybody who watches sees the same times
    for event in client.events(task_id):
        if event["kind"] == "progress":
            console.print(
                f"{event['time_s'] - begun_s:6.1f} s {100 * event['fraction']:3.0f} %  {escape(_words(event))}"
            )


def _words(event: dict[str, Any]) -> str:
    return " · ".join(word for word in (event["step"], event["detail"]) if word) or str(event["state"])


def stop(
    url: Url = UrlDefault,
    reset: Annotated[bool, typer.Option("--reset", help="Clear the stop instead; this moves nothing.")] = False,
    hold: Annotated[bool, typer.Option("--hold", help="Leave the drives on, so that they hold the arm.")] = False,
) -> None:
    """Latch the software stop of a running service (not a safety function)."""
    level = "hold" if hold else "off"
    client = client_of(url)
    if reset:
        seen = client.get("/v1/stop")["count"]
        state = client.post("/v1/stop/reset", {"seen_count": seen})
    else:
        state = client.stop(level)
    how = ", the drives stay on" if state.get("level") == "hold" else ""
    console.print(f"the stop is [red]latched[/]{how}" if state["is_latched"] else "the stop is clear")
    for why in state.get("not_stopped", ()):
        console.print(f"  [red]not stopped[/]  {escape(why)}")
