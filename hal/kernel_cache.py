"""Where compiled kernels are kept: in one folder for the user, each under a hash of everything that it was compiled from.

A second checkout or installation of the same sources finds them there and compiles nothing. numba's own rule looks at
the kernel's file only and keeps a kernel whose callee in another file has changed.
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
ENDINGS = tuple(PYTHON + kind for kind in (".nbi", ".1.nbc", ".2.nbc"))  # numba's: index, and one file a signature
PICKLE_STOP = b"."  # the last byte of every whole file that numba writes

_stamps: dict[str, str] = {}
_expected: dict[str, None] = {}


@cache
def folder() -> Path:
    """Return the folder of the compiled kernels, made when it is not there.

    It is `NUMBA_CACHE_DIR` or `panelwright/kernels` in the user's cache folder. Where that cannot be written, a private
    temporary folder takes its place, and every process compiles for itself.
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
    """Tells numba where a function's machine code is kept, and for which sources it is valid.

    numba finds this class by its name, see `hal.jit`, and asks it what its own locators are asked.
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
        """Remove files that are empty or cut off, as after a power failure; numba would raise when it reads them."""
        for ending in ENDINGS:
            file = folder() / f"{self._name}{ending}"
            with contextlib.suppress(OSError):  # most often there is no such file
                if not _is_whole(file):
                    file.unlink()

    def ensure_cache_path(self) -> None:
        """Make the folder again if somebody has removed it meanwhile."""
        folder().mkdir(parents=True, exist_ok=True, mode=0o700)

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(folder())

    def get_source_stamp(self) -> str:
        """Return the hash of all sources; numba compiles again what was kept under another one."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Return what tells files of functions of the same name apart."""
        return f"{self._line}-{self._stamp[:STAMP_DIGITS]}"


def stamp_of(module: str, names: Mapping[str, Any], path: Path) -> str:
    """Hash what the kernels of a module are compiled from.

    That is the module's file, the files of compiled functions that it imports and so on, the values of imported
    constants (they become part of the machine code), and the versions of Python and the compiler.

    Args:
        names: the module's names at the time of its first compiled function, when all its imports are done.
    """
    if module not in _stamps:
        _stamps[module] = ""  # a circle of imports ends here
        parts = [module.encode(), _versions(), path.read_bytes()]
        for name, value in sorted(names.items()):
            if not name.startswith("__") and (described := _what(value)):  # `__file__` is another one in each checkout
                parts.append(f"{name}={described}".encode())
        _stamps[module] = hashlib.sha256(b"\0".join(parts)).hexdigest()
    return _stamps[module]


def _what(value: Any) -> str:
    """Describe a global that a kernel may use; empty for what no kernel can use or what belongs to its own file."""
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
        return repr(getattr(value, "_fields", ""))  # of a named tuple
    function = getattr(value, "py_func", value)  # of a compiled function, else of a helper that others compile in
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
    """Return those of the names that are not compiled yet."""
    kept = {file.name.removesuffix(ENDINGS[0]) for file in _files() if file.suffix == ".nbi"}
    return set(names) - kept


def bound_size(limit_bytes: int = LIMIT_BYTES) -> None:
    """Remove the files that were written longest ago until the folder is below the limit."""
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
    """Make numba keep kernels here.

    Args:
        settings: `numba.config`; `CACHE_LOCATOR_CLASSES` is what `NUMBA_CACHE_LOCATOR_CLASSES` in the environment sets.
    """
    settings.CACHE_LOCATOR_CLASSES = f"{__name__}.{SourceHashLocator.__name__}"


def register_helper(function: Any) -> None:
    """Make a helper that is compiled into others part of their hashes."""
    stamp_of(function.__module__, function.__globals__, Path(function.__code__.co_filename))
