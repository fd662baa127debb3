"""Turns a lever valve: encloses the bar between the fingers without squeezing it, and carries it about its hub."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.motion import Compliance, Guard, Quantity
from hal.panel import Lever
from manipulation.planning.cartesian_path import arc
from manipulation.skills.attempt import STANDOFF_M, Attempt
from manipulation.skills.contact import against_turn, centre_between
from manipulation.skills.context import SkillContext, panel_from_grip
from manipulation.skills.initial_state import InitialState
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify
from manipulation.skills.repeat import perform

OVERLAP_M = 0.013  # how far the tips reach below the top of the bar
FROM_END_M = 0.008  # distance of the fingers from the end of the bar; a long lever arm keeps the load on the pads low
APPROACH_SIDE_M = 0.010  # free space on each side when approaching; more than the pose error
CAGE_SIDE_M = 0.002  # free space on each side in the stroke: the bar is enclosed, not squeezed
STROKE_M_PER_S = 0.08
LAST_RAD = np.radians(9.0)  # the last part is slow; at full speed the force at the end stop exceeds 300 N
OVERTRAVEL_RAD = np.radians(12.0)  # play between fingers and bar, and compression of the pads
LAST_M_PER_S = 0.018
END_RISE_N = 8.0
# If the tool stops by more than this angle before the state, the cause is friction and not the end stop.
SHORT_RAD = np.radians(1.0)
STOP_TRIES = 3
EFFORT_SPREAD = 1.6
EFFORT_FLOOR_N = 35.0
LARGEST_STOP_N = 92.0  # below the cell's protective limit, to distinguish a stiff valve from a collision
MOVED_RAD = np.radians(12.0)
TOLERANCE_RAD = np.radians(8.0)
INF = float("inf")
# Stiff across the bar, in the direction of the stroke. Along the bar and the fingers the hand is compliant, because a
# pose error would build up friction there (25 N of 60) that is released in jumps.
YIELDING = Compliance(
    stiffness=(INF, 1000.0, 2000.0, INF, INF, INF),
    damping=(1500.0, 1500.0, 1500.0, 10.0, 10.0, 10.0),
    mass=(50.0, 50.0, 50.0, 1.0, 1.0, 1.0),
    max_offset_m=0.006,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Turn:
    """A turn from one angle to another, clockwise seen from the front."""

    start_rad: float
    goal_rad: float

    @property
    def span_rad(self) -> float:
        return self.goal_rad - self.start_rad


def lever(
    context: SkillContext,
    valve: Lever,
    target: str,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Turn the lever to a state of the panel file.

    The mechanical estimate in the report is the angle reached, rad clockwise from up.

    Args:
        current: what the last observation showed; its angle determines where the fingers come down. Without it
            `verify` is called.
        verify: the caller's read-back.

    Raises:
        InvalidRequest: the lever has no such state, or its present angle is not known.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    name = valve.name
    angles = {state.name: state.angle_rad for state in valve.states}
    if target not in angles:
        raise InvalidRequest(f"{name} has no state {target!r}", hint=f"states: {', '.join(angles)}")
    goal = angles[target]
    where = InitialState(
        lambda seen: _angle_of(seen, angles), what=f"the angle of {name}", current=current, verify=verify
    )

    def stroke(attempt: Attempt) -> float:
        turn = _Turn(start_rad=where.known, goal_rad=goal)
        if abs(turn.span_rad) < np.radians(2.0):
            return turn.start_rad
        return _turn_lever(attempt, valve, turn)

    return perform(
        context,
        stroke,
        skill="lever",
        object_name=name,
        target=target,
        is_reached=lambda seen: _is_at(seen, target, goal),
        verify=where.verify,
    )


def _angle_of(seen: ObjectState, angles: dict[str, float]) -> float | None:
    if seen.angle_rad is not None:
        return seen.angle_rad
    return angles.get(seen.state) if seen.state is not None else None


def _is_at(seen: ObjectState, target: str, goal_rad: float) -> bool:
    if seen.angle_rad is not None:
        return bool(abs(seen.angle_rad - goal_rad) <= TOLERANCE_RAD)
    return seen.state == target


def _turn_lever(attempt: Attempt, valve: Lever, turn: _Turn) -> float:
    """Make one stroke; returns the angle that the bar reached, as measured by the tool."""
    open_m = valve.width_m + 2.0 * APPROACH_SIDE_M
    radius = valve.length_m - FROM_END_M
    ways = [_way(valve, turn, radius, flip) for flip in (0.0, np.pi)]
    attempt.begin(ways, may_touch=(valve.name,), width_m=open_m, name=valve.name)
    down = attempt.advance(STANDOFF_M + OVERLAP_M, name="approach")
    if down.tripped is not None:
        raise SkillFailure(Outcome.MISSED, "a finger landed on the bar")
    centre_between(attempt, room_m=2.0 * APPROACH_SIDE_M, what="bar")
    hub = _hub(attempt, valve, turn.start_rad)
    attempt.open_to(valve.width_m + 2.0 * CAGE_SIDE_M, name="cage")
    turned = _carry(attempt, valve, turn, hub)
    attempt.open_to(open_m, name="let go")
    attempt.leave(STANDOFF_M + OVERLAP_M)
    return turn.start_rad + turned


def _way(valve: Lever, turn: _Turn, radius: float, flip: float) -> list[RigidTransform]:
    """Return grip poses in the panel frame from the standoff to the end, with the closing direction across the bar."""

    def at(angle: float, z: float) -> RigidTransform:
        x, y = valve.position_m
        return panel_from_grip((x + radius * np.sin(angle), y + radius * np.cos(angle), z), flip - angle)

    low = valve.height_m - OVERLAP_M
    over = OVERTRAVEL_RAD * np.sign(turn.span_rad)
    steps = np.linspace(turn.start_rad, turn.goal_rad + over, max(8, int(abs(turn.span_rad) / 0.05)))
    return [at(turn.start_rad, valve.height_m + STANDOFF_M), *(at(float(a), low) for a in steps)]


def _hub(attempt: Attempt, valve: Lever, angle_rad: float) -> Array:
    """Return the hub in the base frame: its place by the panel's pose, corrected across the bar by touch."""
    panel = attempt.context.panel_pose
    tool = (panel.inv() * attempt.pose()).translation
    across = np.array([np.cos(angle_rad), -np.sin(angle_rad), 0.0])
    offset = (tool - np.array(valve.point_m)) @ across
    return np.asarray(panel.apply(np.array(valve.point_m) + offset * across + [0.0, 0.0, tool[2]]))


