"""`panelwright report`: writes the report of a mission once more, as a page or as a PDF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hal.errors import NotFound
from service.commands.common import console


def report(
    mission: Annotated[str, typer.Argument(help="Name of a mission, its folder, or `last` for the newest one.")],
    *,
    pdf: Annotated[bool, typer.Option("--pdf", help="Write `report.pdf` in place of the page.")] = False,
    runs: Annotated[Path, typer.Option(help="Folder with the reports.")] = Path("runs"),
) -> None:
    """Write the report of a mission as one file to hand on; no service is needed."""
    from service.report.write import render, write_pdf

    folder = folder_of(mission, runs)
    path = write_pdf(folder, folder / "report.pdf") if pdf else render(folder)
    console.print(f"report: {path}", markup=False, highlight=False, soft_wrap=True)


def folder_of(mission: str, runs: Path) -> Path:
    """Return the folder of a mission.

    Raises:
        NotFound: there is no report of that name.
    """
    known = sorted(path.parent for path in runs.glob("*/report.json"))
    if mission == "last" and known:
        return known[-1]
    for folder in (runs / mission, Path(mission)):
        if (folder / "report.json").is_file():
            return folder
    newest = ", ".join(folder.name for folder in reversed(known[-3:])) or "none"
    raise NotFound(f"there is no report of mission {mission!r} in {runs}", hint=f"newest missions there: {newest}")
