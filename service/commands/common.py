"""Options and functions that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.client import DEFAULT_URL, Client
from service.terminal import console, find_cell

if TYPE_CHECKING:
    from hal.config import Cell  # imports scipy, which commands that are only clients do not need

__all__ = [
    "DEFAULT_CELL",
    "CellOption",
    "SeedOption",
    "Url",
    "UrlDefault",
    "client_of",
    "console",
    "find_cell",
    "read_cell",
    "state_style",
]

Url = Annotated[str, typer.Option("--url", help="Address of a running service.", show_default=True)]
CellOption = Annotated[
    Path, typer.Option("--cell", help="Cell file (TOML); shipped ones are found by their path in the project.")
]
SeedOption = Annotated[int | None, typer.Option("--seed", min=0, help="Replaces the seed of the cell file.")]
DEFAULT_CELL = Path("cells/bench.toml")
UrlDefault = DEFAULT_URL


def client_of(url: str) -> Client:
    """Return a client of the service at `url`."""
    return Client(url=url.rstrip("/"))


def read_cell(path: Path, seed: int | None) -> Cell:
    """Load a cell file and check that this machine has everything that it needs.

    Raises:
        ConfigError: the cell file, the panel file, a calibration record or the machine has a fault.
    """
    from hal.config import load_cell
    from service.commissioning.preflight import check_machine

    cell = load_cell(find_cell(path), seed=seed)
    check_machine(cell)
    return cell


def state_style(state: str) -> str:
    """Return the colour of a task's state."""
    styles = {"succeeded": "green", "failed": "red", "cancelled": "yellow", "running": "cyan", "cancelling": "yellow"}
    return styles.get(state, "white")
