"""Tests of what skills conclude from a motion: outcomes, contact points, and repetitions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hal.errors import Cancelled, DeviceFault, InvalidRequest, Stopped, Unsupported
from hal.geometry import certain, transform_rpy
from hal.motion import DeclaredMotion, Hold, MotionLog, MotionOutcome, MotionReport, Quantity, RobotState
from hal.panel import Lamp, Shown
from manipulation.arm.kinematics import Kinematics
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.skills.attempt import Attempt
from manipulation.skills.contact import onset, step
from manipulation.skills.context import SkillContext
from manipulation.skills.operate import operate
from manipulation.skills.outcome import (
    ObjectState,
    Outcome,
    SkillFailure,
    doubt_within,
    mean_of,
    surely_within,
    wrapped,
)
from manipulation.skills.probe import contact_of
from manipulation.skills.repeat import perform
from manipulation.skills.retreat import retreat
from manipulation.skills.rotary import _turn
from tests.manipulation.arms import T3
from tests.manipulation.planning.test_collision import make_panel
from tests.manipulation.rig import HOME

GRIP = transform_rpy((0.0, 0.0, 0.21), (0.0, 0.0, 0.0))
AT_HOME = Kinematics.of(T3).tool(HOME, GRIP)


def report(
    outcome: MotionOutcome, *, cause: str = "", tripped: str | None = None, device: str | None = None
) -> MotionReport:
    log = MotionLog(
        times_s=np.empty(0), positions_rad=np.empty((0, 6)), wrench=np.empty((0, 6)), tip_m=np.empty((0, 3))
    )
    return MotionReport(
        name="m", outcome=outcome, tripped=tripped, cause=cause, started_s=0.0, ended_s=0.1, position_rad=HOME,
        base_from_tool=AT_HOME, wrench=np.zeros(6), peak_force_n=3.0, gripper_width_m=0.04, log=log, device=device,
    )  # fmt: skip


class ScriptedMover:
    """Mover that answers every motion with the same report and counts them."""

    def __init__(self, answer: MotionReport) -> None:
        self.answer = answer
        self.asked: list[str] = []

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        self.asked.append(motion.name)
        return self.answer

    def cancel(self) -> None:
        return None

    def tare(self) -> np.ndarray:
        return np.zeros(6)

    def state(self) -> RobotState:
        return RobotState(
            stamp_s=0.0, position_rad=HOME, velocity_rad_per_s=np.zeros(6),
            base_from_flange=Kinematics.of(T3).flange(HOME), wrench=np.zeros(6), contacts=(), proximity_m=(),
            gripper_width_m=0.04, is_moving=False, is_stopped=False,
        )  # fmt: skip


def context(answer: MotionReport) -> SkillContext:
    return SkillContext(
        mover=ScriptedMover(answer),
        kinematics=Kinematics.of(T3),
        panel=make_panel(),
        base_from_panel=certain(transform_rpy((0.75, 0.0, 0.6), (np.pi / 2, 0.0, -np.pi / 2))),
        flange_from_grip=GRIP,
        limits=SpeedLimits(tip_m_per_s=0.25),
        park_rad=HOME,
    )


def deed(work: SkillContext, stroke, looks: list[ObjectState | None] | None):
    answers = iter(looks or [])
    return perform(
        work,
        stroke,
        skill="s",
        object_name="o",
        target="on",
        is_reached=lambda seen: seen.state == "on",
        verify=None if looks is None else lambda: next(answers),
    )


ON, OFF = ObjectState(name="o", state="on"), ObjectState(name="o", state="off")
COMPLETED = report(MotionOutcome.COMPLETED)


def test_nothing_is_done_without_a_look() -> None:
    result = deed(context(COMPLETED), lambda attempt: 1.0, None)
    assert result.outcome is Outcome.UNVERIFIED and not result.is_done and result.attempts == 1


def test_a_look_that_cannot_tell_leaves_it_unverified() -> None:
    assert deed(context(COMPLETED), lambda attempt: 1.0, [None]).outcome is Outcome.UNVERIFIED


def test_a_look_that_confirms_makes_it_done() -> None:
    result = deed(context(COMPLETED), lambda attempt: 1.0, [ON])
    assert result.is_done and result.reached == 1.0 and result.seen == ON


def test_a_look_that_denies_leads_to_another_try_and_at_most_three() -> None:
    assert deed(context(COMPLETED), lambda attempt: 1.0, [OFF, ON]).attempts == 2
    failed = deed(context(COMPLETED), lambda attempt: 1.0, [OFF, OFF, OFF])
    assert failed.outcome is Outcome.SLIPPED and failed.attempts == 3


def test_transfers_after_a_stroke_avoid_every_place_where_the_part_may_stand_now() -> None:
    known = []

    def stroke(attempt: Attempt) -> float:
        known.append(set(attempt.context.shown))
        return 1.0

    work = replace(context(COMPLETED), shown={"o": Shown(state="off"), "p": Shown(state="off")})
    assert deed(work, stroke, [OFF, ON]).is_done
    assert known == [{"o", "p"}, {"p"}]


def test_a_look_that_may_err_confirms_only_what_it_would_confirm_two_sigmas_off() -> None:
    assert surely_within(71.2, 70.0, 2.0, sigma=0.3)
    assert not surely_within(71.9, 70.0, 2.0, sigma=0.3)
    assert surely_within(71.9, 70.0, 2.0, sigma=0.0)
    assert not surely_within(None, 70.0, 2.0, sigma=0.0)


@pytest.mark.parametrize(
    ("value", "sigma", "outcome", "said"),
    [
        (71.0, 0.1, Outcome.DONE, "confirms"),
        (71.5, 0.6, Outcome.UNVERIFIED, "a look that shows 71.5 and is sure to 1.2 does not tell"),
        (72.5, 0.6, Outcome.UNVERIFIED, "a look that shows 72.5 and is sure to 1.2 does not tell"),
        (74.0, 0.6, Outcome.SLIPPED, "does not show the target"),
        (None, 0.0, Outcome.UNVERIFIED, "the look shows no value"),
    ],
)
def test_a_look_that_is_merely_unsure_is_not_said_to_deny_the_target(
    value: float | None, sigma: float, outcome: Outcome, said: str
) -> None:
    result = perform(
        context(COMPLETED), lambda attempt: 1.0, skill="s", object_name="o", target="70",
        is_reached=lambda seen: surely_within(seen.value, 70.0, 2.0, sigma=seen.sigma),
        doubt=lambda seen: doubt_within(seen.value, 70.0, 2.0, sigma=seen.sigma),
        verify=lambda: ObjectState(name="o", value=value, sigma=sigma),
    )  # fmt: skip
    assert result.outcome is outcome and said in result.cause


@pytest.mark.parametrize(
    ("second", "outcome", "said"),
    [
        (70.3, Outcome.DONE, "confirms"),  # the mean is 70.7
        (71.3, Outcome.UNVERIFIED, "a look that shows 71.2 and is sure to 1.2 does not tell"),
        (None, Outcome.UNVERIFIED, "a look that shows 71.1 and is sure to 1.2 does not tell"),
    ],
)
def test_the_mean_of_two_looks_decides_where_the_first_one_leaves_a_doubt(
    second: float | None, outcome: Outcome, said: str
) -> None:
    looks = iter(None if value is None else ObjectState(name="o", value=value, sigma=0.6) for value in (71.1, second))
    result = perform(
        context(COMPLETED), lambda attempt: 1.0, skill="s", object_name="o", target="70",
        is_reached=lambda seen: surely_within(seen.value, 70.0, 2.0, sigma=seen.sigma),
        doubt=lambda seen: doubt_within(seen.value, 70.0, 2.0, sigma=seen.sigma),
        verify=lambda: next(looks), repeats=lambda: False,
    )  # fmt: skip
    assert result.outcome is outcome and said in result.cause


def test_the_mean_of_two_looks_goes_the_short_way_round_and_is_no_surer_than_either() -> None:
    first = ObjectState(name="o", angle_rad=np.pi - 0.1, sigma=0.02)
    second = ObjectState(name="o", angle_rad=-np.pi + 0.3, sigma=0.01)
    both = mean_of(first, second)
    assert wrapped(both.angle_rad - (-np.pi + 0.1)) == pytest.approx(0.0) and both.sigma == 0.02
    assert mean_of(ON, OFF) == OFF


@given(truth=st.floats(60.0, 80.0), error=st.floats(-2.0, 2.0), sigma=st.floats(0.0, 0.9))
def test_nothing_outside_the_tolerance_is_confirmed_by_an_error_of_two_sigmas(
    truth: float, error: float, sigma: float
) -> None:
    if surely_within(truth + error * sigma, 70.0, 2.0, sigma=sigma):
        assert abs(truth - 70.0) <= 2.0 + 1e-9


def test_a_second_press_never_undoes_the_first() -> None:
    looks = iter([OFF, OFF, OFF])
    result = perform(
        context(COMPLETED), lambda attempt: 1.0, skill="s", object_name="o", target="on", repeats=lambda: False,
        is_reached=lambda seen: seen.state == "on", verify=lambda: next(looks),
    )  # fmt: skip
    assert result.outcome is Outcome.SLIPPED and result.attempts == 1


def test_a_failure_retreats_and_keeps_its_name_when_the_look_agrees() -> None:
    work = context(COMPLETED)

    def miss(attempt: Attempt) -> float:
        raise SkillFailure(Outcome.MISSED, "not there")

    result = deed(work, miss, [OFF, OFF, OFF])
    assert result.outcome is Outcome.MISSED and result.attempts == 3
    assert work.mover.asked.count("retreat") == 3


def test_the_hand_does_not_go_again_to_where_a_moved_panel_was() -> None:
    """Drills 20811 and 20823: a look showed that the door had swung, and two more tries met it with 144 and 160 N."""

    def miss(attempt: Attempt) -> float:
        raise SkillFailure(Outcome.MISSED, "not there")

    result = deed(replace(context(COMPLETED), is_in_place=lambda: False), miss, [None, None, None])
    assert result.outcome is Outcome.MISSED and result.attempts == 1


def test_a_turn_of_a_selector_ends_by_its_torque_in_either_direction() -> None:
    """Drill 20608: fingers that turned on about a blocked bar rolled off it, and were wedged with 182 N."""
    work, turns = context(COMPLETED), []
    work.mover.execute = lambda motion: turns.append(motion) or COMPLETED  # type: ignore[method-assign]
    _turn(Attempt(work), AT_HOME, 0.5)
    axes = {guard.axis for guard in turns[0].guards if guard.quantity is Quantity.TORQUE and guard.limit < 0.8}
    assert axes == {(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)}


@pytest.mark.parametrize(
    ("force_n", "first"), [((3.0, 4.0, -40.0), "retreat"), ((30.0, 0.0, -40.0), "give way"), ((0, 0, 40.0), "give way")]
)
def test_a_hand_that_is_pushed_back_goes_back_at_once(force_n: tuple[float, float, float], first: str) -> None:
    """Drill 20763: a door swung towards the hand, which gave way across its fingers only, up to 111 N."""
    work = context(COMPLETED)
    pressed = replace(work.mover.state(), wrench=np.array([*force_n, 0.0, 0.0, 0.0]))
    work.mover.state = lambda: pressed  # type: ignore[method-assign]
    retreat(work)
    assert work.mover.asked[0] == first


def test_a_failed_stroke_that_did_the_deed_is_done() -> None:
    def stall(attempt: Attempt) -> float:
        raise SkillFailure(Outcome.STALLED, "stopped early", reached=0.5)

    assert deed(context(COMPLETED), stall, [ON]).is_done


def test_a_stiff_object_is_not_forced_again() -> None:
    def stiff(attempt: Attempt) -> float:
        raise SkillFailure(Outcome.STIFF, "would not move")

    result = deed(context(COMPLETED), stiff, [OFF, OFF])
    assert result.outcome is Outcome.STIFF and result.attempts == 1


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (report(MotionOutcome.STOPPED), Stopped),
        (report(MotionOutcome.CANCELLED), Cancelled),
        (report(MotionOutcome.FAULT, cause="wrist_ft silent", device="wrist_ft"), DeviceFault),
        (report(MotionOutcome.FAULT, tripped="force_limit"), SkillFailure),
    ],
    ids=["stopped", "cancelled", "device", "force"],
)
def test_what_ends_a_motion_decides_what_is_raised(answer: MotionReport, error: type[Exception]) -> None:
    with pytest.raises(error) as caught:
        Attempt(context(answer)).run(Hold(name="h", duration_s=0.1))
    if error is DeviceFault:
        assert caught.value.details["device"] == "wrist_ft"
    if error is SkillFailure:
        assert caught.value.outcome is Outcome.FORCE_LIMIT


def test_a_deed_without_knowledge_of_the_object_is_refused_before_anything_moves() -> None:
    work = context(COMPLETED)
    with pytest.raises(InvalidRequest, match="not known"):
        operate(work, work.panel.object("valve"), "closed")
    with pytest.raises(InvalidRequest, match="not known"):
        operate(work, work.panel.object("fader"), 0.5)
    with pytest.raises(InvalidRequest, match="no state"):
        operate(work, work.panel.object("valve"), "ajar")
    with pytest.raises(InvalidRequest, match="off the scale"):
        operate(work, work.panel.object("fader"), 7.0)
    with pytest.raises(Unsupported, match="no skill"):
        operate(work, Lamp(name="lit", position_m=(0.0, 0.0), radius_m=0.01), "on")
    assert work.mover.asked == []


@given(surface=st.floats(0.002, 0.01), stiffness=st.floats(2000.0, 40000.0), seed=st.integers(0, 2**31))
@settings(max_examples=50, deadline=None)
def test_the_onset_of_a_contact_is_found_behind_noise_and_give(surface: float, stiffness: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = np.arange(0.0, surface + 6.0 / stiffness, 0.0001)
    force = np.maximum(0.0, stiffness * (depth - surface)) + rng.normal(0.0, 0.1, len(depth))
    found, _ = onset(depth, force, float(depth[-1]))
    assert found == pytest.approx(surface, abs=0.00025)


def test_inertia_at_the_start_is_not_taken_for_a_surface() -> None:
    depth = np.linspace(0.0, 0.01, 101)
    force = np.where(depth < 0.0005, 2.0, 0.0) + 5000.0 * np.maximum(0.0, depth - 0.009)
    assert onset(depth, force, 0.01)[0] == pytest.approx(0.009, abs=1e-4)


def test_an_onset_lies_between_the_start_of_the_move_and_the_first_force() -> None:
    depth = np.linspace(0.005, 0.01, 51)
    force = 2.0 + 100.0 * (depth - 0.005)  # so soft that the fitted line reaches zero before the start of the move
    assert onset(depth, force, 0.01)[0] == 0.005


def test_a_contact_begins_where_the_force_begins_and_not_where_a_spring_would_have_none() -> None:
    """A cap on a spring with a preload of 1.1 N and 1.2 kN/m resists at once; the line through its force is zero 0.9 mm before."""
    depth = np.linspace(0.0, 0.006, 51)
    force = np.where(depth > 0.005, 1.1 + 1200.0 * (depth - 0.005), 0.0)
    assert onset(depth, force, 0.006)[0] == pytest.approx(0.005, abs=4e-4)


def test_no_force_at_all_answers_with_the_deepest_place() -> None:
    assert onset(np.linspace(0, 0.01, 50), np.zeros(50), 0.01) == (0.01, 0.0)


def test_a_touch_point_is_known_along_the_fingers_and_spread_across_them() -> None:
    axis = AT_HOME.rotation.apply([0.0, 0.0, 1.0])
    depth = np.linspace(-0.01, 0.001, 111)
    force = 5000.0 * np.maximum(0.0, depth)
    wrench = np.zeros((111, 6))
    wrench[:, 2] = -force
    log = MotionLog(
        times_s=np.arange(111) * 0.008,
        positions_rad=np.zeros((111, 6)),
        wrench=wrench,
        tip_m=AT_HOME.translation + (depth[:, None] - 0.001) * axis,
    )
    point = contact_of(replace(COMPLETED, log=log), finger_half_m=(0.007, 0.006))
    surface = AT_HOME.translation - 0.001 * axis
    assert np.linalg.norm(point.point_m - surface) < 1e-4
    assert point.normal @ axis == pytest.approx(-1.0)
    along = axis @ point.covariance @ axis
    across = AT_HOME.rotation.apply([1.0, 0.0, 0.0])
    assert np.sqrt(along) < 0.0005 < np.sqrt(across @ point.covariance @ across)


@given(angle=st.floats(-20.0, 20.0))
@example(angle=-np.pi)
@example(angle=np.pi)
def test_a_wrapped_angle_is_the_same_direction(angle: float) -> None:
    assert -np.pi < wrapped(angle) <= np.pi + 1e-12
    assert np.cos(wrapped(angle)) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped(angle)) == pytest.approx(np.sin(angle), abs=1e-9)


@pytest.mark.parametrize("noise_n", [0.0, 0.15, 0.3])
def test_a_light_contact_begins_where_the_mean_force_steps_up(noise_n: float) -> None:
    """A slider with a friction of 1.0 N never raises the force above the threshold of a contact."""
    depth = np.linspace(0.0, 0.012, 75)
    misses = []
    for seed in range(20):
        noise = noise_n * np.random.default_rng(seed).standard_normal(75)
        misses.append(step(depth, np.where(depth > 0.009, 1.0, 0.0) + noise) - 0.009)
    assert np.abs(misses).max() < 0.0009 and abs(float(np.median(misses))) < 0.0003
