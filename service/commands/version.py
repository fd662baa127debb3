"""`panelwright --version` and `--key-file`, which stand before the command."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def _show(is_asked: bool) -> None:
    if not is_asked:
        return
    from importlib.metadata import version

    typer.echo(f"panelwright {version('panelwright')}, Python {sys.version.split()[0]}")
    raise typer.Exit


def root(
    context: typer.Context,
    *,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=_show)
    ] = False,
    key_file: Annotated[
        Path | None,
        typer.Option(
            envvar="PANELWRIGHT_KEY_FILE",
            help="File with the key for a service that needs one; or set PANELWRIGHT_KEY.",
        ),
    ] = None,
) -> None:
    """A robot cell that inspects and operates industrial control panels."""
    del version  # handled by its callback
    if key_file is not None:
        from service.commands.common import use_key_file

        use_key_file(key_file, context)
