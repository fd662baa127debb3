"""Tests of the reports of complete skills, with a mover that answers each motion as configured."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.errors import MotionError, Unreachable
from hal.geometry import certain, transform_rpy
from hal.motion import (
    CartesianPath,
    DeclaredMotion,
    JointTrajectory,
    MotionLog,
    MotionOutcome,
    MotionReport,
    RobotState,
)
from hal.panel import load_panel
from manipulation.arm.kinematics import Kinematics
from manipulation.planning.hand import Hand
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.skills.attempt import Attempt
from manipulation.skills.button import button
from manipulation.skills.context import SkillContext
from manipulation.skills.operate import operate
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport
from manipulation.skills.press import stop_force_n, travelled_m
from manipulation.skills.probe import proximity_probe
from manipulation.skills.retreat import PULLS, park, retreat
from manipulation.skills.toggle import toggle
from tests.manipulation.arms import T3
from tests.manipulation.rig import HOME
from tests.manipulation.skills.test_contact import AT_HOME, COMPLETED, GRIP, ScriptedMover

PANEL = load_panel(Path(__file__).parents[3] / "panels" / "bench.toml")
PAD_N_PER_M = Hand().pad_stiffness_n_per_m
DOWN = AT_HOME.rotation.apply([0.0, 0.0, 1.0])


class NamedMover(ScriptedMover):
    """Mover that answers motions by their name; other motions are completed."""

    def __init__(self, answers: dict[str, MotionReport]) -> None:
        super().__init__(COMPLETED)
        self.answers = answers
        self.motions: list[DeclaredMotion] = []
        self.distances_m: list[float] = []

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        self.asked.append(motion.name)
        self.motions.append(motion)
        return self.answers.get(motion.name, COMPLETED)

    def state(self) -> RobotState:
        samples = self.asked.count("proximity sample")
        return replace(super().state(), proximity_m=tuple(self.distances_m[samples - 1 : samples]))


def before_the_bench(answers: dict[str, MotionReport]) -> tuple[SkillContext, NamedMover]:
    mover = NamedMover(answers)
    context = SkillContext(
        mover=mover,
        kinematics=Kinematics.of(T3),
        panel=PANEL,
        base_from_panel=certain(transform_rpy((0.75, 0.0, 0.6), (np.pi / 2, 0.0, -np.pi / 2))),
        flange_from_grip=GRIP,
        limits=SpeedLimits(tip_m_per_s=0.25),
        park_rad=HOME,
    )
    return context, mover


def press(context: SkillContext, name: str, expected: str | None = None, **looks: Any) -> SkillReport:
    """Press the button called `name`."""
    return button(context, context.panel.object(name), expected, **looks)


def pressed(free_m: float, travel_m: float, force_n: float, *, tripped: bool = True) -> MotionReport:
    """Return the report of a push: free, then against a cap that yields by `travel_m` and elastic pads."""
    deepest = free_m + travel_m + force_n / PAD_N_PER_M
    depth = np.linspace(0.0, deepest, 400)
    wrench = np.zeros((400, 6))
    wrench[:, 2] = -force_n * np.clip((depth - free_m) / (deepest - free_m), 0.0, 1.0)
    log = MotionLog(
        times_s=np.arange(400) * 0.002, positions_rad=np.zeros((400, 6)), wrench=wrench,
        tip_m=AT_HOME.translation + depth[:, None] * DOWN,
    )  # fmt: skip
    outcome = MotionOutcome.GUARD if tripped else MotionOutcome.COMPLETED
    return replace(COMPLETED, outcome=outcome, tripped="bottom" if tripped else None, log=log)


def test_the_travel_of_a_cap_is_that_of_the_tip_under_force_less_what_the_pads_gave() -> None:
    found = travelled_m(pressed(0.004, 0.003, 20.0), PAD_N_PER_M)
    assert found == pytest.approx(0.003, abs=4e-4)  # counted from a force of one newton
    assert travelled_m(pressed(0.004, 0.0, 0.5), PAD_N_PER_M) == 0.0


@pytest.mark.parametrize(
    ("push", "outcome"),
    [
        (pressed(0.004, 0.004, 20.0), Outcome.UNVERIFIED),
        (pressed(0.004, 0.0003, 20.0), Outcome.STALLED),
        (pressed(0.02, 0.004, 5.0, tripped=False), Outcome.MISSED),
    ],
    ids=["down", "stuck", "not there"],
)
def test_a_button_says_how_its_press_ended(push: MotionReport, outcome: Outcome) -> None:
    context, _ = before_the_bench({"press": push})
    told = press(context, "start", "on")
    assert told.outcome is outcome
    assert told.reached == pytest.approx(travelled_m(push, PAD_N_PER_M))


def test_a_button_whose_lamp_stays_dark_is_not_pressed_again() -> None:
    context, mover = before_the_bench({"press": pressed(0.004, 0.004, 20.0)})
    told = press(context, "start", "on", verify=lambda: ObjectState(name="start", state="off"))
    assert (told.outcome, mover.asked.count("press")) == (Outcome.SLIPPED, 1)


@pytest.mark.parametrize(
    ("looks", "presses", "tries"), [(("on",), 0, 1), (("off", "on"), 1, 2), (("off", "off"), 1, 2)]
)
def test_a_button_whose_lamp_is_as_wanted_is_left_alone_unless_the_look_says_otherwise(
    looks: tuple[str, ...], presses: int, tries: int
) -> None:
    """Another press would undo it: with the goal `on`, a lamp that was lit would go out."""
    context, mover = before_the_bench({"press": pressed(0.004, 0.004, 20.0)})
    shown = iter(looks)
    lit = ObjectState(name="run_lamp", state="on")
    told = button(
        context,
        context.panel.object("start"),
        expected="on",
        current=lit,
        verify=lambda: ObjectState(name="run_lamp", state=next(shown)),
    )
    assert (told.is_done, mover.asked.count("press"), told.attempts) == (looks[-1] == "on", presses, tries)


@pytest.mark.parametrize(
    ("before", "looks", "sweeps"),
    [
        ("on", ["on", "on"], 0),  # already in the goal state: only read
        ("on", ["off", "on"], 1),  # it was reported to be in the goal state, but is not
        ("on", [None, "on"], 1),  # unknown: switching does no harm
        ("on", ["on", "off", "on"], 1),  # the readings disagree
        ("off", ["on"], 1),
        (None, ["on"], 1),
    ],
)
def test_a_toggle_that_stands_there_already_is_looked_at_and_thrown_only_when_in_doubt(
    before: str | None, looks: list[str | None], sweeps: int
) -> None:
    context, mover = before_the_bench({})
    shown = iter(looks)

    def look() -> ObjectState | None:
        state = next(shown)
        return None if state is None else ObjectState(name="pump", state=state)

    current = None if before is None else ObjectState(name="pump", state=before)
    told = toggle(context, context.panel.object("pump"), "on", current=current, verify=look)
    assert next(shown, "no more") == "no more"
    assert (told.is_done, mover.asked.count("to pump")) == (True, sweeps)


def test_a_button_that_nothing_shows_is_pressed_and_not_confirmed() -> None:
    panel_object = PANEL.object("start").model_copy(update={"lights_lamp": None})
    context, mover = before_the_bench({"press": pressed(0.004, 0.004, 20.0)})
    context = replace(context, panel=PANEL.model_copy(update={"objects": (panel_object,)}))
    told = button(
        context,
        context.panel.object("start"),
        expected="pressed",
        verify=lambda: ObjectState(name="start", state="released"),
    )
    assert (told.outcome, mover.asked.count("press")) == (Outcome.UNVERIFIED, 1)
    assert "springs back" in told.cause


def test_a_look_that_cannot_tell_is_not_called_no_look() -> None:
    context, _ = before_the_bench({"press": pressed(0.004, 0.004, 20.0)})
    told = press(context, "start", "on", verify=lambda: None)
    assert (told.outcome, told.cause) == (
        Outcome.UNVERIFIED,
        "the stroke ended as declared; the reading afterwards was refused",
    )
    assert press(context, "start", "on").cause.endswith("no reading was asked for afterwards")


def test_a_press_that_may_have_counted_is_not_repeated_when_nobody_can_tell() -> None:
    """Otherwise a latching cap that yields little is pressed twice, which may undo the press."""
    context, mover = before_the_bench({"press": pressed(0.004, 0.0003, 20.0)})
    told = press(context, "hold", "pressed", verify=lambda: None)
    assert (told.outcome, mover.asked.count("press")) == (Outcome.STALLED, 1)
    assert "gave way by only" in told.cause and "undo" in told.cause


@pytest.mark.parametrize(
    ("width_m", "wanted_m", "moves"), [(0.0, 0.0, 0), (0.002, 0.0, 1), (0.0, 0.002, 1), (0.03, 0.03, 1)]
)
def test_closed_pads_that_shall_be_closed_are_left_alone(width_m: float, wanted_m: float, moves: int) -> None:
    """Open pads are commanded even to their present width, because they may press against something there."""
    context, mover = before_the_bench({})
    state = replace(mover.state(), gripper_width_m=width_m)
    mover.state = lambda: state  # type: ignore[method-assign]  # one state for this test
    Attempt(context).open_to(wanted_m)
    assert mover.asked.count("set opening") == moves


def test_pads_open_on_the_way_and_before_it_where_the_wider_hand_has_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    context, mover = before_the_bench({})
    goal_rad = context.park_rad
    Attempt(context).go_to_opening(goal_rad, width_m=0.03, name="to there")
    (motion,) = mover.motions
    assert isinstance(motion, JointTrajectory) and motion.pads is not None
    assert motion.pads.width_m == 0.03

    plan, widths_m = SkillContext.transfer, []

    def narrow(self: SkillContext, *joints_rad: Any, width_m: float, **more: Any) -> JointTrajectory:
        widths_m.append(width_m)
        if width_m > 0.01:
            raise Unreachable("no room", hint="close the hand")
        return plan(self, *joints_rad, width_m=width_m, **more)

    monkeypatch.setattr(SkillContext, "transfer", narrow)
    mover.motions.clear()
    state = replace(mover.state(), gripper_width_m=0.03)
    mover.state = lambda: state  # type: ignore[method-assign]  # one state for this test
    Attempt(context).go_to_opening(goal_rad, width_m=0.01, name="to there")
    assert [motion.name for motion in mover.motions] == ["set opening", "to there"]
    assert widths_m == [0.03, 0.01]


def test_a_press_is_guarded_by_more_than_the_springs_of_the_cap() -> None:
    context, mover = before_the_bench({"press": pressed(0.004, 0.004, 20.0)})
    press(context, "start")
    cap = PANEL.object("start")
    (push,) = (m for m in mover.motions if m.name == "press")
    assert push.guards[0].limit == stop_force_n(cap) > cap.preload_n + cap.spring_n_per_m * cap.travel_m


@pytest.mark.parametrize(("distance_m", "against"), [(0.01, -1.0), (-0.01, 1.0)])
def test_a_contact_is_looked_for_against_the_way(distance_m: float, against: float) -> None:
    context, mover = before_the_bench({})
    Attempt(context).advance(distance_m, name="advance")
    (motion,) = mover.motions
    assert isinstance(motion, CartesianPath) and motion.guards[0].axis == (0.0, 0.0, against)


def test_a_hand_that_is_held_is_pulled_again() -> None:
    held = replace(COMPLETED, outcome=MotionOutcome.GUARD, tripped="contact")
    for answer, pulls in ((held, PULLS), (COMPLETED, 1)):
        context, mover = before_the_bench({"retreat": answer})
        with pytest.raises(MotionError, match="did not come free") if pulls == PULLS else nullcontext():
            retreat(context)
        assert mover.asked.count("retreat") == pulls


def test_a_hand_that_is_held_when_the_stroke_has_ended_is_freed_before_anything_else() -> None:
    held = replace(COMPLETED, outcome=MotionOutcome.GUARD, tripped="contact")
    context, mover = before_the_bench({"press": pressed(0.004, 0.004, 20.0)})
    answers = iter([held])  # the first retreat is held, the pulls of the freeing are not
    execute = mover.execute
    mover.execute = lambda motion: (  # type: ignore[method-assign]
        next(answers, execute(motion)) if motion.name == "retreat" else execute(motion)
    )
    told = press(context, "start", "on", verify=lambda: ObjectState(name="start", state="on"))
    assert told.is_done
    assert [name for name in mover.asked if name in ("press", "let go", "retreat")][-2:] == ["let go", "retreat"]


def test_what_holds_the_arm_up_on_its_way_to_park_is_an_error_of_the_motion_and_no_defect() -> None:
    against = replace(COMPLETED, outcome=MotionOutcome.FAULT, cause="114 N against the arm")
    context, mover = before_the_bench({"to park": against})
    with pytest.raises(MotionError, match="to park: 114 N") as caught:
        park(replace(context, park_rad=HOME + 0.05))
    assert mover.asked[-1] == "to park" and "in the way" in caught.value.hint


def _turned(name: str, target: str, now: ObjectState, seen: ObjectState) -> Outcome:
    """The hand finds nothing between its fingers, so only the reading decides."""
    context, _ = before_the_bench({})
    return operate(context, context.panel.object(name), target, current=now, verify=lambda: seen).outcome


@pytest.mark.parametrize(("off_deg", "outcome"), [(5.0, Outcome.DONE), (40.0, Outcome.MISSED)])
@pytest.mark.parametrize("name", ["mode", "main_valve"])
def test_an_angle_that_was_seen_is_a_state_only_near_it(name: str, off_deg: float, outcome: Outcome) -> None:
    first, last = PANEL.object(name).states[0], PANEL.object(name).states[-1]
    now = ObjectState(name=name, angle_rad=first.angle_rad)
    seen = ObjectState(name=name, angle_rad=last.angle_rad - np.radians(off_deg))
    assert _turned(name, last.name, now, seen) is outcome


@pytest.mark.parametrize("seen", [5, 10])
def test_a_distance_is_the_middle_of_what_was_seen(seen: int) -> None:
    context, mover = before_the_bench({})
    mover.distances_m = [0.05 + 0.001 * (k % 3) for k in range(seen)] + [np.nan] * (10 - seen)
    (point,) = proximity_probe(context, (0.0, 0.06, 0.0), flange_from_sensors=[GRIP], sigma_m=0.002)
    assert (point.distance_m, point.samples) == (pytest.approx(0.051), seen)
    assert point.sigma_m == pytest.approx(0.002 * max(1 / 3, seen**-0.5))


def test_a_distance_that_few_samples_saw_is_none() -> None:
    context, mover = before_the_bench({})
    mover.distances_m = [0.05] * 4 + [np.nan] * 6
    with pytest.raises(SkillFailure, match="no proximity sensor"):
        proximity_probe(context, (0.0, 0.06, 0.0), flange_from_sensors=[GRIP])
