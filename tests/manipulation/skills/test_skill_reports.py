"""Tests of the reports of complete skills, with a mover that answers each motion as configured."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

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
from hal.panel import Scale, load_panel
from manipulation.arm.kinematics import Kinematics
from manipulation.control.setpoint import is_retreat
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.skills.attempt import Attempt
from manipulation.skills.context import SkillContext
from manipulation.skills.operate import operate
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure
from manipulation.skills.probe import proximity_probe
from manipulation.skills.retreat import PULLS, park, retreat, step_back
from manipulation.skills.slider import Felt, between_witnesses
from manipulation.skills.toggle import toggle
from tests.manipulation.arms import T3
from tests.manipulation.rig import HOME
from tests.manipulation.skills.test_contact import COMPLETED, GRIP, ScriptedMover

PANEL = load_panel(Path(__file__).parents[3] / "panels" / "bench.toml")


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


FAR = transform_rpy((9.0, 9.0, 9.0), (0.0, 0.0, 0.0))


def swept(force_n: float, to: RigidTransform = FAR) -> MotionReport:
    """Return the report of a sweep over a toggle's pivot, in the last third of which a force acts."""
    wrench = np.zeros((30, 6))
    wrench[20:, 1] = force_n
    log = MotionLog(times_s=np.arange(30.0), positions_rad=np.zeros((30, 6)), wrench=wrench, tip_m=np.zeros((30, 3)))
    return replace(COMPLETED, log=log, base_from_tool=to)


@pytest.mark.parametrize(
    ("felt_n", "looks", "outcome", "sweeps"),
    [
        (12.0, ["on"], "done", 1),  # also if it was seen there already: two looks may be wrong in the same way
        (12.0, ["off", "on"], "done", 2),
        (12.0, [None], "unverified", 1),
        (0.5, ["on", "on", "on"], "missed", 3),  # no bat was met, so the look would be the only witness
        (0.5, ["off", "off", "off"], "missed", 3),
    ],
)
def test_a_toggle_is_done_only_if_the_bat_is_felt_and_seen(
    felt_n: float, looks: list[str | None], outcome: str, sweeps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    context, mover = before_the_bench({"sweep": swept(felt_n)})
    monkeypatch.setattr("manipulation.skills.repeat.retreat", lambda *_: None)
    shown = iter(looks)

    def look() -> ObjectState | None:
        state = next(shown)
        return None if state is None else ObjectState(name="pump", state=state)

    told = toggle(
        context, context.panel.object("pump"), "on", current=ObjectState(name="pump", state="on"), verify=look
    )
    assert next(shown, "no more") == "no more"
    assert (told.outcome, mover.asked.count("to pump")) == (outcome, sweeps)


def test_a_look_does_not_outweigh_a_bat_that_was_felt_to_stay() -> None:
    """In drill 118 a cable was read as the bat: 21 N ended the sweep before the pivot, and the look showed `on`."""
    context, _ = before_the_bench({"sweep": swept(22.0, COMPLETED.base_from_tool)})
    seen = ObjectState(name="pump", state="on")
    told = toggle(context, context.panel.object("pump"), "on", verify=lambda: seen)
    assert told.outcome is Outcome.STIFF and "did not give way" in told.cause


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


@pytest.mark.parametrize("pressed_n", [0.0, 30.0])
def test_no_motion_of_a_retreat_or_of_parking_needs_more_than_the_arm(pressed_n: float) -> None:
    held = replace(COMPLETED, outcome=MotionOutcome.GUARD, tripped="held")
    context, mover = before_the_bench({"retreat": held})
    state = replace(mover.state(), wrench=np.array([pressed_n, 0.0, 0.0, 0.0, 0.0, 0.0]))
    mover.state = lambda: state  # type: ignore[method-assign]
    with pytest.raises(MotionError):
        retreat(context)
    assert {"retreat", "relax", "let go"} | ({"give way"} if pressed_n else set()) == set(mover.asked)
    way = np.linspace(HOME, HOME + 0.1, 20)
    step_back(context, replace(held, position_rad=way[-1], log=replace(held.log, positions_rad=way)))
    free, parking = before_the_bench({})
    park(free)
    assert mover.asked[-1] == "step back" and parking.asked == ["to park"]
    assert all(is_retreat(motion) for motion in (*mover.motions, *parking.motions))


def test_what_holds_the_arm_up_on_its_way_to_park_is_an_error_of_the_motion_and_no_defect() -> None:
    against = replace(COMPLETED, outcome=MotionOutcome.FAULT, cause="114 N against the arm")
    context, mover = before_the_bench({"to park": against})
    with pytest.raises(MotionError, match="to park: 114 N") as caught:
        park(replace(context, park_rad=HOME + 0.05))
    assert mover.asked[-1] == "to park" and "in the way" in caught.value.hint


@pytest.mark.parametrize(("off_deg", "outcome"), [(5.0, Outcome.DONE), (40.0, Outcome.SLIPPED)])
@pytest.mark.parametrize(("name", "stroke"), [("mode", "rotary.turn_bar"), ("main_valve", "lever._turn_lever")])
def test_an_angle_that_was_seen_is_a_state_only_near_it(
    name: str, stroke: str, off_deg: float, outcome: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, last = PANEL.object(name).states[0], PANEL.object(name).states[-1]
    monkeypatch.setattr(f"manipulation.skills.{stroke}", lambda *_, **__: 0.0)
    now = ObjectState(name=name, angle_rad=first.angle_rad)
    seen = ObjectState(name=name, angle_rad=last.angle_rad - np.radians(off_deg))
    context, _ = before_the_bench({})
    told = operate(context, context.panel.object(name), last.name, current=now, verify=lambda: seen)
    assert told.outcome is outcome


def test_a_look_at_what_the_hand_has_missed_proves_nothing() -> None:
    """The hand finds nothing between its fingers, so the look would be the only witness."""
    context, _ = before_the_bench({})
    last = PANEL.object("mode").states[-1]
    now, seen = (ObjectState(name="mode", angle_rad=angle) for angle in (-0.7854, last.angle_rad))
    told = operate(context, context.panel.object("mode"), last.name, current=now, verify=lambda: seen)
    assert (told.outcome, told.attempts) == (Outcome.MISSED, 3)


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


def test_a_slider_is_done_only_where_look_and_push_agree() -> None:
    """A look that was 3 mm off said `done` of a slider that stood 2.4 % beside its goal."""
    scale = Scale(minimum=0.0, maximum=100.0, unit="%", at_min=-0.05, at_max=0.05)
    seen, unseen = ObjectState(name="setpoint", value=70.0, sigma=0.3), ObjectState(name="setpoint")
    assert between_witnesses(scale, seen, Felt(value=69.5, sigma=0.4)) == ""
    disagreed = between_witnesses(scale, seen, Felt(value=66.5, sigma=0.4))
    assert "the push was felt to end at 66.5, 3.5 mm apart" in disagreed
    assert between_witnesses(scale, seen, None)
    assert between_witnesses(scale, unseen, Felt(value=70.0, sigma=0.4))
