"""`panelwright doctor`: checks the machine and a cell, and says what to do about each fault."""

from __future__ import annotations

from typing import Annotated

import typer

from service.commands.common import DEFAULT_CELL, CellOption, console
from service.commands.warm import compile_first

PORT = 8460


def doctor(
    cell: CellOption = DEFAULT_CELL,
    port: Annotated[int, typer.Option(min=0, max=65534, help="Port that `serve` would use.")] = PORT,
    connect: Annotated[bool, typer.Option(help="Also start the cell and time its devices.")] = True,
) -> None:
    """Check Python, packages, ports, the cell file and its devices; the exit code is 1 when something is wrong."""
    from service.commissioning.doctor import examine

    if connect:
        compile_first()
    if not examine(cell, port, connect=connect):
        raise typer.Exit(1)
    options = [
        *(["--cell", str(cell)] if cell != DEFAULT_CELL else []),
        *(["--port", str(port)] if port != PORT else []),
    ]
    console.print(f"everything is in order: `{' '.join(['panelwright serve', *options])}` runs it")
