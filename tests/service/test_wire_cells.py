"""Runs the mission with every device on its real protocol, through the real server: one seed per cell.

The devices, links and emulators are those of the shipped cell file. The panel is small (an instrument, a lamp, a valve,
and a slider or a button), because these cells run in real time. For the large panel and more seeds use
`python -m benchmarks.missions 1 5 --cell cells/wire-ur.toml`.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from hal.config import load_cell
from service.client import Client
from service.serve import Options, Panelwright

ROOT = Path(__file__).parents[2]
LONGEST_S = 500  # a busy machine compiles for a minute and runs at half the speed
pytestmark = [pytest.mark.wire, pytest.mark.timeout(LONGEST_S)]

PANEL = """
schema = 1
name = "small"
width_m = 0.44
height_m = 0.32
lights = [
  { name = "light_upper_left", position_m = [-0.195, 0.135, 0.0005] },
  { name = "light_upper_right", position_m = [0.195, 0.135, 0.0005] },
  { name = "light_lower_right", position_m = [0.195, -0.135, 0.0005] },
  { name = "light_lower_left", position_m = [-0.195, -0.135, 0.0005] },
]

[[objects]]
kind = "gauge"
name = "pressure"
label = "PRESSURE"
position_m = [0.030, 0.080]
radius_m = 0.036
scale = { minimum = 0.0, maximum = 10.0, unit = "bar", at_min = -2.3562, at_max = 2.3562, major_ticks = 11 }

[[objects]]
kind = "lamp"
name = "run_lamp"
label = "RUN"
position_m = [0.115, 0.080]
radius_m = 0.010
colour = "green"

[[objects]]
kind = "lever"
name = "main_valve"
label = "MAIN VALVE"
position_m = [-0.105, 0.0]
length_m = 0.070
width_m = 0.014
height_m = 0.030
torque_nm = 2.0
states = [{ name = "closed", angle_rad = 1.5708 }, { name = "open", angle_rad = 0.0 }]
"""
SLIDER = """
[[objects]]
kind = "slider"
name = "setpoint"
label = "SETPOINT"
position_m = [0.080, -0.060]
angle_rad = 0.0
travel_m = 0.100
cap_size_m = [0.012, 0.024, 0.016]
friction_n = 4.0
scale = { minimum = 0.0, maximum = 100.0, unit = "%", at_min = -0.050, at_max = 0.050, major_ticks = 6 }
"""
BUTTON = """
[[objects]]
kind = "button"
name = "start"
label = "START"
position_m = [0.080, -0.060]
radius_m = 0.013
colour = "green"
lights_lamp = "run_lamp"
"""


def before_small_panel(folder: Path, cell: str, control: str) -> Path:
    """Return the shipped cell file with another panel."""
    text = (ROOT / f"cells/{cell}.toml").read_text()
    for path, mine in (
        ("panels/bench.toml", "panel.toml"),
        ("cells/calibrations", "calibrations"),
        ("cells/knowledge/bench", str(ROOT / "cells/knowledge/bench")),
    ):
        assert text.count(f'"{path}"') == 1
        text = text.replace(path, mine)
    shutil.copytree(ROOT / "cells/calibrations", folder / "calibrations")
    (folder / "panel.toml").write_text(PANEL + control)
    (folder / "cell.toml").write_text(text)
    return folder / "cell.toml"


def judged_mission(panelwright: Panelwright) -> tuple[list[str], str]:
    """Run and judge the mission; return the verdict and the mission's name."""
    client = Client(url=panelwright.url, timeout_s=LONGEST_S)
    stop = client.get("/v1/stop")
    assert stop["is_latched"], "a cell with real parts starts stopped"
    client.post("/v1/stop/reset", {"seen_count": stop["count"]})
    steps = [
        {"kind": "inspect", "name": "read"},
        {"kind": "feel", "name": "feel", "touches": 3, "wanted": {"position_m": 0.0005, "angle_rad": 0.0005}},
        {"kind": "set", "name": "operate", "each_kind": True, "on_failure": "skip"},
    ]
    task = client.post("/v1/missions", {"mission": {"steps": steps}})
    told = [json.dumps(event) for event in client.events(task["id"])]
    (mission,) = client.get("/v1/missions")["missions"]
    client.post("/v1/judge?wait_s=30", {"mission": mission["name"]})
    return told, mission["name"]


@pytest.mark.parametrize(
    ("cell", "seed", "control"), [("wire-ur", 2, SLIDER), ("wire-cia402", 2, BUTTON), ("wire-dynamixel", 2, SLIDER)]
)
def test_a_wire_cell_runs_the_whole_mission_and_the_judge_agrees(
    cell: str, seed: int, control: str, tmp_path: Path
) -> None:
    path = before_small_panel(tmp_path, cell, control)
    panelwright = Panelwright(load_cell(path, seed=seed), Options(port=0, runs_dir=tmp_path / "runs"))
    try:
        panelwright.start()
        told, mission = judged_mission(panelwright)
    finally:
        panelwright.close()
    report: dict[str, Any] = json.loads((tmp_path / "runs" / mission / "report.json").read_text())
    assert report["problem"] is None, told
    assert [(action["object"], action["confirmed"]) for action in report["actions"]] == [
        ("main_valve", True),
        ("setpoint" if control is SLIDER else "start", True),
    ], told
    assert report["judge"]["agrees"], report["judge"]
    assert report["judge"]["readings_right"] == report["judge"]["readings_given"] > 0
    assert report["judge"]["pose_error_m"] < 0.003
    assert len(report["fused"]["touching"]["touches"]) == 3, "three touches cannot give half a millimetre"
