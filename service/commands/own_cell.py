"""Runs one task on a running service, or on a cell that is started for it and closed afterwards."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from service.client import ApiError, Client
from service.commands.common import URL_FROM, client_of, console, read_cell
from service.commands.shutdown import INTERRUPTED, leave, one_interrupt
from service.commands.tasks import follow
from service.commands.warm import compile_first

ServiceUrl = Annotated[
    str | None,
    typer.Option("--url", envvar=URL_FROM, help="Use this running service instead of starting the cell."),
]


def run_task(client: Client, path: str, request: dict[str, Any]) -> dict[str, Any]:
    """Start a task, show its progress, and return it when it has ended.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; the task has been cancelled, which stops the arm.
    """
    task_id = client.post(path, request)["id"]
    try:
        return follow(client, task_id)
    except KeyboardInterrupt:
        with suppress(ApiError):  # the task has ended already
            task = client.post(f"/v1/tasks/{task_id}/cancel")
            console.print(f"Ctrl-C: task {task_id} {task['state']}, the arm stops")
        raise


def run_on_cell(
    work: Callable[[Client], bool], *, cell: Path, seed: int | None, runs: Path, url: str | None, moves: bool = True
) -> NoReturn:
    """Run `work` and end the process, with exit code 0 when `work` returns True, else 1.

    Args:
        cell, seed, runs: options of the cell that is started when `url` is None.
        moves: whether the task moves the arm, so that the stop of the started cell must be cleared first.
    """
    if url is not None:
        with one_interrupt():
            try:
                raise typer.Exit(0 if work(client_of(url)) else 1)
            except KeyboardInterrupt:
                raise typer.Exit(INTERRUPTED) from None
    from service.serve import Options, Panelwright, exit_on_sigterm

    loaded = read_cell(cell, seed)
    compile_first()
    exit_on_sigterm()
    panelwright = Panelwright(loaded, Options(port=0, runs_dir=runs))
    console.print(f"cell [bold]{loaded.name}[/], {loaded.file.cell.mode}, seed {loaded.file.cell.seed}: starting")
    code = 1
    with one_interrupt():
        try:
            panelwright.start()
            client = panelwright.client()
            stop = client.get("/v1/stop")
            if stop["is_latched"] and moves:  # as in `demo`, whoever runs it states that the cell is clear
                client.post("/v1/stop/reset", {"seen_count": stop["count"]})
            code = 0 if work(client) else 1
        except KeyboardInterrupt:
            console.print("stopped by Ctrl-C: arm stopped, nothing written")
            code = INTERRUPTED
        finally:
            panelwright.close()
        leave(code)
