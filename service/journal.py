"""The journal: what was asked, started, stopped and ended, in SQLite, each row chained to the one before by its hash.

One thread writes. `append` returns when the row is on disk; rows that wait together share one commit, so that a burst
of events costs one flush of the disk. Two services on one folder (a demo beside `serve`) keep one chain.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import queue
import sqlite3
import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.errors import JournalError

FIRST_HASH = "0" * 64
MAX_GROUP = 200
MAX_KEPT = 1000  # notes that wait for room on the disk
log = logging.getLogger(__name__)
APPEND_TIMEOUT_S = 10.0
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """One row. `wall_time_s` is for people; `monotonic_s` orders what happened within one run."""

    id: int
    wall_time_s: float
    monotonic_s: float
    kind: str
    data: dict[str, Any]
    previous_hash: str
    hash: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _Entry:
    kind: str
    text: str
    wall_time_s: float
    monotonic_s: float
    done: Future[None] | None  # None: nobody waits for it


class Journal:
    """An append-only record of the cell.

    Args:
        path: SQLite file; made when missing.

    Raises:
        JournalError: it cannot be opened for writing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting: queue.SimpleQueue[_Entry | None] = queue.SimpleQueue()
        self._is_closed = False
        ready: Future[None] = Future()
        self._thread = threading.Thread(target=self._write, args=(ready,), name="journal", daemon=True)
        self._thread.start()
        ready.result()

    def append(self, kind: str, data: dict[str, Any]) -> None:
        """Record durably; returns after the commit.

        Raises:
            JournalError: the disk is full or read-only, or the journal is closed.
        """
        try:
            done: Future[None] = Future()
            self._put(kind, data, done)
            done.result(APPEND_TIMEOUT_S)
        except TimeoutError as error:
            raise JournalError(
                f"the journal {self.path} did not take a record in {APPEND_TIMEOUT_S:.0f} s",
                hint="the disk is too slow or hangs; nothing may move without a record",
            ) from error

    def note(self, kind: str, data: dict[str, Any]) -> None:
        """Record soon, without waiting; for what nobody's permission hangs on. On a full disk it waits for room."""
        if not self._is_closed:
            self._put(kind, data, None)

    def records(self, *, kinds: tuple[str, ...] = (), limit: int = 1000) -> list[Record]:
        """The newest records of the given kinds (all when empty), oldest first."""
        where = f"WHERE kind IN ({','.join('?' * len(kinds))})" if kinds else ""
        sql = f"SELECT * FROM (SELECT * FROM journal {where} ORDER BY id DESC LIMIT ?) ORDER BY id"  # noqa: S608 - only ?s
        with self._reader() as db:
            return [_record(row) for row in db.execute(sql, (*kinds, limit))]

    def verify(self) -> int:
        """Walk the whole chain; returns the number of rows.

        Raises:
            JournalError: a row was changed, removed or inserted; names it.
        """
        previous, expected_id = FIRST_HASH, 1
        with self._reader() as db:
            for row in db.execute("SELECT * FROM journal ORDER BY id"):
                number, wall_s, mono_s, kind, text, said_previous, said = row
                real = _hash(previous, wall_s, mono_s, kind, text)
                if (number, said_previous, said) != (expected_id, previous, real):
                    raise JournalError(
                        f"{self.path}: the chain breaks at row {number}",
                        hint="somebody changed the file; keep it and begin a new one",
                        row=number,
                    )
                previous, expected_id = real, expected_id + 1
        return expected_id - 1

    def close(self) -> None:
        """Write what waits and close; a second call does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        self._waiting.put(None)
        self._thread.join(APPEND_TIMEOUT_S)

    def _put(self, kind: str, data: dict[str, Any], done: Future[None] | None) -> None:
        if self._is_closed or not self._thread.is_alive():
            raise JournalError("the journal is closed", hint="restart the service")
        entry = _Entry(
            kind=kind,
            text=json.dumps(data, separators=(",", ":"), allow_nan=False),
            wall_time_s=time.time(),
            monotonic_s=time.monotonic(),
            done=done,
        )
        self._waiting.put(entry)

    def _reader(self) -> contextlib.closing[sqlite3.Connection]:
        uri = self.path.absolute().as_uri()  # a folder may be called "50% off?"
        return contextlib.closing(sqlite3.connect(f"{uri}?mode=ro", uri=True))

    def _write(self, ready: Future[None]) -> None:
        try:
            db = _opened(self.path)
        except (sqlite3.Error, OSError) as error:
            ready.set_exception(_error(self.path, error))
            return
        ready.set_result(None)
        is_last, kept = False, list[_Entry]()
        while not is_last:
            group, is_last = self._next_group()
            kept = _commit(db, self.path, [*kept, *group])
        db.close()

    def _next_group(self) -> tuple[list[_Entry], bool]:
        """All entries that wait now (at least one, unless the journal ends), and whether they are the last."""
        group: list[_Entry] = []
        entry = self._waiting.get()
        while entry is not None:
            group.append(entry)
            if len(group) == MAX_GROUP:
                return group, False
            try:
                entry = self._waiting.get_nowait()
            except queue.Empty:
                return group, False
        return group, True


def _opened(path: Path) -> sqlite3.Connection:
    path.parent.mkdir(parents=True, exist_ok=True)
    db = sqlite3.connect(path, isolation_level=None)
    db.execute("PRAGMA journal_mode=WAL")
    db.execute("PRAGMA synchronous=FULL")  # NORMAL may lose the newest commits in a power cut
    db.execute(SCHEMA)
    return db


def _last_hash(db: sqlite3.Connection) -> str:
    row = db.execute("SELECT hash FROM journal ORDER BY id DESC LIMIT 1").fetchone()
    return str(row[0]) if row is not None else FIRST_HASH


def _commit(db: sqlite3.Connection, path: Path, group: list[_Entry]) -> list[_Entry]:
    """Write a group in one transaction and tell its callers; returns the notes that found no room."""
    if not group:
        return []
    try:
        db.execute("BEGIN IMMEDIATE")
        newest = _last_hash(db)  # under the lock, for another service may have written since
        for entry in group:
            digest = _hash(newest, entry.wall_time_s, entry.monotonic_s, entry.kind, entry.text)
            row = (entry.wall_time_s, entry.monotonic_s, entry.kind, entry.text, newest, digest)
            db.execute(
                "INSERT INTO journal (wall_time_s, monotonic_s, kind, data, previous_hash, hash) VALUES (?,?,?,?,?,?)",
                row,
            )
            newest = digest
        db.execute("COMMIT")
    except sqlite3.Error as error:
        with contextlib.suppress(sqlite3.Error):  # a disk that takes no commit may take no rollback; callers are told
            db.execute("ROLLBACK")
        notes = [entry for entry in group if entry.done is None]
        if notes:
            log.error("not recorded yet: %s: %s", ", ".join(entry.kind for entry in notes), error)
        for entry in group:
            if entry.done is not None:
                entry.done.set_exception(_error(path, error))
        return notes[-MAX_KEPT:]
    for entry in group:
        if entry.done is not None:
            entry.done.set_result(None)
    return []


def _hash(previous: str, wall_time_s: float, monotonic_s: float, kind: str, text: str) -> str:
    parts = json.dumps([previous, wall_time_s, monotonic_s, kind, text], separators=(",", ":"))
    return hashlib.sha256(parts.encode()).hexdigest()


def _record(row: tuple[Any, ...]) -> Record:
    number, wall_s, mono_s, kind, text, previous, digest = row
    return Record(
        id=number,
        wall_time_s=wall_s,
        monotonic_s=mono_s,
        kind=kind,
        data=json.loads(text),
        previous_hash=previous,
        hash=digest,
    )


def _error(path: Path, error: Exception) -> JournalError:
    return JournalError(
        f"the journal {path} cannot be written: {error}",
        hint="free disk space and check the rights of the folder; nothing may move without a record",
    )
