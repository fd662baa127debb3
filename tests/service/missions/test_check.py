"""Tests of mission files: strict, all faults at once with file, key and remedy, before anything moves."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from hal.config import Cell, load_cell
from hal.errors import CellError, ConfigError, InvalidRequest
from hal.strict import parse_toml, validate
from service.missions.check import operable
from service.missions.files import checked, checked_file, mission_of, mission_paths
from service.operations import OPERATIONS
from service.schema.mission_file import MissionFile
from service.schema.mission_request import MissionRequest
from service.schema.requests import ActionBody

CELL = load_cell(Path(__file__).parents[3] / "cells/bench.toml")


def steps(*given: dict[str, Any]) -> list[str]:
    """Return the faults of a mission with these steps, on the bench panel."""
    numbered = [{"name": f"s{k}", **step} for k, step in enumerate(given)]
    file = validate({"steps": numbered}, MissionFile, source="mission")
    try:
        checked(file, CELL, source="mission")
    except InvalidRequest as error:
        return list(error.details["faults"])
    return []


def beside(folder: Path, **files: str) -> Cell:
    """Return the bench cell as a file beside which these mission files lie."""
    (folder / "missions").mkdir()
    for name, text in files.items():
        (folder / "missions" / f"{name}.toml").write_text(text)
    return CELL.model_copy(update={"path": folder / "cell.toml"})


def test_the_missions_of_the_page_fit_the_bench() -> None:
    page = (Path(__file__).parents[3] / "docs/how-to/write-a-mission.md").read_text()
    (block,) = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    checked(parse_toml(block, MissionFile, source="page"), CELL, source="page")


@pytest.mark.parametrize("name", sorted(mission_paths(CELL)))
def test_every_shipped_mission_fits_the_bench(name: str) -> None:
    checked_file(name, CELL)


def test_all_faults_are_told_at_once_with_key_and_remedy() -> None:
    found = steps(
        {"kind": "inspect", "objects": ["pressure", "presure"]},
        {"kind": "set", "object": "main_valve", "state": "ajar"},
        {
            "kind": "set",
            "object": "setpoint",
            "value": 40.0,
            "needs": [{"object": "flow", "below": 3.0, "unit": "bar"}],
        },
        {"kind": "require", "conditions": [{"object": "run_lamp", "state": "green"}, {"object": "pump", "below": 1.0}]},
        {"kind": "repeat", "times": 2, "steps": [{"kind": "set", "name": "in", "object": "pressure", "value": 1.0}]},
        {"kind": "call", "mission": "no_such"},
        {"kind": "set", "object": "pressure", "other": True},
    )
    told = "\n".join(found)
    for words in (
        "mission: steps.0.objects.1: no object called 'presure' on panel 'bench'; did you mean 'pressure'?",
        "steps.1.object: main_valve has no state 'ajar'; states: closed, open",
        "steps.2.needs.0.unit: the unit of flow is 'l/min', and 'bar' is given; write unit = 'l/min'",
        "steps.3.conditions.0.state: run_lamp has no state 'green'; states: on, off",
        "steps.3.conditions.1: pump shows states and no value",
        "steps.4.steps.0.object: pressure is a gauge, which cannot be operated",
        "steps.5.mission: there is no mission file 'no_such'",
        "steps.6.object: pressure cannot be operated",
    ):
        assert words in told
    assert len(found) == 8


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[[steps]]\nkind = "inspct"\nname = "a"', "inspct"),
        ('[[steps]]\nkind = "set"\nname = "a"\nobjct = "pump"', "did you mean 'object'?"),
        ('[[steps]]\nkind = "set"\nname = "a"', "give object, or each_kind = true"),
        (
            '[[steps]]\nkind = "set"\nname = "a"\nobject = "pump"\nstate = "on"\nother = true',
            "cannot be given together",
        ),
        ('[[steps]]\nkind = "require"\nname = "a"\nconditions = [{ object = "pump" }]', "a number or for a state"),
        ('[[steps]]\nkind = "inspect"\nname = "a"\n[[steps]]\nkind = "feel"\nname = "a"', "several steps are called a"),
        ("steps = []", "steps"),
        ("[[steps]", "not valid TOML"),
    ],
)
def test_a_malformed_file_is_refused_by_its_name(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        checked_file("mine", beside(tmp_path, mine=text))
    assert "missions/mine.toml" in caught.value.what
    assert words in f"{caught.value.what} {caught.value.hint}"


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (
            {"kind": "require", "conditions": [{"object": "pressure", "above": 600.0, "unit": "bar"}]},
            "no value is above 600",
        ),
        (
            {"kind": "require", "conditions": [{"object": "pressure", "below": 600.0, "unit": "bar"}]},
            "every value is below",
        ),
        (
            {"kind": "require", "conditions": [{"object": "pump", "state": "on"}, {"object": "pump", "state": "off"}]},
            "conditions.1: it can never be met together with steps.0.conditions.0",
        ),
        (
            {
                "kind": "require",
                "conditions": [
                    {"object": "pressure", "below": 3.0, "unit": "bar"},
                    {"object": "pressure", "above": 5.0, "unit": "bar"},
                ],
            },
            "it can never be met together",
        ),
        ({"kind": "inspect", "objects": ["flow", "flow"]}, "steps.0.objects.1: flow is named already"),
        (
            {
                "kind": "repeat",
                "times": 1000,
                "steps": [
                    {"kind": "repeat", "name": "b", "times": 1000, "steps": [{"kind": "inspect", "name": "c"}]},
                ],
            },
            "at most 10000 are run",
        ),
    ],
)
def test_what_nothing_can_meet_or_end_is_a_fault(step: dict[str, Any], words: str) -> None:
    (fault,) = steps(step)
    assert words in fault


def test_a_malformed_file_tells_also_what_its_sound_steps_cannot_mean(tmp_path: Path) -> None:
    text = """
