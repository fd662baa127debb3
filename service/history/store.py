"""Keeps the readings of a cell: a reading that `add` has taken is on disk, and the store stays within its bounds."""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from hal.errors import CellError
from hal.plant import HistorySection
from service.errors import NoSuchTask, NotPossibleNow
from service.history.crops import Crops
from service.history.database import cannot_write, checkpoint, is_damaged, open_history, set_aside_beside
from service.history.parts import ids_of, need_engine, part_path, parts_of, write_parquet
from service.history.query import Query, Reader, Row
from service.history.reading import COLUMNS, StoredReading

DAY_S = 86_400.0
TRIM_EVERY_S = 3600.0  # between two looks at the age of the oldest reading
TRIM_EVERY_ADDS = 1000  # between two looks at the size
TRIM_SHARE = 0.1  # of the readings leave at once when the file is too large
CHECKPOINT_EVERY_ADDS = 50  # in a thread of its own, as trimming: the call that stores would take 20 to 50 ms
KEPT_NEWEST = 200  # readings in memory, for those that follow
ALL = ("id", "cell", "panel", *COLUMNS)
ROW = f"({', '.join('?' * (2 + len(COLUMNS)))})"
INSERT = f"INSERT INTO readings (cell, panel, {', '.join(COLUMNS)}) VALUES "
log = logging.getLogger(__name__)


