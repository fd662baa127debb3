"""The older parts of a journal: files beside the live one to which rows were moved.

A part is written completely under a temporary name and then renamed, so it exists with all its rows or not at all.
"""

from __future__ import annotations

import os
import re
import secrets
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from hal.atomic_write import NEW, flush_folder

SCHEMA = """
CREATE TABLE IF NOT EXISTS journal (
    id INTEGER PRIMARY KEY,
    wall_time_s REAL NOT NULL,
    monotonic_s REAL NOT NULL,
    kind TEXT NOT NULL,
    data TEXT NOT NULL,
    previous_hash TEXT NOT NULL,
    hash TEXT NOT NULL UNIQUE
)
"""
HEAD_SCHEMA = "CREATE TABLE IF NOT EXISTS head (one INTEGER PRIMARY KEY CHECK (one = 1), last_id INTEGER, seal TEXT)"
INSERT_ROW = "INSERT INTO journal VALUES (?,?,?,?,?,?,?)"
Row = tuple[Any, ...]


def key_of(live: Path) -> bytes:
    """Return the secret that seals the end of the journal; makes it if there is none.

    Raises:
        OSError: it cannot be read or written.
    """
    live.parent.mkdir(parents=True, exist_ok=True)
    path = live.with_suffix(".key")
    try:
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        return path.read_bytes()
    with os.fdopen(number, "wb") as file:
        key = secrets.token_bytes(32)
        file.write(key)
        file.flush()
        os.fsync(file.fileno())
    return key


def marks_of(live: Path) -> tuple[tuple[int, int] | None, ...]:
    """Return what identifies the open files of a journal (device and inode); None for a file that does not exist."""
    files = (live, live.with_name(live.name + "-wal"), live.with_suffix(".key"))
    return tuple(_mark(path) for path in files)


def _mark(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def parts_of(live: Path) -> list[Path]:
    """Return the older parts of the journal whose live file is `live`, oldest first."""
    name = re.compile(rf"{re.escape(live.stem)}-\d{{12}}-\d{{12}}{re.escape(live.suffix)}")
    return sorted(path for path in live.parent.iterdir() if name.fullmatch(path.name))


def newest_first(live: Path) -> Iterator[Path]:
    """Yield all files of a journal, the live one first.

    The parts are listed after the live file was read, so rows that were moved out of it are found in a part.
    """
    yield live
    yield from reversed(parts_of(live))


@contextmanager
def snapshot(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a journal file for reading at its present state; rows that are moved meanwhile stay visible."""
    uri = path.absolute().as_uri()  # escapes characters such as % and ? in folder names
    with closing(sqlite3.connect(f"{uri}?mode=ro", uri=True, isolation_level=None)) as db:
        db.execute("BEGIN")
        db.execute("SELECT 1 FROM journal LIMIT 1").fetchone()  # the first read fixes the snapshot
        yield db


def write_part(live: Path, rows: Iterable[Row], *, first_id: int, last_id: int) -> Path:
    """Write the rows with these ids as a part beside `live`; returns its path when it is on the disk.

    Raises:
        OSError, sqlite3.Error: the part cannot be written; no incomplete file remains.
    """
    path = live.with_name(f"{live.stem}-{first_id:012d}-{last_id:012d}{live.suffix}")
    fresh = path.with_name(path.name + NEW)
    fresh.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(fresh, isolation_level=None)) as db:
            db.execute("PRAGMA journal_mode=DELETE")
            db.execute("PRAGMA synchronous=FULL")
            db.execute(SCHEMA)
            db.execute("BEGIN")
            db.executemany(INSERT_ROW, rows)
            db.execute("COMMIT")
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)
    flush_folder(path.parent)
    return path
