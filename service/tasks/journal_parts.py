"""The older parts of a journal: files beside the live one that took over its rows, oldest first.

A part is written whole under another name and renamed, so it is there with all its rows or not at all.
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from hal.atomic_write import NEW

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
INSERT_ROW = "INSERT INTO journal VALUES (?,?,?,?,?,?,?)"
Row = tuple[Any, ...]


def parts_of(live: Path) -> list[Path]:
    """The parts of the journal whose newest rows are in `live`, oldest first."""
    name = re.compile(rf"{re.escape(live.stem)}-\d{{12}}-\d{{12}}{re.escape(live.suffix)}")
    return sorted(path for path in live.parent.iterdir() if name.fullmatch(path.name))


def newest_first(live: Path) -> Iterator[Path]:
    """All files of a journal. The parts are looked up after the live file was read: what left it is in one by then."""
    yield live
    yield from reversed(parts_of(live))


@contextmanager
def snapshot(path: Path) -> Iterator[sqlite3.Connection]:
    """A file of a journal as it is now, for reading; rows that go meanwhile stay visible."""
    uri = path.absolute().as_uri()  # a folder may be called "50% off?"
    with closing(sqlite3.connect(f"{uri}?mode=ro", uri=True, isolation_level=None)) as db:
        db.execute("BEGIN")
        db.execute("SELECT 1 FROM journal LIMIT 1").fetchone()  # the snapshot begins with the first read
        yield db


def write_part(live: Path, rows: Iterable[Row], *, first_id: int, last_id: int) -> Path:
    """Write the rows with these ids beside `live`; on the disk when it returns.

    Raises:
        OSError, sqlite3.Error: it cannot be written; nothing is left of it.
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
    folder = os.open(path.parent, os.O_RDONLY)  # the new name is on the disk once its folder is
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
    return path
