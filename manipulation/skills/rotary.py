"""Turns a rotary selector: holds its bar lightly and turns about the knob's axis."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.errors import InvalidRequest
from hal.motion import Compliance, Guard, Quantity
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
BAR_RATIO = 0.45  # width of the bar divided by the knob's radius
SEAT_N = 5.0
LIFT_M = 0.0015
GRIP_N = 12.0  # low, because 40 N doubles the force peaks
TURN_M_PER_S = 0.05
PLAY_RAD = 0.08
STOP_N = 40.0
TOLERANCE_RAD = np.radians(12.0)
# A heavy virtual mass prevents chatter (15 to 28 N from tick to tick with 8 kg, 4 to 6 N with 200 kg).
YIELDING = Compliance(
    stiffness=(400.0, 400.0, float("inf"), float("inf"), float("inf"), float("inf")),
    damping=(1500.0, 1500.0, 1500.0, 10.0, 10.0, 10.0),
    mass=(200.0, 200.0, 200.0, 1.0, 1.0, 1.0),
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
    return perform(
        context,
        lambda attempt: turn_bar(attempt, selector, where.known, angles[target], over_rad=PLAY_RAD),
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
    attempt: Attempt, selector: Rotary | Knob, start_rad: float, goal_rad: float, *, over_rad: float = 0.0
) -> float:
    """Hold the bar of a knob and turn it `over_rad` further than asked; returns the angle reached."""
    context = attempt.context
    bar_m = BAR_RATIO * selector.radius_m
    open_m = bar_m + 2.0 * SIDE_M
    seat = selector.height_m / 2  # the shoulder under the bar
    ways = [_way(selector, start_rad, goal_rad, seat, flip) for flip in (0.0, np.pi)]
    attempt.begin(ways, may_touch=(selector.name,), width_m=open_m, name=selector.name)
    down = attempt.advance(
        STANDOFF_M + selector.height_m - seat + 0.004, name="approach", speed_m_per_s=0.04, stop_n=SEAT_N
    )
    height = float((context.panel_pose.inv() * attempt.pose()).translation[2])
    if down.tripped is not None and height > selector.height_m - 0.002:
        raise SkillFailure(Outcome.MISSED, "a finger landed on the bar")
    if down.tripped is not None:
        attempt.advance(-LIFT_M, name="lift off the shoulder", speed_m_per_s=0.03)
    centre_between(attempt, room_m=2.0 * SIDE_M, what="bar")
    width = attempt.grasp(GRIP_N, name="hold the bar")
    if width < 0.5 * bar_m:
        raise SkillFailure(Outcome.MISSED, f"the fingers closed to {1e3 * width:.1f} mm; no bar between them")
    start = attempt.pose()
    axis = context.panel_pose.rotation.apply([0.0, 0.0, -1.0])
    over = over_rad * float(np.sign(goal_rad - start_rad))  # the detent pulls the knob back into place
    poses = arc(start, centre_m=start.translation, axis=axis, angle_rad=goal_rad - start_rad + over)
    guard = Guard(name="effort", quantity=Quantity.FORCE, limit=STOP_N)
    report = attempt.along(poses, name="turn", speed_m_per_s=TURN_M_PER_S, guards=(guard,), compliance=YIELDING)
    turned = float(np.linalg.norm((report.base_from_tool.rotation * start.rotation.inv()).as_rotvec()))
    attempt.open_to(open_m, name="let go")
    attempt.leave(STANDOFF_M + selector.height_m - seat)
    reached = start_rad + float(np.sign(goal_rad - start_rad)) * turned
    if report.tripped is not None:
        raise SkillFailure(Outcome.STALLED, f"it stopped against {report.peak_force_n:.0f} N", reached=reached)
    return reached


def _way(
    selector: Rotary | Knob, start_rad: float, goal_rad: float, seat_m: float, flip: float
) -> list[RigidTransform]:
    x, y = selector.position_m
    steps = np.linspace(start_rad, goal_rad, max(3, int(abs(goal_rad - start_rad) / 0.1)))
    down = [panel_from_grip((x, y, seat_m + LIFT_M), flip - float(a)) for a in steps]
    return [panel_from_grip((x, y, selector.height_m + STANDOFF_M), flip - start_rad), *down]
