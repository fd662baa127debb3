"""Turns a handwheel by pushing two spokes, or by holding the rim beside a spoke, as often as the angle needs it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hal.errors import InvalidRequest, Unreachable
from hal.panel import Handwheel
from manipulation.skills.attempt import Attempt
from manipulation.skills.context import SkillContext
from manipulation.skills.crank import SpokeHold, spoke_holds
from manipulation.skills.initial_state import InitialState
from manipulation.skills.outcome import (
    ObjectState,
    Outcome,
    SkillFailure,
    SkillReport,
    Verify,
    doubt_within,
    surely_within,
)
from manipulation.skills.repeat import perform
from manipulation.skills.wheel_belief import PUSH_N, Belief, Hold
from manipulation.skills.wheel_hold import behind_two_spokes, hold_across, hold_the_rim
from manipulation.skills.wheel_turn import WheelTurn

DRAGGED_RAD = 0.2  # largest turn by which a hand that lets go drags the wheel back
GAINED_RAD = 0.3  # a wheel that stopped after a turn of so much is turned on
SPARE_PUSH = 1.05  # of the torque behind spokes to the believed one; with more the fingers stand near the rim
LONGER_M = 1e-4
TOLERANCE_RAD = np.radians(6.0)
AT_STOP_RAD = 0.35
SAME_RAD = 0.6  # a look that differs by more from where the wheel was left shows that somebody else has turned it
TURN_RAD = 2.0 * np.pi
MOST_HOLDS = 30  # of one try


def handwheel(
    context: SkillContext,
    wheel: Handwheel,
    target_rad: float,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Turn the wheel until its marked spoke has come from the present angle to `target_rad` (clockwise from up).

    A turn of more than about 240 degrees takes several holds. A look shows the angle within one turn only, so the whole
    turns are tracked from what was done and felt. The mechanical estimate in the report is the angle reached.

    Args:
        current: what the last observation showed (angle, and whole turns if known); without it `verify` is asked.
        verify: the caller's read-back.

    Raises:
        InvalidRequest: the target is beyond the wheel's stops, or its present angle or whole turns are not known.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    name = wheel.name
    if not wheel.minimum_rad <= target_rad <= wheel.maximum_rad:
        raise InvalidRequest(
            f"{target_rad:.2f} rad is beyond the stops of {name}",
            hint=f"{wheel.minimum_rad:.2f} to {wheel.maximum_rad:.2f} rad",
        )
    seen = current if current is not None or verify is None else verify()
    if seen is not None:
        seen = replace(seen, angle_rad=believed_angle(wheel, seen))
    where = InitialState(
        lambda look: look.angle_rad, what=f"the angle of {name}", current=seen, verify=verify, period=TURN_RAD
    )
    belief = Belief(effort_nm=wheel.torque_nm)

    def stroke(attempt: Attempt) -> float:
        try:
            _turn_to(attempt, wheel, where, belief, target_rad)
        except SkillFailure as failure:
            failure.reached = where.known  # the whole turns so far must not be lost
            raise
        except Unreachable as failure:
            raise SkillFailure(Outcome.UNREACHABLE, f"{failure.what}; {failure.hint}", reached=where.known) from failure
        return where.known

    report = perform(
        context,
        stroke,
        skill="handwheel",
        object_name=name,
        target=f"{target_rad:.3f} rad",
        is_reached=lambda seen: (
            where.is_sure and surely_within(where.nearest(seen), target_rad, TOLERANCE_RAD, sigma=seen.sigma)
        ),
        doubt=lambda seen: _doubt(where, target_rad, seen),
        verify=where.verify,
    )
    return report if report.reached is None else replace(report, reached=where.known)


def _doubt(where: InitialState, target_rad: float, seen: ObjectState) -> str:
    if not where.is_sure:
        return "the look does not show which of its turns the wheel is in"
    return doubt_within(where.nearest(seen), target_rad, TOLERANCE_RAD, sigma=seen.sigma)


def believed_angle(wheel: Handwheel, seen: ObjectState) -> float | None:
    """Return the angle with its whole turns: those tracked so far, or those nearest to upright.

    Raises:
        InvalidRequest: the whole turns are unknown.
    """
    if seen.angle_rad is None:
        return None
    if seen.turned_rad is not None:
        near = seen.angle_rad + TURN_RAD * round((seen.turned_rad - seen.angle_rad) / TURN_RAD)
        if abs(near - seen.turned_rad) < SAME_RAD:
            return float(near)
    possible = [
        seen.angle_rad + TURN_RAD * k
        for k in range(-20, 21)
        if wheel.minimum_rad - SAME_RAD <= seen.angle_rad + TURN_RAD * k <= wheel.maximum_rad + SAME_RAD
    ]
    if not wheel.starts_upright and len(possible) > 1:
        raise InvalidRequest(
            f"the whole turns of {wheel.name} are not known: an image shows its angle within one turn only",
            hint="bring it within half a turn of 0 by hand and set starts_upright in the panel file",
        )
    return min(possible, key=abs, default=seen.angle_rad)


def _turn_to(attempt: Attempt, wheel: Handwheel, where: InitialState, belief: Belief, target_rad: float) -> None:
    """Turn the wheel in as many holds as it takes; what is still missing after `MOST_HOLDS` the read-back shows."""
    for _ in range(MOST_HOLDS):
        if abs(target_rad - where.known) <= 0.3 * TOLERANCE_RAD:
            return
        _turn_on(attempt, wheel, where, belief, target_rad)


def _turn_on(attempt: Attempt, wheel: Handwheel, where: InitialState, belief: Belief, target_rad: float) -> None:
    """Turn the wheel in one hold, and look how far it has come unless that was the last one.

    A wheel that a hold does not turn is tried in the next one, and one that stops on the way in another hold: friction
    between fingers and spokes grows while the hand does not turn about the true hub. What a look shows between two holds
    is one turn at most, so it counts the whole turns whatever the fingers felt.

    Raises:
        SkillFailure: as `_turn_once`; or the wheel has not followed the hand in any hold.
    """
    begun_rad, hand = where.known, attempt.context.hand
    belief.learn(begun_rad)
    belief.begin(begun_rad)
    hold = belief.next_hold(wheel, hand)
    if hold is None:
        raise _given_up(belief, begun_rad)
    try:
        span_rad = target_rad - begun_rad
        _turn_once(attempt, wheel, where, belief, hold, span_rad + np.sign(span_rad) * belief.lost_rad)
    except Unreachable as failure:
        belief.failed.add(hold)
        if belief.next_hold(wheel, hand) is None:
            raise
        belief.out_of_reach = f"{failure.what}, to hold it {hold}"
        return
    except SkillFailure as failure:
        if failure.outcome is Outcome.STALLED and where.verify is not None and where.verify() is not None:
            if abs(target_rad - begun_rad) - abs(target_rad - where.known) < GAINED_RAD:
                raise
            belief.failed.clear()
            return
        if failure.outcome not in (Outcome.STIFF, Outcome.SLIPPED):
            raise
        if where.verify is not None:
            where.verify()
        if belief.next_hold(wheel, hand) is None:
            raise _given_up(belief, where.known) from failure
        return
    if where.verify is None or abs(target_rad - where.known) <= 0.3 * TOLERANCE_RAD:
        return
    missing_rad = belief.learn(where.known) if where.verify() is not None else 0.0
    if missing_rad and belief.next_hold(wheel, hand) is None:
        raise _given_up(belief, where.known)


def _given_up(belief: Belief, seen_rad: float) -> SkillFailure:
    """Return the failure of a wheel that no hold turns (any more), with the largest torque that it was turned with."""
    names = ", ".join(sorted(belief.failed))
    if belief.has_moved(seen_rad):
        return SkillFailure(
            Outcome.SLIPPED, f"the wheel stopped following the hand at {belief.tried_nm:.1f} N m (holds: {names})"
        )
    if belief.has_slipped:
        what = f"the pads slipped at {belief.tried_nm:.1f} N m before the wheel gave way (holds: {names})"
        return SkillFailure(Outcome.SLIPPED, what)
    if belief.out_of_reach:
        what = f"{belief.out_of_reach}; the holds that are in reach turn it with {belief.tried_nm:.1f} N m, which is too little"
        return SkillFailure(Outcome.UNREACHABLE, what)
    return SkillFailure(Outcome.STIFF, f"it did not give way at {belief.tried_nm:.1f} N m (holds: {names})")


def _turn_once(
    attempt: Attempt, wheel: Handwheel, where: InitialState, belief: Belief, hold: Hold, span_rad: float
) -> None:
    """Turn the wheel in one hold as far as the arm can, and leave.

    Raises:
        SkillFailure: a finger landed on the wheel, it did not give way, it met an end stop, or the fingers slipped.
        Unreachable: the arm cannot turn its hand about this hub.
    """
    angle_rad, sign = where.known, float(np.sign(span_rad))
    try:
        match hold:
            case Hold.ACROSS:
                turn, part_rad = hold_across(attempt, wheel, angle_rad, span_rad)
            case Hold.SPOKES:
                holds = _spokes(attempt, wheel, belief, angle_rad, sign)
                turn, part_rad = behind_two_spokes(attempt, wheel, holds, span_rad)
            case Hold.RIM:
                turn, part_rad = hold_the_rim(attempt, wheel, angle_rad, span_rad, belief.effort_nm)
    except SkillFailure:
        belief.failed.add(hold)
        raise
    turn.free_rad, turn.ran_nm = free_turn_rad(wheel, where, sign), belief.ran_nm
    try:
        turn.turn(part_rad)
        _note(where, turn, sign, belief.lost_rad)
        belief.ran_at(turn.felt_nm)
        belief.turned(hold, angle_rad, where.known)
    except SkillFailure as failure:
        _note(where, turn, sign, belief.lost_rad)
        where.moved_to(at_a_stop(wheel, where.known, sign, failure.outcome))
        belief.felt(turn.felt_nm)
        belief.effort_nm = max(belief.effort_nm, turn.felt_nm)
        if failure.outcome is Outcome.SLIPPED:
            belief.slipped(hold)
        elif hold is not Hold.SPOKES or not _has_longer_arm(attempt, wheel, belief, holds[0].arm_m):
            belief.failed.add(hold)
        raise
    finally:
        turn.let_go()


def _spokes(attempt: Attempt, wheel: Handwheel, belief: Belief, angle_rad: float, sign: float) -> tuple[SpokeHold, ...]:
    """Return the holds behind two spokes, with an arm that is long enough for the believed torque if there is one."""
    enough_m = max(belief.least_arm_m, SPARE_PUSH * belief.effort_nm / (2.0 * PUSH_N))
    return spoke_holds(wheel, attempt.context.hand, angle_rad, sign, least_arm_m=enough_m)


def _has_longer_arm(attempt: Attempt, wheel: Handwheel, belief: Belief, arm_m: float) -> bool:
    """Note that pushing the spokes at `arm_m` from the hub did not do; returns whether the fingers can stand further."""
    belief.least_arm_m = arm_m + LONGER_M
    return _spokes(attempt, wheel, belief, 0.0, 1.0)[0].arm_m >= belief.least_arm_m


def _note(where: InitialState, turn: WheelTurn, sign: float, lost_rad: float) -> None:
    """Keep how far the wheel has turned, and that it cannot have turned further than the hand."""
    ends = (-sign * DRAGGED_RAD, sign * turn.hand_rad)
    where.moved_by(sign * max(0.0, turn.moved_rad - lost_rad), least=min(ends), largest=max(ends))


def free_turn_rad(wheel: Handwheel, where: InitialState, sign: float) -> float:
    """Return how far the wheel can surely turn before it meets an end stop; 0 where its whole turns are not known."""
    if not where.is_sure:
        return 0.0
    stop = wheel.maximum_rad if sign > 0 else wheel.minimum_rad
    return max(0.0, abs(stop - where.known) - AT_STOP_RAD)


def at_a_stop(wheel: Handwheel, angle_rad: float, sign: float, outcome: Outcome) -> float:
    """Return the angle of a wheel that stopped turning, with its whole turns corrected if it can only be an end stop.

    A wheel that stops at the angle of its end stop, but whole turns before it, was not in the turn that was assumed.
    """
    if wheel.starts_upright:  # the whole turns are known, so something else has stopped it
        return angle_rad
    stop = wheel.maximum_rad if sign > 0 else wheel.minimum_rad
    turns = round((stop - angle_rad) / TURN_RAD)
    if outcome is Outcome.STALLED and turns != 0 and abs(stop - angle_rad - turns * TURN_RAD) < AT_STOP_RAD:
        return angle_rad + turns * TURN_RAD
    return angle_rad
