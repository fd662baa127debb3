"""Tests of pressing in a numpy cell: what the fingers feel decides what is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.errors import InvalidRequest, Unreachable
from hal.geometry import UncertainPose, transform_rpy
from hal.motion import DeclaredMotion, Hold, MotionOutcome, MotionReport
from hal.panel import Button, Mushroom, Panel, load_panel
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.skills.attempt import Attempt
from manipulation.skills.button import button
from manipulation.skills.cap import state_by_height, stop_force_n
from manipulation.skills.context import SkillContext
from manipulation.skills.mushroom import mushroom
from manipulation.skills.outcome import ObjectState, Outcome
from tests.manipulation.rig import HOME
from tests.manipulation.skills.cap_mover import FRAMES, CapMover, raised
from tests.manipulation.skills.test_contact import GRIP

PANEL = load_panel(Path(__file__).parents[3] / "panels" / "bench.toml")
POSE = transform_rpy((0.80, 0.0, 0.6), (np.pi / 2, 0.0, -np.pi / 2))


def before(cap: Button | Mushroom, *, height_error_m: float = 0.0, sigma_m: float = 0.0005, **how: Any) -> SkillContext:
    """Return the inputs of a skill in front of one cap, by a pose that is wrong by `height_error_m` along the normal."""
    how = {"latches": getattr(cap, "latching", True), "releases": isinstance(cap, Button), **how}
    mover = CapMover(cap=cap, base_from_panel=raised(POSE, -height_error_m), flange_from_grip=GRIP, **how)
    objects = tuple(cap if one.name == cap.name else one for one in PANEL.objects)
    panel = Panel.model_construct(**{**dict(PANEL), "objects": objects})
    covariance = np.diag([sigma_m**2] * 3 + [1e-8] * 3)
    return SkillContext(
        mover=mover, kinematics=FRAMES, panel=panel,
        base_from_panel=UncertainPose(parent_from_child=POSE, covariance=covariance),
        flange_from_grip=GRIP, limits=SpeedLimits(tip_m_per_s=0.25), park_rad=HOME,
    )  # fmt: skip


def the_button(**changes: Any) -> Button:
    cap = PANEL.object("hold").model_copy(update=changes)
    assert isinstance(cap, Button)
    return cap


@pytest.mark.parametrize("height_error_m", [-0.002, 0.0, 0.002])
@pytest.mark.parametrize("is_latched", [False, True])
@pytest.mark.parametrize("target", ["pressed", "released"])
def test_a_latching_button_is_pressed_only_if_it_is_felt_to_be_otherwise(
    target: str, is_latched: bool, height_error_m: float
) -> None:
    """Looks said `pressed` of released caps: the deed was then said to be done, though nothing had been touched."""
    context = before(the_button(), is_latched=is_latched, height_error_m=height_error_m, sigma_m=0.001)
    seen = ObjectState(name="hold", state=target)
    told = button(context, context.panel.object("hold"), target, current=seen, verify=lambda: seen)
    mover = context.mover
    is_there = is_latched == (target == "pressed")
    assert mover.is_latched == (target == "pressed") and mover.presses == (not is_there)
    assert told.peak_force_n > 1.0 and "felt" in told.cause
    assert not is_there or ("felt and seen" in told.cause and "touch the plate" in mover.asked)
    assert told.is_done and told.seen is not None and told.seen.state == target


@pytest.mark.parametrize("blocked", [1, 99])
def test_a_cap_is_pressed_though_there_is_no_way_to_the_plate_beside_it(
    blocked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mushroom of panel 410005 was not pressed, because no path led to the nearest place of the plate."""
    begin, refused = Attempt.begin, []

    def shy(attempt: Attempt, options: Any, *, name: str, **rest: Any) -> int:
        if name.startswith("the plate") and len(refused) < blocked:
            refused.append(name)
            raise Unreachable("no path", hint="none")
        return begin(attempt, options, name=name, **rest)

    monkeypatch.setattr(Attempt, "begin", shy)
    context = before(the_button(), is_latched=False, sigma_m=0.02)
    told = button(context, context.panel.object("hold"), "pressed", current=None, verify=lambda: None)
    assert ("touch the plate" in context.mover.asked) == (blocked == 1) and len(refused) == min(blocked, 4)
    assert context.mover.is_latched and told.is_done


@pytest.mark.parametrize("shown", ["released", None])
def test_a_height_alone_does_not_prove_that_a_cap_is_there_already(shown: str | None) -> None:
    """By the pose of the panel the height told the wrong state in 2 of 16 sweeps."""
    seen = None if shown is None else ObjectState(name="hold", state=shown)
    context = before(the_button(), is_latched=True)
    told = button(context, context.panel.object("hold"), "pressed", verify=lambda: seen)
    assert (told.outcome, context.mover.presses) == (Outcome.UNVERIFIED, 0)
    assert ("the look shows it released" if shown else "no look confirms it") in told.cause


@pytest.mark.parametrize("spring_n_per_m", [500.0, 1000.0, 2000.0])
def test_a_cap_is_pressed_through_with_little_more_force_than_its_spring_needs(spring_n_per_m: float) -> None:
    """The panel file states 1 kN/m for all; its file's limit let the force rise to 40 N at the stop."""
    true = the_button(spring_n_per_m=spring_n_per_m)
    context = before(true)
    told = button(context, the_button(), "pressed")
    assert told.is_done
    assert told.peak_force_n < true.preload_n + spring_n_per_m * true.travel_m + 6.0 < 30.0
    assert told.peak_force_n <= stop_force_n(the_button())


