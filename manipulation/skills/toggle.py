"""Throws a toggle switch: sweeps the closed fingertip across the bat until it snaps over."""

from __future__ import annotations

import itertools
from typing import Protocol

import numpy as np

from hal.errors import InvalidRequest, Unprovable
from hal.motion import Guard, Quantity
from hal.panel import Toggle
from manipulation.planning.cartesian_path import shifted
from manipulation.skills.attempt import STANDOFF_M, Attempt
from manipulation.skills.contact import SOFT_PUSH
from manipulation.skills.context import SkillContext, panel_from_grip
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify
from manipulation.skills.repeat import perform

PIVOT_M = 0.004  # the bat turns a little above the plate
GRIP_RATIO = 0.55  # how far up the bat the fingertip pushes: high enough for a lever arm, low enough not to slip off
SIDE_M = 0.008  # free space between fingertip and bat when approaching; more than the pose error
BEYOND_M = 0.013  # distance of the fingertip's face beyond the middle at the end of a free sweep
SWEEP_M_PER_S = 0.03
LEAST_STOP_N = 27.0  # of further tries: a panel file may state the usual effort instead of the measured one
FIRST_N = 22.0  # of the first try; the fingertip ends it against the bat's stop, some newtons higher
EFFORT_SPREAD = 1.6  # three sigma of the panel file's effort tolerance
MET_N, MET_SHARE = 2.0, 0.1  # across the fingers, in this share of the sweep: less is noise or the hand's inertia
LEAST_SEEN_M = 0.002  # way of the tip between the states: five pixels of a close-up
END_N = 4.0  # added to the force of the detent, so that the bat is at its stop


class Handle(Protocol):
    """A bat that leans up or down by `tilt_rad` about a pivot `PIVOT_M` above the plate."""

    @property
    def name(self) -> str:
        """Name in the panel file."""
        ...

    @property
    def position_m(self) -> tuple[float, float]:
        """Position of the pivot on the plate."""
        ...

    @property
    def bat_length_m(self) -> float:
        """Length from the plate to the tip."""
        ...

    @property
    def bat_radius_m(self) -> float:
        """Radius of the round end."""
        ...

    @property
    def tilt_rad(self) -> float:
        """Angle by which the bat leans to either side."""
        ...

    @property
    def force_n(self) -> float:
        """Force at the tip that throws it."""
        ...


