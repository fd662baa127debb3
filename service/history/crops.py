"""Pictures of objects as files that are named by their content, bounded in size."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import secrets
from pathlib import Path

NAME = re.compile(r"[0-9a-f]{64}")
AROUND = "-around"
LOOK_EVERY = 200  # pictures between two looks at the size of the folder
log = logging.getLogger(__name__)


class Crops:
    """A folder of PNG files `ab/abcd….png`; the same picture is stored once. Of doubted readings, `abcd…-around.png` shows
    the plate around the object, from which its look can be taught.

    A picture is not forced to the disk, so the newest ones may be lost in a power failure; readings are not.
    """

    def __init__(self, folder: Path, *, max_bytes: float) -> None:
        self._folder = folder
        self._max_bytes = max_bytes
        self._until_look = 0

    def add(self, png: bytes) -> str | None:
        """Store a picture and return its name; None when no pictures are kept or the disk does not take it."""
        if self._max_bytes <= 0.0:
            return None
        name = hashlib.sha256(png).hexdigest()
        return name if self._write(self._path(name), png) else None

    def add_surroundings(self, name: str, png: bytes) -> None:
        """Store the surroundings of a kept picture; nothing when the disk does not take them."""
        self._write(self._path(f"{name}{AROUND}"), png)

    def surroundings(self, name: str) -> bytes | None:
        """Return the surroundings of a picture; None if none are kept."""
        path = self._path(f"{name}{AROUND}")
        return path.read_bytes() if NAME.fullmatch(name) and path.is_file() else None

    def _write(self, path: Path, png: bytes) -> bool:
        try:
            if path.exists():
                os.utime(path)  # the newest use decides what is deleted first
                return True
            path.parent.mkdir(parents=True, exist_ok=True)
            fresh = path.with_name(f".{secrets.token_hex(6)}")
            fresh.write_bytes(png)
            fresh.replace(path)
        except OSError as error:
            log.warning("a picture cannot be kept in %s: %s", self._folder, error.strerror or error)
            return False
        self._until_look -= 1
        if self._until_look < 0:
            self._until_look = LOOK_EVERY
            self.shrink()
        return True

    def path(self, name: str) -> Path | None:
        """Return the file of a picture; None for a name that is no picture's, or of one that is not kept any more."""
        if not NAME.fullmatch(name) or not self._path(name).is_file():
            return None
        return self._path(name)

    def shrink(self) -> None:
        """Delete the pictures that were used longest ago until the folder is at most as large as allowed."""
        found = [
            (status.st_mtime, status.st_size, path) for path in self._folder.glob("*/*.png") if (status := _of(path))
        ]
        excess = sum(size for _, size, _ in found) - self._max_bytes
        for _, size, path in sorted(found):
            if excess <= 0.0:
                return
            path.unlink(missing_ok=True)
            excess -= size

    def _path(self, name: str) -> Path:
        return self._folder / name[:2] / f"{name}.png"


def _of(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except FileNotFoundError:  # deleted meanwhile by another service on the same folder
        return None
