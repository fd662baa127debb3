"""The SQLite file of the history: opened only if it is whole and of a version that this program knows."""

from __future__ import annotations

import logging
import os
import sqlite3
import time
from contextlib import closing, suppress
from pathlib import Path

from service.errors import HistoryError

VERSION = 2
MAGIC = b"SQLite format 3\0"
LOG_BYTES = 2_000_000  # of the write-ahead log on disk, which holds some 100 readings
MOST_LOG_PAGES = 10_000  # 40 MB: then the call that stores a reading moves the log itself
SCHEMA = """
CREATE TABLE IF NOT EXISTS readings (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    cell TEXT NOT NULL, panel TEXT NOT NULL,
    object TEXT NOT NULL, kind TEXT NOT NULL,
    utc_s REAL NOT NULL, cell_s REAL NOT NULL,
    quality TEXT NOT NULL, cause TEXT NOT NULL,
    value REAL, unit TEXT NOT NULL, sigma REAL,
    state TEXT, text TEXT, confidence REAL NOT NULL, guess TEXT,
    verb TEXT NOT NULL, task TEXT NOT NULL, mission TEXT NOT NULL, asked_by TEXT NOT NULL, phase TEXT NOT NULL,
    told TEXT, crop TEXT,
    doubt TEXT NOT NULL DEFAULT '', certificate TEXT, answered TEXT, final_value REAL, final_state TEXT, final_text TEXT
);
CREATE INDEX IF NOT EXISTS readings_of_object ON readings (cell, object, utc_s);
CREATE INDEX IF NOT EXISTS readings_in_order ON readings (cell, object, id);
CREATE INDEX IF NOT EXISTS readings_in_doubt ON readings (cell, id) WHERE doubt != '' AND answered IS NULL;
"""
FROM_VERSION_1 = (
    "doubt TEXT NOT NULL DEFAULT ''",
    "certificate TEXT",
    "answered TEXT",
    "final_value REAL",
    "final_state TEXT",
    "final_text TEXT",
)
log = logging.getLogger(__name__)


def open_history(path: Path) -> tuple[sqlite3.Connection, Path | None]:
    """Open the history for writing, created if missing; a damaged file is set aside under another name.

    Returns:
        The connection, and the new path of a damaged file that was set aside.

    Raises:
        HistoryError: the file is of a newer version, which is left as it is; or the folder cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _refuse_newer(path, _version_in(path))
        try:
            return _opened(path), None
        except sqlite3.OperationalError:
            raise  # a full or locked disk is no damage
        except sqlite3.DatabaseError:
            aside = set_aside(path)
            return _opened(path), aside
    except (sqlite3.Error, OSError) as error:
        raise cannot_write(path, error) from error


def is_damaged(error: sqlite3.Error) -> bool:
    """Return whether an error says that the file itself is damaged."""
    return isinstance(error, sqlite3.DatabaseError) and (
        "malformed" in str(error) or "not a database" in str(error) or "corrupt" in str(error)
    )


def cannot_write(path: Path, error: Exception) -> HistoryError:
    """Return the error for a history that cannot be written."""
    return HistoryError(
        f"the history {path} cannot be written: {error}",
        hint="free disk space and check the rights of the folder; no reading is reported that is not stored",
        file=str(path),
    )


def checkpoint(path: Path) -> None:
    """Move what was stored from the write-ahead log into the database, beside those that read and write.

    What comes meanwhile stays in the log until the next time.
    """
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True, isolation_level=None)) as db:
            db.execute("PRAGMA wal_checkpoint(PASSIVE)")
    except sqlite3.Error as error:  # the readings are in the log
        log.warning("the log of the history %s stays as long as it is: %s", path, error)


def set_aside_beside(path: Path) -> list[Path]:
    """Return the damaged files that were set aside, oldest first."""
    return sorted(path.parent.glob(f"{path.stem}-damaged-*{path.suffix}"))


def _opened(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=10.0)
    try:
        found = db.execute("PRAGMA quick_check(1)").fetchone()[0]
        if found != "ok":
            raise sqlite3.DatabaseError(f"malformed: {found}")
        _refuse_newer(path, db.execute("PRAGMA user_version").fetchone()[0])
        db.execute("PRAGMA journal_mode=WAL")
        db.execute("PRAGMA synchronous=FULL")  # NORMAL may lose the newest readings in a power failure
        db.execute(f"PRAGMA journal_size_limit={LOG_BYTES}")
        db.execute(f"PRAGMA wal_autocheckpoint={MOST_LOG_PAGES}")
        known = {row[1] for row in db.execute("PRAGMA table_info(readings)")}
        for column in FROM_VERSION_1:
            if known and column.partition(" ")[0] not in known:
                db.execute(f"ALTER TABLE readings ADD COLUMN {column}")
        db.executescript(SCHEMA)
        db.execute(f"PRAGMA user_version={VERSION}")
        _give_log_its_space(path)
    except BaseException:
        db.close()
        raise
    return db


def _give_log_its_space(path: Path) -> None:
    """Fill the write-ahead log with zeros up to its usual size, so that a reading overwrites blocks that the file has.

    SQLite ignores what follows the last valid frame. When a file grows, a worker of the file system that has no priority completes
    the write: 2 to 4 ms later, in one of a hundred times, while missions run.
    """
    with suppress(OSError), path.with_name(f"{path.name}-wal").open("r+b") as file:
        file.seek(0, os.SEEK_END)
        file.write(bytes(max(0, LOG_BYTES - file.tell())))
        file.flush()
        os.fsync(file.fileno())


def _version_in(path: Path) -> int:
    """Return the version in the file's header, read without opening it as a database, which could change it."""
    try:
        with path.open("rb") as file:
            header = file.read(64)
    except FileNotFoundError:
        return 0
    return int.from_bytes(header[60:64], "big") if header.startswith(MAGIC) and len(header) == 64 else 0


def _refuse_newer(path: Path, version: int) -> None:
    if version > VERSION:
        raise HistoryError(
            f"the history {path} was written by a newer panelwright (version {version} of the file, this one knows {VERSION})",
            hint="use that panelwright, or another folder (--runs); the file has not been changed",
            file=str(path),
        )


def set_aside(path: Path) -> Path:
    """Rename a damaged file and what belongs to it; returns the new path."""
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    aside = path.with_name(f"{path.stem}-damaged-{stamp}{path.suffix}")
    number = 1
    while aside.exists():
        number += 1
        aside = path.with_name(f"{path.stem}-damaged-{stamp}-{number}{path.suffix}")
    path.replace(aside)
    for ending in ("-wal", "-shm"):
        beside = path.with_name(path.name + ending)
        if beside.exists():
            beside.replace(aside.with_name(aside.name + ending))
    return aside
