"""The three ways to hold a handwheel: across the whole wheel, behind two spokes, or by the rim beside a spoke."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.errors import Unreachable
from hal.motion import CartesianPath, Compliance, Guard, Quantity
from hal.panel import Handwheel
from manipulation.planning.hand import Hand
from manipulation.skills.attempt import STANDOFF_M, Attempt
from manipulation.skills.contact import centre_between
from manipulation.skills.context import panel_from_grip
from manipulation.skills.crank import SpokeHold
from manipulation.skills.landing import come_down
from manipulation.skills.outcome import Outcome, SkillFailure
from manipulation.skills.wheel_belief import FRICTION, GRIP_ACROSS_N, PUSH_N, SIDE_N, SPARE_M, across_gap_m, outer_m
from manipulation.skills.wheel_turn import HEAVY_M_PER_S, HEAVY_N, LAG_RAD, TURN_M_PER_S, WheelTurn

TIP_DEPTH_M = 0.014  # depth of the tips below the middle of the spokes
RIM_DEPTH_M = 0.008  # the same below the middle of the rim
HOLDS_RAD = (
    4.2,
    2.6,
    1.3,
)  # largest turns of one hold that are tried, in this order; the arm's wrist allows one of them
RIM_HOLDS_RAD = (1.7, 0.9)
INF = float("inf")
RIM_SIDE_M = 0.009  # largest free space between each finger and the rim when approaching
ACROSS_RAD = tuple(float(a) for a in np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False))  # angles at which it may begin
ACROSS_LAG_RAD = 0.3
SPOKE_GAP_M = 0.0025  # between the inner finger and the spoke beside which it holds the rim
GRIP_N = (12.0, 25.0)  # smallest and largest force of the pads; with 45 N friction along the fingers reached 70 N
LIGHT_N, SETTLE_S, SETTLES = 8.0, 0.25, 6
GRIP_STEP_N = 20.0
QUIET = Guard(name="quiet", quantity=Quantity.FORCE, limit=1.5, below=True, ticks=12)
EVEN_N = 3.0  # a larger side force shows that only one of the pads is at the rim
# Pads that press lightly centre the hand on the rim before they press firmly: both pads move by one screw, so a rim that is
# off their middle by 2 mm would push the arm aside with all of the grip force. Along the fingers the friction of the pads
# is let go, slowly.
SIDEWAYS = Compliance(
    stiffness=(0.0, INF, 50.0, INF, INF, INF), damping=(600.0, 600.0, 4000.0) + (10.0,) * 3,
    mass=(60.0, 60.0, 400.0) + (1.0,) * 3,
    max_offset_m=0.006,
)  # fmt: skip


def hold_across(attempt: Attempt, wheel: Handwheel, angle_rad: float, span_rad: float) -> tuple[WheelTurn, float]:
    """Hold the whole wheel between the fingers, which nothing but their friction turns; any angle of the hand will do."""
    hand, sign = attempt.context.hand, float(np.sign(span_rad))
    low, top = wheel.height_m - wheel.rim_m - RIM_DEPTH_M, wheel.height_m + STANDOFF_M

    def at(angle: float, z: float) -> RigidTransform:
        return panel_from_grip((*wheel.position_m, z), -angle)

    def ways(part: float) -> list[list[RigidTransform]]:
        steps = _steps(sign * (part + ACROSS_LAG_RAD))
        return [[at(angle_rad + start, top), *(at(angle_rad + start + a, low) for a in steps)] for start in ACROSS_RAD]

    width = 2.0 * (outer_m(wheel) + across_gap_m(wheel, hand))
    _, part = _begin(attempt, wheel, span_rad, HOLDS_RAD, width, ways)
    come_down(attempt, STANDOFF_M + wheel.rim_m + RIM_DEPTH_M, what="the wheel")
    _squeeze(attempt, GRIP_ACROSS_N, least_m=1.6 * wheel.radius_m, what="wheel")
    turn = WheelTurn(
        attempt=attempt, wheel=wheel, sign=sign, behind_rad=0.0, most_nm=2.0 * PUSH_N * outer_m(wheel),
        up_m=STANDOFF_M + wheel.rim_m + RIM_DEPTH_M, open_m=width, is_across=True,
    )  # fmt: skip
    return turn, part


def behind_two_spokes(
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
    come_down(attempt, STANDOFF_M + wheel.rim_m + TIP_DEPTH_M, what="the wheel")
    hold = holds[index // 2]
    turn = WheelTurn(
        attempt=attempt, wheel=wheel, sign=sign, behind_rad=hold.behind_rad, most_nm=2.0 * PUSH_N * hold.arm_m,
        up_m=STANDOFF_M + wheel.rim_m + TIP_DEPTH_M, side_per_nm=hold.side_per_nm,
    )  # fmt: skip
    return turn, part


def hold_the_rim(
    attempt: Attempt, wheel: Handwheel, angle_rad: float, span_rad: float, effort_nm: float
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
    come_down(attempt, STANDOFF_M + wheel.rim_m + RIM_DEPTH_M, what="the wheel")
    centre_between(attempt, room_m=2.0 * side, what="rim")
    grip_n = float(np.clip(effort_nm / (2.0 * FRICTION * wheel.radius_m), *GRIP_N))
    _squeeze(attempt, grip_n, least_m=0.4 * wheel.rim_m, what="rim")
    turn = WheelTurn(
        attempt=attempt, wheel=wheel, sign=sign, behind_rad=0.0, most_nm=SIDE_N * wheel.radius_m,
        up_m=STANDOFF_M + wheel.rim_m + RIM_DEPTH_M, open_m=width,
        speed_m_per_s=TURN_M_PER_S if effort_nm < HEAVY_N * wheel.radius_m else HEAVY_M_PER_S,
    )  # fmt: skip
    return turn, part


def _squeeze(attempt: Attempt, grip_n: float, *, least_m: float, what: str) -> None:
    """Close lightly and let the hand yield sideways until both pads are at the wheel, then firmly in steps.

    Soft pads go on closing under a firm grip, so the light one tells whether there is something between them.

    Raises:
        SkillFailure: the fingers closed to less than `least_m`.
    """
    for _ in range(SETTLES):
        left_m = attempt.grasp(LIGHT_N, name=f"touch the {what}")
        if abs(attempt.reports[-1].wrench[0]) < EVEN_N:
            break
        _settle(attempt)
    if left_m < least_m:
        raise SkillFailure(Outcome.MISSED, f"the fingers closed to {1e3 * left_m:.1f} mm; no {what} between them")
    for force_n in np.linspace(LIGHT_N, grip_n, 1 + int(np.ceil((grip_n - LIGHT_N) / GRIP_STEP_N)))[1:]:
        _settle(attempt)
        attempt.grasp(float(force_n), name=f"hold the {what}")
    _settle(attempt)


def _settle(attempt: Attempt) -> None:
    """Stay until nothing pushes on the hand any more, and yield along the closing direction of its pads."""
    here = attempt.pose()
    attempt.run(
        CartesianPath(
            name="settle on the rim", flange_from_tool=attempt.context.flange_from_grip,
            times_s=np.array([0.0, SETTLE_S]), base_from_tool=(here, here), compliance=SIDEWAYS, guards=(QUIET,),
        )
    )  # fmt: skip


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


def _steps(end_rad: float) -> list[float]:
    return [float(a) for a in np.linspace(0.0, end_rad, max(6, int(abs(end_rad) / 0.15)))]
