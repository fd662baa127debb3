"""The durable record of rounds: up to which time each is settled, and how each run went.

A run is settled in the transaction that writes its row, and a row is one for each time of a round. So no run can be lost or
doubled by a service that ends between two steps.
"""

from __future__ import annotations

import secrets
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from hal.plant import RoundSection
from service.errors import HistoryError
from service.history.database import set_aside

VERSION = 1
KEEP_RUNS = 10_000
NEWER = "a newer run was due"
SCHEMA = """
CREATE TABLE IF NOT EXISTS rounds (
    name TEXT PRIMARY KEY, plan TEXT NOT NULL, settled_s REAL NOT NULL, definition TEXT
);
CREATE TABLE IF NOT EXISTS runs (
    round TEXT NOT NULL, due_s REAL NOT NULL, state TEXT NOT NULL, why TEXT NOT NULL DEFAULT '', mission TEXT NOT NULL,
    key TEXT NOT NULL, task TEXT, begun_s REAL, ended_s REAL, settled_before_s REAL NOT NULL,
    PRIMARY KEY (round, due_s)
);
"""
SELECTED = "SELECT round, due_s, state, why, mission, key, task, begun_s, ended_s FROM runs"


class RunState(StrEnum):
    """How a run of a round went."""

    BEGINNING = "beginning"  # recorded, and not yet known whether its task was accepted
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"  # the service ended while it ran
    MISSED = "missed"


