"""`panelwright --version`."""

from __future__ import annotations

import sys
from typing import Annotated

import typer


def _show(is_asked: bool) -> None:
    if not is_asked:
        return
    from importlib.metadata import version

    typer.echo(f"panelwright {version('panelwright')}, Python {sys.version.split()[0]}")
    raise typer.Exit


def root(
    *,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=_show)
    ] = False,
) -> None:
    """A robot cell that inspects and operates industrial control panels."""
