"""Feels a cap on a spring: where a light touch meets it, how it gives way, and where it leaves the fingertip again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.errors import Unreachable
from hal.motion import Guard, MotionReport, Quantity
from hal.panel import Button, Mushroom
from hal.panel.parts import LATCHED_SHARE
from manipulation.planning.cartesian_path import shifted
from manipulation.planning.touch_points import room_m
from manipulation.skills.attempt import FREE_N, STANDOFF_M, Attempt
from manipulation.skills.contact import meet
from manipulation.skills.context import SkillContext, panel_from_grip
from manipulation.skills.outcome import Outcome, SkillFailure
from manipulation.skills.probe import TURNS_RAD

SEEK_N = 2.5  # a light contact ends the fast part of the approach
SEEK_ABOVE_M = 0.004  # height above the cap at which the slow part begins
TOUCH_N = 1.5  # less than the preload of most caps, so that a touch moves nothing
TOUCH_TICKS = 3
TOUCH_M_PER_S = 0.015
LOST_M = 0.018  # largest distance of the cap behind its expected place
# A hand that yields would let a latch that springs open push it back and close again, so slow speed limits the force.
PUSH_M_PER_S, LIFT_M_PER_S = 0.010, 0.025
FIRST_SHARE = 0.5  # of the way: the spring is measured so far, and the force at its end is predicted
FIRM_N = 4.0  # above the predicted force at the end of the way: the cap is at its stop
SURELY_SHARE = 1.0  # of the way, without going on to the stop; switches close before
STOP_FLOOR_N = 15.0
EFFORT_SPREAD = 1.6  # three sigma of the panel file's effort tolerance
BOTTOM_N = 6.0  # beyond the spring force at full travel, where the cap is at its stop
GONE_N, GONE_SAMPLES = 0.8, 3  # the fingertip has left the cap when this many samples are below this force
UPRIGHT = Rotation.identity()
TILTS = tuple(Rotation.from_rotvec(0.08 * np.array(axis)) for axis in ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]))
FREE_M = 0.003  # way of a release beyond the place of first contact
HAND_SIGMA_M = 0.0005  # of the tips along the fingers relative to the camera, and of the cap's height in the file
FELT_SIGMA_M = 0.0004  # of the height difference of two touches, and of a cap's height in the file
SURE_ODDS = 6.0  # least logarithm of the odds of a state that a height proves
LOST_SIGMAS = 3.0
LATCH_MOVED = 0.5  # share of the latch's depth by which a cap must stand otherwise than before
BESIDE_M, LEAST_ROOM_M = (
    0.045,
    0.013,
)  # largest distance of the touched plate from the cap's edge; room of the fingertip, 2 mm more than it needs
PLACES = 4  # of the plate that are tried
# A plate gives nothing, so it is touched slowly: at 15 mm/s the force went up to 15 N.
PLATE_N, PLATE_M_PER_S, PLATE_REACH_M = 2.0, 0.006, 0.006


def stop_force_n(cap: Button | Mushroom) -> float:
    """Return the force at which the cap must have reached its stop, N."""
    full = cap.preload_n + cap.spring_n_per_m * cap.travel_m
    return max(STOP_FLOOR_N, EFFORT_SPREAD * full + BOTTOM_N)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Touch:
    """A cap that the closed fingertip touches lightly.

    Attributes:
        tip_m: (3,) the tip at the first contact, base frame, and `ahead` (3,) the unit vector along the fingers.
        height_m: of the cap above the plate, by the estimated pose of the panel.
    """

    tip_m: Array
    ahead: Array
    height_m: float

    def depth_m(self, tip_m: Array) -> Array:
        """Return how far tips (3,) or (N, 3) are beyond the first contact, m."""
        return np.asarray((tip_m - self.tip_m) @ self.ahead)


@dataclass(frozen=True, slots=True, kw_only=True)
class Give:
    """How a cap gave way: its travel, and the largest force along the fingers."""

    travel_m: float
    force_n: float


def touch(attempt: Attempt, cap: Button | Mushroom) -> Touch:
    """Go above the cap and touch it lightly.

    Raises:
        SkillFailure: no cap is there (`missed`).
    """
    _go_above(attempt, cap)
    early = attempt.advance(STANDOFF_M - SEEK_ABOVE_M, name="approach", stop_n=SEEK_N)
    if early.tripped is not None:
        attempt.advance(-FREE_M, name="lift", speed_m_per_s=LIFT_M_PER_S, stop_n=FREE_N)
    start = attempt.pose()
    goal = shifted(start, (0.0, 0.0, SEEK_ABOVE_M + cap.travel_m + LOST_M))
    met = meet(attempt, goal, name="touch", speed_m_per_s=TOUCH_M_PER_S, stop_n=TOUCH_N, ticks=TOUCH_TICKS)
    if not met.is_met:
        raise SkillFailure(Outcome.MISSED, "no cap was met where it should be", reached=0.0)
    ahead = start.rotation.apply([0.0, 0.0, 1.0])
    tip = start.translation + met.way_m * ahead
    height = float((attempt.context.panel_pose.inv().apply(tip))[2]) - _edge_m(attempt, cap, ahead)
    return Touch(tip_m=tip, ahead=ahead, height_m=height)


def _go_above(attempt: Attempt, cap: Button | Mushroom) -> None:
    """Go to the standoff above the cap; with the hand a little aslant where the arm reaches no other way.

    A hand at a right angle to the plate may be in line with the forearm, where a small error turns the wrist far.
    """
    try:
        attempt.begin(_ways(cap, UPRIGHT), may_touch=(cap.name,), width_m=0.0, name=cap.name)
    except Unreachable:
        attempt.begin(
            [way for tilt in TILTS for way in _ways(cap, tilt)], may_touch=(cap.name,), width_m=0.0, name=cap.name
        )


def _ways(cap: Button | Mushroom, tilt: Rotation) -> list[list[RigidTransform]]:
    """Return for each turn of the hand the poses (panel_from_grip) at the standoff, above the cap, and at its stop."""
    top = (*cap.position_m, cap.height_m)
    on_cap = [panel_from_grip(top, turn) * RigidTransform.from_rotation(tilt) for turn in TURNS_RAD]
    return [[shifted(pose, (0.0, 0.0, -z)) for z in (STANDOFF_M, SEEK_ABOVE_M, -cap.travel_m)] for pose in on_cap]


def _edge_m(attempt: Attempt, cap: Button | Mushroom, ahead: Array) -> float:
    """Return how far the middle of a fingertip that points `ahead` (3,) is above the cap that its edge touches."""
    cosine = -float(ahead @ attempt.context.panel_pose.rotation.apply([0.0, 0.0, 1.0]))
    half_m = min(max(attempt.context.hand.closed_half_m), cap.radius_m)
    return half_m * float(np.sqrt(max(0.0, 1.0 - cosine**2)))


def push(attempt: Attempt, cap: Button | Mushroom, first: Touch, *, way_m: float, is_firm: bool) -> Give:
    """Push a touched cap in by `way_m`; the spring is measured on the way, and limits the force at its end.

    Args:
        is_firm: whether to go on to the stop.
    """
    limit_n = stop_force_n(cap)
    pads_n_per_m = 2.0 * attempt.context.hand.pad_stiffness_n_per_m  # two fingers side by side
    report = _down(attempt, first, FIRST_SHARE * way_m, limit_n=limit_n)
    now_n, slope = _spring(first, report)
    deepest_m = float(first.depth_m(report.base_from_tool.translation))
    if report.tripped is None:
        expected_n = now_n + slope * max(0.0, way_m - deepest_m)
        goal_m = (way_m + LOST_M if is_firm else SURELY_SHARE * way_m) + expected_n / pads_n_per_m
        limit_n = min(limit_n, expected_n + FIRM_N)
        report = _down(attempt, first, goal_m, limit_n=limit_n)
        deepest_m = float(first.depth_m(report.base_from_tool.translation))
    force_n = float(np.max(-report.log.wrench[:, 2], initial=0.0))
    return Give(travel_m=max(0.0, deepest_m - force_n / pads_n_per_m), force_n=force_n)


def is_at(attempt: Attempt, first: Touch) -> bool:
    """Return whether the tips are still where they touched the cap."""
    return float(np.linalg.norm(attempt.pose().translation - first.tip_m)) < FREE_M


def let_go(attempt: Attempt, first: Touch) -> float:
    """Move back until the cap leaves the fingertip; returns how much deeper than before the cap stays, m."""
    depth = float(first.depth_m(attempt.pose().translation))
    report = attempt.advance(-(depth + FREE_M), name="release", speed_m_per_s=LIFT_M_PER_S, stop_n=FREE_N)
    is_free = -report.log.wrench[:, 2] < GONE_N
    depths = first.depth_m(report.log.tip_m)
    for k in range(len(is_free) - GONE_SAMPLES + 1):
        if is_free[k : k + GONE_SAMPLES].all():
            return float(depths[k])
    return float(depths[-1])


def state_by_height(cap: Button | Mushroom, height_m: float, *, sigma_m: float) -> str | None:
    """Return `pressed` or `released` by the height of a cap that latches; None if the height allows both."""
    depth_m = LATCHED_SHARE * cap.travel_m
    odds = (height_m - (cap.height_m - depth_m / 2)) * depth_m / sigma_m**2
    if abs(odds) < SURE_ODDS:
        return None
    return "released" if odds > 0 else "pressed"


def state_by_touch(
    attempt: Attempt, cap: Button | Mushroom, first: Touch, *, in_doubt: str | None = None
) -> tuple[str | None, bool]:
    """Return the state of a touched cap, and whether the plate beside it was touched for that.

    The plate is touched if the pose of the panel is too uncertain, or for the state `in_doubt`, which a height by the pose
    alone does not prove. Without a place beside the cap that the hand can touch the hand stays at the cap; after a touch
    of the plate it is above the plate. The state is None where no height tells it.

    Raises:
        SkillFailure: what was touched is lower than a cap can be (`missed`).
    """
    height_m, sigma_m = first.height_m, _height_sigma_m(attempt.context, cap)
    state, is_beside = state_by_height(cap, height_m, sigma_m=sigma_m), False
    if state is None or state == in_doubt:
        plate_m = _plate_height_m(attempt, cap)
        if plate_m is None:
            return state, False
        height_m, sigma_m, is_beside = height_m - plate_m, FELT_SIGMA_M, True
        state = state_by_height(cap, height_m, sigma_m=sigma_m)
    if height_m < cap.height_m - cap.travel_m - LOST_SIGMAS * sigma_m:
        what = f"what was touched stands {1e3 * height_m:.1f} mm out of the plate, lower than a pressed {cap.name}"
        raise SkillFailure(Outcome.MISSED, what)
    return state, is_beside


def _down(attempt: Attempt, first: Touch, depth_m: float, *, limit_n: float) -> MotionReport:
    guard = Guard(name="bottom", quantity=Quantity.FORCE, limit=limit_n, axis=(0.0, 0.0, -1.0), ticks=1)
    here = attempt.pose()
    further_m = max(2e-4, depth_m - float(first.depth_m(here.translation)))
    goal = shifted(here, (0.0, 0.0, further_m))
    return attempt.straight(goal, name="press", speed_m_per_s=PUSH_M_PER_S, guards=(guard,))


def _spring(first: Touch, report: MotionReport) -> tuple[float, float]:
    """Return the force at the end of a push, N, and its rise, N/m, over the second half of the way."""
    depth, force = first.depth_m(report.log.tip_m), -report.log.wrench[:, 2]
    late = depth > 0.4 * depth.max(initial=0.0)
    if late.sum() < 3 or np.ptp(depth[late]) < 2e-4:
        return float(force.max(initial=0.0)), 0.0
    slope, offset = np.polyfit(depth[late], force[late], 1)
    return float(offset + slope * depth.max()), max(0.0, float(slope))


def _height_sigma_m(context: SkillContext, cap: Button | Mushroom) -> float:
    """Return one sigma of a height above the plate at the cap, by the covariance of the panel's pose."""
    pose = context.panel_pose
    normal = pose.rotation.apply([0.0, 0.0, 1.0])
    arm = pose.rotation.apply([*cap.position_m, cap.height_m])
    gradient = np.concatenate([normal, np.cross(arm, normal)])
    return float(np.sqrt(gradient @ context.base_from_panel.covariance @ gradient + HAND_SIGMA_M**2 + FELT_SIGMA_M**2))