def test_a_cap_that_stops_before_it_latches_is_not_said_to_be_pressed() -> None:
    context = before(the_button(), stuck_at_m=0.002)
    told = button(
        context, context.panel.object("hold"), "pressed", verify=lambda: ObjectState(name="h", state="pressed")
    )
    assert (told.outcome, told.attempts) == (Outcome.STALLED, 3)
    assert "stays where it was" in told.cause


def test_a_cap_that_is_not_there_is_missed_whatever_a_look_says() -> None:
    context = before(the_button(), is_gone=True)
    told = button(
        context, context.panel.object("hold"), "pressed", verify=lambda: ObjectState(name="h", state="pressed")
    )
    assert told.outcome in (Outcome.MISSED, Outcome.STALLED)


def test_a_latched_mushroom_is_left_alone_and_none_is_released() -> None:
    head = PANEL.object("emergency")
    assert isinstance(head, Mushroom)
    context = before(head, is_latched=True)
    told = mushroom(context, head, "pressed")
    assert told.outcome is Outcome.UNVERIFIED and context.mover.presses == 0
    assert mushroom(context, head, "released").outcome is Outcome.STALLED
    context = before(head)
    assert mushroom(context, head, "pressed").is_done and context.mover.is_latched


def test_a_button_that_springs_back_is_done_when_its_travel_and_its_return_were_felt() -> None:
    cap = the_button(latching=False)
    context = before(cap)
    told = button(context, cap, None)
    assert (told.outcome, context.mover.presses) == (Outcome.DONE, 1)
    assert told.reached == pytest.approx(cap.travel_m, abs=1e-3)
    assert "felt to give way" in told.cause and "come back" in told.cause
    stuck = before(cap, stuck_at_m=0.002)
    assert button(stuck, cap, None).outcome is Outcome.STALLED


def test_a_state_that_nothing_could_show_is_refused_before_anything_moves() -> None:
    cap = the_button(latching=False)
    context = before(cap)
    with pytest.raises(InvalidRequest, match="nothing could show") as refusal:
        button(context, cap, "pressed")
    assert "leave the state out" in refusal.value.hint and context.mover.asked == []


def test_a_height_proves_a_state_only_if_it_is_certain_enough() -> None:
    cap = the_button()
    assert state_by_height(cap, cap.height_m, sigma_m=0.0004) == "released"
    assert state_by_height(cap, cap.height_m - 0.003, sigma_m=0.0004) == "pressed"
    assert state_by_height(cap, cap.height_m, sigma_m=0.002) is None
    assert state_by_height(cap, cap.height_m - 0.0015, sigma_m=0.0004) is None


def lit(state: str | None) -> ObjectState | None:
    return None if state is None else ObjectState(name="run_lamp", state=state)


@pytest.mark.parametrize(
    ("current", "looks", "presses", "outcome"),
    [
        (None, ["on"], 1, Outcome.DONE),
        ("on", ["on"], 0, Outcome.DONE),  # a press would switch it off
        ("on", ["off", "on"], 1, Outcome.DONE),  # it was said to be on, and is not
        ("on", ["off", "off"], 1, Outcome.SLIPPED),
        (None, ["off"], 1, Outcome.SLIPPED),  # another press might undo this one
        (None, [None], 1, Outcome.UNVERIFIED),
    ],
)
def test_a_button_with_a_lamp_is_pressed_once_and_its_lamp_decides(
    current: str | None, looks: list[str | None], presses: int, outcome: Outcome
) -> None:
    cap = the_button(latching=False, lights_lamp="run_lamp")
    context = before(cap)
    shown = iter(looks)
    told = button(context, cap, "on", current=lit(current), verify=lambda: lit(next(shown)))
    assert (told.outcome, context.mover.presses) == (outcome, presses)
    assert next(shown, "no more") == "no more"


def test_a_press_that_may_have_counted_is_not_repeated_when_nobody_can_tell() -> None:
    cap = the_button(latching=False, lights_lamp="run_lamp")
    context = before(cap, stuck_at_m=0.002)
    told = button(context, cap, "on", verify=lambda: None)
    assert (told.outcome, told.attempts) == (Outcome.STALLED, 1)
    assert "gave way by only" in told.cause and "undo" in told.cause


def test_a_deed_that_touched_nothing_does_not_say_that_its_stroke_ended() -> None:
    cap = the_button(latching=False, lights_lamp="run_lamp")
    told = button(before(cap), cap, "on", current=lit("on"), verify=lambda: None)
    assert "nothing was moved" in told.cause or told.peak_force_n > 1.0


def test_a_hand_that_is_held_when_the_stroke_has_ended_is_freed_before_anything_else() -> None:
    cap = the_button(latching=False, lights_lamp="run_lamp")
    context = before(cap)
    mover, asked = context.mover, context.mover.asked
    execute, held = mover.execute, iter([True])  # the first retreat is held, the pulls of the freeing are not

    def holding(motion: DeclaredMotion) -> MotionReport:
        if motion.name == "retreat" and next(held, False):
            asked.append(motion.name)
            still = execute(Hold(name="held", duration_s=0.1))
            return replace(still, outcome=MotionOutcome.GUARD, tripped="contact")
        return execute(motion)

    mover.execute = holding
    assert button(context, cap, "on", verify=lambda: lit("on")).is_done
    assert [name for name in asked if name in ("press", "let go", "retreat")][-3:] == ["retreat", "let go", "retreat"]
