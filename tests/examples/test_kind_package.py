"""Tests of the example package of a kind: its four parts are found when installed, and latch and reader work."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROBE = """
import json
from hal.panel.kinds import BODIES, READERS, SKILLS, installed_kinds, part_of
from hal.panel import Panel
from hal.strict import parse_toml
lights = "".join(
    f'[[lights]]\\nname = "l{k}"\\nposition_m = [{x}, {y}, 0.0]\\n'
    for k, (x, y) in enumerate([(-0.18, 0.13), (0.18, 0.13), (0.18, -0.13), (-0.18, -0.13)])
)
text = 'schema = 1\\nname = "tiny"\\nwidth_m = 0.4\\nheight_m = 0.3\\n' + lights
text += '[[objects]]\\nkind = "breaker"\\nname = "feed"\\nposition_m = [0.0, 0.0]\\n'
feed = parse_toml(text, Panel, source="tiny").object("feed")
body = part_of(BODIES, "breaker")
starts = [body.start(feed, u).place for u in (0.1, 0.5, 0.9)]
latch = body.mechanism(None, 0, feed, body.start(feed, 0.9), 1.0)
print(json.dumps({
    "kinds": installed_kinds(), "parts": [part_of(g, "breaker") is not None for g in (READERS, SKILLS)],
    "goal": feed.goal.states, "starts": starts,
    "rests": [latch.nearest(x) for x in (0.4, -0.4, 0.4)],
}))
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the environment of a process in which the example package is installed beside panelwright."""
    target = tmp_path_factory.mktemp("packages")
    source = tmp_path_factory.mktemp("source") / "kind-package"
    subprocess.run(["cp", "-r", str(ROOT / "examples" / "kind-package"), str(source)], check=True)
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", str(target), str(source)], check=True, capture_output=True, text=True)
    return {**os.environ, "PYTHONPATH": f"{target}{os.pathsep}{ROOT}"}


def test_an_installed_kind_is_found_by_its_name_in_all_four_tables(installed: dict[str, str]) -> None:
    ran = subprocess.run([sys.executable, "-c", PROBE], env=installed, check=True, capture_output=True, text=True)
    found = json.loads(ran.stdout)
    assert "breaker" in found["kinds"] and "gauge" in found["kinds"]
    assert found["parts"] == [True, True]
    assert found["goal"] == ["on", "off"]
    assert found["starts"] == [0.45, -0.45, 0.0]


def test_a_breaker_that_has_tripped_holds_on_only_after_off(installed: dict[str, str]) -> None:
    ran = subprocess.run([sys.executable, "-c", PROBE], env=installed, check=True, capture_output=True, text=True)
    assert json.loads(ran.stdout)["rests"] == [0.0, -0.45, 0.45]


def test_without_its_package_the_kind_is_refused() -> None:
    ran = subprocess.run([sys.executable, "-c", PROBE], check=False, capture_output=True, text=True, cwd=ROOT)
    assert ran.returncode != 0
    assert "'breaker' is no kind of object that is installed" in ran.stderr