def _is_above_plate(attempt: Attempt, cap: Button | Mushroom, x_m: float, y_m: float) -> bool:
    """Go to the plate at a place beside the cap; returns whether there is a way."""
    heights = (PLATE_REACH_M, 0.0, -PLATE_REACH_M)
    ways = [[panel_from_grip((float(x_m), float(y_m), z), turn) for z in heights] for turn in TURNS_RAD]
    try:
        attempt.begin(ways, may_touch=(), width_m=0.0, name=f"the plate beside {cap.name}")
    except Unreachable:
        return False
    return True


def _plate_height_m(attempt: Attempt, cap: Button | Mushroom) -> float | None:
    """Touch the plate beside the cap; returns its height in the estimated panel frame, m, or None without a place."""
    panel = attempt.context.panel
    around = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    radii = cap.radius_m + np.arange(LEAST_ROOM_M, BESIDE_M, 0.004)
    points = np.array([np.array(cap.position_m) + r * np.array([np.cos(a), np.sin(a)]) for r in radii for a in around])
    half = np.array([panel.width_m, panel.height_m]) / 2 - LEAST_ROOM_M
    free = points[(room_m(panel, points) >= LEAST_ROOM_M) & (np.abs(points) <= half).all(axis=1)]
    places = free[:: max(1, len(free) // PLACES)][:PLACES]
    attempt.leave()
    if not any(_is_above_plate(attempt, cap, x, y) for x, y in places):
        return None
    start = attempt.pose()
    goal = shifted(start, (0.0, 0.0, 2.0 * PLATE_REACH_M))
    met = meet(attempt, goal, name="touch the plate", speed_m_per_s=PLATE_M_PER_S, stop_n=PLATE_N, ticks=TOUCH_TICKS)
    attempt.leave()
    if not met.is_met:
        return None
    return float((attempt.context.panel_pose.inv() * start).translation[2]) - met.way_m