titel = "x"
[[steps]]
kind = "fel"
name = "a"
[[steps]]
kind = "choose"
name = "b"
when = []
then = [{ kind = "set", name = "a", object = "pmp", state = "on" }]
[[steps]]
kind = "call"
name = "d"
mission = "no_such"
"""
    with pytest.raises(ConfigError) as caught:
        checked_file("mine", beside(tmp_path, mine=text))
    told = "\n".join(caught.value.details["faults"])
    for words in (
        "titel: unknown key 'titel'; did you mean 'title'?",
        "steps.0.kind: there is no kind 'fel'; did you mean 'feel'?",
        "steps.1.when: it has 0 entries",
        "several steps are called a; give each step its own name",
        "steps.1.then.0.object: no object called 'pmp' on panel 'bench'; did you mean 'pump'?",
        "steps.2.mission: there is no mission file 'no_such'",
    ):
        assert words in told
    assert len(caught.value.details["faults"]) == 6


def test_malformed_missions_that_call_each_other_are_refused(tmp_path: Path) -> None:
    call = '[[steps]]\nkind = "fel"\nname = "x"\n[[steps]]\nkind = "call"\nname = "a"\nmission = "{}"'
    cell = beside(tmp_path, one=call.format("two"), two=call.format("one"))
    with pytest.raises(ConfigError) as caught:
        checked_file("one", cell)
    assert any("'one' calls itself" in fault or "two.toml" in fault for fault in caught.value.details["faults"])


def test_a_circle_of_calls_is_refused(tmp_path: Path) -> None:
    call = '[[steps]]\nkind = "call"\nname = "a"\nmission = "{}"'
    cell = beside(tmp_path, one=call.format("two"), two=call.format("three"), three=call.format("two"))
    with pytest.raises(InvalidRequest, match="'two' calls itself"):
        checked_file("one", cell)


def test_a_file_beside_the_cell_hides_the_shipped_one(tmp_path: Path) -> None:
    cell = beside(tmp_path, demo='title = "mine"\n[[steps]]\nkind = "inspect"\nname = "a"')
    assert checked_file("demo", cell).mission.title == "mine"
    assert set(mission_paths(cell)) >= {"demo", "inspect"}
    with pytest.raises(ConfigError, match="no mission file 'dem'") as caught:
        checked_file("dem", cell)
    assert caught.value.hint == "did you mean 'demo'?"


def test_controls_are_forbidden_or_named_twice() -> None:
    mushroom, pump = CELL.panel.object("emergency"), CELL.panel.object("pump")
    assert "named twice" in steps({"kind": "set", "object": "emergency"})[0]
    assert steps({"kind": "set", "object": "emergency", "confirm": "emergency"}) == []
    assert "confirm names 'pump'" in steps({"kind": "set", "object": "start", "confirm": "pump"})[0]
    forbidden = pump.model_copy(update={"forbidden": True})
    for confirm in (None, "pump"):
        with pytest.raises(InvalidRequest, match="pump is forbidden in the panel file"):
            operable(forbidden, ActionBody(object="pump", confirm=confirm))
    operable(mushroom.model_copy(update={"confirm": False}), ActionBody(object="emergency"))


def test_a_request_without_a_mission_inspects_and_touches_nothing() -> None:
    kinds = {
        name: [
            step.kind for step in mission_of(MissionRequest.model_validate_json(json.dumps(body)), CELL).mission.steps
        ]
        for name, body in {
            "nothing": {},
            "actions": {"actions": [{"object": "pump", "state": "on"}]},
            "no actions": {"actions": []},
            "touches": {"touches": 2},
            "file": {"file": "demo"},
        }.items()
    }
    assert kinds == {
        "nothing": ["inspect"],
        "actions": ["inspect", "feel", "set"],
        "no actions": ["inspect", "feel"],
        "touches": ["inspect", "feel"],
        "file": ["inspect", "feel", "set"],
    }


def test_one_request_names_one_mission_and_a_bad_one_becomes_no_task() -> None:
    with pytest.raises(ValueError, match="give one of file"):
        MissionRequest(file="demo", touches=3)
    with pytest.raises(CellError, match="no object called 'pmp'"):
        asked = MissionRequest(actions=(ActionBody(object="pump", state="on"), ActionBody(object="pmp")))
        OPERATIONS["missions"].check_with_arm(CELL, asked, lambda: None)
    with pytest.raises(CellError, match="no mission file"):
        OPERATIONS["missions"].check_with_arm(CELL, MissionRequest(file="no-such"), lambda: None)
    assert not OPERATIONS["missions"].may_move(MissionRequest(file="demo", dry_run=True))
