"""The journal of requests, starts, stops and ends in SQLite; the hash of each row covers the hash of the row before.

One thread writes. `append` returns when the row is on disk; rows that wait at the same time share one commit, so a burst
of events costs one disk flush. Two services on one folder (a demo beside `serve`) write one chain.

The disk space is bounded: the rows of a file that has grown too large are moved to an older part
(`journal-<first>-<last>.sqlite`), and the oldest part is deleted when there are too many. Rows are copied first and deleted
afterwards, so each row always exists in at least one file; readers read all parts as one journal. A row of the chain
records which rows were deleted, so that `verify_chain` can distinguish this from tampering.
"""

from __future__ import annotations

import contextlib
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

from service.access.actor import signed
from service.errors import JournalError
from service.tasks.journal_parts import (
    HEAD_SCHEMA,
    INSERT_ROW,
    SCHEMA,
    key_of,
    marks_of,
    parts_of,
    snapshot,
    write_part,
)
from service.tasks.journal_reader import DROPPED, FIRST_HASH, Record, chain_hash, read_records, seal, verify_chain

MAX_GROUP = 200
MAX_KEPT = 1000  # notes kept in memory while the disk is full
PART_BYTES = 16_000_000  # some ten thousand rows
KEEP_PARTS = 8  # together with the live file about 150 MB
LOST = "journal-lost"  # kind of the first row after the files of the journal were deleted while a service ran
FAILED = "journal-failed"  # kind of the row that says that a commit failed before
log = logging.getLogger(__name__)
APPEND_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Entry:
    kind: str
    text: str
    wall_time_s: float
    monotonic_s: float
    done: Future[None] | None  # None for a note, which nobody waits for

    @classmethod
    def now(cls, kind: str, data: dict[str, Any], done: Future[None] | None = None) -> _Entry:
        """Return an entry with the present time."""
        text = json.dumps(data, separators=(",", ":"), allow_nan=False)
        return cls(kind=kind, text=text, wall_time_s=time.time(), monotonic_s=time.monotonic(), done=done)


WAKE = _Entry.now("wake", {})  # never written


