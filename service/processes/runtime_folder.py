"""The folder of a running service for latch, heartbeats, sockets and temporary files of the cell."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from pathlib import Path
from typing import IO

PREFIX = "panelwright-"
LOCK = "lock"


class RuntimeFolder:
    """A folder that only this user can access; folders of services that were killed are removed first.

    The process holds a lock on a file of its folder. The operating system releases the lock when the process ends, however
    it ends, so a folder whose lock is free belongs to nobody.
    """

    def __init__(self) -> None:
        clear_abandoned(Path(tempfile.gettempdir()))
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX))
        fresh = self.path / f"{LOCK}.new"  # the name that others look for appears when the lock is held
        self._lock = fresh.open("w")
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        fresh.rename(self.path / LOCK)

    def close(self) -> None:
        """Remove the folder; a second call does nothing."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._lock.close()


def clear_abandoned(parent: Path) -> None:
    """Remove the runtime folders of this user whose service has ended."""
    for folder in parent.glob(PREFIX + "*"):
        with contextlib.suppress(OSError):
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            with (folder / LOCK).open("r+") as lock:
                if _is_free(lock):
                    shutil.rmtree(folder, ignore_errors=True)


def _is_free(lock: IO[str]) -> bool:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