def _carry(attempt: Attempt, valve: Lever, turn: _Turn, hub: Array) -> float:
    """Make the stroke in two parts: fast to 9 degrees before the end, then slowly onto the end stop.

    Returns the signed angle by which the bar turned: the angle of the tool minus the play between fingers and bar and
    the compression of the pads.
    """
    context, span_rad = attempt.context, turn.span_rad
    sign = float(np.sign(span_rad))
    axis = context.panel_pose.rotation.apply([0.0, 0.0, -1.0])  # clockwise seen from the front
    radius = valve.length_m - FROM_END_M
    stop_n = min(LARGEST_STOP_N, EFFORT_SPREAD * valve.torque_nm / radius + EFFORT_FLOOR_N)
    start = attempt.pose()
    against = against_turn(start, hub, sign * axis)
    strong = Guard(name="effort", quantity=Quantity.FORCE, limit=stop_n, axis=against)
    fast_rad = max(0.0, abs(span_rad) - LAST_RAD)
    if fast_rad > 0.0:
        poses = arc(start, centre_m=hub, axis=axis, angle_rad=sign * fast_rad)
        report = attempt.along(poses, name="turn", speed_m_per_s=STROKE_M_PER_S, guards=(strong,), compliance=YIELDING)
        if report.tripped is not None:
            turned = _between(start, report.base_from_tool)
            outcome = Outcome.STIFF if turned < MOVED_RAD else Outcome.STALLED
            raise SkillFailure(
                outcome, f"it did not give way at {report.peak_force_n:.0f} N", reached=turn.start_rad + sign * turned
            )
    way = _Arc(hub=hub, axis=sign * axis, radius_m=radius, span_rad=abs(span_rad), against=against)
    return sign * _to_the_stop(attempt, way, start, strong)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Arc:
    """The rotation of the bar: hub (3,) m and axis (3,) in the base frame, positive in the sense of the stroke."""

    hub: Array
    axis: Array
    radius_m: float
    span_rad: float
    against: tuple[float, float, float]


def _to_the_stop(attempt: Attempt, way: _Arc, start: RigidTransform, strong: Guard) -> float:
    """Move on slowly until the force rises where the end stop can be; an earlier rise is the bar's own friction.

    Returns the angle by which the bar turned since `start`.
    """
    rise = Guard(name="end stop", quantity=Quantity.FORCE_RISE, limit=END_RISE_N, axis=way.against)
    tries = 0
    while True:
        tries += 1
        here = attempt.pose()
        rest_rad = way.span_rad - _between(start, here) + OVERTRAVEL_RAD
        report = attempt.along(
            arc(here, centre_m=way.hub, axis=way.axis, angle_rad=rest_rad),
            name="turn to the stop", speed_m_per_s=LAST_M_PER_S, guards=(rise, strong), compliance=YIELDING,
        )  # fmt: skip
        force = float(np.linalg.norm(report.wrench[:3]))
        tool_rad = _between(start, report.base_from_tool)
        lag_rad = (CAGE_SIDE_M + force / attempt.context.hand.pad_stiffness_n_per_m) / way.radius_m
        # The tool is ahead of the bar by a lag that is known poorly, so at the stop it is always past the state.
        if report.tripped != rise.name or tool_rad > way.span_rad - SHORT_RAD or tries == STOP_TRIES:
            return max(0.0, tool_rad - lag_rad)


def _between(start: RigidTransform, end: RigidTransform) -> float:
    return float(np.linalg.norm((end.rotation * start.rotation.inv()).as_rotvec()))
