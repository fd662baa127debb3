"""Prints to the terminal, and finds the cell file that a person names."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from rich.console import Console

ROOT = Path(__file__).parents[1]
LOG_WIDTH = 160  # width without a terminal; at 80 columns tables lose the device names
console = Console(
    highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else LOG_WIDTH
)


def find_cell(path: Path) -> Path:
    """Return `path` as given if it exists, else the shipped file of that name."""
    shipped = ROOT / path
    is_elsewhere = not path.exists() and not path.is_absolute() and shipped.parent.is_dir()
    return shipped if is_elsewhere and (shipped.exists() or not path.parent.is_dir()) else path
