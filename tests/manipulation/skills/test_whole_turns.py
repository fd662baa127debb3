"""Tests of the whole turns of a wheel: tracked ones, those of a wheel never turned, and those that an end stop shows."""

from __future__ import annotations

import pytest

from hal.errors import InvalidRequest
from hal.panel import Handwheel
from manipulation.skills.handwheel import at_a_stop, believed_angle
from manipulation.skills.outcome import ObjectState, Outcome

WHEEL = Handwheel(name="bypass", position_m=(0.0, 0.0))


def seen(angle_rad: float, turned_rad: float | None = None) -> ObjectState:
    return ObjectState(name="bypass", angle_rad=angle_rad, turned_rad=turned_rad)


@pytest.mark.parametrize(
    ("angle_rad", "turned_rad", "believed_rad"),
    [
        (1.0, None, 1.0),
        (0.28, -6.0, -6.0032),
        (-3.1, 3.2, 3.1832),
        (1.0, -6.0, 1.0),  # somebody has turned it meanwhile
    ],
)
def test_the_whole_turns_are_those_that_were_tracked(
    angle_rad: float, turned_rad: float | None, believed_rad: float
) -> None:
    assert believed_angle(WHEEL, seen(angle_rad, turned_rad)) == pytest.approx(believed_rad, abs=1e-4)


def test_a_wheel_with_unknown_whole_turns_is_refused_unless_its_stops_leave_one_possibility() -> None:
    unknown = WHEEL.model_copy(update={"starts_upright": False})
    with pytest.raises(InvalidRequest, match="whole turns of bypass are not known"):
        believed_angle(unknown, seen(1.0))
    assert believed_angle(unknown, seen(0.28, -6.0)) == pytest.approx(-6.0032, abs=1e-4)
    one_turn = unknown.model_copy(update={"minimum_rad": 0.8, "maximum_rad": 6.0})
    assert believed_angle(one_turn, seen(-1.5)) == pytest.approx(4.7832, abs=1e-4)


def test_a_wheel_that_stalls_where_only_its_end_stop_can_be_was_whole_turns_further() -> None:
    unknown = WHEEL.model_copy(update={"starts_upright": False})
    assert at_a_stop(unknown, -0.1, 1.0, Outcome.STALLED) == pytest.approx(6.1832, abs=1e-4)
    assert at_a_stop(unknown, 6.2, 1.0, Outcome.STALLED) == 6.2
    assert at_a_stop(unknown, 2.5, 1.0, Outcome.STALLED) == 2.5
    assert at_a_stop(unknown, -0.1, 1.0, Outcome.SLIPPED) == -0.1
    assert at_a_stop(WHEEL, -0.1, 1.0, Outcome.STALLED) == -0.1  # its whole turns are known: it is only hard to turn