class History:
    """The history of one cell in a folder, which other services may share.

    Args:
        folder: holds `history.sqlite`, `crops/` and `parts/`.
        cell, panel: names that every reading gets; a query returns the readings of this cell only.
        bounds: of the cell file.
        now_s: seconds since 1970.

    Raises:
        HistoryError: the file is of a newer version or cannot be written.
        Unsupported: the bounds ask for Parquet files, and DuckDB is not installed.
    """

    def __init__(
        self,
        folder: Path,
        *,
        cell: str,
        panel: str,
        bounds: HistorySection | None = None,
        now_s: Callable[[], float] = time.time,
    ) -> None:
        self._bounds = HistorySection() if bounds is None else bounds
        if self._bounds.parquet:
            need_engine()  # raises now, rather than when the first readings leave the database
        self.path = folder / "history.sqlite"
        self.crops = Crops(folder / "crops", max_bytes=1e6 * self._bounds.crops_max_mb)
        self._parts = folder / "parts"
        self._cell, self._panel, self._now_s = cell, panel, now_s
        self._lock = threading.Lock()
        self._adds, self._trimmed_s = 0, float("-inf")
        self.version = 0  # rises with all that is stored
        self._newest: tuple[Row, ...] = ()  # the newest readings of this cell without a gap
        self._reader = Reader(self.path, self._parts)
        self._thread = ThreadPoolExecutor(1, "history-upkeep")
        self._db, aside = open_history(self.path)
        self.set_aside_now = aside
        if aside is not None:
            log.error("the history was damaged: it is kept as %s, and a new one was begun", aside)
        self._join_parts()

    @property
    def set_aside(self) -> list[Path]:
        """Damaged files that were set aside, oldest first."""
        return set_aside_beside(self.path)

    def reader(self) -> Reader:
        """Return what answers questions."""
        return self._reader

    def ask(self, **given: object) -> Query:
        """Return a question about this cell; see `Query`."""
        return Query(cell=self._cell, **given)  # type: ignore[arg-type]  # the fields of Query check themselves

    def add(self, readings: Sequence[StoredReading]) -> None:
        """Store readings; they are on disk and visible to every reader when this returns.

        Raises:
            HistoryError: they could not be stored, so they must not be reported.
        """
        if not readings:
            return
        rows = [(self._cell, self._panel, *(getattr(reading, name) for name in COLUMNS)) for reading in readings]
        with self._lock:
            try:
                last_id = self._insert(rows)
            except sqlite3.Error as error:
                if not is_damaged(error):
                    raise cannot_write(self.path, error) from error
                self._begin_anew()
                last_id = self._retry(rows)
            added = tuple(Row(id=last_id - len(rows) + k, reading=one) for k, one in enumerate(readings, start=1))
            self._newest = (*self._newest, *added)[-KEPT_NEWEST:]
            self.version += 1
            self._adds += 1
            if self._adds % CHECKPOINT_EVERY_ADDS == 0:
                self._thread.submit(checkpoint, self.path)
            if self._adds >= TRIM_EVERY_ADDS or self._now_s() - self._trimmed_s >= TRIM_EVERY_S:
                self._adds, self._trimmed_s = 0, self._now_s()
                self._thread.submit(self._trim_or_say)

    def answer(self, reading_id: int, *, said: str, value: float | None, state: str | None, text: str | None) -> Row:
        """Store what a person says about a reading, beside what was read; returns the reading as it is now.

        Args:
            said: the answer as JSON.
            value, state, text: what the reading shows by that answer.

        Raises:
            NoSuchTask: there is no such reading in the database.
            NotPossibleNow: nobody asked about it, or it is answered already.
            HistoryError: it could not be stored.
        """
        with self._lock:
            try:
                changed = self._db.execute(
                    "UPDATE readings SET answered = ?, final_value = ?, final_state = ?, final_text = ? "
                    "WHERE id = ? AND cell = ? AND doubt != '' AND answered IS NULL",
                    (said, value, state, text, reading_id, self._cell),
                ).rowcount
                self._newest = ()
                self.version += 1
            except sqlite3.Error as error:
                raise cannot_write(self.path, error) from error
        found = self.row(reading_id)
        if not changed:
            is_answered = found.reading.answered is not None
            what = "has an answer already" if is_answered else "is sure, so there is no question about it"
            raise NotPossibleNow(
                f"reading {reading_id} {what}", hint="GET /v1/review lists what waits", state="settled"
            )
        return found

    def row(self, reading_id: int) -> Row:
        """Return a reading of the database by its number.

        Raises:
            NoSuchTask: there is none.
        """
        found = self.reader().page(self.ask(), after=reading_id - 1, limit=1)
        if not found or found[0].id != reading_id:
            raise NoSuchTask(f"there is no reading {reading_id} of this cell", hint="GET /v1/review lists what waits")
        return found[0]

    def after(self, reading_id: int, *, limit: int) -> list[Row]:
        """Return at most `limit` readings of this cell with a larger id, oldest first.

        The newest ones come from memory: a question to the file waits for the lock of Python several times.

        Raises:
            HistoryError, Unsupported: as for `Reader.page`.
        """
        newest = self._newest
        if newest and reading_id >= newest[0].id - 1:
            return [row for row in newest if row.id > reading_id][:limit]
        return self._reader.page(self.ask(), after=reading_id, limit=limit)

    def newest(self) -> list[StoredReading]:
        """Return the newest reading of each object of this cell."""
        return [row.reading for row in self.reader().newest(self._cell)]

    def told(self) -> dict[str, str]:
        """Return what each object was last told to be, from its newest reading."""
        return self.reader().told(self._cell)

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._thread.shutdown(cancel_futures=True)
        with self._lock:
            self._reader.close()
            self._db.close()

    def trim(self) -> None:
        """Move or delete the readings that are too old or too many.

        Raises:
            HistoryError, Unsupported: that failed; no reading is lost.
        """
        with self._lock:
            try:
                self._move_until(self._last_too_old())
                while self._size_bytes() > 1e6 * self._bounds.max_mb and self._move_until(self._last_of_share()):
                    pass
            except (sqlite3.Error, OSError) as error:
                with suppress(sqlite3.Error):
                    self._db.execute("ROLLBACK")
                raise cannot_write(self.path, error) from error

    def _trim_or_say(self) -> None:
        try:
            self.trim()
        except CellError as error:  # the reading itself is stored
            log.error("the history is larger than it should be: %s", error.what)

    def _insert(self, rows: Sequence[tuple[object, ...]]) -> int:
        """Return the id of the last row.

        One statement for all rows, which is a transaction of its own: each further call of SQLite may wait for the lock of
        Python.
        """
        done = self._db.execute(INSERT + ", ".join([ROW] * len(rows)), [value for row in rows for value in row])
        return int(done.lastrowid or 0)

    def _begin_anew(self) -> None:
        """Set the damaged file aside and begin a new one."""
        self._reader.close()
        with suppress(sqlite3.Error):
            self._db.close()
        self._db, aside = open_history(self.path)
        self.set_aside_now = aside or self.set_aside_now
        self._newest = ()
        self._join_parts()
        log.error("the history was damaged while it was used: it is kept as %s", aside)

    def _retry(self, rows: Sequence[tuple[object, ...]]) -> int:
        try:
            return self._insert(rows)
        except sqlite3.Error as error:
            raise cannot_write(self.path, error) from error

    def _last_too_old(self) -> int:
        """Return the id before the first reading that is young enough; clocks that were set do not hurt."""
        cutoff_s = self._now_s() - DAY_S * self._bounds.keep_days
        young = self._db.execute("SELECT MIN(id) FROM readings WHERE utc_s >= ?", (cutoff_s,)).fetchone()[0]
        newest: int | None = self._db.execute("SELECT MAX(id) FROM readings").fetchone()[0]
        return (newest or 0) if young is None else int(young) - 1

    def _last_of_share(self) -> int:
        first, last = self._db.execute("SELECT MIN(id), MAX(id) FROM readings").fetchone()
        return 0 if first is None else int(first + TRIM_SHARE * (last - first))

    def _move_until(self, last_id: int) -> bool:
        """Let the readings up to this id leave the database; returns whether any did."""
        first_id = self._db.execute("SELECT MIN(id) FROM readings WHERE id <= ?", (last_id,)).fetchone()[0]
        if first_id is None:
            return False
        if self._bounds.parquet:
            self._parts.mkdir(parents=True, exist_ok=True)
            rows = self._db.execute(f"SELECT {', '.join(ALL)} FROM readings WHERE id <= ? ORDER BY id", (last_id,))
            write_parquet(part_path(self._parts, int(first_id), last_id), ALL, rows)
        self._db.execute("DELETE FROM readings WHERE id <= ?", (last_id,))
        return True

    def _join_parts(self) -> None:
        """Let the numbers of new readings follow those of the parts; a file that was begun anew starts at 1.

        Parts whose readings are still in the database are deleted: the service ended between the two steps of a move.
        """
        first = self._db.execute("SELECT MIN(id) FROM readings").fetchone()[0]
        for part in parts_of(self._parts):
            if first is not None and ids_of(part)[1] >= first:
                part.unlink(missing_ok=True)
        last = max((ids_of(part)[1] for part in parts_of(self._parts)), default=0)
        if first is None and last > 0:
            self._db.execute("DELETE FROM sqlite_sequence WHERE name = 'readings' AND seq < ?", (last,))
            row = "SELECT 'readings', ? WHERE NOT EXISTS (SELECT 1 FROM sqlite_sequence WHERE name = 'readings')"
            self._db.execute(f"INSERT INTO sqlite_sequence (name, seq) {row}", (last,))

    def _size_bytes(self) -> float:
        """Return the bytes that the readings occupy; free pages do not count."""
        pages, free, size = (
            int(self._db.execute(f"PRAGMA {what}").fetchone()[0])
            for what in ("page_count", "freelist_count", "page_size")
        )
        return float((pages - free) * size)
