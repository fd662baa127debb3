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

# Tried in this order, because near a joint limit a smaller image is better than none.
HALVES_RAD = (0.48, 0.40, 0.32, 0.24)
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
        half_rad: the lines lie up to this angle on both sides of the initial pose.
    """

    out: CartesianPath
    across: CartesianPath
    again: CartesianPath
    back: CartesianPath
    half_rad: float


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
        Unreachable: not even the smallest sweep is possible.
    """
    base_from_scanner = context.kinematics.tool(start_rad, flange_from_scanner)
    axis = base_from_scanner.rotation.apply([1.0, 0.0, 0.0])

    def turned(start: RigidTransform, angle_rad: float) -> tuple[RigidTransform, ...]:
        return arc(start, centre_m=start.translation, axis=axis, angle_rad=angle_rad)

    def motion(poses: tuple[RigidTransform, ...], name: str, rate: float) -> CartesianPath:
        return through(poses, name=name, speed_m_per_s=TURN_ARM_M * rate, flange_from_tool=flange_from_scanner)

    for half_rad in HALVES_RAD:
        out = turned(base_from_scanner, half_rad)
        across = turned(out[-1], -2.0 * half_rad)
        again = turned(across[-1], 2.0 * half_rad)
        if _is_free(context, across, flange_from_scanner, start_rad, width_m):
            return Sweep(
                out=motion(out, "to the first line", QUICK_RAD_PER_S),
                across=motion(across, "sweep", rate_rad_per_s),
                again=motion(again, "sweep back", rate_rad_per_s),
                back=motion(turned(again[-1], -half_rad), "back from the first line", QUICK_RAD_PER_S),
                half_rad=half_rad,
            )
    raise Unreachable(
        f"the wrist cannot nod the scanner by {HALVES_RAD[-1]:.2f} rad from here without a joint limit or a touch",
        hint="drive the arm further away from the panel or from its joint limits, then scan again",
    )


def _is_free(
    context: SkillContext,
    base_from_scanner: tuple[RigidTransform, ...],
    flange_from_scanner: RigidTransform,
    start_rad: Array,
    width_m: float,
) -> bool:
    """Return whether the arm can follow these poses on its present branch without touching anything."""
    flange = [pose * flange_from_scanner.inv() for pose in base_from_scanner]
    try:
        paths = context.kinematics.follow(flange, near_rad=start_rad)
    except Unreachable:
        return False
    model = context.collision(width_m=width_m)
    middle = len(flange) // 2
    return any(
        np.abs(path[middle] - start_rad).max() < SAME_BRANCH_RAD
        and all(model.is_clear(q, margin_m=STROKE_MARGIN_M) for q in path)
        for path in paths
    )
