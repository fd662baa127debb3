"""The judge verifies everything, so a false claim of any kind is detected."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from hal.errors import InvalidRequest
from hal.geometry import perturbed, to_json, transform_rpy
from hal.panel import Shown, load_panel
from hal.simulated import ObjectTruth, Truth
from service.evaluate import AFTER, compare, evaluate, shown_of
from service.processes.connection import CellConnection
from service.schema.mission_results import UnaskedMotion

PANEL = load_panel(Path(__file__).parents[2] / "panels/bench.toml")
POSE = transform_rpy((0.95, 0.0, 0.55), (1.57, 0.0, -1.57))


def truth(**after: Any) -> Truth:
    def things(valve: str, slider: float, lamp: str) -> tuple[ObjectTruth, ...]:
        return (
            ObjectTruth(name="main_valve", state=valve),
            ObjectTruth(name="setpoint", value=slider),
            ObjectTruth(name="start", state="released", value=0.0),
            ObjectTruth(name="run_lamp", state=lamp),
            ObjectTruth(name="pressure", value=4.0),
            ObjectTruth(name="temperature", text="21.5", value=21.5),
        )

    return Truth(
        base_from_panel_matrix=POSE.as_matrix(),
        initial=things("closed", 20.0, "off"),
        objects=things(after.get("valve", "open"), after.get("slider", 70.0), after.get("lamp", "on")),
        peak_force_n=30.0,
        sim_time_s=50.0,
    )


def action(name: str, target: str, *, confirmed: bool = True) -> dict[str, Any]:
    outcome = "done" if confirmed else "stalled"
    return {"object": name, "skill": "skill", "target": target, "outcome": outcome, "confirmed": confirmed}


def reading(name: str, when: str = "before the actions", **said: Any) -> dict[str, Any]:
    shown = {"value": None, "state": None, "text": None, **said}
    return {"name": name, "when": when, "present": True, "reason": None, "shows": str(said), **shown}


def report(**parts: Any) -> dict[str, Any]:
    covariance = np.diag([1e-3] * 3 + [2e-3] * 3) ** 2
    fused = {**to_json(perturbed(POSE, [5e-4, 0, 0, 1e-3, 0, 0])), "covariance": covariance.tolist()}
    return {"readings": [], "actions": [], "fused": fused, **parts}


ALL_DONE = [action("main_valve", "open"), action("setpoint", "70"), action("start", "on")]


def test_true_claims_are_agreed_with() -> None:
    verdict = compare(report(actions=ALL_DONE, readings=[reading("pressure", value=4.1)]), truth(), PANEL)
    assert verdict.agrees
    assert (verdict.readings_right, verdict.readings_given) == (1, 1)
    assert verdict.pose_error_m == pytest.approx(5e-4)
    assert verdict.pose_error_rad == pytest.approx(1e-3)
    assert verdict.inside_95


@pytest.mark.parametrize("lie", [{"valve": "closed"}, {"slider": 60.0}, {"lamp": "off"}])
def test_one_false_done_is_disagreed_with(lie: dict[str, Any]) -> None:
    assert not compare(report(actions=ALL_DONE), truth(**lie), PANEL).agrees


def test_what_moved_though_nobody_asked_is_told() -> None:
    asked = report(actions=[action("main_valve", "open"), action("start", "on")])
    knocked = compare(asked, truth(slider=60.0), PANEL)
    assert knocked.moved_unasked == [UnaskedMotion(name="setpoint", truth="20 to 60")]
    assert compare(asked, truth(slider=20.5), PANEL).moved_unasked == [], "within what a reading may be off"
    assert compare(report(actions=ALL_DONE), truth(), PANEL).moved_unasked == [], "the lamp is the button's"
    lit = compare(report(actions=[action("main_valve", "open")]), truth(slider=20.0), PANEL)
    assert [moved.name for moved in lit.moved_unasked] == ["run_lamp"]


def test_of_several_deeds_with_one_control_the_last_is_judged() -> None:
    """After on and off again the lamp is dark, but both claims were true when they were made."""
    deeds = [action("start", "on"), action("start", "off")]
    looks = [reading("run_lamp", AFTER, state="on"), reading("run_lamp", AFTER, state="off")]
    verdict = compare(report(actions=deeds, readings=looks), truth(lamp="off"), PANEL)
    assert verdict.agrees and (verdict.readings_right, verdict.readings_given) == (1, 1)
    verdict = compare(report(actions=deeds[::-1], readings=looks), truth(lamp="off"), PANEL)
    assert not verdict.agrees and verdict.readings_right == 1


def test_a_failure_that_is_told_is_no_lie() -> None:
    verdict = compare(report(actions=[action("main_valve", "open", confirmed=False)]), truth(valve="closed"), PANEL)
    assert verdict.agrees
    assert verdict.actions_confirmed == 0


def test_a_pose_outside_its_ellipsoid_is_said_to_be() -> None:
    covariance = (np.diag([1e-4] * 6) ** 2).tolist()
    fused = {**to_json(perturbed(POSE, [5e-4, 0, 0, 0, 0, 0])), "covariance": covariance}
    assert not compare(report(fused=fused), truth(), PANEL).inside_95


def test_a_mission_without_a_pose_is_judged_without_one() -> None:
    assert compare(report(fused=None), truth(), PANEL).pose_error_m is None


def test_readings_are_held_against_their_own_time() -> None:
    rows = [reading("main_valve", state="closed"), reading("main_valve", AFTER, state="open")]
    assert compare(report(readings=rows), truth(), PANEL).readings_right == 2


@pytest.mark.parametrize(
    ("name", "said", "is_right"),
    [
        ("pressure", {"value": 4.19}, True),
        ("pressure", {"value": 4.21}, False),
        ("temperature", {"text": "21.5"}, True),
        ("temperature", {"text": "215"}, False),
        ("main_valve", {"state": "open"}, True),
        ("main_valve", {"state": None}, False),
        ("setpoint", {"value": 71.9}, True),
        ("setpoint", {"value": None}, False),
    ],
)
def test_right_means_two_per_cent_of_the_scale_or_the_very_state(
    name: str, said: dict[str, Any], is_right: bool
) -> None:
    now = {panel_object.name: panel_object for panel_object in truth().objects}[name]
    assert PANEL.object(name).is_right(Shown(**said), shown_of(now)) is is_right


def test_a_mission_without_a_report_is_refused_before_anything_is_asked(tmp_path: Path) -> None:
    with pytest.raises(InvalidRequest, match="no report of a mission '20261120T231502'"):
        evaluate(cast(CellConnection, None), tmp_path / "20261120T231502")


@pytest.mark.parametrize(("key", "other"), [("cell", "press"), ("panel", "press"), ("seed", 8)])
def test_a_mission_of_another_cell_is_not_judged_by_this_simulator(tmp_path: Path, key: str, other: str | int) -> None:
    """Otherwise another panel would raise KeyError, and another seed would be judged by the wrong world."""
    ran = {"cell": "bench", "panel": "bench", "seed": 7, key: other}
    (tmp_path / "report.json").write_text(json.dumps(report(**ran)))
    cell = SimpleNamespace(name="bench", panel=PANEL, file=SimpleNamespace(cell=SimpleNamespace(seed=7)))
    with pytest.raises(InvalidRequest, match=f"was of {key} {other!r}, this service runs {key}"):
        evaluate(cast(CellConnection, SimpleNamespace(cell=cell)), tmp_path)


def test_a_mission_is_compared_with_what_its_own_beginning_showed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second mission is not compared with the beginning of the world, since the first one has changed it."""
    asked: list[float] = []

    def told(initial_s: float = 0.0) -> Truth:
        asked.append(initial_s)
        return replace(truth(), sim_time_s=130.0, initial=truth().objects if initial_s > 0.0 else truth().initial)

    ran = report(cell="bench", panel="bench", seed=7, started_cell_s=1000.0)
    (tmp_path / "report.json").write_text(json.dumps(ran))
    connection = SimpleNamespace(
        cell=SimpleNamespace(name="bench", panel=PANEL, file=SimpleNamespace(cell=SimpleNamespace(seed=7))),
        clock=SimpleNamespace(now_s=lambda: 1050.0),
        devices_of=lambda kind: {"arm": SimpleNamespace(truth=told)},
        behind_wires_of=lambda kind: {},
    )
    monkeypatch.setattr("service.evaluate.render", lambda folder: None)
    verdict = evaluate(cast(CellConnection, connection), tmp_path)
    assert asked[-1] == 80.0 and verdict.moved_unasked == []
