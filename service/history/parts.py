"""Parquet parts of the history, written and read by DuckDB, which is an extra (`panelwright[history]`)."""

from __future__ import annotations

import atexit
import gc
import json
import os
import re
from collections.abc import Iterable, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hal.errors import Unsupported
from service.errors import HistoryError

if TYPE_CHECKING:
    import duckdb

PART = re.compile(r"readings-(\d{12})-(\d{12})\.parquet")
NUMBERS = ("utc_s", "cell_s", "value", "sigma", "confidence", "final_value")
# Columns that parts of version 1 do not have.
NEWER = (
    "SELECT '' AS doubt, NULL::VARCHAR AS certificate, NULL::VARCHAR AS answered, NULL::DOUBLE AS final_value, "
    "NULL::VARCHAR AS final_state, NULL::VARCHAR AS final_text LIMIT 0"
)


def need_engine() -> None:
    """Raise `Unsupported` if DuckDB is not installed; it is not imported yet."""
    if find_spec("duckdb") is None:
        raise Unsupported(
            "Parquet files need DuckDB, which is not installed",
            hint="install the extra `history`: pip install 'panelwright[history]'",
        )


def engine() -> duckdb.DuckDBPyConnection:
    """Return a new connection of DuckDB.

    Raises:
        Unsupported: DuckDB is not installed; the hint names the extra.
    """
    need_engine()
    import duckdb

    _leave_cleanly()
    return duckdb.connect()


@cache
def _leave_cleanly() -> None:
    """Let the process collect DuckDB's objects at its end, which otherwise prints a page about leaks.

    `hal.gc_freeze` excludes them from collection.
    """
    atexit.register(gc.unfreeze)


def failure() -> type[Exception]:
    """Return the base of DuckDB's errors."""
    import duckdb

    return duckdb.Error


def parts_of(folder: Path) -> list[Path]:
    """Return the Parquet parts in a folder, oldest first."""
    return sorted(path for path in folder.glob("*.parquet") if PART.fullmatch(path.name))


def ids_of(part: Path) -> tuple[int, int]:
    """Return the ids of the first and the last reading of a part, from its name."""
    found = PART.fullmatch(part.name)
    assert found is not None  # noqa: S101 - narrowing: `parts_of` lists no other names
    return int(found[1]), int(found[2])


def part_path(folder: Path, first_id: int, last_id: int) -> Path:
    """Return the path of the part with these readings."""
    return folder / f"readings-{first_id:012d}-{last_id:012d}.parquet"


def write_parquet(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write rows as a Parquet file, which exists completely or not at all.

    Raises:
        Unsupported: DuckDB is not installed.
        HistoryError, OSError: the file cannot be written.
    """
    database = engine()
    table, fresh = path.with_name(f".{path.name}.json"), path.with_name(f".{path.name}.new")
    try:
        with table.open("w", encoding="utf-8") as file:
            for row in rows:
                file.write(json.dumps(dict(zip(columns, row, strict=True))) + "\n")
        types = ", ".join(f"{quoted(name)}: {quoted(_type(name))}" for name in columns)
        rows_of_file = f"read_json({quoted(table)}, format='newline_delimited', columns={{{types}}})"
        database.execute(f"COPY (SELECT * FROM {rows_of_file}) TO {quoted(fresh)} (FORMAT parquet, COMPRESSION zstd)")
        with fresh.open("rb") as file:
            os.fsync(file.fileno())
        fresh.replace(path)
    except failure() as error:
        raise HistoryError(f"{path} cannot be written: {error}", hint="free disk space", file=str(path)) from error
    finally:
        database.close()
        for leftover in (table, fresh):
            leftover.unlink(missing_ok=True)


def read_parts(parts: Sequence[Path], what: str, where: str, values: Sequence[Any]) -> list[tuple[Any, ...]]:
    """Return `SELECT what FROM parts where`; empty without parts.

    Raises:
        Unsupported: there are parts, but DuckDB is not installed.
        HistoryError: a part is damaged.
    """
    if not parts:
        return []
    files = ", ".join(quoted(path) for path in parts)
    database = engine()
    try:
        found: list[tuple[Any, ...]] = database.execute(
            f"WITH parts AS (({NEWER}) UNION ALL BY NAME SELECT * FROM read_parquet([{files}], union_by_name=true)), "
            f"readings AS (SELECT * REPLACE (COALESCE(doubt, '') AS doubt) FROM parts) SELECT {what} FROM readings {where}",
            list(values),
        ).fetchall()
    except failure() as error:
        what_failed = f"one of the {len(parts)} Parquet files in {parts[0].parent} cannot be read: {error}"
        raise HistoryError(what_failed, hint="move the file that is named there away; the rest is read") from error
    finally:
        database.close()
    return found


def quoted(text: object) -> str:
    """Return a text as an SQL literal."""
    return "'" + str(text).replace("'", "''") + "'"


def _type(column: str) -> str:
    if column == "id":
        return "BIGINT"
    return "DOUBLE" if column in NUMBERS else "VARCHAR"
