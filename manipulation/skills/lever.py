"""Turns a lever valve: pushes the side of its bar with the closed fingers, near the end, about its hub."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.motion import STOPPING_S, Compliance, Guard, MotionReport, Quantity
from hal.panel import Lever
from manipulation.planning.cartesian_path import arc, shifted
from manipulation.skills.attempt import STANDOFF_M, Attempt
from manipulation.skills.contact import FEEL_M_PER_S, FEEL_N, meet, relax
from manipulation.skills.context import SkillContext, panel_from_grip
from manipulation.skills.initial_state import InitialState
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify
from manipulation.skills.repeat import perform

OVERLAP_M = 0.013  # how far the tips reach below the top of the bar
FROM_END_M = 0.005  # of the fingers' middle from the end of the bar; the longest lever arm keeps the load low
BESIDE_M = 0.008  # free space between hand and bar when approaching; more than the pose error
BEYOND_M = 0.010  # how far beyond the expected side the bar is felt for
BACK_M = 0.008  # back from the bar before leaving, because the pressed pads rub on it
STROKE_M_PER_S = 0.08
LAST_RAD = np.radians(9.0)  # the last part is slow; at full speed the force at the end stop exceeds 300 N
OVERTRAVEL_RAD = np.radians(12.0)  # compression of the pads
LAST_M_PER_S = 0.018
HEAVY_N, LAST_HEAVY_M_PER_S = (
    45.0,
    0.009,
)  # the heavier a bar, the more slowly it is brought to its end stop: less overshoot
END_RISE_N, HEAVY_RISE_N = 8.0, 4.0  # the stop of a heavy bar is met with little more than its friction
# If the tool stops by more than this angle before the state, the cause is friction and not the end stop.
SHORT_RAD = np.radians(1.0)
STOP_TRIES = 3
EASY_N = 35.0  # a bar that gives way below this is turned at once; a heavier one is loaded slowly first
LARGEST_N = 84.0  # tells a stiff valve from a collision
#: Force up to which a bar is loaded, and the speed: at 80 mm/s it overshoots by 30 N before the arm has stopped.
FIRM_N, FIRM_M_PER_S = 70.0, 0.02
LOADS = ((FIRM_N, FIRM_M_PER_S), (LARGEST_N, 0.006))
LARGEST_WITH_FRICTION_N = 92.0
FELT_RATIO, FELT_N = 1.25, 12.0  # a bar that needs more than this multiple of the felt force plus this much has stalled
FELT_SAMPLES = 12  # of the log, a tenth of a second
MOVED_RAD = np.radians(6.0)
TOLERANCE_RAD = np.radians(8.0)
INF = float("inf")
# Stiff across the bar, in the direction of the stroke. Along the bar and the fingers the hand is compliant, because a
# pose error would build up friction there. With a mass of 50 kg that friction flips from tick to tick (28 N of 67).
YIELDING = Compliance(
    stiffness=(1000.0, INF, 2000.0, INF, INF, INF),
    damping=(4000.0, 4000.0, 4000.0, 10.0, 10.0, 10.0),
    mass=(400.0, 400.0, 400.0, 1.0, 1.0, 1.0),
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
        try:
            return _turn_lever(attempt, valve, turn)
        except SkillFailure as failure:
            if failure.reached is not None:  # a bar between two states is often not read
                where.moved_to(failure.reached)
            raise

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
    side_m = valve.width_m / 2 + attempt.context.hand.closed_half_m[1]  # between the middles of bar and hand in contact
    ways = [_way(valve, turn, side_m + BESIDE_M, flip) for flip in (0.0, np.pi)]
    attempt.begin(ways, may_touch=(valve.name,), width_m=0.0, name=valve.name, leans_about=(0, 1))
    down = attempt.advance(STANDOFF_M + OVERLAP_M, name="approach")
    if down.tripped is not None:
        raise SkillFailure(Outcome.MISSED, "the hand landed on the bar")
    start = attempt.pose()
    sign = float(np.sign(turn.span_rad))
    ahead = sign * attempt.context.panel_pose.rotation.apply(_across(turn.start_rad))
    goal = RigidTransform.from_components(start.translation + (BESIDE_M + BEYOND_M) * ahead, start.rotation)
    met = meet(attempt, goal, name="feel", speed_m_per_s=FEEL_M_PER_S, stop_n=FEEL_N)
    if not met.is_met:
        raise SkillFailure(Outcome.MISSED, "there is no bar beside the hand")
    contact_m = start.translation + met.way_m * ahead
    way = _Arc(
        hub=_hub(attempt, valve, turn.start_rad, contact_m + side_m * ahead),
        axis=sign * attempt.context.panel_pose.rotation.apply([0.0, 0.0, -1.0]),  # clockwise seen from the front
        radius_m=valve.length_m - FROM_END_M,
        span_rad=abs(turn.span_rad),
        against=_in_tool(start, -ahead),
    )
    try:
        return turn.start_rad + sign * _carry(attempt, way)
    except SkillFailure as failure:
        failure.reached = turn.start_rad + sign * (failure.reached or 0.0)
        raise
    finally:
        if np.linalg.norm(attempt.context.mover.state().wrench[:3]) > HEAVY_N:
            relax(attempt)  # friction on a loaded pad adds to the load at every start of a motion
        back = shifted(attempt.pose(), BACK_M * np.array(way.against))
        attempt.straight(back, name="step back", speed_m_per_s=STROKE_M_PER_S)
        attempt.leave(STANDOFF_M + OVERLAP_M)


def _across(angle_rad: float) -> Array:
    """Return the direction in the panel (3,) in which the bar at this angle moves when it turns clockwise."""
    return np.array([np.cos(angle_rad), -np.sin(angle_rad), 0.0])


def _way(valve: Lever, turn: _Turn, beside_m: float, flip: float) -> list[RigidTransform]:
    """Return grip poses in the panel frame from the standoff beside the bar to the end, with the fingers' width across."""
    sign = float(np.sign(turn.span_rad))

    def at(angle: float, z: float) -> RigidTransform:
        along = (valve.length_m - FROM_END_M) * np.array([np.sin(angle), np.cos(angle), 0.0])
        x, y, _ = np.array(valve.point_m) + along - sign * beside_m * _across(angle)
        return panel_from_grip((x, y, z), np.pi / 2 - angle + flip)

    low = valve.height_m - OVERLAP_M
    steps = np.linspace(turn.start_rad, turn.goal_rad + sign * OVERTRAVEL_RAD, max(8, int(abs(turn.span_rad) / 0.05)))
    return [at(turn.start_rad, valve.height_m + STANDOFF_M), *(at(float(a), low) for a in steps)]


