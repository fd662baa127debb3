"""Turns a rotary selector: holds its bar lightly and turns about the knob's axis."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.motion import Compliance, Guard, MotionReport, Quantity
from hal.panel import Rotary
from hal.panel.knob import Knob
from manipulation.planning.cartesian_path import arc
from manipulation.skills.attempt import STANDOFF_M, Attempt
from manipulation.skills.contact import centre_between
from manipulation.skills.context import SkillContext, panel_from_grip
from manipulation.skills.initial_state import InitialState
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify
from manipulation.skills.repeat import perform

SIDE_M = 0.009
SEAT_N = 5.0
LIFT_M = 0.0015
GRIPS_N = (12.0, 18.0, 26.0)  # of the tries; low at first, because 40 N doubles the force peaks
TURN_M_PER_S = 0.12
PLAY_RAD = 0.08
MOST_GIVE_RAD = 0.15  # that the hand turns further for pads that yield; .01 to .08 rad were felt on 10 random selectors
FELT_RATIO = 0.85  # of the largest torque; where it is reached first, the bar gives way
RESISTS_RATIO, SNAP_RATIO = (
    0.6,
    0.35,
)  # of the largest torque: above the first a detent resists, below the second it was passed
LEAST_NM = 0.03
STOP_N = 40.0
# Twice the torque of the heaviest selectors. Against a blocked one the fingers roll off the bar at 0.8 N m, and are wedged
# with up to 180 N.
STOP_NM = 0.65
TOLERANCE_RAD = np.radians(12.0)
INF = float("inf")
# A heavy virtual mass prevents chatter (15 to 28 N from tick to tick with 8 kg, 4 to 6 N with 200 kg). Along the fingers
# the hand yields too: stiff, it was pushed against the knob with 41 N.
YIELDING = Compliance(
    stiffness=(400.0, 400.0, 400.0, INF, INF, INF),
    damping=(1500.0, 1500.0, 4000.0, 10.0, 10.0, 10.0),
    mass=(200.0, 200.0, 400.0, 1.0, 1.0, 1.0),
    max_offset_m=0.01,
)


def rotary(
    context: SkillContext,
    selector: Rotary,
    target: str,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Turn the selector to a state of the panel file.

    The mechanical estimate in the report is the angle reached, rad clockwise from up.

    Args:
        current: what the last observation showed (angle or state); without it `verify` is asked.
        verify: the caller's read-back.

    Raises:
        InvalidRequest: the selector has no such state, or its present position is not known.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    name = selector.name
    angles = {state.name: state.angle_rad for state in selector.states}
    if target not in angles:
        raise InvalidRequest(f"{name} has no state {target!r}", hint=f"states: {', '.join(angles)}")
    where = InitialState(
        lambda seen: _resting_angle(seen, angles), what=f"the position of {name}", current=current, verify=verify
    )
    tries = itertools.count()

    def stroke(attempt: Attempt) -> float:
        start, goal = where.known, angles[target]
        grip_n = GRIPS_N[min(next(tries), len(GRIPS_N) - 1)]
        between = sum(min(start, goal) < angle <= max(start, goal) for angle in angles.values())
        return turn_bar(attempt, selector, start, goal, over_rad=PLAY_RAD, grip_n=grip_n, detents=between)

    return perform(
        context,
        stroke,
        skill="rotary",
        object_name=name,
        target=target,
        is_reached=lambda seen: _is_at(seen, target, angles[target]),
        verify=where.verify,
    )


def _resting_angle(seen: ObjectState, angles: dict[str, float]) -> float | None:
    """Return the angle of the observed state if there is one: a selector rests in a detent, so it is the most exact."""
    if seen.state in angles:
        return angles[str(seen.state)]
    return seen.angle_rad


def _is_at(seen: ObjectState, target: str, angle_rad: float) -> bool:
    if seen.state is not None:
        return seen.state == target
    return seen.angle_rad is not None and abs(seen.angle_rad - angle_rad) <= TOLERANCE_RAD


def turn_bar(
    attempt: Attempt,
    selector: Rotary | Knob,
    start_rad: float,
    goal_rad: float,
    *,
    over_rad: float = 0.0,
    grip_n: float = GRIPS_N[0],
    detents: int = 0,
) -> float:
    """Hold the bar of a knob and turn it `over_rad` further than asked; returns the angle reached.

    Args:
        detents: how many must be felt; the hand then turns further by what the pads were felt to yield.

    Raises:
        SkillFailure: a finger landed on the bar, there is none between them, it stalled, or fewer detents were felt.
    """
    bar_m = selector.bar_width_m
    open_m = bar_m + 2.0 * SIDE_M
    seat = selector.height_m / 2  # the shoulder under the bar
    sign = float(np.sign(goal_rad - start_rad))
    span_rad = abs(goal_rad - start_rad) + over_rad  # the detent pulls the knob back into place
    most_give_rad = min(MOST_GIVE_RAD, 0.5 * span_rad) if detents else 0.0
    furthest_rad = start_rad + sign * (span_rad + most_give_rad)
    ways = [_way(selector, start_rad, furthest_rad, seat, flip) for flip in (0.0, np.pi)]
    _hold(attempt, selector, ways, open_m, grip_n)
    start = attempt.pose()
    reports = [_turn(attempt, start, sign * span_rad)]
    felt = _felt(reports, sign)
    if detents and reports[0].tripped is None:
        give_rad = min(_give_rad(attempt, reports[0], felt), most_give_rad)
        reports.append(_turn(attempt, attempt.pose(), sign * give_rad))
        felt = _felt(reports, sign)
    end = reports[-1]
    turned = float(np.linalg.norm((end.base_from_tool.rotation * start.rotation.inv()).as_rotvec()))
    attempt.open_to(open_m, name="let go")
    attempt.leave(STANDOFF_M + selector.height_m - seat)
    reached = start_rad + sign * turned
    if end.tripped is not None:
        against = f"{abs(end.wrench[5]):.1f} N m" if end.tripped == "torque" else f"{end.peak_force_n:.0f} N"
        raise SkillFailure(Outcome.STALLED, f"it does not turn on against {against}", reached=reached)
    passed = detents_passed(felt)
    if passed < detents:
        what = f"{passed} of {detents} detents were felt while the hand turned all the way at {grip_n:.0f} N"
        raise SkillFailure(Outcome.SLIPPED, what, reached=reached)
    return reached


def _hold(
    attempt: Attempt, selector: Rotary | Knob, ways: list[list[RigidTransform]], open_m: float, grip_n: float
) -> None:
    seat = selector.height_m / 2
    attempt.begin(ways, may_touch=(selector.name,), width_m=open_m, name=selector.name, leans_about=(0,))
    down = attempt.advance(
        STANDOFF_M + selector.height_m - seat + 0.004, name="approach", speed_m_per_s=0.04, stop_n=SEAT_N
    )
    height = float((attempt.context.panel_pose.inv() * attempt.pose()).translation[2])
    if down.tripped is not None and height > selector.height_m - 0.002:
        raise SkillFailure(Outcome.MISSED, "a finger landed on the bar")
    if down.tripped is not None:
        attempt.advance(-LIFT_M, name="lift off the shoulder", speed_m_per_s=0.03)
    centre_between(attempt, room_m=2.0 * SIDE_M, what="bar")
    width = attempt.grasp(grip_n, name="hold the bar")
    if width < 0.4 * selector.bar_width_m:
        raise SkillFailure(Outcome.MISSED, f"the fingers closed to {1e3 * width:.1f} mm; no bar between them")


def _turn(attempt: Attempt, start: RigidTransform, angle_rad: float) -> MotionReport:
    axis = attempt.context.panel_pose.rotation.apply([0.0, 0.0, -1.0])
    poses = arc(start, centre_m=start.translation, axis=axis, angle_rad=angle_rad)
    guards = (
        Guard(name="effort", quantity=Quantity.FORCE, limit=STOP_N),
        *(Guard(name="torque", quantity=Quantity.TORQUE, limit=STOP_NM, axis=(0.0, 0.0, side)) for side in (-1.0, 1.0)),
    )
    return attempt.along(poses, name="turn", speed_m_per_s=TURN_M_PER_S, guards=guards, compliance=YIELDING)


def _felt(reports: list[MotionReport], sign: float) -> Array:
    """Return the torques (N,) against the turn."""
    return np.concatenate([-sign * report.log.wrench[:, 5] for report in reports])


def _give_rad(attempt: Attempt, report: MotionReport, torque_nm: Array) -> float:
    """Return by what turn of the hand the pads yield before the bar follows: up to where the torque is nearly largest."""
    most = float(np.percentile(torque_nm, 98.0))
    if most < LEAST_NM:
        return 0.0
    k = int(np.argmax(torque_nm >= FELT_RATIO * most))
    context = attempt.context
    first, then = (context.kinematics.tool(q, context.flange_from_grip) for q in report.log.positions_rad[[0, k]])
    return float(np.linalg.norm((then.rotation * first.rotation.inv()).as_rotvec()))


def detents_passed(torque_nm: Array) -> int:
    """Return how many detents were passed: the torque resists up to the middle between two, then it falls."""
    most = max(2.0 * LEAST_NM, float(np.percentile(torque_nm, 98.0)))
    count, resists = 0, False
    for torque in torque_nm:
        if torque > RESISTS_RATIO * most:
            resists = True
        elif resists and torque < SNAP_RATIO * most:
            count, resists = count + 1, False
    return count


def _way(selector: Rotary | Knob, start_rad: float, end_rad: float, seat_m: float, flip: float) -> list[RigidTransform]:
    x, y = selector.position_m
    steps = np.linspace(start_rad, end_rad, max(3, int(abs(end_rad - start_rad) / 0.1)))
    down = [panel_from_grip((x, y, seat_m + LIFT_M), flip - float(a)) for a in steps]
    return [panel_from_grip((x, y, selector.height_m + STANDOFF_M), flip - start_rad), *down]
