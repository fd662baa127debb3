"""Options and functions that several commands share."""

from __future__ import annotations

import os
from contextvars import ContextVar
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
    "use_key_file",
]

URL_FROM = "PANELWRIGHT_URL"  # of the environment
Url = Annotated[str, typer.Option("--url", envvar=URL_FROM, help="Address of a running service.", show_default=True)]
CellOption = Annotated[
    Path, typer.Option("--cell", help="Cell file (TOML); shipped ones are found by their path in the project.")
]
SeedOption = Annotated[int | None, typer.Option("--seed", min=0, help="Replaces the seed of the cell file.")]
DEFAULT_CELL = Path("cells/bench.toml")
UrlDefault = DEFAULT_URL


def use_key_file(path: Path, context: typer.Context) -> None:
    """Send the key in this file with all requests until the command ends."""
    before = _key_file.set(path)
    context.call_on_close(lambda: _key_file.reset(before))


_key_file: ContextVar[Path | None] = ContextVar("key_file", default=None)


def client_of(url: str) -> Client:
    """Return a client of the service at `url`, with the key of `--key-file` or of the environment.

    Raises:
        ConfigError: the key file cannot be used.
    """
    from service.access.keys import key_from_file

    path = _key_file.get()
    key = os.environ.get("PANELWRIGHT_KEY") if path is None else key_from_file(path)
    ca = os.environ.get("PANELWRIGHT_CA")
    return Client(url=url.rstrip("/"), key=key or None, ca=Path(ca) if ca else None)


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
