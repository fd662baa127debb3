"""Draws the contact force of one deed of each skill for `docs/skills`: `python -m benchmarks.skill_plots [SKILL ...]`.

The deeds run on the simulated bench with a panel pose that is wrong by 3 mm and 1 degree. A grey line shows the force at
which a motion would have ended.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.manipulation import OTHERS, SKILLS
from benchmarks.simcell import open_bench
from hal.motion import DeclaredMotion, MotionReport, Mover, Quantity
from service.report.plots import figure_png, sheet

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "images" / "skills"
SEED = 4
NAMED_S = 0.5  # a shorter motion has no room for its name


@dataclass(slots=True)
class ListeningMover:
    """Passes motions on and keeps them with their reports."""

    mover: Mover
    kept: list[tuple[DeclaredMotion, MotionReport]] = field(default_factory=list)

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        """Run the motion and keep its report."""
        report = self.mover.execute(motion)
        self.kept.append((motion, report))
        return report

    def __getattr__(self, name: str) -> Any:
        return getattr(self.mover, name)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one deed of each skill and write its picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("skills", nargs="*", help=f"of: {', '.join(SKILLS | OTHERS)}")
    FOLDER.mkdir(parents=True, exist_ok=True)
    for skill in parser.parse_args(arguments).skills or SKILLS:
        bench = open_bench(SEED)
        try:
            mover = ListeningMover(bench.context.mover)
            bench.context = replace(bench.context, mover=mover)
            report, _, _ = (SKILLS | OTHERS)[skill](bench)
        finally:
            bench.close()
        (FOLDER / f"{skill}.png").write_bytes(picture(mover.kept))
        print(f"{skill}: {report.outcome} after {report.duration_s:.1f} s, at most {report.peak_force_n:.0f} N")


def picture(kept: Sequence[tuple[DeclaredMotion, MotionReport]]) -> bytes:
    """Plot the contact force over the time of a deed, with the names of its motions and the force that would end each."""
    figure = sheet(3.0)
    pane = figure.subplots()
    begun_s = kept[0][1].started_s
    for k, (motion, report) in enumerate(kept):
        times = report.started_s - begun_s + report.log.times_s
        if not len(times):
            continue
        pane.plot(times, np.linalg.norm(report.log.wrench[:, :3], axis=1), lw=0.9, color="tab:blue")
        if k % 2:
            pane.axvspan(times[0], times[-1], color="0.95", lw=0)
        limits = [guard.limit for guard in motion.guards if guard.quantity is Quantity.FORCE]
        if limits:
            pane.plot(times[[0, -1]], [min(limits)] * 2, lw=1.2, color="0.55")
        if times[-1] - times[0] >= NAMED_S:
            pane.annotate(report.name, (float(times.mean()), 0.98), xycoords=("data", "axes fraction"), fontsize=6,
                          rotation=90, ha="center", va="top")  # fmt: skip
    pane.set_ylabel("contact force, N")
    pane.set_xlabel("time, s")
    pane.set_ylim(0.0, 1.35 * pane.get_ylim()[1])
    return figure_png(figure)


if __name__ == "__main__":
    main()
