"""`panelwright backup FILE` and `panelwright restore FILE`: a service's whole folder in one file, and back."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from service.commands.common import console

Runs = Annotated[
    Path, typer.Option(help="Folder of the service: reports, journal, keys, knowledge, calibrations, history.")
]
RUNS = Path("runs")


def backup(
    file: Annotated[Path, typer.Argument(help="File to write, such as cell-3.tar.gz; it has secrets and mode 0600.")],
    runs: Runs = RUNS,
) -> None:
    """Save everything that a service has stored, also while it runs, with a hash of each file."""
    from service.backup import backup as save

    manifest = save(runs, file)
    size = sum(entry.size_bytes for entry in manifest.files)
    console.print(f"{escape(str(file))}: {len(manifest.files)} files, {size / 1e6:.1f} MB, sha256 {manifest.sha256()}")


def restore(
    file: Annotated[Path, typer.Argument(help="File that `panelwright backup` wrote.")], runs: Runs = RUNS
) -> None:
    """Put a backup in place; refused while a service runs there, over newer data, and for a damaged file.

    The folder that was there is renamed and not deleted.
    """
    from service.backup import restore as put_back

    manifest, aside = put_back(file, runs)
    console.print(f"{escape(str(runs))}: {len(manifest.files)} files, every hash equal, sha256 {manifest.sha256()}")
    if aside is not None:
        console.print(f"the folder that was there is now {escape(str(aside))}")
