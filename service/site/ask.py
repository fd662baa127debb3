"""Asks the collected histories of a site by DuckDB: readings and trends of one object in all cells, or any question in SQL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal.errors import InvalidRequest
from service.errors import HistoryError
from service.history.parts import engine, failure, quoted

TREND = """
WITH shown AS (
    SELECT cell, CAST(LEAST(FLOOR((utc_s - CAST(? AS DOUBLE)) / CAST(? AS DOUBLE)), ?) AS INTEGER) AS number,
        CASE WHEN answered IS NULL THEN value ELSE final_value END AS value,
        CASE WHEN answered IS NULL THEN COALESCE(state, text) ELSE COALESCE(final_state, final_text) END AS word
    FROM readings WHERE object = ? AND utc_s BETWEEN ? AND ? AND (? IS NULL OR cell = ?)
)
SELECT cell, number, COUNT(*) AS count, COUNT(*) FILTER (value IS NULL AND word IS NULL) AS refused,
    MIN(value) AS minimum, MAX(value) AS maximum, AVG(value) AS mean,
    LIST(DISTINCT word) FILTER (value IS NULL AND word IS NOT NULL) AS words
FROM shown GROUP BY cell, number ORDER BY cell, number
"""
FILES = "*/readings-????-??.parquet"


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """The rows that answer a question, with the names of their columns."""

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]

    def dicts(self) -> list[dict[str, Any]]:
        """Return the rows by the names of the columns."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]


def ask(folder: Path, sql: str, values: Sequence[Any] = ()) -> Answer:
    """Answer a question about the table `readings`, which has `cell` and everything that a history keeps.

    Raises:
        InvalidRequest: the folder has no histories, or the question cannot be answered.
        HistoryError: a file cannot be read.
        Unsupported: DuckDB is not installed.
    """
    files = sorted(folder.glob(FILES))
    if not files:
        raise InvalidRequest(
            f"{folder} has no collected history", hint="`panelwright site collect SITE.toml --into FOLDER` fills it"
        )
    database = engine()
    try:
        listed = ", ".join(quoted(path.absolute()) for path in files)
        database.execute(f"CREATE VIEW readings AS SELECT * FROM read_parquet([{listed}], union_by_name=true)")  # noqa: S608 - our own files, quoted
    except failure() as error:
        database.close()
        raise HistoryError(
            f"a file of {folder} cannot be read: {error}", hint="delete that file and collect again", file=str(folder)
        ) from error
    try:
        found = database.execute(sql, list(values))
        columns = tuple(str(column[0]) for column in found.description or ())
        return Answer(columns=columns, rows=found.fetchall())
    except failure() as error:
        raise InvalidRequest(
            f"the question cannot be answered: {error}", hint="DESCRIBE readings shows the columns"
        ) from error
    finally:
        database.close()


def readings_of(folder: Path, name: str, *, since_s: float, cell: str | None = None) -> list[dict[str, Any]]:
    """Return the readings of one object in all cells, or in one, by time; raises as `ask`."""
    asked = (
        "SELECT * FROM readings WHERE object = ? AND utc_s >= ? AND (? IS NULL OR cell = ?) ORDER BY utc_s, cell, id"
    )
    return ask(folder, asked, (name, since_s, cell, cell)).dicts()


def trends_of(
    folder: Path, name: str, *, since_s: float, until_s: float, buckets: int, cell: str | None = None
) -> dict[str, list[dict[str, Any]]]:
    """Return the trend of one object by cell, in so many spans of equal length; empty spans are left out.

    The buckets are those of `service.history.query.Bucket`; what a person has said takes the place of what was read.
    Raises as `ask`.
    """
    width_s = max((until_s - since_s) / buckets, 1e-3)
    values = (since_s, width_s, buckets - 1, name, since_s, until_s, cell, cell)
    found: dict[str, list[dict[str, Any]]] = {}
    for row in ask(folder, TREND, values).dicts():
        begin_s = since_s + row.pop("number") * width_s
        states = dict.fromkeys(sorted(row.pop("words") or ()), 1)
        found.setdefault(row.pop("cell"), []).append(
            {"since_s": begin_s, "until_s": begin_s + width_s, **row, "states": states}
        )
    return found
