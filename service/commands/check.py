"""`panelwright check`: checks one device of a cell while it is being commissioned, with a picture and words."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from service.commands.common import DEFAULT_CELL, CellOption, SeedOption, console, read_cell


def check(
    device: Annotated[str, typer.Argument(help="Camera, force/torque sensor, lights or arm of the cell file.")],
    *,
    cell: CellOption = DEFAULT_CELL,
    seed: SeedOption = None,
    out: Annotated[Path | None, typer.Option(help="Picture to write; by default runs/check-DEVICE.png.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Confirm the small motion that checks an arm.")] = False,
) -> None:
    """Check focus and exposure of a camera, noise and payload of a wrench sensor, the lights, or how the arm follows.

    The service must not run, because two programs cannot use one device. The exit code is 1 when something is wrong.
    """
    from service.commissioning.device_checks import check_device

    def may_move(words: str) -> bool:
        return yes or typer.confirm(f"{words}. Is the cell clear?")

    found = check_device(read_cell(cell, seed), device, may_move=may_move)
    path = out or Path("runs") / f"check-{device}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(found.png)
    for finding in found.findings:
        word = "[green]good[/] " if finding.is_good else "[red]wrong[/]"
        console.print(f"{word}  {escape(finding.what)}")
        if not finding.is_good:
            console.print(f"{'':<7}try: {escape(finding.remedy)}")
    console.print(f"picture: {path}", markup=False)
    if not found.is_good:
        raise typer.Exit(1)
