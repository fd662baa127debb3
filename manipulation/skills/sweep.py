"""Sweeps a line scanner with the wrist: turns it about its own x axis, so that its lines form an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import Unreachable
from hal.motion import CartesianPath
from manipulation.planning.cartesian_path import TURN_ARM_M, arc, through
from manipulation.skills.context import STROKE_MARGIN_M, SkillContext

# Tried in this order to each side, because near a joint limit a smaller image is better than none.
SIDES_RAD = (0.48, 0.40, 0.32, 0.24, 0.16, 0.08)
LEAST_RAD = 0.48  # of both sides together
QUICK_RAD_PER_S = 0.4  # to the first line and back from the last
SAME_BRANCH_RAD = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sweep:
    """Four declared motions, each from rest to rest; after the last one the arm is back where it began.

    Attributes:
        out: to the first line.
        across: over all lines, at the rate of the sweep.
        again: over all lines the other way. What a late time stamp turns one way in the first pass, it turns the other
            way in this one, so the two show the delay.
        back: to the initial pose.
        up_rad, down_rad: the lines lie up to these angles on the two sides of the initial pose.
    """

    out: CartesianPath
    across: CartesianPath
    again: CartesianPath
    back: CartesianPath
    up_rad: float
    down_rad: float


def plan_sweep(
    context: SkillContext,
    flange_from_scanner: RigidTransform,
    *,
    rate_rad_per_s: float,
    start_rad: Array,
    width_m: float,
) -> Sweep:
    """Plan the widest sweep that the arm can make from where it stands without touching anything.

    The scanner turns about its x axis through its own origin, so that the image is the one that a range camera would
    see from the pose `start_rad`.

    Args:
        flange_from_scanner: mount of the scanner; its beams lie in its x-z plane.
        width_m: opening of the gripper.

    Raises:
        Unreachable: the arm cannot turn the scanner far enough.
    """
    base_from_scanner = context.kinematics.tool(start_rad, flange_from_scanner)
    axis = base_from_scanner.rotation.apply([1.0, 0.0, 0.0])

    def turned(start: RigidTransform, angle_rad: float) -> tuple[RigidTransform, ...]:
        return arc(start, centre_m=start.translation, axis=axis, angle_rad=angle_rad)

    def motion(poses: tuple[RigidTransform, ...], name: str, rate: float) -> CartesianPath:
        return through(poses, name=name, speed_m_per_s=TURN_ARM_M * rate, flange_from_tool=flange_from_scanner)

    def widest(sign: float) -> float:
        free = (
            side
            for side in SIDES_RAD
            if _is_free(context, turned(base_from_scanner, sign * side), flange_from_scanner, start_rad, width_m)
        )
        return next(free, 0.0)

    up_rad, down_rad = widest(1.0), widest(-1.0)
    if min(up_rad, down_rad) == 0.0 or up_rad + down_rad < LEAST_RAD:
        raise Unreachable(
            f"the wrist can nod the scanner by {up_rad:.2f} and {down_rad:.2f} rad to its two sides from here, and needs "
            f"{SIDES_RAD[-1]:.2f} rad to each and {LEAST_RAD:.2f} rad in all: joint limits or obstacles are in the way",
            hint="drive the arm further away from the panel or from its joint limits, then scan again",
        )
    out = turned(base_from_scanner, up_rad)
    across = turned(out[-1], -up_rad - down_rad)
    again = turned(across[-1], up_rad + down_rad)
    return Sweep(
        out=motion(out, "to the first line", QUICK_RAD_PER_S),
        across=motion(across, "sweep", rate_rad_per_s),
        again=motion(again, "sweep back", rate_rad_per_s),
        back=motion(turned(again[-1], -up_rad), "back from the first line", QUICK_RAD_PER_S),
        up_rad=up_rad,
        down_rad=down_rad,
    )


def _is_free(
    context: SkillContext,
    base_from_scanner: tuple[RigidTransform, ...],
    flange_from_scanner: RigidTransform,
    start_rad: Array,
    width_m: float,
) -> bool:
    """Return whether the arm can follow these poses from where it stands without touching anything."""
    flange = [pose * flange_from_scanner.inv() for pose in base_from_scanner]
    try:
        paths = context.kinematics.follow(flange, near_rad=start_rad)
    except Unreachable:
        return False
    model = context.collision(width_m=width_m)
    return any(
        np.abs(path[0] - start_rad).max() < SAME_BRANCH_RAD
        and all(model.is_clear(q, margin_m=STROKE_MARGIN_M) for q in path)
        for path in paths
    )