def _hub(attempt: Attempt, valve: Lever, angle_rad: float, bar_m: Array) -> Array:
    """Return the hub (3,) in the base frame: its place by the panel's pose, corrected across the bar by touch.

    Args:
        bar_m: the middle of the bar where it was touched, in the base frame.
    """
    panel = attempt.context.panel_pose
    bar = panel.inv().apply(bar_m)
    across = _across(angle_rad)
    offset = (bar - np.array(valve.point_m)) @ across
    return np.asarray(panel.apply(np.array([*valve.position_m, bar[2]]) + offset * across))


def _in_tool(tool: RigidTransform, direction: Array) -> tuple[float, float, float]:
    x, y, z = tool.rotation.inv().apply(direction)
    return float(x), float(y), float(z)


def _carry(attempt: Attempt, way: _Arc) -> float:
    """Make the stroke: to 9 degrees before the end as fast as the bar allows, then slowly onto the end stop.

    Returns the angle by which the bar turned: that of the tool minus what the pads yield.
    """
    start = attempt.pose()
    felt_n = _turn_most(attempt, way, start, max(0.0, way.span_rad - LAST_RAD))
    last_m_per_s = float(np.interp(felt_n, (HEAVY_N, LARGEST_N), (LAST_M_PER_S, LAST_HEAVY_M_PER_S)))
    return _to_the_stop(attempt, way, start, last_m_per_s, felt_n)


def _turn_most(attempt: Attempt, way: _Arc, start: RigidTransform, fast_rad: float) -> float:
    """Turn the bar by `fast_rad` from where the tool was at `start`; returns the force that it takes.

    A bar that does not give way easily is loaded slowly up to the largest force, which tells what it needs.

    Raises:
        SkillFailure: `stiff` or `stalled`, with the turn of the bar.
    """
    if fast_rad <= 0.0:
        return 0.0
    easy = _turn_to(attempt, way, start, fast_rad, limit_n=EASY_N, speed_m_per_s=STROKE_M_PER_S)
    if easy.tripped is None:
        return _felt_n(way, easy)
    give_m = LARGEST_N / attempt.context.hand.pad_stiffness_n_per_m
    loaded = easy
    for load_n, speed_m_per_s in LOADS:
        loaded_rad = min(fast_rad, _between(start, loaded.base_from_tool) + give_m / way.radius_m)
        loaded = _turn_to(attempt, way, start, loaded_rad, limit_n=load_n, speed_m_per_s=speed_m_per_s)
        if loaded.tripped is None:
            break
    else:
        raise _gave_no_way(attempt, way, start, loaded)
    felt_n = _felt_n(way, loaded)
    limit_n = min(LARGEST_N, FELT_RATIO * felt_n + FELT_N)
    rest = _turn_to(attempt, way, start, fast_rad, limit_n=limit_n, speed_m_per_s=speed_for(felt_n))
    if rest.tripped is not None:
        raise _gave_no_way(attempt, way, start, rest)
    return felt_n


