"""Replaces a file atomically: after a crash or on a full disk, either the old or the new file is complete."""

from __future__ import annotations

import os
from pathlib import Path

NEW = ".new"  # appended to the whole name, so that no pattern for the file itself matches it


def write_atomically(path: Path, text: str, *, mode: int | None = None) -> Path:
    """Replace the file at `path` by `text` (UTF-8) and return `path`; on return, the change survives a power failure.

    Args:
        mode: permissions of the file, from before its first byte; None for those that the process's mask allows.

    Raises:
        OSError: the file cannot be written; the old content is still there.
    """
    fresh = path.with_name(path.name + NEW)
    number = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666 if mode is None else mode)
    with os.fdopen(number, "w", encoding="utf-8") as file:
        if mode is not None:
            os.fchmod(number, mode)  # of a file that a killed process left
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)
    flush_folder(path.parent)
    return path


def flush_folder(folder: Path) -> None:
    """Make the names in a folder durable: a new, changed or deleted name survives a power failure only after this."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
