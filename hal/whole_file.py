"""Files that are replaced in one step: after a crash or a full disk the old one or the new one is there, never half."""

from __future__ import annotations

import os
from pathlib import Path

NEW = ".new"  # after the whole name: no pattern for the file itself meets it


def write_whole(path: Path, text: str) -> Path:
    """Put `text` (UTF-8) in the place of the file at `path`; returns `path`.

    Raises:
        OSError: it cannot be written; what was there is there still.
    """
    fresh = path.with_name(path.name + NEW)
    with fresh.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)
    return path
