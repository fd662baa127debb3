"""The face of a package: the names that it gives to other rooms, each loaded when it is first used (PEP 562).

A package lists its names once as imports that only type checkers run, and once in `__all__`:

    if TYPE_CHECKING:
        from fusion.robust import FusedPose, fuse

    __all__ = ["FusedPose", "fuse"]
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
    """A module's `__getattr__`, which imports a name from where the `if TYPE_CHECKING:` block of `file` has it from.

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
        setattr(sys.modules[package], name, value)  # the next use finds it without coming here
        return value

    return load


def _homes(source: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """Name, and the module and name that it stands for, of every import under `if TYPE_CHECKING:`."""
    for block in ast.parse(source).body:
        if isinstance(block, ast.If) and isinstance(block.test, ast.Name) and block.test.id == "TYPE_CHECKING":
            for line in block.body:
                if isinstance(line, ast.ImportFrom) and line.module is not None:
                    for alias in line.names:
                        yield alias.asname or alias.name, (line.module, alias.name)
