"""Turns a handwheel: holds its rim lightly between two spokes and carries it about the hub."""

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
from manipulation.skills.initial_state import InitialState
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify, surely_within
from manipulation.skills.repeat import perform

HUB_M = 0.009  # generous radius of the hub, which the panel file does not give
SIDE_M = 0.009  # largest free space between each finger and the rim when approaching
SPARE_M = 0.001
TIP_DEPTH_M = 0.008  # depth of the tips below the middle of the rim
FRICTION = 0.6  # coefficient of the pads on paint; the low value makes the grip firm enough
FIRMER_RATIO = 1.4  # the first grasp is light, because a firm one caused 97 N of friction along the fingers
GRIP_FLOOR_N = 12.0
LARGEST_GRIP_N = 45.0
TURN_M_PER_S = 0.08
LONGEST_RAD = 1.7  # largest turn of one grasp; then the hand goes back for the next
EFFORT_SPREAD = 1.6
EFFORT_FLOOR_N = 30.0
LARGEST_STOP_N = 92.0
TOLERANCE_RAD = np.radians(6.0)
INF = float("inf")
# Hub and plate are known only to a few millimetres, so the hand is compliant along the radius and the axis, and the rim
# guides it.
RADIAL = Compliance(
    stiffness=(50.0, INF, 400.0, INF, INF, INF),
    damping=(1000.0, 1000.0, 1500.0, 10.0, 10.0, 10.0),
    mass=(100.0, 100.0, 100.0, 1.0, 1.0, 1.0),
    max_offset_m=0.015,
)