class Journal:
    """An append-only record of what happened in the cell.

    Args:
        path: SQLite file, created if missing. Older parts are in the same folder.
        part_bytes: size from which the rows of the file are moved to a new part.
        keep_parts: number of older parts that are kept.

    Raises:
        JournalError: the file cannot be opened for writing.
    """

    def __init__(self, path: Path, *, part_bytes: int = PART_BYTES, keep_parts: int = KEEP_PARTS) -> None:
        self.path = path
        self._part_bytes, self._keep_parts = part_bytes, keep_parts
        self._hand_over_at = part_bytes
        self._waiting: queue.SimpleQueue[_Entry | None] = queue.SimpleQueue()
        self._is_closed = False
        self._marks = marks_of(path)
        self._ended: tuple[int, str] | None = None  # the last row of files that were deleted
        self.failure: str | None = None  # why the last commit failed
        self.losses = 0  # how often its files were deleted or replaced while it was open
        ready: Future[None] = Future()
        self._thread = threading.Thread(target=self._write, args=(ready,), name="journal", daemon=True)
        self._thread.start()
        ready.result()

    def append(self, kind: str, data: dict[str, Any], *, timeout_s: float = APPEND_TIMEOUT_S) -> None:
        """Record durably and return after the commit.

        Raises:
            JournalError: the disk is full or read-only, or the journal is closed.
        """
        try:
            done: Future[None] = Future()
            self._put(kind, data, done)
            done.result(timeout_s)
        except TimeoutError as error:
            raise JournalError(
                f"the journal {self.path} did not store a record within {timeout_s:.0f} s",
                hint="the disk is too slow or hangs; nothing may move without a record",
            ) from error

    def note(self, kind: str, data: dict[str, Any]) -> None:
        """Record without waiting, for events that no permission depends on; kept in memory while the disk is full."""
        if not self._is_closed:
            self._put(kind, data, None)

    def records(self, *, kinds: tuple[str, ...] = (), limit: int = 1000) -> list[Record]:
        """Return the newest records of the given kinds (of all kinds when empty), oldest first."""
        return read_records(self.path, kinds=kinds, limit=limit)

    def try_again(self) -> None:
        """Write what could not be written before, and begin new files if the old ones were deleted; returns at once."""
        self._waiting.put(WAKE)

    def is_lost(self) -> bool:
        """Whether its files were deleted or replaced; rows that are written now would be in no file."""
        return marks_of(self.path) != self._marks

    def verify(self) -> int:
        """Check the whole chain; see `verify_chain`."""
        return verify_chain(self.path)

    def close(self) -> None:
        """Write all waiting entries and close; a second call does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        self._waiting.put(None)
        self._thread.join(APPEND_TIMEOUT_S)

    def _put(self, kind: str, data: dict[str, Any], done: Future[None] | None) -> None:
        if self._is_closed or not self._thread.is_alive():
            raise JournalError("the journal is closed", hint="restart the service")
        self._waiting.put(_Entry.now(kind, signed(data), done))

    def _write(self, ready: Future[None]) -> None:
        try:
            key = key_of(self.path)
            db = _opened(self.path, key)
        except (sqlite3.Error, OSError) as error:
            ready.set_exception(_error(self.path, error))
            return
        self._marks = marks_of(self.path)
        ready.set_result(None)
        is_last, kept = False, list[_Entry]()
        while not is_last:
            group, is_last = self._next_group()
            if self.is_lost() and not is_last:
                kept, (db, key) = _refuse(self.path, [*kept, *group]), self._begin_again(db, key)
                continue
            kept, self.failure = _commit(db, self.path, [*kept, *group], key)
            if self.failure is None:
                self._hand_over(db, key)
        db.close()

    def _begin_again(self, db: sqlite3.Connection, key: bytes) -> tuple[sqlite3.Connection, bytes]:
        """Open new files in place of those that were deleted; the first row says where the old chain ended."""
        with contextlib.suppress(sqlite3.Error):  # it is closed already when the last attempt failed
            self._ended = db.execute("SELECT id, hash FROM journal ORDER BY id DESC LIMIT 1").fetchone()
            db.close()  # before the new files are opened, because connections of a process share what they know of the WAL
        try:
            fresh_key = key_of(self.path)
            fresh = _opened(self.path, fresh_key)
            told = _Entry.now(
                LOST, {"last": None if self._ended is None else dict(zip(("id", "hash"), self._ended, strict=True))}
            )
            _, self.failure = _commit(fresh, self.path, [told], fresh_key)
        except (sqlite3.Error, OSError) as error:
            self.failure = str(error)
            log.error("%s was deleted and cannot be made again: %s", self.path, error)
            return db, key
        self._marks = marks_of(self.path)
        self.losses += 1
        log.error("%s was deleted or replaced while the service ran; a new one begins", self.path)
        return fresh, fresh_key

    def _hand_over(self, db: sqlite3.Connection, key: bytes) -> None:
        """Move rows to an older part when the live file is too large; a failure loses no row and is tried again later."""
        size = _size_bytes(db)
        if size <= self._hand_over_at:
            return
        self._hand_over_at = self._part_bytes
        try:
            hand_over(db, self.path, key, part_bytes=self._part_bytes, keep_parts=self._keep_parts)
        except (sqlite3.Error, OSError) as error:
            with contextlib.suppress(sqlite3.Error):
                db.execute("ROLLBACK")
            self._hand_over_at = size + self._part_bytes // 4
            log.error("%s has %.0f MB and cannot be divided: %s", self.path, size / 1e6, error)

    def _next_group(self) -> tuple[list[_Entry], bool]:
        """Wait for entries; returns all that wait (none only when the journal ends) and whether they are the last."""
        group: list[_Entry] = []
        entry = self._waiting.get()
        while entry is not None:
            if entry is not WAKE:
                group.append(entry)
            if len(group) == MAX_GROUP:
                return group, False
            try:
                entry = self._waiting.get_nowait()
            except queue.Empty:
                return group, False
        return group, True


def _opened(path: Path, key: bytes) -> sqlite3.Connection:
    db = sqlite3.connect(path, isolation_level=None)
    db.execute("PRAGMA journal_mode=WAL")
    db.execute("PRAGMA synchronous=FULL")  # NORMAL may lose the newest commits in a power cut
    db.execute("PRAGMA journal_size_limit=4000000")  # the WAL is cut back after a large group
    db.execute(SCHEMA)
    is_sealed = db.execute("SELECT COUNT(*) FROM sqlite_master WHERE name = 'head'").fetchone()[0]
    if not is_sealed:  # new, or of a version that had no seal
        db.execute("BEGIN IMMEDIATE")
        db.execute(HEAD_SCHEMA)
        _seal_end(db, key)
        db.execute("COMMIT")
    return db


def _seal_end(db: sqlite3.Connection, key: bytes) -> None:
    """Seal the newest row, in the transaction that wrote it."""
    newest = db.execute("SELECT id, hash FROM journal ORDER BY id DESC LIMIT 1").fetchone() or (0, FIRST_HASH)
    db.execute("INSERT OR REPLACE INTO head VALUES (1, ?, ?)", (newest[0], seal(key, *newest)))


def _last_hash(db: sqlite3.Connection) -> str:
    row = db.execute("SELECT hash FROM journal ORDER BY id DESC LIMIT 1").fetchone()
    return str(row[0]) if row is not None else FIRST_HASH


def _refuse(path: Path, group: list[_Entry]) -> list[_Entry]:
    """Tell the callers of a group that their entries were not written; returns the notes, which nobody waits for."""
    for entry in group:
        if entry.done is not None:
            entry.done.set_exception(_error(path, OSError("its files were deleted or replaced")))
    return [entry for entry in group if entry.done is None][-MAX_KEPT:]


def _commit(db: sqlite3.Connection, path: Path, group: list[_Entry], key: bytes) -> tuple[list[_Entry], str | None]:
    """Write a group in one transaction and notify its callers.

    Returns the notes that did not fit on the disk, and why the commit failed.
    """
    if not group:
        return [], None
    try:
        db.execute("BEGIN IMMEDIATE")
        for entry in group:
            _insert(db, entry)
        _seal_end(db, key)
        db.execute("COMMIT")
    except sqlite3.Error as error:
        with contextlib.suppress(sqlite3.Error):  # after a failed commit this may fail too
            db.execute("ROLLBACK")
        notes = [entry for entry in group if entry.done is None]
        if not any(entry.kind == FAILED for entry in notes):
            notes.append(_Entry.now(FAILED, {"why": str(error)}))
        if len(notes) > 1:
            log.error("not recorded yet: %s: %s", ", ".join(entry.kind for entry in notes), error)
        for entry in group:
            if entry.done is not None:
                entry.done.set_exception(_error(path, error))
        return notes[-MAX_KEPT:], str(error)
    for entry in group:
        if entry.done is not None:
            entry.done.set_result(None)
    return [], None


def _insert(db: sqlite3.Connection, entry: _Entry) -> None:
    newest = _last_hash(db)  # read under the lock, because another service may have written meanwhile
    digest = chain_hash(newest, entry.wall_time_s, entry.monotonic_s, entry.kind, entry.text)
    row = (None, entry.wall_time_s, entry.monotonic_s, entry.kind, entry.text, newest, digest)
    db.execute(INSERT_ROW, row)


def hand_over(db: sqlite3.Connection, path: Path, key: bytes, *, part_bytes: int, keep_parts: int) -> None:
    """Move all rows except the newest, which the chain continues from, to a new part; delete the oldest parts.

    Raises:
        sqlite3.Error, OSError: the move failed; every row still exists in at least one file.
    """
    db.execute("BEGIN IMMEDIATE")
    if _size_bytes(db) <= part_bytes:  # another service has done it meanwhile
        db.execute("ROLLBACK")
        return
    first_id, last_id = db.execute("SELECT MIN(id), MAX(id) - 1 FROM journal").fetchone()
    if first_id <= last_id:
        rows = db.execute("SELECT * FROM journal WHERE id <= ? ORDER BY id", (last_id,))
        write_part(path, rows, first_id=first_id, last_id=last_id)
        db.execute("DELETE FROM journal WHERE id <= ?", (last_id,))
    dropped = parts_of(path)[:-keep_parts]
    if dropped:
        _insert(db, _dropped(dropped))
        _seal_end(db, key)
    db.execute("COMMIT")
    for part in dropped:
        part.unlink(missing_ok=True)


def _dropped(parts: list[Path]) -> _Entry:
    """Return the row that records which rows were deleted."""
    with snapshot(parts[-1]) as db:
        number, digest = db.execute("SELECT id, hash FROM journal ORDER BY id DESC LIMIT 1").fetchone()
    return _Entry.now(DROPPED, {"id": number, "hash": digest, "files": [part.name for part in parts]})


def _size_bytes(db: sqlite3.Connection) -> int:
    """Return the bytes that the rows occupy; free pages do not count."""
    pages, free, size = (
        int(db.execute(f"PRAGMA {what}").fetchone()[0]) for what in ("page_count", "freelist_count", "page_size")
    )
    return (pages - free) * size


def _error(path: Path, error: Exception) -> JournalError:
    return JournalError(
        f"the journal {path} cannot be written: {error}",
        hint="free disk space and check the rights of the folder; nothing may move without a record",
    )
