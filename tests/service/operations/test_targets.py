"""An invalid request is refused before anything moves."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hal.config import load_cell
from hal.errors import InvalidRequest
from service.operations import OPERATIONS
from service.operations.manipulate import target_of
from service.operations.mission import usual_actions
from service.schema.requests import ActionBody
from service.world_model import WorldModel

CELL = load_cell(Path(__file__).parents[3] / "cells/bench.toml")


@pytest.mark.parametrize(
    ("body", "target"),
    [
        ({"object": "setpoint", "value": 40.0}, 40.0),
        ({"object": "bypass", "angle_rad": 0.5}, 0.5),
        ({"object": "main_valve", "state": "open"}, "open"),
        ({"object": "pump", "state": "on"}, "on"),
        ({"object": "emergency"}, "pressed"),
        ({"object": "start"}, "on"),
        ({"object": "hold"}, "pressed"),
        ({"object": "hold", "state": "released"}, "released"),
    ],
)
def test_a_deed_says_what_it_shall_reach(body: dict[str, Any], target: str | float) -> None:
    assert target_of(CELL.panel.object(body["object"]), ActionBody(**body)) == target


NONSENSE = [
    ({"object": "setpiont", "value": 4.0}, "no object called", "'setpoint'"),
    ({"object": "setpoint", "value": 400.0}, "value from 0 to 100 %", "'value'"),
    ({"object": "setpoint"}, "value from 0 to 100 %", "'value'"),
    ({"object": "bypass", "angle_rad": 50.0}, "angle_rad from", "'angle_rad'"),
    ({"object": "main_valve", "state": "ajar"}, "no state 'ajar'", "open"),
    ({"object": "main_valve"}, "needs a state", "open"),
    ({"object": "emergency", "value": 3.0}, "takes state, not value", "'state'"),
    ({"object": "start", "state": "pressed"}, "no state 'pressed'", "on, off"),
    ({"object": "hold", "state": "on"}, "no state 'on'", "pressed, released"),
    ({"object": "pressure", "value": 3.0}, "cannot be operated", "lever"),
]


@pytest.mark.parametrize(("body", "why", "hint"), NONSENSE)
def test_nonsense_is_refused_by_both_verbs_that_work_controls(body: dict[str, Any], why: str, hint: str) -> None:
    for verb, request in (("manipulate", body), ("missions", {"actions": (ActionBody(**body),)})):
        operation = OPERATIONS[verb]
        with pytest.raises(InvalidRequest, match=why) as refused:
            operation.check(CELL, operation.request_model(**request))
        assert hint in refused.value.hint


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
        session: Any = SimpleNamespace(panel=CELL.panel.model_copy(update={"objects": things}), world=WorldModel())
        assert [(body.object, body.state) for body in usual_actions(session)] == wanted


@pytest.mark.parametrize("verb", ["inspect", "recognise"])
def test_an_object_to_look_for_must_be_on_the_panel_unless_an_image_of_another_one_is_sent(verb: str) -> None:
    operation = OPERATIONS[verb]
    with pytest.raises(InvalidRequest, match="presure"):
        operation.check(CELL, operation.request_model(objects=("presure",)))
    operation.check(CELL, operation.request_model(objects=("presure",), image="0" * 24))
    operation.check(CELL, operation.request_model())