def handwheel(
    context: SkillContext,
    wheel: Handwheel,
    target_rad: float,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Turn the wheel until its marked spoke has come from the present angle to `target_rad` (clockwise from up).

    A turn of more than about 100 degrees takes several grasps. The mechanical estimate in the report is the angle
    reached.

    Args:
        current: what the last observation showed (angle); without it `verify` is asked.
        verify: the caller's read-back.

    Raises:
        InvalidRequest: the target is beyond the wheel's stops, or its present angle is not known.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    name = wheel.name
    if not wheel.minimum_rad <= target_rad <= wheel.maximum_rad:
        raise InvalidRequest(
            f"{target_rad:.2f} rad is beyond the stops of {name}",
            hint=f"{wheel.minimum_rad:.2f} to {wheel.maximum_rad:.2f} rad",
        )
    where = InitialState(lambda seen: seen.angle_rad, what=f"the angle of {name}", current=current, verify=verify)
    tries = itertools.count()

    def stroke(attempt: Attempt) -> float:
        grip_n = grip_force_n(wheel, tries=next(tries))
        angle_rad = where.known
        while abs(target_rad - angle_rad) > 0.3 * TOLERANCE_RAD:
            part = float(np.clip(target_rad - angle_rad, -LONGEST_RAD, LONGEST_RAD))
            angle_rad = where.moved_to(angle_rad + _carry(attempt, wheel, angle_rad, part, grip_n))
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


def grip_force_n(wheel: Handwheel, *, tries: int = 0) -> float:
    """Return the force of each pad with which friction carries the wheel, 2 mu F r = torque; firmer after each slip."""
    needed = wheel.torque_nm / (2.0 * FRICTION * wheel.radius_m)
    return float(np.clip(needed * FIRMER_RATIO**tries, GRIP_FLOOR_N, LARGEST_GRIP_N))


def free_side_m(wheel: Handwheel, finger_m: float) -> float:
    """Return the free space on each side of the rim with which the rim is met before the hub.

    Moving inwards, the outer finger meets the rim at radius R - side, the inner one the hub at hub + finger + rim +
    side.
    """
    most = 0.5 * (wheel.radius_m - wheel.rim_m - HUB_M - finger_m - SPARE_M)
    return float(np.clip(most, 0.003, SIDE_M))


def _carry(attempt: Attempt, wheel: Handwheel, angle_rad: float, span_rad: float, grip_n: float) -> float:
    """Hold the rim once and turn it; returns the signed angle by which the wheel turned."""
    context, sign = attempt.context, float(np.sign(span_rad))
    side_m = free_side_m(wheel, context.hand.finger_thickness_m)
    open_m = 2.0 * (wheel.rim_m + side_m)
    gap = np.pi / wheel.spokes
    between = [angle_rad + (2 * k + 1) * gap for k in range(wheel.spokes)]
    ways = [_way(wheel, place, span_rad, flip) for place in between for flip in (0.0, np.pi)]
    way = attempt.begin(ways, may_touch=(wheel.name,), width_m=open_m, name=wheel.name)
    down = attempt.advance(STANDOFF_M + wheel.rim_m + TIP_DEPTH_M, name="approach")
    if down.tripped is not None:
        raise SkillFailure(Outcome.MISSED, "a finger landed on the wheel")
    centre_between(attempt, room_m=2.0 * side_m, what="rim")
    hub = _hub(attempt, wheel, between[way // 2])
    width = attempt.grasp(grip_n, name="hold the rim")
    if width < wheel.rim_m:
        raise SkillFailure(Outcome.MISSED, f"the fingers closed to {1e3 * width:.1f} mm; no rim between them")
    start = attempt.pose()
    axis = context.panel_pose.rotation.apply([0.0, 0.0, -1.0])  # clockwise seen from the front
    stop_n = min(LARGEST_STOP_N, EFFORT_SPREAD * wheel.torque_nm / wheel.radius_m + EFFORT_FLOOR_N)
    against = against_turn(start, hub, sign * axis)
    guard = Guard(name="effort", quantity=Quantity.FORCE, limit=stop_n, axis=against)
    # Angle lost because both pads yield.
    lag = wheel.torque_nm / (2.0 * context.hand.pad_stiffness_n_per_m * wheel.radius_m**2)
    poses = arc(start, centre_m=hub, axis=axis, angle_rad=span_rad + sign * lag)
    report = attempt.along(poses, name="turn", speed_m_per_s=TURN_M_PER_S, guards=(guard,), compliance=RADIAL)
    turned = sign * float(np.linalg.norm((report.base_from_tool.rotation * start.rotation.inv()).as_rotvec()))
    if report.tripped is not None:
        outcome = Outcome.STIFF if abs(turned) < 0.2 else Outcome.STALLED
        raise SkillFailure(outcome, f"it did not give way at {report.peak_force_n:.0f} N", reached=angle_rad + turned)
    attempt.open_to(open_m, name="let go")
    attempt.leave(STANDOFF_M + wheel.rim_m + TIP_DEPTH_M)
    return turned - sign * lag


def _hub(attempt: Attempt, wheel: Handwheel, place_rad: float) -> Array:
    """Return the hub in the base frame: its place by the panel's pose, corrected radially by where the rim was felt."""
    panel = attempt.context.panel_pose
    tool = (panel.inv() * attempt.pose()).translation
    radial = np.array([np.sin(place_rad), np.cos(place_rad), 0.0])
    offset = (tool - np.array(wheel.point_m)) @ radial - wheel.radius_m
    return np.asarray(panel.apply(np.array(wheel.point_m) + offset * radial + [0.0, 0.0, tool[2]]))


def _way(wheel: Handwheel, start_rad: float, span_rad: float, flip: float) -> list[RigidTransform]:
    """Return grip poses with the closing direction along the radius, from the standoff to the end of the turn."""

    def at(angle: float, z: float) -> RigidTransform:
        x, y = wheel.position_m
        point = (x + wheel.radius_m * np.sin(angle), y + wheel.radius_m * np.cos(angle), z)
        return panel_from_grip(point, np.pi / 2 - angle + flip)  # the radius points at pi/2 - angle from the panel's x

    low = wheel.height_m - wheel.rim_m - TIP_DEPTH_M
    steps = np.linspace(start_rad, start_rad + span_rad, max(6, int(abs(span_rad) / 0.08)))
    return [at(start_rad, wheel.height_m + STANDOFF_M), *(at(float(a), low) for a in steps)]
