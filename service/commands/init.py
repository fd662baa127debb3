"""`panelwright init`: copies a cell with all its files into a folder for editing."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from service.commands.common import DEFAULT_CELL, console


def init(
    folder: Annotated[Path, typer.Argument(help="Folder for the files; created if missing.")],
    *,
    cell: Annotated[Path, typer.Option("--cell", help="Cell file to start from, shipped or your own.")] = (
        DEFAULT_CELL
    ),
) -> None:
    """Copy a cell file with its panel, calibration records and taught looks into FOLDER for editing."""
    from service.commissioning.new_cell import copy_cell

    copied = copy_cell(cell, folder)
    for place, count in Counter(path.parent for path in copied.files).items():
        console.print(f"wrote {place}: {count} {'file' if count == 1 else 'files'}", markup=False)
    name = copied.cell.relative_to(folder)
    is_default = name == DEFAULT_CELL
    option = "" if is_default else f" --cell {name}"
    console.print("\nwhat to do next:")
    steps = {
        f"cd {folder}": "reports, measurements and the journal go to runs/ there",
        f"panelwright doctor{option}": "checks the cell file and this machine",
        f"panelwright demo{option}": "runs a whole mission",
        f"panelwright serve{option}": "serves the cell over HTTP",
    }
    for command, why in steps.items():
        console.print(f"  {command:<{max(map(len, steps))}}  {why}", markup=False)
    console.print(
        f"edit {name} (devices, drivers, where the panel stands) and {copied.panel.relative_to(folder)} (its objects)",
        markup=False,
    )
