"""Loads the public names of a package when they are first used (PEP 562).

A package lists its names once as imports that only type checkers run, and once in `__all__`:

    if TYPE_CHECKING:
        from fusion.robust import FusedPose, fuse

    __all__ = ["FusedPose", "fuse"]
    if not TYPE_CHECKING:  # else type checkers would take every name from the package
        __getattr__ = load_on_first_use(__name__, __file__)

Importing such a package costs a fraction of a millisecond, whatever its names bring along.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any


def load_on_first_use(package: str, file: str) -> Callable[[str], Any]:
    """Return a module's `__getattr__` that imports names from the modules in the `if TYPE_CHECKING:` block of `file`.

    Args:
        package: `__name__` of the package.
        file: `__file__` of the package.
    """
    homes = dict(_homes(Path(file).read_text(encoding="utf-8")))

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, original = homes[name]
        is_submodule = module == package  # `from manipulation import plausibility`, in manipulation itself
        value = import_module(f"{package}.{original}") if is_submodule else getattr(import_module(module), original)
        setattr(sys.modules[package], name, value)  # the next use does not call `__getattr__`
        return value

    return load


def _homes(source: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield each name imported under `if TYPE_CHECKING:`, with its module and its name there."""
    for block in ast.parse(source).body:
        if isinstance(block, ast.If) and isinstance(block.test, ast.Name) and block.test.id == "TYPE_CHECKING":
            for line in block.body:
                if isinstance(line, ast.ImportFrom) and line.module is not None:
                    for alias in line.names:
                        yield alias.asname or alias.name, (line.module, alias.name)
