"""Random panels repeat from their seed, have the stated distribution, and can be loaded as any other cell."""

from __future__ import annotations

import hashlib
import itertools
import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from hal.config import load_cell
from hal.panel import Panel
from hal.strict import validate
from service.sweep.draw import NOMINAL, STATED_RATIO, DrawnPanel, draw_panel
from service.sweep.files import write_files
from service.sweep.layout import GAP_M

ROOT = Path(__file__).parents[3]
DRAWN = [draw_panel(seed) for seed in range(300)]


def panel_of(drawn: DrawnPanel) -> Panel:
    return validate(drawn.built, Panel, source="a random panel")


def efforts(drawn: DrawnPanel, key: str, kind: str) -> list[float]:
    return [table[key] for table in drawn.built["objects"] if table["kind"] == kind]


def test_a_seed_gives_the_same_panel_in_every_process() -> None:
    ask = "import json; from dataclasses import asdict; from service.sweep.draw import draw_panel; "
    ask += "print(json.dumps([asdict(draw_panel(seed)) for seed in range(5)], sort_keys=True))"
    told = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    here = json.dumps([asdict(drawn) for drawn in DRAWN[:5]], sort_keys=True)
    assert hashlib.sha256(told.strip().encode()).digest() == hashlib.sha256(here.encode()).digest()


def test_there_are_eight_controls_a_lamp_and_two_to_four_instruments() -> None:
    counts = {len(drawn.built["objects"]) for drawn in DRAWN}
    assert counts == {11, 12, 13}
    kinds = {kind for drawn in DRAWN for kind in [table["kind"] for table in drawn.built["objects"]]}
    assert kinds == {*NOMINAL, "lamp", "gauge", "display", "panel_meter"}


@pytest.mark.parametrize(
    ("kind", "key", "low", "high"),
    [
        ("lever", "torque_nm", 0.5, 8.0),
        ("handwheel", "torque_nm", 0.3, 3.0),
        ("slider", "friction_n", 1.0, 15.0),
        ("button", "spring_n_per_m", 500.0, 2000.0),
        ("mushroom", "spring_n_per_m", 500.0, 2000.0),
    ],
)
def test_efforts_fill_their_range(kind: str, key: str, low: float, high: float) -> None:
    drawn = np.array([effort for panel in DRAWN for effort in efforts(panel, key, kind)])
    assert low <= drawn.min() < low + 0.05 * (high - low)
    assert high - 0.05 * (high - low) < drawn.max() <= high
    assert abs(drawn.mean() - (low + high) / 2) < 0.06 * (high - low)


def test_three_of_five_files_state_the_efforts_within_a_fifth_and_the_others_the_nominal_ones() -> None:
    nominal = 0
    for drawn in DRAWN:
        pairs = list(zip(drawn.built["objects"], drawn.stated["objects"], strict=True))
        keys = [(true, stated, key) for true, stated in pairs for key in NOMINAL.get(true["kind"], ())]
        if all(stated[key] == NOMINAL[stated["kind"]][key] for _, stated, key in keys):
            nominal += 1
        else:
            assert all(abs(stated[key] / true[key] - 1.0) <= STATED_RATIO + 1e-3 for true, stated, key in keys)
    assert 0.33 < nominal / len(DRAWN) < 0.47


def test_stated_and_built_panel_differ_in_efforts_only() -> None:
    forces = {key for kind in NOMINAL.values() for key in kind}
    for drawn in DRAWN[:40]:
        for true, stated in zip(drawn.built["objects"], drawn.stated["objects"], strict=True):
            assert {k: v for k, v in true.items() if k not in forces} == {
                k: v for k, v in stated.items() if k not in forces
            }


def test_parts_keep_their_distance() -> None:
    for drawn in DRAWN[:100]:
        boxes = [(*one.position_m, *one.half_footprint_m) for one in panel_of(drawn).objects]
        for (x, y, a, b), (u, v, c, d) in itertools.combinations(boxes, 2):
            assert max(abs(x - u) - a - c, abs(y - v) - b - d) >= GAP_M - 2e-4


@pytest.mark.parametrize("cell", ["bench", "ur10e"])
def test_the_files_load_as_a_cell_with_a_built_panel(cell: str, tmp_path: Path) -> None:
    loaded = load_cell(write_files(7, ROOT / f"cells/{cell}.toml", tmp_path), seed=7)
    assert loaded.built_panel is not None
    assert loaded.built_panel.tolerances.effort_ratio == 0.0
    assert loaded.file.simulation.panel_spread_m == 0.1
    assert 0.3 <= loaded.file.simulation.pad_friction <= 1.0
