"""Reads a journal with all its parts and checks its chain, without a service and without disturbing one."""

from __future__ import annotations

import hashlib
import hmac
import json
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.errors import JournalError
from service.tasks.journal_parts import newest_first, parts_of, snapshot

FIRST_HASH = "0" * 64
DROPPED = "journal-dropped"  # kind of the row that records which of the oldest rows were deleted
MAX_ID = 2**62


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """One row of the journal. `wall_time_s` is for display; `monotonic_s` gives the order within one run."""

    id: int
    wall_time_s: float
    monotonic_s: float
    kind: str
    data: dict[str, Any]
    previous_hash: str
    hash: str


def read_records(path: Path, *, kinds: tuple[str, ...] = (), limit: int = 1000) -> list[Record]:
    """Return the newest records of the given kinds (of all kinds when empty), oldest first.

    Raises:
        JournalError: the journal cannot be read.
    """
    where = f"AND kind IN ({','.join('?' * len(kinds))})" if kinds else ""
    sql = f"SELECT * FROM journal WHERE id < ? {where} ORDER BY id DESC LIMIT ?"  # noqa: S608 - only ?s
    found: list[Record] = []
    before = MAX_ID
    for part in newest_first(path):
        with _readable(part), snapshot(part) as db:
            found += [_record(row) for row in db.execute(sql, (before, *kinds, limit - len(found)))]
            before = min(before, _first_id(db) or MAX_ID)
        if len(found) == limit:
            break
    return found[::-1]


def verify_chain(path: Path) -> int:
    """Check the whole chain as far back as it is kept; returns the number of rows.

    Raises:
        JournalError: a row was changed, removed or inserted (the error names it), the end was cut off, or the journal
            cannot be read.
    """
    dropped = read_records(path, kinds=(DROPPED,), limit=1)
    previous, last_id = (dropped[0].data["hash"], dropped[0].data["id"]) if dropped else (FIRST_HASH, 0)
    count = 0
    with _readable(path), snapshot(path) as live, ExitStack() as files:  # before the parts are listed
        parts = [(part, files.enter_context(snapshot(part))) for part in parts_of(path)]
        for part, db in (*parts, (path, live)):
            for row in db.execute("SELECT * FROM journal WHERE id > ? ORDER BY id", (last_id,)):
                number, wall_s, mono_s, kind, text, said_previous, said = row
                real = chain_hash(previous, wall_s, mono_s, kind, text)
                if (number, said_previous, said) != (last_id + 1, previous, real):
                    raise JournalError(
                        f"{part}: the chain breaks at row {number}",
                        hint="somebody changed the file; keep it and begin a new one",
                        row=number,
                    )
                previous, last_id, count = real, number, count + 1
        _check_end(path, live, last_id, previous)
    return count


def _check_end(path: Path, live: sqlite3.Connection, last_id: int, last_hash: str) -> None:
    """Compare the newest row with the sealed head, because a chain whose end was cut off is a chain as well."""
    head = live.execute("SELECT last_id, seal FROM head").fetchone()
    try:
        key = path.with_suffix(".key").read_bytes()
    except OSError as error:
        raise JournalError(
            f"the end of {path} cannot be checked: {error}",
            hint="its key is beside it; only the service's user may read it",
        ) from error
    if head is None or (last_id, seal(key, last_id, last_hash)) != head:
        kept = "no row" if head is None else f"row {head[0]}"
        raise JournalError(
            f"{path} ends at row {last_id}, but its sealed head names {kept}",
            hint="somebody cut off its end; keep the file and begin a new one",
            row=last_id,
        )


def seal(key: bytes, last_id: int, last_hash: str) -> str:
    """Return the seal of a journal that ends with a row, which nobody can make without the key."""
    return hmac.new(key, f"{last_id} {last_hash}".encode(), hashlib.sha256).hexdigest()


def chain_hash(previous: str, wall_time_s: float, monotonic_s: float, kind: str, text: str) -> str:
    """Return the hash of a row, computed over its content and the hash of the row before."""
    parts = json.dumps([previous, wall_time_s, monotonic_s, kind, text], separators=(",", ":"))
    return hashlib.sha256(parts.encode()).hexdigest()


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise JournalError(
            f"{path} cannot be read: {error}", hint="is it a journal of panelwright, and may this user read it?"
        ) from error


def _first_id(db: sqlite3.Connection) -> int | None:
    number: int | None = db.execute("SELECT MIN(id) FROM journal").fetchone()[0]
    return number


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
