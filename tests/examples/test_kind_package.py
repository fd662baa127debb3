"""Tests of the example package of a kind: its four parts are found when installed, and latch and reader work."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

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


@pytest.fixture(scope="module")
def mission(installed: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return what a judged mission on the package's panel said; in the world of this seed the breaker has tripped."""
    script, folder = ROOT / "tests/examples/breaker_mission.py", tmp_path_factory.mktemp("mission")
    command = [sys.executable, str(script), str(folder), "305"]
    ran = subprocess.run(command, env=installed, check=True, capture_output=True, text=True)
    said: dict[str, Any] = json.loads(ran.stdout)
    return said


@pytest.mark.slow
def test_a_mission_reads_a_tripped_breaker_and_throws_it_on(mission: dict[str, Any]) -> None:
    assert mission["readings"]["feed, before the actions"] == "tripped"
    assert mission["readings"]["feed, after the actions"] == "on"
    assert ["feed", "breaker to on", True] in mission["claims"] and mission["agrees"]


@pytest.mark.slow
def test_the_mission_reads_the_counter_and_turns_the_knob_beside_it(mission: dict[str, Any]) -> None:
    assert all(is_right for _, _, is_right in mission["claims"])
    done = {(name, what.split(" to ")[0]) for name, what, _ in mission["claims"]}
    assert done >= {("hours", "read before the actions"), ("speed", "read after the actions"), ("speed", "knob")}


@pytest.mark.slow
def test_the_package_brings_what_its_kind_looks_like(mission: dict[str, Any]) -> None:
    assert mission["kinds"].count("breaker") == 1


def test_the_page_shows_what_the_package_does() -> None:
    page = (ROOT / "docs/how-to/add-a-kind.md").read_text(encoding="utf-8")
    package = ROOT / "examples/kind-package"
    shown = {language: re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL) for language in ("python", "toml")}
    files = [package / "acme_breaker/skill.py", package / "pyproject.toml", package / "panel.toml"]
    blocks = [*shown["python"], *shown["toml"]]
    assert len(blocks) == len(files)
    for block, file in zip(blocks, files, strict=True):
        assert block in file.read_text(encoding="utf-8")


def test_without_its_package_the_kind_is_refused() -> None:
    ran = subprocess.run([sys.executable, "-c", PROBE], check=False, capture_output=True, text=True, cwd=ROOT)
    assert ran.returncode != 0
    assert "'breaker' is no kind of object that is installed" in ran.stderr
