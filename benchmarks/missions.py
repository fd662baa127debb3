"""Whole missions over seeds, judged: `python -m benchmarks.missions [FIRST LAST] [--cell FILE]`; a table and the pass lines.

Every mission runs through the real server, as `panelwright demo --seed N --judge` does.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cell import clear_stop, run_to_end
from hal.config import load_cell
from service.client import Client
from service.serve import Options, Panelwright

ROOT = Path(__file__).resolve().parents[1]
HEAD = "| seed | confirmed | judge agrees | pose mm | pose deg | in 95 % | readings right | cell s | wall s | peak N | note |"


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One judged mission."""

    seed: int
    report: dict[str, Any]

    @property
    def judge(self) -> dict[str, Any]:
        """The verdict."""
        verdict: dict[str, Any] = self.report["judge"]
        return verdict

    def row(self) -> str:
        """A line of the table."""
        v, r = self.judge, self.report
        pose = ("-", "-") if v["pose_error_m"] is None else _pose(v)
        done = f"{sum(a['confirmed'] for a in r['actions'])}/{len(r['actions'])}"
        note = "" if r["problem"] is None else r["problem"]["detail"][:80]
        return (
            f"| {self.seed} | {done} | {_yes(v['agrees'])} | {pose[0]} | {pose[1]} | {_yes(v['inside_95'])} "
            f"| {v['readings_right']}/{v['readings_given']} | {r['cell_s']:.1f} | {r['wall_s']:.1f} "
            f"| {v['peak_force_n']:.0f} | {note} |"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print, and return 1 when a pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=int, nargs="?", default=1)
    parser.add_argument("last", type=int, nargs="?", default=20)
    parser.add_argument("--cell", type=Path, default=ROOT / "cells/bench.toml")
    given = parser.parse_args(arguments)
    print(f"{HEAD}\n|{' --- |' * 11}", flush=True)
    runs = []
    for seed in range(given.first, given.last + 1):
        runs.append(run(seed, given.cell))
        print(runs[-1].row(), flush=True)
    return summary(runs)


def run(seed: int, cell: Path) -> Run:
    """One mission and its judgement, in a fresh service."""
    with tempfile.TemporaryDirectory() as folder:
        panelwright = Panelwright(load_cell(cell, seed=seed), Options(port=0, runs_dir=Path(folder)))
        panelwright.start()
        try:
            client = Client(url=panelwright.url, timeout_s=120.0)
            clear_stop(client)
            run_to_end(client, "/v1/missions", {})
            name = client.get("/v1/missions")["missions"][0]["name"]
            run_to_end(client, "/v1/judge", {"mission": name})
        finally:
            panelwright.close()
        return Run(seed=seed, report=json.loads((Path(folder) / name / "report.json").read_text(encoding="utf-8")))


def summary(runs: Sequence[Run]) -> int:
    """Print the figures of all runs beside their pass lines; 1 when one is missed."""
    n = len(runs)
    posed = [r.judge for r in runs if r.judge["pose_error_m"] is not None]
    done = sum(bool(r.report["succeeded"]) for r in runs)
    agreed = sum(bool(r.judge["agrees"]) for r in runs)
    inside = sum(bool(v["inside_95"]) for v in posed)
    right, given = (sum(r.judge[key] for r in runs) for key in ("readings_right", "readings_given"))
    error_mm = 1e3 * float(np.median([v["pose_error_m"] for v in posed]))
    error_deg = float(np.rad2deg(np.median([v["pose_error_rad"] for v in posed])))
    lines = [
        (f"every action confirmed: {done} of {n}", done >= 0.95 * n),
        (f"the judge agrees: {agreed} of {n}", agreed == n),
        (f"fused pose, median error: {error_mm:.2f} mm, {error_deg:.3f} deg", error_mm <= 2.0 and error_deg <= 0.3),
        (f"inside the stated 95 % ellipsoid: {inside} of {n}", inside >= 0.85 * n),
        (f"readings and states right: {right} of {given} ({100 * right / max(given, 1):.1f} %)", right >= 0.95 * given),
        (f"longest mission: {max(r.report['cell_s'] for r in runs):.1f} s on the cell's clock", True),
        (f"median mission: {np.median([r.report['wall_s'] for r in runs]):.1f} s on the wall", True),
    ]
    for text, is_met in lines:
        print(f"{'met   ' if is_met else 'MISSED'} {text}")
    return 0 if all(is_met for _, is_met in lines) else 1


def _pose(verdict: dict[str, Any]) -> tuple[str, str]:
    return f"{1e3 * verdict['pose_error_m']:.2f}", f"{np.rad2deg(verdict['pose_error_rad']):.3f}"


def _yes(value: bool | None) -> str:
    return "-" if value is None else ("yes" if value else "NO")


if __name__ == "__main__":
    raise SystemExit(main())