def toggle(
    context: SkillContext,
    switch: Toggle,
    target: str,
    *,
    current: ObjectState | None = None,  # noqa: ARG001 - not needed, because the bat is felt
    verify: Verify | None = None,
) -> SkillReport:
    """Throw the toggle to `on` (up) or `off` (down), also if it is seen there already, which then changes nothing.

    Two witnesses must agree before it is done: the look afterwards, and the fingertip that met the bat at its stop beyond
    the pivot. Two looks of 200 drills were wrong twice in the same way.

    The mechanical estimate in the report is how far past the pivot the fingertip's face came, m; more than 0 means that
    the toggle was thrown.

    Args:
        verify: the caller's read-back.

    Raises:
        InvalidRequest: a toggle has no such state.
        Unprovable: its two states look the same.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    if target not in ("on", "off"):
        raise InvalidRequest(f"a toggle has no state {target!r}", hint="on (up) or off (down)")
    moves_m = 2.0 * switch.bat_length_m * np.sin(switch.tilt_rad)
    if moves_m < LEAST_SEEN_M:
        raise Unprovable(
            f"the tip of {switch.name} moves by only {1e3 * moves_m:.1f} mm between on and off, which no look can tell: at "
            f"least {1e3 * LEAST_SEEN_M:.1f} mm can be seen",
            hint="correct bat_length_m and tilt_rad in the panel file",
            object=switch.name,
        )
    up = 1.0 if target == "on" else -1.0
    throws = itertools.count()

    def stroke(attempt: Attempt) -> float:
        return throw(attempt, switch, up, most_n=FIRST_N if next(throws) == 0 else np.inf)

    return perform(
        context,
        stroke,
        skill="toggle",
        object_name=switch.name,
        target=target,
        is_reached=lambda seen: seen.state == target,
        verify=verify,
    )


def throw(
    attempt: Attempt, switch: Handle, up: float, *, grip_ratio: float = GRIP_RATIO, most_n: float = np.inf
) -> float:
    """Approach beside the bat and sweep it over; returns how far past the pivot the fingertip's face came, m.

    Args:
        up: 1 or -1.
        grip_ratio: how far up the bat the fingertip pushes, over its length; a flat handle may be pushed near its end.
        most_n: largest force of this try, where a further one may use all that the switch may need.

    Raises:
        SkillFailure: the bat did not give way, none was met, or the fingertip did not come down beside it.
    """
    half = max(attempt.context.hand.closed_half_m)
    # The bat leans away from the target; come down beyond it.
    lean = switch.bat_length_m * np.sin(switch.tilt_rad) + switch.bat_radius_m
    y = switch.position_m[1]
    start, end = y - up * (lean + half + SIDE_M), y + up * (BEYOND_M - half)
    _come_down(attempt, switch, start, end, PIVOT_M + grip_ratio * switch.bat_length_m)
    stop_n = min(stop_force_n(switch), most_n)
    moved, is_met = _sweep(attempt, end - start, stop_n)
    past = float(moved - (abs(end - start) - BEYOND_M))
    if past < -0.004:
        outcome = Outcome.STALLED if stop_n == most_n else Outcome.STIFF
        what = f"the bat did not give way at {stop_n:.0f} N"
        raise SkillFailure(outcome, what, reached=past, is_sure=True)
    attempt.leave()
    if not is_met:
        raise SkillFailure(Outcome.MISSED, "no bat was met on the way over the pivot", reached=past)
    return past


def stop_force_n(switch: Handle) -> float:
    """Return the force at which the bat must have reached its stop, N.

    The effort in the panel file acts at the tip of the bat; the fingertip pushes lower down.
    """
    return max(LEAST_STOP_N, EFFORT_SPREAD * switch.force_n / GRIP_RATIO + END_N)


def _come_down(attempt: Attempt, switch: Handle, start_m: float, end_m: float, reach_m: float) -> None:
    """Bring the fingertip beside the bat, at panel height `start_m`, where the sweep to `end_m` is free.

    Args:
        reach_m: height of the fingertip above the plate, m.
    """
    x, above = switch.position_m[0], reach_m + switch.bat_length_m + STANDOFF_M
    ways = [
        [panel_from_grip(point, turn) for point in ((x, start_m, above), (x, start_m, reach_m), (x, end_m, reach_m))]
        for turn in (0.0, np.pi, np.pi / 2, -np.pi / 2)
    ]
    attempt.begin(ways, may_touch=(switch.name,), width_m=0.0, name=switch.name, leans_about=(0, 1))
    down = attempt.advance(switch.bat_length_m + STANDOFF_M, name="approach")
    if down.tripped is None:
        return
    left_m = float((attempt.context.panel_pose.inv() * attempt.pose()).translation[2]) - reach_m
    if left_m > 0.004:
        raise SkillFailure(Outcome.MISSED, "the fingertip landed on something before it was beside the bat")
    attempt.advance(-0.002, name="lift off", speed_m_per_s=0.03)


def _sweep(attempt: Attempt, way_m: float, stop_n: float) -> tuple[float, bool]:
    """Push along the panel's y axis until the bat reaches its stop.

    Returns how far the fingertip moved, m, and whether it met anything.
    """
    here = attempt.pose()
    sweep = attempt.context.panel_pose.rotation.apply([0.0, way_m, 0.0])
    unit = sweep / np.linalg.norm(sweep)
    # Only the force against the sweep counts; the force that pushes the finger up along the leaning bat does not.
    x, y, z = here.rotation.inv().apply(-unit)
    against = (float(x), float(y), float(z))
    guard = Guard(name="end stop", quantity=Quantity.FORCE, limit=stop_n, axis=against, ticks=1)
    goal = shifted(here, here.rotation.inv().apply(sweep))
    report = attempt.straight(goal, name="sweep", speed_m_per_s=SWEEP_M_PER_S, guards=(guard,), compliance=SOFT_PUSH)
    across_n = np.linalg.norm(report.log.wrench[:, :2], axis=1)
    is_met = len(across_n) > 0 and float(np.quantile(across_n, 1.0 - MET_SHARE)) >= MET_N
    return float((report.base_from_tool.translation - here.translation) @ unit), is_met
