"""Tests of the initial state of a skill's object, from what was seen of it."""

from __future__ import annotations

import pytest

from hal.errors import InvalidRequest
from manipulation.skills.initial_state import InitialState
from manipulation.skills.outcome import ObjectState


def at(value: float | None) -> ObjectState:
    return ObjectState(name="fader", value=value)


def value_of(seen: ObjectState) -> float | None:
    return seen.value


def test_without_any_look_the_place_is_not_known_and_the_message_says_of_what() -> None:
    where = InitialState(value_of, what="the value of fader", current=None, verify=None)
    assert where.verify is None
    with pytest.raises(InvalidRequest, match="the value of fader is not known"):
        _ = where.known


def test_the_current_state_saves_a_look() -> None:
    asked: list[ObjectState] = []

    def verify() -> ObjectState:
        asked.append(at(5.0))
        return asked[-1]

    assert InitialState(value_of, what="it", current=at(2.0), verify=verify).known == 2.0
    assert asked == []
    assert InitialState(value_of, what="it", current=None, verify=verify).known == 5.0
    assert len(asked) == 1


def test_a_look_corrects_what_the_tool_measured_and_one_that_tells_nothing_does_not() -> None:
    looks = iter([at(3.0), None, at(None), at(4.0)])
    where = InitialState(value_of, what="it", current=None, verify=lambda: next(looks))
    verify = where.verify
    assert verify is not None
    assert where.moved_to(3.5) == where.known == 3.5
    assert verify() is None
    assert where.known == 3.5
    assert verify() == at(None)
    assert where.known == 3.5
    assert verify() == at(4.0)
    assert where.known == 4.0


def test_a_look_that_shows_one_turn_only_does_not_change_the_whole_turns() -> None:
    looks = iter([at(-0.4), at(3.0)])
    where = InitialState(value_of, what="it", current=at(1.0), verify=lambda: next(looks), period=6.0)
    assert where.verify is not None
    where.moved_to(11.5)
    where.verify()
    assert where.known == 11.6
    where.moved_to(-8.8)
    where.verify()
    assert where.known == -9.0


def test_a_look_between_two_holds_counts_the_turns_of_a_wheel_that_did_not_follow() -> None:
    """The fingers felt 4.2 rad and slid all the way: the next look shows the angle of the beginning again."""
    looks = iter([at(0.5), at(-1.6)])
    where = InitialState(value_of, what="it", current=at(0.5), verify=lambda: next(looks), period=6.28)
    assert where.verify is not None
    where.moved_by(4.2, least=-0.2, largest=4.6)
    where.verify()
    assert (where.known, where.is_sure) == (0.5, True)
    where.moved_by(4.2, least=-0.2, largest=4.6)
    where.verify()
    assert (where.known, where.is_sure) == (pytest.approx(4.68), True)


def test_turns_that_no_look_has_told_apart_are_not_sure() -> None:
    """Two holds of 4.2 rad without a look between them: the wheel may have turned once or not at all."""
    looks = iter([None, at(0.5), at(0.5)])
    where = InitialState(value_of, what="it", current=at(0.5), verify=lambda: next(looks), period=6.28)
    assert where.verify is not None
    where.moved_by(4.2, least=-0.2, largest=4.6)
    where.verify()
    where.moved_by(4.2, least=-0.2, largest=4.6)
    where.verify()
    assert not where.is_sure
    where.verify()
    assert not where.is_sure


def test_an_observation_is_taken_with_the_whole_periods_that_are_known() -> None:
    where = InitialState(value_of, what="it", current=at(13.0), verify=None, period=6.0)
    assert where.nearest(at(1.4)) == pytest.approx(13.4)
    assert where.nearest(at(None)) is None
    assert InitialState(value_of, what="it", current=at(13.0), verify=None).nearest(at(1.4)) == 1.4
