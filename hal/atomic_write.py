"""Replaces a file atomically: after a crash or on a full disk, either the old or the new file is complete."""

from __future__ import annotations

import os
from pathlib import Path

NEW = ".new"  # appended to the whole name, so that no pattern for the file itself matches it


def write_atomically(path: Path, text: str) -> Path:
    """Replace the file at `path` by `text` (UTF-8) and return `path`.

    Raises:
        OSError: the file cannot be written; the old content is still there.
    """
    fresh = path.with_name(path.name + NEW)
    with fresh.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)
    return path
