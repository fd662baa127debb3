"""Brings the histories of many cells into one folder, one Parquet file for each cell and month, written anew as a whole.

A month is asked for again as long as it may change: the newest month that the folder has, and the one before, because people
answer readings later.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from hal.errors import CellError
from service.client import Client
from service.history.parts import NUMBERS, need_engine, write_parquet
from service.history.reading import COLUMNS
from service.site.look import Cells

AGAIN = 2  # newest months that are asked for again
ALL = ("cell", "id", *COLUMNS)
TEXTS = ("object", "kind", "quality", "cause", "unit", "verb", "task", "mission", "asked_by", "phase", "doubt")


@dataclass(frozen=True, slots=True, kw_only=True)
class Collected:
    """What came of one cell: how many readings in how many files; `why` says why none came."""

    name: str
    readings: int = 0
    files: int = 0
    why: str = ""


def collect(cells: Cells, folder: Path) -> Iterator[Collected]:
    """Bring the history of each cell into the folder; yields what came of each, also of one that does not answer.

    Raises:
        Unsupported: DuckDB is not installed.
        HistoryError, OSError: the folder cannot be written.
    """
    need_engine()
    for entry in cells.site.cells:
        try:
            client = cells.client(entry)
            since_s = _begin_of(months_of(folder / entry.name))
            rows = _exported(client, entry.name, since_s)
        except CellError as error:
            yield Collected(name=entry.name, why=error.what)
            continue
        files = _write(folder / entry.name, rows)
        yield Collected(name=entry.name, readings=len(rows), files=files)


def months_of(folder: Path) -> list[str]:
    """Return the months that the folder of a cell has, such as `2026-11`, oldest first."""
    return sorted(path.stem.removeprefix("readings-") for path in folder.glob("readings-????-??.parquet"))


def _begin_of(months: Sequence[str]) -> float:
    """Return from when on the readings are asked for, seconds since 1970."""
    if len(months) < AGAIN:
        return 0.0
    return datetime.strptime(months[-AGAIN], "%Y-%m").replace(tzinfo=UTC).timestamp()


def _exported(client: Client, name: str, since_s: float) -> list[tuple[Any, ...]]:
    """Return the readings of a cell as rows of `ALL`; the text of its export tells every value apart from none."""
    data = client.fetch("GET", f"/v1/history/export?{urlencode({'since_s': f'{since_s:.3f}'})}").decode("utf-8")
    return [(name, int(row["id"]), *(_plain(column, row[column]) for column in COLUMNS)) for row in _dicts(data)]


def _dicts(data: str) -> Iterator[dict[str, str]]:
    yield from csv.DictReader(io.StringIO(data, newline=""))


def _plain(column: str, text: str) -> float | str | None:
    if column in NUMBERS:
        return float(text) if text else None
    return text if text or column in TEXTS else None


def _write(folder: Path, rows: Sequence[tuple[Any, ...]]) -> int:
    """Write one file for each month; returns how many."""
    by_month: dict[str, list[tuple[Any, ...]]] = {}
    at = ALL.index("utc_s")
    for row in rows:
        by_month.setdefault(datetime.fromtimestamp(row[at], UTC).strftime("%Y-%m"), []).append(row)
    folder.mkdir(parents=True, exist_ok=True)
    for month, own in by_month.items():
        write_parquet(folder / f"readings-{month}.parquet", ALL, own)
    return len(by_month)
