"""Answers questions about the history: pages of readings, trends in buckets of time, and the newest of each object."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.errors import HistoryError
from service.history.parts import ids_of, parts_of, read_parts
from service.history.reading import COLUMNS, INVALID, VALID, StoredReading

MOST_ROWS = 1000
SELECTED = f"id, {', '.join(COLUMNS)}"
BATCH = 2000


@dataclass(frozen=True, slots=True, kw_only=True)
class Query:
    """Readings that are asked for.

    Attributes:
        object: name of the object; None for all.
        since_s, until_s: first and last moment, seconds since 1970; None for no bound.
    """

    cell: str
    object: str | None = None
    since_s: float | None = None
    until_s: float | None = None

    def where(self, *more: str) -> tuple[str, list[Any]]:
        """Return the condition in SQL, with its values."""
        terms, values = ["cell = ?"], list[Any]([self.cell])
        for term, value in (("object = ?", self.object), ("utc_s >= ?", self.since_s), ("utc_s <= ?", self.until_s)):
            if value is not None:
                terms.append(term)
                values.append(value)
        return f"WHERE {' AND '.join([*terms, *more])}", values


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A stored reading and its number, which rises by time of storing."""

    id: int
    reading: StoredReading


@dataclass(frozen=True, slots=True, kw_only=True)
class Bucket:
    """What was read in one span of time.

    Attributes:
        since_s, until_s: the span, seconds since 1970.
        count: readings in it; `refused` of them were invalid and count in nothing else.
        minimum, maximum, mean: of the valid values; None without any.
        states: how often each state or text was read.
    """

    since_s: float
    until_s: float
    count: int
    refused: int
    minimum: float | None
    maximum: float | None
    mean: float | None
    states: dict[str, int]


class Reader:
    """Reads the database and the Parquet parts as one history; any thread may ask.

    Connections stay open for the next questions, as many as were asked at once: to open one needs the interpreter eight times,
    which a mission keeps busy.

    Args:
        path: the SQLite file.
        parts: folder of the Parquet parts.
    """

    def __init__(self, path: Path, parts: Path) -> None:
        self._path = path
        self._parts = parts
        self._idle: list[sqlite3.Connection] = []

    def close(self) -> None:
        """Close the connections that wait for questions; a later question opens one again."""
        idle, self._idle = self._idle, []  # a connection that answers now returns to the old list, and is forgotten
        for db in idle:
            db.close()

    def page(self, query: Query, *, after: int = 0, limit: int = MOST_ROWS) -> list[Row]:
        """Return at most `limit` readings with an id above `after`, in the order in which they were stored.

        Raises:
            HistoryError: the file cannot be read.
            Unsupported: the readings are in Parquet parts, and DuckDB is not installed.
        """
        where, values = query.where("id > ?")
        tail = f"{where} ORDER BY id LIMIT {int(limit)}"
        live = f"SELECT {SELECTED} FROM readings {tail}"
        with self._open() as db:
            rows = db.execute(live, [*values, after]).fetchall()
            if parts_of(self._parts):  # else all of the history was in that one answer
                rows = read_parts(self._older(db, after=after), SELECTED, tail, [*values, after])
                rows += db.execute(live, [*values, after]).fetchall()
        return [_row(row) for row in rows[:limit]]

    def last(self, query: Query, *, limit: int) -> list[Row]:
        """Return the newest `limit` readings, in the order in which they were stored.

        Raises:
            HistoryError, Unsupported: as for `page`.
        """
        where, values = query.where()
        tail = f"{where} ORDER BY id DESC LIMIT {int(limit)}"
        live = f"SELECT {SELECTED} FROM readings {tail}"
        with self._open() as db:
            rows = db.execute(live, values).fetchall()
            if len(rows) < limit and parts_of(self._parts):
                rows = read_parts(self._older(db), SELECTED, tail, values)
                rows += db.execute(live, values).fetchall()
        return [_row(row) for row in sorted(rows, key=lambda row: int(row[0]))[-limit:]]

    def all(self, query: Query) -> Iterator[Row]:
        """Yield all readings, in pages, so that writing is never held up."""
        after = 0
        while page := self.page(query, after=after, limit=BATCH):
            yield from page
            after = page[-1].id

    def trend(self, query: Query, *, buckets: int) -> list[Bucket]:
        """Return the readings of one object down-sampled to at most `buckets` spans of equal length; empty spans are left out.

        Raises:
            HistoryError, Unsupported: as for `page`.
        """
        with self._open() as db:
            older = self._older(db)
            first_s, last_s = self._span(db, older, query)
            if first_s is None or last_s is None:
                return []
            since_s = first_s if query.since_s is None else query.since_s
            until_s = last_s if query.until_s is None else query.until_s
            width_s = max((until_s - since_s) / buckets, 1e-3)
            place = f"(utc_s - {since_s!r}) / {width_s!r}"
            where, values = query.where()
            sums = _sums(f"MIN(CAST({place} AS INTEGER), {buckets - 1})")
            found = db.execute(f"SELECT {sums} FROM readings {where} GROUP BY 1, 2", values).fetchall()
            sums = _sums(
                f"CAST(LEAST(FLOOR({place}), {buckets - 1}) AS INTEGER)"
            )  # DuckDB rounds where SQLite cuts off
            found += read_parts(older, sums, f"{where} GROUP BY 1, 2", values)
        return _merged(found, since_s, width_s)

    def newest_id(self) -> int:
        """Return the number of the newest reading of the file; 0 before the first."""
        with self._open() as db:
            row = db.execute("SELECT seq FROM sqlite_sequence WHERE name = 'readings'").fetchone()
        return 0 if row is None else int(row[0])

    def newest(self, cell: str) -> list[Row]:
        """Return the newest reading of each object of the database."""
        chosen = "SELECT MAX(id) FROM readings WHERE cell = ? GROUP BY object"
        with self._open() as db:
            rows = db.execute(
                f"SELECT {SELECTED} FROM readings WHERE id IN ({chosen}) ORDER BY object", (cell,)
            ).fetchall()
        return [_row(row) for row in rows]

    def waiting(self, cell: str, *, limit: int = 100) -> list[Row]:
        """Return the readings of the database that wait for a person, newest first."""
        asked = f"SELECT {SELECTED} FROM readings WHERE cell = ? AND doubt != '' AND answered IS NULL ORDER BY id DESC LIMIT ?"
        with self._open() as db:
            return [_row(row) for row in db.execute(asked, (cell, limit)).fetchall()]

    def count_waiting(self, cell: str) -> int:
        """Return how many readings wait for a person."""
        with self._open() as db:
            asked = "SELECT COUNT(*) FROM readings WHERE cell = ? AND doubt != '' AND answered IS NULL"
            return int(db.execute(asked, (cell,)).fetchone()[0])

    def told(self, cell: str) -> dict[str, str]:
        """Return what each object was told to be when it was read last."""
        return {row.reading.object: row.reading.told for row in self.newest(cell) if row.reading.told is not None}

    def valid_at_s(self, cell: str, names: Sequence[str]) -> dict[str, float]:
        """Return when each of the objects was read validly last, seconds since 1970."""
        newest = "SELECT utc_s FROM readings WHERE cell = ? AND object = ? AND quality = ? ORDER BY utc_s DESC LIMIT 1"
        with self._open() as db:
            found = {name: db.execute(newest, (cell, name, VALID)).fetchone() for name in names}
        return {name: float(row[0]) for name, row in found.items() if row is not None}

    def _span(self, db: sqlite3.Connection, older: Sequence[Path], query: Query) -> tuple[float | None, float | None]:
        where, values = query.where()
        spans = db.execute(f"SELECT MIN(utc_s), MAX(utc_s) FROM readings {where}", values).fetchall()
        spans += read_parts(older, "MIN(utc_s), MAX(utc_s)", where, values)
        known = [(low, high) for low, high in spans if low is not None]
        return (min(low for low, _ in known), max(high for _, high in known)) if known else (None, None)

    def _older(self, db: sqlite3.Connection, *, after: int = 0) -> list[Path]:
        """Return the parts with readings above `after` that are not in the database any more."""
        db.execute("BEGIN")  # a snapshot from here on, and the parts are listed after it: a reading is never in neither
        first = db.execute("SELECT MIN(id) FROM readings").fetchone()[0]
        ids = [(part, *ids_of(part)) for part in parts_of(self._parts)]
        return [part for part, _, last in ids if last > after and (first is None or last < first)]

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """Yield a connection for one answer."""
        idle = self._idle
        try:
            with ExitStack() as unless_answered:
                db = self._one_of(idle)
                unless_answered.callback(db.close)
                yield db
                if db.in_transaction:
                    db.execute("COMMIT")
                unless_answered.pop_all()
        except sqlite3.Error as error:
            raise HistoryError(
                f"the history {self._path} cannot be read: {error}",
                hint="see the service's log; a damaged file is set aside at the next start",
            ) from error
        idle.append(db)

    def _one_of(self, idle: list[sqlite3.Connection]) -> sqlite3.Connection:
        """Return one of the open connections, or a new one where all of them answer."""
        with suppress(IndexError):
            return idle.pop()
        uri = f"{self._path.absolute().as_uri()}?mode=ro"
        return sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False, timeout=5.0)


