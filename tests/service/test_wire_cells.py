"""The whole mission with every device on its real protocol, as a user starts it: one seed a cell."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
LONGEST_S = 500  # a busy machine compiles for a minute and lets time pass at half its pace
pytestmark = [pytest.mark.wire, pytest.mark.timeout(LONGEST_S + 60)]


def report_of(runs: Path, log: str) -> dict[str, Any]:
    """The only report; the log of the run says why there is none."""
    paths = list(runs.glob("*/report.json"))
    assert len(paths) == 1, log
    report: dict[str, Any] = json.loads(paths[0].read_text())
    return report


@pytest.mark.parametrize(("cell", "seed"), [("wire-ur", 2), ("wire-cia402", 2), ("wire-dynamixel", 2)])
def test_a_wire_cell_runs_the_whole_mission_and_the_judge_agrees(cell: str, seed: int, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "service.cli", "demo", "--cell", f"cells/{cell}.toml"]
    run = subprocess.run(
        [*command, "--seed", str(seed), "--judge", "--runs", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
        check=False,
    )
    log = run.stdout + run.stderr
    report = report_of(tmp_path, log)
    assert [action["confirmed"] for action in report["actions"]] == [True] * 4, log
    assert run.returncode == 0, log
    assert report["judge"]["agrees"]
    assert report["judge"]["readings_right"] == report["judge"]["readings_given"] > 0
