"""Turn a handwheel: hold its rim lightly between two spokes and carry it round the hub."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.motion import Compliance, Guard, Quantity
from hal.panel import Handwheel
from manipulation.planning.cartesian_path import arc
from manipulation.skills.attempt import STANDOFF_M, Attempt
from manipulation.skills.contact import against_turn, centre_between
from manipulation.skills.context import SkillContext, panel_from_grip
from manipulation.skills.initial_state import InitialState, object_of_kind
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify, surely_within
from manipulation.skills.perform import perform

HUB_M = 0.009  # the panel file does not say how thick the hub is; this is generous
SIDE_M = 0.009  # most room between each finger and the rim when coming down
SPARE_M = 0.001
TIP_DEPTH_M = 0.008  # of the tips below the middle of the rim
FRICTION = 0.6  # of pads on paint, low on purpose
FIRMER_RATIO = 1.4  # a light grasp first: a firm one made 97 N of friction along the fingers
GRIP_FLOOR_N = 12.0
LARGEST_GRIP_N = 45.0
TURN_M_PER_S = 0.08
LONGEST_RAD = 1.7  # of one hold; then the hand goes back for the next
EFFORT_SPREAD = 1.6
EFFORT_FLOOR_N = 30.0
LARGEST_STOP_N = 92.0
TOLERANCE_RAD = np.radians(6.0)
INF = float("inf")
# Hub and plate are known to a few millimetres: the hand yields along the radius and the axis, so that the rim leads
# it round.
RADIAL = Compliance(
    stiffness=(50.0, INF, 400.0, INF, INF, INF),
    damping=(1000.0, 1000.0, 1500.0, 10.0, 10.0, 10.0),
    mass=(100.0, 100.0, 100.0, 1.0, 1.0, 1.0),
    max_offset_m=0.015,
)


def handwheel(
    context: SkillContext,
    name: str,
    target_rad: float,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Turn the wheel until its marked spoke has come from the present angle to `target_rad` (clockwise from up).

    A turn of more than about 100 degrees is made by several holds.

    Args:
        current: what the last look said (angle); without it `verify` is asked.

    The mechanical estimate is the angle reached.

    Raises:
        InvalidRequest: not a wheel, a target beyond its stops, or nobody knows its angle.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    panel_object = object_of_kind(context, name, Handwheel, "handwheel")
    if not panel_object.minimum_rad <= target_rad <= panel_object.maximum_rad:
        raise InvalidRequest(
            f"{target_rad:.2f} rad is beyond the stops of {name}",
            hint=f"{panel_object.minimum_rad:.2f} to {panel_object.maximum_rad:.2f} rad",
        )
    where = InitialState(lambda seen: seen.angle_rad, what=f"the angle of {name}", current=current, verify=verify)
    tries = itertools.count()

    def stroke(attempt: Attempt) -> float:
        grip_n = grip_force_n(panel_object, tries=next(tries))
        angle_rad = where.known
        while abs(target_rad - angle_rad) > 0.3 * TOLERANCE_RAD:
            part = float(np.clip(target_rad - angle_rad, -LONGEST_RAD, LONGEST_RAD))
            angle_rad = where.moved_to(angle_rad + _carry(attempt, panel_object, angle_rad, part, grip_n))
        return angle_rad

    return perform(
        context,
        stroke,
        skill="handwheel",
        object_name=name,
        target=f"{target_rad:.3f} rad",
        is_reached=lambda seen: surely_within(seen.angle_rad, target_rad, TOLERANCE_RAD, sigma=seen.sigma),
        verify=where.verify,
    )


def grip_force_n(panel_object: Handwheel, *, tries: int = 0) -> float:
    """Force of each pad so that friction carries the wheel, 2 mu F r = torque; firmer after each try that slipped."""
    needed = panel_object.torque_nm / (2.0 * FRICTION * panel_object.radius_m)
    return float(np.clip(needed * FIRMER_RATIO**tries, GRIP_FLOOR_N, LARGEST_GRIP_N))


def free_side_m(panel_object: Handwheel, finger_m: float) -> float:
    """Room on each side of the rim, such that a hand moved inwards meets the rim before its inner finger meets the hub.

    The outer finger meets the rim at radius R - side, the inner one the hub at hub + finger + rim + side.
    """
    most = 0.5 * (panel_object.radius_m - panel_object.rim_m - HUB_M - finger_m - SPARE_M)
    return float(np.clip(most, 0.003, SIDE_M))


def _carry(attempt: Attempt, panel_object: Handwheel, angle_rad: float, span_rad: float, grip_n: float) -> float:
    """One hold and turn; returns the signed angle by which the wheel turned."""
    context, sign = attempt.context, float(np.sign(span_rad))
    side_m = free_side_m(panel_object, context.hand.finger_thickness_m)
    open_m = 2.0 * (panel_object.rim_m + side_m)
    gap = np.pi / panel_object.spokes
    between = [angle_rad + (2 * k + 1) * gap for k in range(panel_object.spokes)]
    ways = [_way(panel_object, place, span_rad, flip) for place in between for flip in (0.0, np.pi)]
    way = attempt.begin(ways, may_touch=(panel_object.name,), width_m=open_m, name=panel_object.name)
    down = attempt.advance(STANDOFF_M + panel_object.rim_m + TIP_DEPTH_M, name="approach")
    if down.tripped is not None:
        raise SkillFailure(Outcome.MISSED, "a finger landed on the wheel")
    centre_between(attempt, room_m=2.0 * side_m, what="rim")
    hub = _hub(attempt, panel_object, between[way // 2])
    width = attempt.grasp(grip_n, name="hold the rim")
    if width < panel_object.rim_m:
        raise SkillFailure(Outcome.MISSED, f"the fingers closed to {1e3 * width:.1f} mm; no rim between them")
    start = attempt.pose()
    axis = context.panel_pose.rotation.apply([0.0, 0.0, -1.0])  # clockwise seen from the front
    stop_n = min(LARGEST_STOP_N, EFFORT_SPREAD * panel_object.torque_nm / panel_object.radius_m + EFFORT_FLOOR_N)
    against = against_turn(start, hub, sign * axis)
    guard = Guard(name="effort", quantity=Quantity.FORCE, limit=stop_n, axis=against)
    lag = panel_object.torque_nm / (
        2.0 * context.hand.pad_stiffness_n_per_m * panel_object.radius_m**2
    )  # what both pads give
    poses = arc(start, centre_m=hub, axis=axis, angle_rad=span_rad + sign * lag)
    report = attempt.along(poses, name="turn", speed_m_per_s=TURN_M_PER_S, guards=(guard,), compliance=RADIAL)
    turned = sign * float(np.linalg.norm((report.base_from_tool.rotation * start.rotation.inv()).as_rotvec()))
    if report.tripped is not None:
        outcome = Outcome.STIFF if abs(turned) < 0.2 else Outcome.STALLED
        raise SkillFailure(outcome, f"it did not give way at {report.peak_force_n:.0f} N", reached=angle_rad + turned)
    attempt.open_to(open_m, name="let go")
    attempt.leave(STANDOFF_M + panel_object.rim_m + TIP_DEPTH_M)
    return turned - sign * lag


def _hub(attempt: Attempt, panel_object: Handwheel, place_rad: float) -> Array:
    """The hub in the base frame: the panel's pose, moved along the radius by what the fingers found of the rim."""
    panel = attempt.context.panel_pose
    tool = (panel.inv() * attempt.pose()).translation
    radial = np.array([np.sin(place_rad), np.cos(place_rad), 0.0])
    offset = (tool - np.array(panel_object.point_m)) @ radial - panel_object.radius_m
    return np.asarray(panel.apply(np.array(panel_object.point_m) + offset * radial + [0.0, 0.0, tool[2]]))


def _way(panel_object: Handwheel, start_rad: float, span_rad: float, flip: float) -> list[RigidTransform]:
    """Grip poses with the closing direction along the radius, from the standoff round the turn."""

    def at(angle: float, z: float) -> RigidTransform:
        x, y = panel_object.position_m
        point = (x + panel_object.radius_m * np.sin(angle), y + panel_object.radius_m * np.cos(angle), z)
        return panel_from_grip(point, np.pi / 2 - angle + flip)  # the radius points at pi/2 - angle from the panel's x

    low = panel_object.height_m - panel_object.rim_m - TIP_DEPTH_M
    steps = np.linspace(start_rad, start_rad + span_rad, max(6, int(abs(span_rad) / 0.08)))
    return [at(start_rad, panel_object.height_m + STANDOFF_M), *(at(float(a), low) for a in steps)]