def _sums(number: str) -> str:
    """Return the columns of a trend: bucket, what was shown in words, counts, extremes and sum of the values.

    What a person has said about a reading takes the place of what was read.
    """
    value, words, refused = (
        f"CASE WHEN answered IS NULL THEN {read} ELSE {said} END"
        for read, said in (
            ("value", "final_value"),
            ("COALESCE(state, text)", "COALESCE(final_state, final_text)"),
            (
                f"CASE WHEN quality = '{INVALID}' THEN 1 ELSE 0 END",
                "CASE WHEN COALESCE(CAST(final_value AS VARCHAR), final_state, final_text) IS NULL THEN 1 ELSE 0 END",
            ),
        )
    )
    return (
        f"{number}, CASE WHEN ({value}) IS NULL THEN ({words}) END, COUNT(*), "
        f"SUM({refused}), MIN({value}), MAX({value}), SUM({value}), COUNT({value})"
    )


def _merged(found: Sequence[tuple[Any, ...]], since_s: float, width_s: float) -> list[Bucket]:
    """Join the sums of database and parts, bucket by bucket."""
    by_number: dict[int, list[tuple[Any, ...]]] = {}
    for number, *sums in found:
        by_number.setdefault(int(number), []).append(tuple(sums))
    buckets: list[Bucket] = []
    for number, rows in sorted(by_number.items()):
        values = [row for row in rows if row[6]]
        count = sum(row[6] for row in values)
        states: dict[str, int] = {}
        for row in rows:
            if row[0] is not None:
                states[row[0]] = states.get(row[0], 0) + int(row[1])
        buckets.append(
            Bucket(
                since_s=since_s + number * width_s,
                until_s=since_s + (number + 1) * width_s,
                count=sum(int(row[1]) for row in rows),
                refused=sum(int(row[2]) for row in rows),
                minimum=min((row[3] for row in values), default=None),
                maximum=max((row[4] for row in values), default=None),
                mean=sum(row[5] for row in values) / count if count else None,
                states=states,
            )
        )
    return buckets


def _row(row: Sequence[Any]) -> Row:
    return Row(id=int(row[0]), reading=StoredReading(**dict(zip(COLUMNS, row[1:], strict=True))))
