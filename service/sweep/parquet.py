"""Writes a sweep as Parquet by DuckDB, which is an extra: every deed, and a summary with Wilson's bounds."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from service.errors import HistoryError
from service.history.parts import engine, failure, quoted
from service.sweep.ask import PanelRun
from service.sweep.deeds import ROWS
from service.sweep.judge import Verdict
from service.sweep.table import wilson

DEEDS, SUMMARY = "deeds.parquet", "summary.parquet"


def write_parquet(runs: Sequence[PanelRun], folder: Path) -> tuple[Path, Path]:
    """Write `deeds.parquet` and `summary.parquet` into a folder; returns their paths.

    The summary has for each control, and for `all`: the number of deeds and of right ones, and the bounds of Wilson's 95 %
    interval of the share of right ones.

    Raises:
        Unsupported: DuckDB is not installed.
        HistoryError: a file cannot be written.
    """
    deeds = [asdict(deed) for run in runs for deed in run.deeds]
    return _written(folder / DEEDS, deeds), _written(folder / SUMMARY, summary_of(runs))


def summary_of(runs: Sequence[PanelRun]) -> list[dict[str, Any]]:
    """Return the rows of the summary."""
    deeds = [deed for run in runs for deed in run.deeds]
    rows = [(row, [deed for deed in deeds if deed.row == row]) for row in ROWS]
    found = []
    for name, own in [*rows, ("all", deeds)]:
        counts = Counter(deed.verdict for deed in own)
        low, high = wilson(counts[Verdict.RIGHT], len(own))
        if own:
            found.append(
                {
                    "control": name,
                    "deeds": len(own),
                    "right": counts[Verdict.RIGHT],
                    "at_least": low,
                    "at_most": high,
                    "said_done_and_was_not": counts[Verdict.FALSE],
                }
            )
    return found


def _written(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    database = engine()
    lines, fresh = path.with_name(f".{path.name}.json"), path.with_name(f".{path.name}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lines.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
        source = f"read_json({quoted(lines)}, format='newline_delimited', sample_size=-1)"
        what = f"SELECT * FROM {source}" if rows else "SELECT NULL AS control WHERE FALSE"  # noqa: S608 - our own file
        database.execute(f"COPY ({what}) TO {quoted(fresh)} (FORMAT parquet, COMPRESSION zstd)")
        fresh.replace(path)
    except failure() as error:
        raise HistoryError(f"{path} cannot be written: {error}", hint="free disk space", file=str(path)) from error
    finally:
        database.close()
        for leftover in (lines, fresh):
            leftover.unlink(missing_ok=True)
    return path
