"""Turns a handwheel by pushing two spokes, or by holding the rim beside a spoke, as often as the angle needs it."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.errors import InvalidRequest, Unreachable
from hal.motion import CartesianPath, Compliance
from hal.panel import Handwheel
from manipulation.planning.hand import Hand
from manipulation.skills.attempt import STANDOFF_M, Attempt
from manipulation.skills.contact import centre_between
from manipulation.skills.context import SkillContext, panel_from_grip
from manipulation.skills.crank import SpokeHold, spoke_holds
from manipulation.skills.initial_state import InitialState
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify, surely_within
from manipulation.skills.repeat import perform
from manipulation.skills.wheel_turn import LAG_RAD, WheelTurn

TIP_DEPTH_M = 0.014  # depth of the tips below the middle of the spokes
RIM_DEPTH_M = 0.008  # the same below the middle of the rim
HOLDS_RAD = (
    4.2,
    2.6,
    1.3,
)  # largest turns of one hold that are tried, in this order; the arm's wrist allows one of them
RIM_HOLDS_RAD = (1.7, 0.9)
INF = float("inf")
PUSH_N = 50.0  # of one finger on a spoke; the soft pads of the bench slip past it at 58 N
SIDE_N = 65.0  # of the hand on the rim; a heavier wheel would load the arm with more than 100 N
RIM_SIDE_M = 0.009  # largest free space between each finger and the rim when approaching
SPARE_M = 0.001
SPOKE_GAP_M = 0.0025  # between the inner finger and the spoke beside which it holds the rim
FRICTION = 0.5  # of the pads on paint; where they slip, the spoke takes over
GRIP_N = (12.0, 30.0)  # smallest and largest force of the pads; with 45 N friction along the fingers reached 70 N
LIGHT_N, SETTLE_S, SETTLES = 8.0, 0.4, 6
SETTLED_RATIO = 2.0  # of the rim's radius: the opening at which both pads press
# Pads that press lightly centre the hand on the rim before they press firmly: both pads move by one screw, so a rim that is
# off their middle by 2 mm would push the arm aside with all of the grip force.
SIDEWAYS = Compliance(
    stiffness=(0.0, INF, INF, INF, INF, INF), damping=(600.0,) * 3 + (10.0,) * 3, mass=(60.0,) * 3 + (1.0,) * 3,
    max_offset_m=0.006,
)  # fmt: skip
TOLERANCE_RAD = np.radians(6.0)
AT_STOP_RAD = 0.35
SAME_RAD = 0.6  # a look that differs by more from where the wheel was left shows that somebody else has turned it
TURN_RAD = 2.0 * np.pi


@dataclass(slots=True, kw_only=True)
class _Belief:
    """What is believed of the wheel's effort: the panel file's, then the felt one."""

    effort_nm: float


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
    belief = _Belief(effort_nm=wheel.torque_nm)

    def stroke(attempt: Attempt) -> float:
        try:
            while abs(target_rad - where.known) > 0.3 * TOLERANCE_RAD:
                _turn_once(attempt, wheel, where, belief, target_rad - where.known)
        except SkillFailure as failure:
            failure.reached = where.known  # the whole turns so far must not be lost
            raise
        except Unreachable as failure:
            raise SkillFailure(Outcome.UNREACHABLE, f"{failure.what}; {failure.hint}", reached=where.known) from failure
        return where.known

    return perform(
        context,
        stroke,
        skill="handwheel",
        object_name=name,
        target=f"{target_rad:.3f} rad",
        is_reached=lambda seen: surely_within(where.known, target_rad, TOLERANCE_RAD, sigma=seen.sigma),
        verify=where.verify,
    )


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


def _turn_once(attempt: Attempt, wheel: Handwheel, where: InitialState, belief: _Belief, span_rad: float) -> None:
    """Turn the wheel in one hold as far as the arm can, and leave.

    Raises:
        SkillFailure: a finger landed on the wheel, it did not give way, it met an end stop, or the fingers slipped.
        Unreachable: the arm cannot turn its hand about this hub.
    """
    holds = spoke_holds(wheel, attempt.context.hand, where.known, float(np.sign(span_rad)))
    turn, part_rad = (
        _behind_spokes(attempt, wheel, holds, span_rad) if holds else _at_the_rim(attempt, wheel, where.known, span_rad, belief)
    )  # fmt: skip
    angle_rad, sign = where.known, float(np.sign(span_rad))
    try:
        turn.turn(part_rad)
        where.moved_to(angle_rad + sign * turn.moved_rad)
        belief.effort_nm = turn.felt_nm
    except SkillFailure as failure:
        where.moved_to(at_a_stop(wheel, angle_rad + sign * turn.moved_rad, sign, failure.outcome))
        belief.effort_nm = turn.felt_nm
        raise
    finally:
        turn.let_go()


def _behind_spokes(
    attempt: Attempt, wheel: Handwheel, holds: tuple[SpokeHold, ...], span_rad: float
) -> tuple[WheelTurn, float]:
    """Bring the fingers behind two spokes; returns the hold and the part of the turn that it allows."""
    sign = float(np.sign(span_rad))
    low = wheel.height_m - wheel.rim_m - TIP_DEPTH_M

    def way(hold: SpokeHold, part: float, flip: int) -> list[RigidTransform]:
        end = sign * (hold.behind_rad + LAG_RAD + part)
        above = hold.grip(wheel, 0.0, wheel.height_m + STANDOFF_M, flip=bool(flip))
        return [above, *(hold.grip(wheel, a, low, flip=bool(flip)) for a in _steps(end))]

    width = holds[0].opening_m(attempt.context.hand)
    index, part = _begin(
        attempt, wheel, span_rad, HOLDS_RAD, width,
        lambda part: [way(hold, part, flip) for hold in holds for flip in (0, 1)],
    )  # fmt: skip
    _come_down(attempt, wheel, TIP_DEPTH_M)
    hold = holds[index // 2]
    turn = WheelTurn(
        attempt=attempt, wheel=wheel, sign=sign, behind_rad=hold.behind_rad, most_nm=2.0 * PUSH_N * hold.arm_m,
        up_m=STANDOFF_M + wheel.rim_m + TIP_DEPTH_M,
    )  # fmt: skip
    return turn, part


def _at_the_rim(
    attempt: Attempt, wheel: Handwheel, angle_rad: float, span_rad: float, belief: _Belief
) -> tuple[WheelTurn, float]:
    """Hold the rim between the fingers, the inner one just behind a spoke, which takes over where the pads slip."""
    hand, sign = attempt.context.hand, float(np.sign(span_rad))
    side = free_side_m(wheel, hand)
    inner = wheel.radius_m - wheel.rim_m - side - hand.finger_thickness_m / 2
    behind = float(np.arcsin(min(1.0, (hand.finger_width_m / 2 + wheel.spoke_m + SPOKE_GAP_M) / inner)))
    places = [angle_rad + 2.0 * np.pi * k / wheel.spokes - sign * behind for k in range(wheel.spokes)]
    low, top = wheel.height_m - wheel.rim_m - RIM_DEPTH_M, wheel.height_m + STANDOFF_M

    def at(angle: float, z: float, flip: int) -> RigidTransform:
        x, y = wheel.position_m
        point = (x + wheel.radius_m * np.sin(angle), y + wheel.radius_m * np.cos(angle), z)
        return panel_from_grip(
            point, np.pi / 2 - angle + np.pi * flip
        )  # the radius is at pi/2 - angle from the panel's x

    def ways(part: float) -> list[list[RigidTransform]]:
        steps = _steps(sign * (part + 0.3))
        return [
            [at(place, top, flip), *(at(place + a, low, flip) for a in steps)]
            for place, flip in itertools.product(places, (0, 1))
        ]

    width = 2.0 * (wheel.rim_m + side)
    _, part = _begin(attempt, wheel, span_rad, RIM_HOLDS_RAD, width, ways)
    _come_down(attempt, wheel, RIM_DEPTH_M)
    centre_between(attempt, room_m=2.0 * side, what="rim")
    grip_n = float(np.clip(belief.effort_nm / (2.0 * FRICTION * wheel.radius_m), *GRIP_N))
    _settle_on(attempt, wheel)
    left = attempt.grasp(grip_n, name="hold the rim")
    if left < 0.4 * wheel.rim_m:
        raise SkillFailure(Outcome.MISSED, f"the fingers closed to {1e3 * left:.1f} mm; no rim between them")
    turn = WheelTurn(
        attempt=attempt, wheel=wheel, sign=sign, behind_rad=0.0, most_nm=SIDE_N * wheel.radius_m,
        up_m=STANDOFF_M + wheel.rim_m + RIM_DEPTH_M, open_m=width,
    )  # fmt: skip
    return turn, part


def _settle_on(attempt: Attempt, wheel: Handwheel) -> None:
    """Close lightly and let the hand yield sideways, until both pads are at the rim."""
    for _ in range(SETTLES):
        if attempt.grasp(LIGHT_N, name="touch the rim") < SETTLED_RATIO * wheel.rim_m:
            return
        here = attempt.pose()
        settle = CartesianPath(
            name="settle on the rim", flange_from_tool=attempt.context.flange_from_grip,
            times_s=np.array([0.0, SETTLE_S]), base_from_tool=(here, here), compliance=SIDEWAYS,
        )  # fmt: skip
        attempt.run(settle)


def free_side_m(wheel: Handwheel, hand: Hand) -> float:
    """Return the free space on each side of the rim with which the rim is met before the hub.

    Moving inwards, the outer finger meets the rim at radius R - side, the inner one the hub at hub + finger + rim +
    side.
    """
    most = 0.5 * (wheel.radius_m - wheel.rim_m - wheel.hub_m - hand.finger_thickness_m - SPARE_M)
    return float(np.clip(most, 0.003, RIM_SIDE_M))


def _begin(
    attempt: Attempt,
    wheel: Handwheel,
    span_rad: float,
    longest_rad: tuple[float, ...],
    width_m: float,
    ways: Callable[[float], list[list[RigidTransform]]],
) -> tuple[int, float]:
    """Go to the standoff of the way that allows the largest part of the turn; returns its index and that part."""
    parts = sorted({min(abs(span_rad), longest) for longest in longest_rad}, reverse=True)
    for part in parts:
        try:
            return attempt.begin(ways(part), may_touch=(wheel.name,), width_m=width_m, name=wheel.name), part
        except Unreachable:
            if part == parts[-1]:
                raise
    raise AssertionError("there is a longest hold")


def _come_down(attempt: Attempt, wheel: Handwheel, depth_m: float) -> None:
    down = attempt.advance(STANDOFF_M + wheel.rim_m + depth_m, name="approach")
    if down.tripped is not None:
        raise SkillFailure(Outcome.MISSED, "a finger landed on the wheel")


def _steps(end_rad: float) -> list[float]:
    return [float(a) for a in np.linspace(0.0, end_rad, max(6, int(abs(end_rad) / 0.15)))]


def at_a_stop(wheel: Handwheel, angle_rad: float, sign: float, outcome: Outcome) -> float:
    """Return the angle of a wheel that stopped turning, with its whole turns corrected if it can only be an end stop.

    A wheel that stops at the angle of its end stop, but whole turns before it, was not in the turn that was assumed.
    """
    stop = wheel.maximum_rad if sign > 0 else wheel.minimum_rad
    turns = round((stop - angle_rad) / TURN_RAD)
    if outcome is Outcome.STALLED and turns != 0 and abs(stop - angle_rad - turns * TURN_RAD) < AT_STOP_RAD:
        return angle_rad + turns * TURN_RAD
    return angle_rad