def speed_for(felt_n: float) -> float:
    """Return the speed at which a bar that takes `felt_n` is turned: the nearer to the largest force, the slower."""
    share = (LARGEST_N - felt_n) / (LARGEST_N - EASY_N)
    return float(np.clip(share * STROKE_M_PER_S, FIRM_M_PER_S, STROKE_M_PER_S))


def _felt_n(way: _Arc, report: MotionReport) -> float:
    """Return the force against the turn at the end of a motion, N."""
    return float(np.median(report.log.wrench[-FELT_SAMPLES:, :3] @ np.array(way.against)))


def _efforts(way: _Arc, limit_n: float) -> tuple[Guard, ...]:
    """Return the guards of a turn: the force against it, and the whole force, to which friction adds."""
    return (
        Guard(name="effort", quantity=Quantity.FORCE, limit=limit_n, axis=way.against, ahead_s=STOPPING_S),
        Guard(name="effort", quantity=Quantity.FORCE, limit=LARGEST_WITH_FRICTION_N, ticks=4, ahead_s=STOPPING_S),
    )


def _turn_to(
    attempt: Attempt, way: _Arc, start: RigidTransform, goal_rad: float, *, limit_n: float, speed_m_per_s: float
) -> MotionReport:
    here = attempt.pose()
    poses = arc(here, centre_m=way.hub, axis=way.axis, angle_rad=max(0.0, goal_rad - _between(start, here)))
    return attempt.along(
        poses, name="turn", speed_m_per_s=speed_m_per_s, guards=_efforts(way, limit_n), compliance=YIELDING
    )


def _gave_no_way(attempt: Attempt, way: _Arc, start: RigidTransform, report: MotionReport) -> SkillFailure:
    force_n = float(report.wrench[:3] @ np.array(way.against))
    turned = max(0.0, _between(start, report.base_from_tool) - way.lag_rad(attempt, force_n))
    outcome = Outcome.STIFF if turned < MOVED_RAD else Outcome.STALLED
    what = f"it did not give way at {report.peak_force_n:.0f} N, {1e3 * way.radius_m:.0f} mm from its hub"
    return SkillFailure(outcome, what, reached=turned)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Arc:
    """The rotation of the bar: hub (3,) m and axis (3,) in the base frame, positive in the sense of the stroke."""

    hub: Array
    axis: Array
    radius_m: float
    span_rad: float
    against: tuple[float, float, float]

    def lag_rad(self, attempt: Attempt, force_n: float) -> float:
        """Return by how much the tool is ahead of the bar, because the pads yield under a force."""
        return max(0.0, force_n) / attempt.context.hand.pad_stiffness_n_per_m / self.radius_m


def _to_the_stop(
    attempt: Attempt, way: _Arc, start: RigidTransform, speed_m_per_s: float, felt_n: float = 0.0
) -> float:
    """Move on slowly until the force rises where the end stop can be; an earlier rise is the bar's own friction.

    Returns the angle by which the bar turned since `start`.
    """
    rise = Guard(name="end stop", quantity=Quantity.FORCE_RISE, limit=END_RISE_N, axis=way.against)
    if felt_n >= HEAVY_N:  # at the lower speed the force rises hardly faster than its running median
        rise = Guard(name="end stop", quantity=Quantity.FORCE, limit=felt_n + HEAVY_RISE_N, axis=way.against)
    tries = 0
    while True:
        tries += 1
        here = attempt.pose()
        rest_rad = way.span_rad - _between(start, here) + OVERTRAVEL_RAD
        report = attempt.along(
            arc(here, centre_m=way.hub, axis=way.axis, angle_rad=rest_rad),
            name="turn to the stop", speed_m_per_s=speed_m_per_s, guards=(rise, *_efforts(way, LARGEST_N)), compliance=YIELDING,
        )  # fmt: skip
        force = float(np.linalg.norm(report.wrench[:3]))
        tool_rad = _between(start, report.base_from_tool)
        lag_rad = way.lag_rad(attempt, force)
        # The tool is ahead of the bar by a lag that is known poorly, so at the stop it is always past the state.
        if report.tripped != rise.name or tool_rad > way.span_rad - SHORT_RAD or tries == STOP_TRIES:
            return max(0.0, tool_rad - lag_rad)


def _between(start: RigidTransform, end: RigidTransform) -> float:
    return float(np.linalg.norm((end.rotation * start.rotation.inv()).as_rotvec()))
