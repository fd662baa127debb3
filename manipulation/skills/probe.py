"""Probes the panel: touch points with the closed fingers, and proximity points with the sensors beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.geometry import matrix_of
from hal.motion import Guard, Hold, MotionReport, Quantity
from manipulation.planning.cartesian_path import shifted
from manipulation.skills.attempt import RETREAT_M_PER_S, Attempt
from manipulation.skills.contact import onset
from manipulation.skills.context import SkillContext, panel_from_grip
from manipulation.skills.outcome import Outcome, SkillFailure

SLOW_FROM_M = 0.010  # slow from this distance before the expected surface; more than a pose error of 3 mm and 1 degree
BEYOND_M = 0.012
TOUCH_M_PER_S = 0.012
TOUCH_N = 4.0
NORMAL_SIGMA_M = 0.0003  # repeat scatter of the onset fit on the simulated bench
TURNS_RAD = tuple(np.linspace(-np.pi, np.pi, 8, endpoint=False))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TouchPoint:
    """Where the fingers met a surface: base frame, m, with a (3, 3) covariance in base axes.

    `normal` points from the surface to the fingers. Across the fingers, the covariance is that of the fingertip's face.
    """

    point_m: Array
    covariance: Array
    normal: Array
    force_n: float
    stamp_s: float
    report: MotionReport


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ProximityPoint:
    """One averaged distance of one sensor, whose beam leaves `base_from_sensor` along +z."""

    base_from_sensor: RigidTransform
    distance_m: float
    sigma_m: float
    samples: int
    stamp_s: float


def touch_probe(
    context: SkillContext, point_m: Sequence[float], *, object_name: str | None = None, retreat_m: float = 0.03
) -> TouchPoint:
    """Touch the panel (or the top of an object) at a point of the panel frame, along the panel's normal.

    Args:
        point_m: expected surface point in the panel frame, m.
        object_name: the object that will be touched; None means the plate.

    Raises:
        SkillFailure: no contact up to 12 mm behind the expected surface (`missed`), or the force limit was reached.
        Unreachable: there is no collision-free path.
    """
    attempt = Attempt(context)
    x, y, z = (float(v) for v in point_m)
    ways = [[panel_from_grip((x, y, z + up), turn) for up in (SLOW_FROM_M, 0.0, -BEYOND_M)] for turn in TURNS_RAD]
    attempt.begin(ways, may_touch=() if object_name is None else (object_name,), width_m=0.0, name="touch point")
    start = attempt.pose()
    guard = Guard(name="contact", quantity=Quantity.FORCE, limit=TOUCH_N, axis=(0.0, 0.0, -1.0))
    goal = shifted(start, (0.0, 0.0, SLOW_FROM_M + BEYOND_M))
    report = attempt.straight(goal, name="touch", speed_m_per_s=TOUCH_M_PER_S, guards=(guard,))
    attempt.advance(-retreat_m, name="leave touch point", speed_m_per_s=RETREAT_M_PER_S, stop_n=40.0)
    if report.tripped is None:
        raise SkillFailure(Outcome.MISSED, f"no surface within {1e3 * BEYOND_M:.0f} mm behind the expected point")
    return contact_of(report, finger_half_m=context.hand.closed_half_m)


def contact_of(report: MotionReport, *, finger_half_m: tuple[float, float]) -> TouchPoint:
    """Return the point of first contact of a guarded approach along the fingers.

    The pads are compressed, so the tip is past the surface when the guard trips. The force rises linearly with the depth,
    and the straight line through the samples above the sensor's noise is zero at the surface.
    """
    axis = report.base_from_tool.rotation.apply([0.0, 0.0, 1.0])
    depth = report.log.tip_m @ axis
    force = -report.log.wrench[:, 2]
    surface, _ = onset(depth, force, float(report.base_from_tool.translation @ axis))
    tip = report.base_from_tool.translation
    point = tip + (surface - tip @ axis) * axis
    R = matrix_of(report.base_from_tool)
    half_x, half_y = finger_half_m
    # The contact is anywhere on the rectangular face with equal probability: the variance is half^2 / 3.
    local = np.diag([half_x**2 / 3, half_y**2 / 3, NORMAL_SIGMA_M**2])
    return TouchPoint(
        point_m=point,
        covariance=R @ local @ R.T,
        normal=-axis,
        force_n=float(np.linalg.norm(report.wrench[:3])),
        stamp_s=report.ended_s,
        report=report,
    )


def proximity_probe(
    context: SkillContext,
    point_m: Sequence[float],
    *,
    flange_from_sensors: Sequence[RigidTransform],
    distance_m: float = 0.06,
    samples: int = 10,
    sigma_m: float = 0.001,
) -> tuple[ProximityPoint, ...]:
    """Hold the fingers `distance_m` above a point of the panel frame and average the readings of each proximity sensor.

    Args:
        flange_from_sensors: mounts in the order of the mover's `proximity_m`.
        sigma_m: one sigma of a single reading; the result has that of the mean, but at least a third of it.

    Raises:
        SkillFailure: no sensor saw a surface (`missed`).
        Unreachable: there is no collision-free path.
    """
    attempt = Attempt(context)
    x, y, z = (float(v) for v in point_m)
    ways = [[panel_from_grip((x, y, z + distance_m), turn)] * 2 for turn in TURNS_RAD]
    attempt.begin(ways, may_touch=(), width_m=0.0, name="proximity point")
    readings, poses = [], []
    for _ in range(samples):
        attempt.run(Hold(name="proximity sample", duration_s=0.01))
        state = context.mover.state()
        readings.append(state.proximity_m)
        poses.append(state.base_from_flange)
    table = np.array(readings, float)
    points = []
    for k, mount in enumerate(flange_from_sensors):
        seen = table[~np.isnan(table[:, k]), k] if table.size else np.empty(0)
        if len(seen) >= max(1, samples // 2):
            points.append(
                ProximityPoint(
                    base_from_sensor=poses[-1] * mount,
                    distance_m=float(np.median(seen)),
                    sigma_m=sigma_m * max(1.0 / 3.0, float(len(seen)) ** -0.5),
                    samples=len(seen),
                    stamp_s=context.mover.state().stamp_s,
                )
            )
    if not points:
        raise SkillFailure(Outcome.MISSED, "no proximity sensor saw a surface")
    return tuple(points)
