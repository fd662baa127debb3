"""Operates every control of random panels and judges: `python -m benchmarks.random_panels FIRST LAST [options]`.

`--only slider,lever` limits the deeds to some kinds or rows; `--known-pose` gives the panel's pose with a realistic error
instead of looking for it, which is faster. A line for each deed goes to the terminal, then the tables.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from service.sweep.options import SweepOptions
from service.sweep.run import run_panel
from service.sweep.table import report

ROOT = Path(__file__).resolve().parents[1]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the panels and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--cell", type=Path, default=ROOT / "cells/bench.toml")
    parser.add_argument("--only", default="")
    parser.add_argument("--known-pose", action="store_true")
    parser.add_argument("--mission", action="store_true")
    given = parser.parse_args(arguments)
    only = tuple(filter(None, given.only.split(",")))
    options = SweepOptions(cell=given.cell.resolve(), only=only, known_pose=given.known_pose, mission=given.mission)
    runs = []
    for seed in range(given.first, given.last + 1):
        runs.append(run_panel(seed, options, tell=lambda line: print(line, flush=True)))
        print(f"{seed:4} {runs[-1].cell_s:.0f} s of the cell, {runs[-1].wall_s:.0f} s {runs[-1].problem}", flush=True)
    print(report(runs))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
