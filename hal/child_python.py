"""How a Python module is started in a process of its own."""

from __future__ import annotations

import sys


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command line that runs an importable module with this interpreter.

    `-P` keeps the current folder off the child's import path: a user's own `hal.py` or `drivers.py` in the folder
    where the command was given must not be taken for ours. `PYTHONPATH` counts as usual.
    """
    return [sys.executable, "-P", "-m", module, *arguments]
