"""Writes `docs/reference/commands.md` from the commands themselves: `python -m tests.docs.commands_page`."""

from __future__ import annotations

from pathlib import Path

import typer.main
from typer.cli import get_docs_for_click

from service.cli import _app

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "commands.md"


def text() -> str:
    """Return the page as generated from the commands."""
    command = typer.main.get_command(_app())
    page = get_docs_for_click(obj=command, ctx=typer.Context(command), name="panelwright", title="Command line")
    return "\n".join(line.rstrip() for line in page.strip().splitlines()).replace("```console", "```text") + "\n"


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
