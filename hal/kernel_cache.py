"""Stores compiled kernels in one folder per user, each under a hash of everything that it was compiled from.

A second checkout or installation of the same sources therefore compiles nothing. numba's own cache checks the kernel's
file only and would reuse a kernel although a function that it calls in another file has changed.
"""

from __future__ import annotations

import atexit
import contextlib
import enum
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

STAMP_DIGITS = 24
LIMIT_BYTES = 1_000_000_000  # about ten sets of all kernels
PYTHON = f".py{sys.version_info[0]}{sys.version_info[1]}{sys.abiflags}"
ENDINGS = tuple(PYTHON + kind for kind in (".nbi", ".1.nbc", ".2.nbc"))  # numba's: index, and one file per signature
PICKLE_STOP = b"."  # last byte of every complete file that numba writes

_stamps: dict[str, str] = {}
_expected: dict[str, None] = {}


@cache
def folder() -> Path:
    """Return the folder of the compiled kernels; it is created if it does not exist.

    It is `NUMBA_CACHE_DIR` or `panelwright/kernels` in the user's cache folder. If that is not writable, a temporary
    folder of this process is used, so every process compiles its own kernels.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    caches = os.environ.get("XDG_CACHE_HOME") or str(Path("~/.cache").expanduser())
    wanted = Path(chosen) if chosen else Path(caches) / "panelwright" / "kernels"
    with contextlib.suppress(OSError):
        wanted.mkdir(parents=True, exist_ok=True, mode=0o700)
        tempfile.TemporaryFile(dir=wanted).close()
        return wanted
    private = tempfile.mkdtemp(prefix="panelwright-kernels-")
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    return Path(private)


class SourceHashLocator:
    """Tells numba where a function's machine code is stored, and for which sources it is valid.

    numba imports this class by the name that `use` sets, and calls it instead of its own locators.
    """

    def __init__(self, function: FunctionType, path: str) -> None:
        self._stamp = stamp_of(function.__module__, function.__globals__, Path(path))
        self._line = function.__code__.co_firstlineno
        self._name = f"{Path(path).stem}.{function.__qualname__}-{self.get_disambiguator()}"
        _expected[self._name] = None

    @classmethod
    def from_function(cls, function: FunctionType, path: str) -> SourceHashLocator:
        """Return the locator of a function."""
        locator = cls(function, path)
        locator._drop_damaged_files()
        return locator

    def _drop_damaged_files(self) -> None:
        """Remove files that are empty or cut off, as after a power failure, because numba would fail to read them."""
        for ending in ENDINGS:
            file = folder() / f"{self._name}{ending}"
            with contextlib.suppress(OSError):  # usually there is no such file
                if not _is_whole(file):
                    file.unlink()

    def ensure_cache_path(self) -> None:
        """Create the folder again if it was removed in the meantime."""
        folder().mkdir(parents=True, exist_ok=True, mode=0o700)

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(folder())

    def get_source_stamp(self) -> str:
        """Return the hash of all sources; numba compiles a kernel again if its stored hash differs."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Return the part of the file name that distinguishes functions of the same name."""
        return f"{self._line}-{self._stamp[:STAMP_DIGITS]}"


def stamp_of(module: str, names: Mapping[str, Any], path: Path) -> str:
    """Return a hash of everything that the kernels of a module are compiled from.

    That is the module's file, the files of the compiled functions that it imports, directly or indirectly, the values
    of imported constants (they become part of the machine code), and the versions of Python and the compiler.

    Args:
        names: the module's global names when its first function is compiled; by then all its imports are done.
    """
    if module not in _stamps:
        _stamps[module] = ""  # ends the recursion for circular imports
        parts = [module.encode(), _versions(), path.read_bytes()]
        for name, value in sorted(names.items()):
            if not name.startswith("__") and (described := _what(value)):  # `__file__` differs between checkouts
                parts.append(f"{name}={described}".encode())
        _stamps[module] = hashlib.sha256(b"\0".join(parts)).hexdigest()
    return _stamps[module]


def _what(value: Any) -> str:
    """Return the part of the hash for one global; empty if kernels cannot use it or its own file already covers it."""
    if isinstance(value, ModuleType):
        return _stamps.get(value.__name__, "")
    if isinstance(value, bool | int | float | complex | str | bytes | np.generic):
        return repr(value)
    if isinstance(value, tuple):
        return repr([_what(entry) for entry in value])
    if isinstance(value, np.ndarray):
        return hashlib.sha256(value.tobytes()).hexdigest() + repr((value.shape, value.dtype))
    if isinstance(value, enum.EnumType):
        members: Mapping[str, enum.Enum] = value.__members__
        return repr([(name, _what(member.value)) for name, member in members.items()])
    if isinstance(value, type):
        return repr(getattr(value, "_fields", ""))  # a named tuple's fields
    function = getattr(value, "py_func", value)  # a compiled function has `py_func`; an inlined helper has not
    return _stamps.get(function.__module__, "") if isinstance(function, FunctionType) else ""


@cache
def _versions() -> bytes:
    packages = ("numba", "llvmlite", "numpy")
    return " ".join([sys.version, *(version(package) for package in packages)]).encode()


def _is_whole(file: Path) -> bool:
    with file.open("rb") as stream:
        if stream.seek(0, os.SEEK_END) == 0:
            return False
        stream.seek(-1, os.SEEK_END)
        return stream.read() == PICKLE_STOP


def expected() -> tuple[str, ...]:
    """Return the names of all kernels of the modules that this process has imported."""
    return tuple(_expected)


def missing(names: Iterable[str]) -> set[str]:
    """Return the names that are not compiled yet."""
    kept = {file.name.removesuffix(ENDINGS[0]) for file in _files() if file.suffix == ".nbi"}
    return set(names) - kept


def bound_size(limit_bytes: int = LIMIT_BYTES) -> None:
    """Remove the oldest files until the folder is below the limit."""
    total, sizes = 0, []
    for file in _files():
        with contextlib.suppress(OSError):
            status = file.stat()
            sizes.append((status.st_mtime, status.st_size, file))
            total += status.st_size
    for _, size, file in sorted(sizes, key=lambda row: row[0]):
        if total <= limit_bytes:
            return
        with contextlib.suppress(OSError):
            file.unlink()
        total -= size


def _files() -> Iterable[Path]:
    return [file for file in folder().iterdir() if file.suffix in (".nbi", ".nbc")]


def use(settings: Any) -> None:
    """Make numba use this cache.

    Args:
        settings: `numba.config`; the environment variable `NUMBA_CACHE_LOCATOR_CLASSES` sets the same entry.
    """
    settings.CACHE_LOCATOR_CLASSES = f"{__name__}.{SourceHashLocator.__name__}"


def register_helper(function: Any) -> None:
    """Include a helper, which is compiled into other functions, in the hashes of those functions."""
    stamp_of(function.__module__, function.__globals__, Path(function.__code__.co_filename))
