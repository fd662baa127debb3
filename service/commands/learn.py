"""`panelwright learn`: learns what the objects of the cell's own panel look like, for blind recognition."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from service.client import Client
from service.commands.common import DEFAULT_CELL, CellOption, SeedOption, console
from service.commands.own_cell import ServiceUrl, run_on_cell, run_task

if TYPE_CHECKING:
    from service.schema.results import LearnResult


def learn(
    *,
    cell: CellOption = DEFAULT_CELL,
    seed: SeedOption = None,
    runs: Annotated[Path, typer.Option(help="Folder of the service; the looks are stored in RUNS/knowledge.")] = Path(
        "runs"
    ),
    url: ServiceUrl = None,
) -> None:
    """Locate the panel and learn from one overview what its objects look like, without clicks.

    Run it again when an object looks different (a lamp is lit, a lever is open); only new looks are added.
    """
    run_on_cell(_learn, cell=cell, seed=seed, runs=runs, url=url)


def _learn(client: Client) -> bool:
    from service.schema.results import LearnResult

    result = run_task(client, "/v1/learn", {})["result"]
    if result is None:
        return False
    tell(LearnResult.model_validate(result))
    return True


def tell(learned: LearnResult) -> None:
    """Print what was learned from an overview of a known panel."""
    added, seen = learned.added, len(learned.taught_by)
    looks = (
        ", ".join(f"{name} {count}" for name, count in sorted(added.items())) or "none, because all of them were known"
    )
    console.print(f"panel [bold]{learned.panel}[/]: {seen} objects looked at; new looks: {looks}")
    console.print(
        f"recognised blind in this overview: {len(learned.known_before)} of {seen} before, {len(learned.known_now)} now"
    )
    for name, why in learned.left_out.items():
        console.print(escape(f"  nothing was learned from {name}: {why}"))
    if files := [Path(file) for file in learned.files]:
        console.print(escape(f"written  {files[0].parent}: {', '.join(file.name for file in files)}"))
