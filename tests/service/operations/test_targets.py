"""An invalid request is refused before anything moves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hal.config import Cell, load_cell
from hal.errors import InvalidRequest, NoRoom, OutOfReach
from manipulation import Kinematics
from service.feasibility import target_of, usual_actions
from service.operations import OPERATIONS
from service.problem import status_of
from service.schema.requests import ActionBody
from tests.manipulation.arms import T3

CELL = load_cell(Path(__file__).parents[3] / "cells/bench.toml")
ARM = Kinematics.of(T3)


def no_arm() -> None:
    return None


@pytest.mark.parametrize(
    ("body", "target"),
    [
        ({"object": "setpoint", "value": 40.0}, 40.0),
        ({"object": "bypass", "angle_rad": 0.5}, 0.5),
        ({"object": "main_valve", "state": "open"}, "open"),
        ({"object": "pump", "state": "on"}, "on"),
        ({"object": "emergency", "confirm": "emergency"}, "pressed"),
        ({"object": "start"}, "on"),
        ({"object": "hold"}, "pressed"),
        ({"object": "hold", "state": "released"}, "released"),
    ],
)
def test_a_deed_says_what_it_shall_reach(body: dict[str, Any], target: str | float) -> None:
    assert target_of(CELL.panel.object(body["object"]), ActionBody(**body)) == target


NONSENSE = [
    ({"object": "setpiont", "value": 4.0}, "no object called", "'setpoint'"),
    ({"object": "setpoint", "value": 400.0}, "value from 0 to 100 %", "value"),
    ({"object": "setpoint"}, "value from 0 to 100 %", "value"),
    ({"object": "bypass", "angle_rad": 50.0}, "angle_rad from", "angle_rad"),
    ({"object": "main_valve", "state": "ajar"}, "no state 'ajar'", "open"),
    ({"object": "main_valve"}, "needs a state", "open"),
    ({"object": "emergency", "value": 3.0}, "takes state, not value", "state"),
    ({"object": "start", "state": "pressed"}, "no state 'pressed'", "on, off"),
    ({"object": "hold", "state": "on"}, "no state 'on'", "pressed, released"),
    ({"object": "pressure", "value": 3.0}, "cannot be operated", "lever"),
    ({"object": "emergency"}, "only when it is named twice", "confirm = 'emergency'"),
    ({"object": "emergency", "confirm": "pump"}, "confirm names 'pump'", "confirm = 'emergency'"),
]


@pytest.mark.parametrize(("body", "why", "hint"), NONSENSE)
def test_nonsense_is_refused_by_both_verbs_that_work_controls(body: dict[str, Any], why: str, hint: str) -> None:
    for verb, request in (("manipulate", body), ("missions", {"actions": (ActionBody(**body),)})):
        operation = OPERATIONS[verb]
        with pytest.raises(InvalidRequest, match=why) as refused:
            operation.check_with_arm(CELL, operation.request_model(**request), no_arm)
        assert hint in refused.value.hint


def crowded(**moved: tuple[float, float]) -> Cell:
    """Return the bench cell with some objects elsewhere."""
    objects = tuple(
        one.model_copy(update={"position_m": moved[one.name]}) if one.name in moved else one
        for one in CELL.panel.objects
    )
    return CELL.model_copy(update={"panel": CELL.panel.model_copy(update={"objects": objects})})


def test_all_that_a_mission_cannot_do_is_refused_at_once() -> None:
    x, y = CELL.panel.object("pump").position_m
    cell = crowded(emergency=(x, y + 0.030))
    asked = (
        {"object": "pump", "state": "on"}, {"object": "setpoint", "value": 104.0}, {"object": "start", "state": "on"},
        {"object": "pressure", "value": 1.0},
    )  # fmt: skip
    request = OPERATIONS["missions"].request_model(actions=tuple(ActionBody(**body) for body in asked))
    with pytest.raises(NoRoom, match=r"pump stands too near to emergency: .* lacks .* mm") as refused:
        OPERATIONS["missions"].check_with_arm(cell, request, lambda: ARM)
    assert refused.value.details["objects"] == ["pump", "setpoint", "pressure"]
    assert "104 is 4 % above the end of its way" in refused.value.details["faults"][1]
    assert status_of(refused.value) == 422


def test_a_control_that_no_pose_of_the_panel_brings_into_reach_is_refused() -> None:
    workspace = CELL.file.workspace.model_copy(update={"panel_position_m": (3.0, 0.0, 0.55)})
    cell = CELL.model_copy(update={"file": CELL.file.model_copy(update={"workspace": workspace})})
    request = OPERATIONS["manipulate"].request_model(object="pump", state="on")
    with pytest.raises(OutOfReach, match=r"pump is beyond the arm's reach by \d+ mm"):
        OPERATIONS["manipulate"].check_with_arm(cell, request, lambda: ARM)
    OPERATIONS["manipulate"].check_with_arm(CELL, request, lambda: ARM)


def test_a_button_that_nothing_shows_can_be_asked_for_a_press_only() -> None:
    bell = CELL.panel.object("hold").model_copy(update={"latching": False})
    assert target_of(bell, ActionBody(object="hold")) == "pressed once"
    for state in ("pressed", "released"):
        with pytest.raises(InvalidRequest, match="keeps no state, so neither a look nor the fingers") as refused:
            target_of(bell, ActionBody(object="hold", state=state))
        assert "leave the state out" in refused.value.hint


def test_a_mission_presses_by_itself_only_what_shows_that_it_was_pressed() -> None:
    lit, latching = CELL.panel.object("start"), CELL.panel.object("hold")
    bell = latching.model_copy(update={"latching": False, "name": "bell"})
    for things, wanted in (
        ((latching, lit), [("start", "on")]),
        ((bell, latching), [("hold", "pressed")]),
        ((bell,), []),
    ):
        bodies = usual_actions(CELL.panel.model_copy(update={"objects": things}), {})
        assert [(body.object, body.state) for body in bodies] == wanted


@pytest.mark.parametrize("verb", ["inspect", "recognise"])
def test_an_object_to_look_for_must_be_on_the_panel_unless_an_image_of_another_one_is_sent(verb: str) -> None:
    operation = OPERATIONS[verb]
    with pytest.raises(InvalidRequest, match="presure"):
        operation.check(CELL, operation.request_model(objects=("presure",)))
    operation.check(CELL, operation.request_model(objects=("presure",), image="0" * 24))
    operation.check(CELL, operation.request_model())