OPEN = (RunState.BEGINNING, RunState.RUNNING)


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One run of a round.

    Attributes:
        due_s: the time of the cron expression, seconds since 1970, as `begun_s` and `ended_s`.
        why: why it was missed, failed or ended early; empty otherwise.
        key: the idempotency key of its task, by which a restarted service recognises it; empty for a missed one.
        task: the task that ran it; None if none did.
    """

    round: str
    due_s: float
    state: RunState
    mission: str
    why: str = ""
    key: str = ""
    task: str | None = None
    begun_s: float | None = None
    ended_s: float | None = None


class RoundBook:
    """The record in a SQLite file. A damaged one is set aside, and a new one is begun, so that the rounds go on from now.

    Attributes:
        set_aside_now: new path of a damaged file that was set aside at this start; None if there was none.

    Raises:
        HistoryError: the file cannot be used, or is of a newer version. The same holds for every method.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.RLock()
        self.set_aside_now: Path | None = None
        path.parent.mkdir(parents=True, exist_ok=True)
        with self._errors():
            try:
                self._db = self._opened()
            except sqlite3.OperationalError:
                raise  # a full or locked disk is no damage
            except sqlite3.DatabaseError:
                self.set_aside_now = set_aside(path)
                self._db = self._opened()

    def _opened(self) -> sqlite3.Connection:
        db = sqlite3.connect(self._path, isolation_level=None, check_same_thread=False, timeout=10.0)
        try:
            version = int(db.execute("PRAGMA user_version").fetchone()[0])
            if version > VERSION:
                raise HistoryError(
                    f"the record of rounds {self._path} was written by a newer panelwright (version {version})",
                    hint="use that panelwright, or another folder (--runs); the file has not been changed",
                    file=str(self._path),
                )
            found = db.execute("PRAGMA quick_check(1)").fetchone()[0]
            if found != "ok":
                raise sqlite3.DatabaseError(f"malformed: {found}")
            db.execute("PRAGMA journal_mode=WAL")
            db.execute("PRAGMA synchronous=FULL")
            db.executescript(SCHEMA)
            db.execute(f"PRAGMA user_version={VERSION}")
        except BaseException:
            db.close()
            raise
        return db

    def settled_s(self, section: RoundSection, now_s: float) -> float:
        """Return the time up to which a round is settled; a new round, or one with another plan, begins now."""
        plan = f"{section.cron} {section.zone}"
        with self._changing():
            row = self._db.execute("SELECT plan, settled_s FROM rounds WHERE name = ?", (section.name,)).fetchone()
            if row is not None and row[0] == plan:
                return float(row[1])
            newest = self._db.execute("SELECT MAX(due_s) FROM runs WHERE round = ?", (section.name,)).fetchone()[0]
            settled_s = max(now_s, newest or 0.0)  # after a clock that was set back, too
            self._db.execute(
                "INSERT INTO rounds (name, plan, settled_s) VALUES (?, ?, ?) "
                "ON CONFLICT (name) DO UPDATE SET plan = excluded.plan, settled_s = excluded.settled_s",
                (section.name, plan, settled_s),
            )
        return settled_s

    def begin(self, section: RoundSection, due_s: float, now_s: float) -> Run:
        """Record that a run begins, before its task is asked for."""
        key = f"round {section.name} {due_s:.0f} {secrets.token_hex(4)}"
        with self._changing():
            self._put(section, due_s, RunState.BEGINNING, key=key, begun_s=now_s)
        return self._run(section.name, due_s)

    def withdraw(self, run: Run) -> None:
        """Undo the beginning of a run whose task did not begin; it is due again, unless a newer one was settled meanwhile."""
        at = (run.round, run.due_s)
        with self._changing():
            (newest_s,) = self._db.execute("SELECT settled_s FROM rounds WHERE name = ?", (run.round,)).fetchone()
            if newest_s > run.due_s:
                self._set(run, state=RunState.MISSED, why=NEWER)
                return
            (before_s,) = self._db.execute(
                "SELECT settled_before_s FROM runs WHERE round = ? AND due_s = ?", at
            ).fetchone()
            self._db.execute("UPDATE rounds SET settled_s = ? WHERE name = ?", (before_s, run.round))
            self._db.execute("DELETE FROM runs WHERE round = ? AND due_s = ?", at)

    def running(self, run: Run, task: str) -> None:
        """Record the task of a run."""
        self._set(run, state=RunState.RUNNING, task=task)

    def end(self, run: Run, state: RunState, *, now_s: float, why: str = "") -> None:
        """Record how a run ended."""
        self._set(run, state=state, ended_s=now_s, why=why)

    def miss(self, section: RoundSection, dues_s: Sequence[float], *, why: str) -> None:
        """Record runs that will not take place, oldest first."""
        with self._changing():
            for due_s in dues_s:
                self._put(section, due_s, RunState.MISSED, why=why)

    def open_run(self) -> Run | None:
        """Return the run that has begun and not ended; there is at most one."""
        found = self._select(f"WHERE state IN ('{OPEN[0]}', '{OPEN[1]}')")
        return found[0] if found else None

    def runs(self, name: str | None = None, *, limit: int = 100) -> list[Run]:
        """Return the newest runs of a round, or of all, newest first."""
        return self._select("WHERE round = ? OR ? IS NULL", name, name, limit=limit)

    def definitions(self) -> list[RoundSection]:
        """Return the rounds that were defined over the API."""
        with self._lock, self._errors():
            rows = self._db.execute(
                "SELECT definition FROM rounds WHERE definition IS NOT NULL ORDER BY name"
            ).fetchall()
        return [RoundSection.model_validate_json(row[0]) for row in rows]

    def define(self, section: RoundSection, now_s: float) -> None:
        """Store a round that was defined over the API."""
        with self._changing():
            self.settled_s(section, now_s)
            self._db.execute(
                "UPDATE rounds SET definition = ? WHERE name = ?", (section.model_dump_json(), section.name)
            )

    def forget(self, name: str) -> None:
        """Remove a round that was defined over the API; its runs stay."""
        with self._changing():
            self._db.execute("DELETE FROM rounds WHERE name = ?", (name,))

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        with self._lock:
            self._db.close()

    def _put(
        self,
        section: RoundSection,
        due_s: float,
        state: RunState,
        *,
        why: str = "",
        key: str = "",
        begun_s: float | None = None,
    ) -> None:
        before = self._db.execute("SELECT settled_s FROM rounds WHERE name = ?", (section.name,)).fetchone()[0]
        self._db.execute(
            "INSERT INTO runs (round, due_s, state, why, mission, key, begun_s, settled_before_s) "
            "VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            (section.name, due_s, str(state), why, section.mission, key, begun_s, before),
        )
        self._db.execute("UPDATE rounds SET settled_s = MAX(settled_s, ?) WHERE name = ?", (due_s, section.name))
        self._db.execute("DELETE FROM runs WHERE rowid <= (SELECT MAX(rowid) FROM runs) - ?", (KEEP_RUNS,))

    def _set(self, run: Run, **given: str | float) -> None:
        terms = ", ".join(f"{name} = ?" for name in given)
        with self._changing():
            self._db.execute(
                f"UPDATE runs SET {terms} WHERE round = ? AND due_s = ?",  # noqa: S608 - the names are ours
                (
                    *(str(value) if isinstance(value, StrEnum) else value for value in given.values()),
                    run.round,
                    run.due_s,
                ),
            )

    def _run(self, name: str, due_s: float) -> Run:
        (found,) = self._select("WHERE round = ? AND due_s = ?", name, due_s)
        return found

    def _select(self, where: str, *values: object, limit: int = 100) -> list[Run]:
        with self._lock, self._errors(), closing(self._db.cursor()) as cursor:
            cursor.row_factory = sqlite3.Row
            rows = cursor.execute(f"{SELECTED} {where} ORDER BY due_s DESC, round LIMIT ?", (*values, limit)).fetchall()
        return [Run(**{**dict(row), "state": RunState(row["state"])}) for row in rows]

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Do what follows in one transaction, which is on disk at its end."""
        with self._lock, self._errors():
            if self._db.in_transaction:
                yield
                return
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            except BaseException:
                with suppress(sqlite3.Error):
                    self._db.execute("ROLLBACK")
                raise

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise HistoryError(
                f"the record of rounds {self._path} cannot be used: {error}",
                hint="free disk space and check the rights of the folder; no round begins that is not recorded",
                file=str(self._path),
            ) from error
