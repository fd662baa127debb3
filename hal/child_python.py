"""Starts Python modules in separate processes."""

from __future__ import annotations

import sys


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command line that runs an importable module with this interpreter.

    `-P` keeps the current folder off the child's import path: a user's own `hal.py` or `drivers.py` in the folder
    where the command was given must not be imported instead of ours. `PYTHONPATH` applies as usual.
    """
    return [sys.executable, "-P", "-m", module, *arguments]
