"""Turn a handwheel: one finger inside the rim pushes a spoke round, the other stays outside."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.errors import InvalidRequest
from hal.motion import Guard, Quantity
from hal.panel import Handwheel
from manipulation.skills.contact import meet
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify
from manipulation.skills.steps import STANDOFF_M, Attempt, perform
from manipulation.stroke import arc, turned_about
from manipulation.workcell import Workcell, panel_from_grip

HUB_M = 0.009
OPENING_M = 0.034
TIP_DEPTH_M = 0.012  # of the tips below the middle of the rim
SPOKE_M = 0.0036
ROOM_M = 0.006  # between finger and spoke when coming down
SEEK_RAD = 0.9
SEEK_N = 3.0
SEEK_M_PER_S = 0.03
TURN_M_PER_S = 0.06
LONGEST_RAD = 1.8  # of one push; then the finger goes back for the next spoke
EFFORT_SPREAD = 1.6
EFFORT_FLOOR_N = 20.0
LARGEST_STOP_N = 92.0
TOLERANCE_RAD = np.radians(6.0)


def handwheel(
    cell: Workcell, name: str, target_rad: float, *, current: ObjectState | None = None, verify: Verify | None = None
) -> SkillReport:
    """Turn the wheel until its marked spoke has come from the present angle to `target_rad` (clockwise from up).

    A turn of more than 100 degrees is made by several pushes.

    Args:
        current: what the last look said (angle); without it `verify` is asked.

    The mechanical estimate is the angle reached.

    Raises:
        InvalidRequest: not a wheel, a target beyond its stops, or nobody knows its angle.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    thing = cell.panel.object(name)
    if not isinstance(thing, Handwheel):
        raise InvalidRequest(f"{name} is a {thing.kind}, not a handwheel", hint="see the panel file")
    if not thing.minimum_rad <= target_rad <= thing.maximum_rad:
        raise InvalidRequest(
            f"{target_rad:.2f} rad is beyond the stops of {name}",
            hint=f"{thing.minimum_rad:.2f} to {thing.maximum_rad:.2f} rad",
        )
    known = current if current is not None else (verify() if verify is not None else None)
    where = [known.angle_rad if known is not None else None]

    def stroke(attempt: Attempt) -> float:
        if where[0] is None:
            raise InvalidRequest(f"the angle of {name} is not known", hint="read it first, or give `current`")
        angle = where[0]
        while abs(target_rad - angle) > 0.5 * TOLERANCE_RAD:
            part = float(np.clip(target_rad - angle, -LONGEST_RAD, LONGEST_RAD))
            angle += _push_spoke(attempt, thing, angle, part)
            where[0] = angle
        return angle

    def look() -> ObjectState | None:
        seen = verify() if verify is not None else None
        if seen is not None and seen.angle_rad is not None:
            where[0] = seen.angle_rad
        return seen

    return perform(
        cell,
        stroke,
        skill="handwheel",
        object_name=name,
        target=f"{target_rad:.3f} rad",
        is_reached=lambda seen: seen.angle_rad is not None and abs(seen.angle_rad - target_rad) <= TOLERANCE_RAD,
        verify=look if verify is not None else None,
    )


def _push_spoke(attempt: Attempt, thing: Handwheel, angle_rad: float, span_rad: float) -> float:
    """One push by `span_rad`; returns the signed angle by which the wheel turned."""
    cell, sign = attempt.cell, float(np.sign(span_rad))
    finger = 0.5 * (HUB_M + thing.radius_m - thing.rim_m)  # radius at which the inner finger works
    grip = finger + cell.hand.finger_thickness_m / 2 + OPENING_M / 2  # and the middle between the fingers
    behind = (SPOKE_M + cell.hand.finger_width_m / 2 + ROOM_M) / finger
    spokes = [angle_rad + 2.0 * np.pi * k / thing.spokes for k in range(thing.spokes)]
    ways = [_way(thing, spoke - sign * behind, span_rad + sign * behind, grip, flip) for spoke in spokes for flip in (0.0, np.pi)]
    attempt.begin(ways, may_touch=(thing.name,), width_m=OPENING_M, name=thing.name)
    low = thing.height_m - thing.rim_m - TIP_DEPTH_M
    down = attempt.advance(thing.height_m + STANDOFF_M - low, name="approach")
    if down.tripped is not None:
        raise SkillFailure(Outcome.MISSED, "a finger landed on the wheel")
    panel = cell.panel_pose
    hub = panel.apply(np.array(thing.point_m))
    axis = panel.rotation.apply([0.0, 0.0, -1.0])  # clockwise seen from the front
    start = attempt.pose()
    stop_n = min(LARGEST_STOP_N, EFFORT_SPREAD * thing.torque_nm / finger + EFFORT_FLOOR_N)
    seek = Guard(name="spoke", quantity=Quantity.FORCE, limit=SEEK_N, ticks=3)
    poses = arc(start, centre_m=hub, axis=axis, angle_rad=sign * SEEK_RAD)
    found = attempt.along(poses, name="feel the spoke", speed_m_per_s=SEEK_M_PER_S, guards=(seek,))
    if found.tripped is None:
        raise SkillFailure(Outcome.MISSED, "no spoke was met")
    met = attempt.pose()
    give = (stop_n / EFFORT_SPREAD) / cell.hand.pad_stiffness_n_per_m / finger
    del give
    strong = Guard(name="effort", quantity=Quantity.FORCE, limit=stop_n)
    poses = arc(met, centre_m=hub, axis=axis, angle_rad=span_rad)
    report = attempt.along(poses, name="turn", speed_m_per_s=TURN_M_PER_S, guards=(strong,))
    turned = sign * float(np.linalg.norm((report.base_from_tool.rotation * met.rotation.inv()).as_rotvec()))
    back = turned_about(attempt.pose(), hub, axis, -sign * 0.15)
    attempt.straight(back, name="let go", speed_m_per_s=SEEK_M_PER_S)
    attempt.leave(thing.height_m + STANDOFF_M - low)
    if report.tripped is not None:
        outcome = Outcome.STIFF if abs(turned) < 0.2 else Outcome.STALLED
        raise SkillFailure(outcome, f"it did not give way at {report.peak_force_n:.0f} N", reached=angle_rad + turned)
    return turned


def _way(thing: Handwheel, start_rad: float, span_rad: float, grip_m: float, flip: float) -> list[RigidTransform]:
    """Grip poses with the closing direction along the radius, from the standoff round the push."""

    def at(angle: float, z: float) -> RigidTransform:
        x, y = thing.position_m
        point = (x + grip_m * np.sin(angle), y + grip_m * np.cos(angle), z)
        # The radius points at pi/2 - angle from the panel's x.
        return panel_from_grip(point, np.pi / 2 - angle + flip)

    low = thing.height_m - thing.rim_m - TIP_DEPTH_M
    steps = np.linspace(start_rad, start_rad + span_rad, max(6, int(abs(span_rad) / 0.08)))
    return [at(start_rad, thing.height_m + STANDOFF_M), *(at(float(a), low) for a in steps)]
