"""A whole sweep: panels of many seeds, in this process or on many workers, and its files.

The answer does not depend on the number of workers, except for the time on the wall.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from hal.workers import as_they_end, workers_of
from service.sweep.ask import PanelRun
from service.sweep.kept import Kept
from service.sweep.options import SweepOptions
from service.sweep.run import run_panel
from service.sweep.table import report

RETRIES = 1  # of a panel whose worker died
LOCAL = "local"
DIGITS = 9


def sweep(
    seeds: Sequence[int],
    options: SweepOptions,
    *,
    scheduler: str = LOCAL,
    workers: int = 1,
    progress: Callable[[PanelRun], None] = lambda _run: None,
    kept: Kept | None = None,
) -> list[PanelRun]:
    """Run the panels of the seeds; returns them in the order of the seeds.

    Args:
        kept: where each panel is kept as it ends; those that it has are not run again.
        scheduler: `local`, or `tcp://host:port` of a dask scheduler whose workers see the cell file under the same path.
        workers: number of processes of the local scheduler; with one, everything runs in this process.
        progress: called with each panel as it ends.

    Raises:
        ConfigError: the scheduler does not answer, or no worker is left.
    """
    earlier = [] if kept is None else [run for seed in seeds if (run := kept.run_of(seed)) is not None]
    runs: list[PanelRun] = []

    def note(run: PanelRun) -> None:
        runs.append(run)
        if kept is not None and run not in earlier:
            kept.keep(run)
        progress(run)

    for run in earlier:
        note(run)
    left = [seed for seed in seeds if seed not in {run.seed for run in earlier}]
    if scheduler == LOCAL and workers == 1:
        for seed in left:
            note(run_panel(seed, options))
    elif left:
        _on_workers(left, options, scheduler, workers, note)
    return sorted(runs, key=lambda run: list(seeds).index(run.seed))


def _on_workers(
    seeds: Sequence[int], options: SweepOptions, scheduler: str, workers: int, note: Callable[[PanelRun], None]
) -> None:
    with workers_of(scheduler, workers) as client:
        task = partial(run_panel, options=options)
        futures = client.map(task, list(seeds), retries=RETRIES, pure=False)
        for run in as_they_end(client, futures):
            note(run)


def hash_of(run: PanelRun) -> str:
    """Return a hash of everything about a panel that a repetition must give again, that is, without the time on the wall.

    Numbers count to `DIGITS` digits. The same processes repeat to the last bit. With the cell in the service's process
    (`inline`) force, impulse and chatter may differ in the 9th digit, so that its hash is another one.
    """
    plain = _rounded({**asdict(run), "wall_s": 0.0})
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def _rounded(value: Any) -> Any:
    match value:
        case float():
            return float(f"{value:.{DIGITS}g}")
        case dict():
            return {key: _rounded(item) for key, item in value.items()}
        case list() | tuple():
            return [_rounded(item) for item in value]
        case _:
            return value


def write(runs: Sequence[PanelRun], options: SweepOptions, folder: Path) -> tuple[Path, Path]:
    """Write `sweep.json` and `sweep.md` into a folder; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    told: dict[str, Any] = {"cell": options.cell.name, "only": list(options.only), "known_pose": options.known_pose}
    panels = [{**asdict(run), "hash": hash_of(run)} for run in runs]
    data, text = folder / "sweep.json", folder / "sweep.md"
    data.write_text(json.dumps({"options": told, "panels": panels}, indent=1) + "\n", encoding="utf-8")
    seeds = sorted(run.seed for run in runs)
    title = f"# {len(seeds)} random panels, seeds {seeds[0]} to {seeds[-1]}, {options.cell.name}"
    text.write_text(f"{title}\n\n{report(runs)}", encoding="utf-8")
    return data, text
