"""Guarded moves until contact.

The pads are compressed under load, so the place of first contact is computed from the rise of the force.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.motion import CartesianPath, Compliance, Guard, Hold, MotionReport, Quantity
from manipulation.planning.cartesian_path import shifted
from manipulation.skills.attempt import Attempt
from manipulation.skills.outcome import Outcome, SkillFailure

INF = float("inf")
FEEL_N = 3.0  # too little to move a lever, or a knob pushed from its side
FEEL_M_PER_S = 0.03
# At a hard stop the force overshoots by stiffness x speed x reaction time; a soft push along or across the fingers
# limits the stiffness to 4 kN/m, whatever is touched.
SOFT_PUSH = Compliance(
    stiffness=(4000.0, 4000.0, 4000.0, INF, INF, INF),
    damping=(500.0, 500.0, 500.0, 10.0, 10.0, 10.0),
    mass=(20.0, 20.0, 20.0, 1.0, 1.0, 1.0),
    max_offset_m=0.015,
)
RELAX_S = 0.5
FREE_N, FREE_NM = 1.5, 0.1  # of a hand on which nothing presses
RELAXING = Compliance(
    stiffness=(50.0, 50.0, 400.0, INF, INF, 0.5),
    damping=(1500.0, 1500.0, 4000.0, 10.0, 10.0, 2.0),
    mass=(150.0, 150.0, 400.0, 1.0, 1.0, 0.1),
    max_offset_m=0.012,
    max_offset_rad=0.5,
)
ONSET_N = 1.0  # above noise, drift and inertia in a slow move
QUIET_N, QUIET_M = 0.4, 0.00025  # a smaller force may be noise, or the first part of a contact, which is not longer
COARSE_RAD = 5e-4  # joint steps of this size or more cause larger inertial forces than a light contact
REST_S = 0.12  # vibration has decayed by then, and the mean over the second half resolves 0.1 N
REST_RATIO = 0.4  # of the force that stopped the move; creeping pads and friction may reduce it this far
LEAST_M = 0.0005
LIGHT = "light contact"
START_SHARE = 0.2  # of the samples of a move: the arm speeds up, which looks like a light contact
MOST_TRIES = 24  # an object that yields at once leaves no force at rest either, so the number of tries is limited


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Meeting:
    """Result of a guarded move that should make contact.

    Attributes:
        way_m: distance from the start of the move to the place of first contact, along the move.
        give_n_per_m: rise of the force per metre beyond it; 0 when there are too few samples.
        is_met: whether the guard tripped.
    """

    way_m: float
    give_n_per_m: float
    is_met: bool
    report: MotionReport


def meet(
    attempt: Attempt,
    goal: RigidTransform,
    *,
    name: str,
    speed_m_per_s: float,
    stop_n: float,
    ticks: int = 2,
    light: tuple[float, int] | None = None,
) -> Meeting:
    """Move straight to `goal` (base_from_grip, same rotation) until a force of `stop_n` against the motion.

    If the arm moves in jerks, the hand's own inertia can look like a contact: a servo resolution of 1.5 mrad causes
    several newtons. On such an arm a force that is gone at rest was no contact, and the move goes on.

    Args:
        light: a smaller force (N) that is also a contact if it lasts for a number of ticks, as that of an object that
            yields does; not on an arm that moves in jerks.
    """
    start = attempt.pose()
    ahead = goal.translation - start.translation
    length = float(np.linalg.norm(ahead))
    unit = ahead / length
    in_tool = start.rotation.inv().apply(-unit)
    axis = (float(in_tool[0]), float(in_tool[1]), float(in_tool[2]))
    guards = [Guard(name="contact", quantity=Quantity.FORCE, limit=stop_n, axis=axis, ticks=ticks)]
    if light is not None and not _shakes(attempt):
        guards.append(Guard(name=LIGHT, quantity=Quantity.FORCE, limit=light[0], axis=axis, ticks=light[1]))
    for _ in range(MOST_TRIES):
        report = attempt.straight(goal, name=name, speed_m_per_s=speed_m_per_s, guards=tuple(guards))
        deepest = float((report.base_from_tool.translation - start.translation) @ unit)
        if report.tripped is None or length - deepest < LEAST_M or not _shakes(attempt):
            break
        if force_at_rest_n(attempt, in_tool) >= REST_RATIO * stop_n:
            break
    depth = (report.log.tip_m - start.translation) @ unit
    force = report.log.wrench[:, :3] @ in_tool
    way, give = (step(depth, force), 0.0) if report.tripped == LIGHT else onset(depth, force, deepest)
    return Meeting(way_m=way, give_n_per_m=give, is_met=report.tripped is not None, report=report)


def relax(attempt: Attempt) -> None:
    """Stay and yield, also about the fingers, until nothing presses on the hand: what presses rubs when it leaves."""
    felt = attempt.reports[-1].wrench
    if np.linalg.norm(felt[:3]) < FREE_N and np.linalg.norm(felt[3:]) < FREE_NM:
        return
    here = attempt.pose()
    attempt.run(
        CartesianPath(
            name="relax", flange_from_tool=attempt.context.flange_from_grip, times_s=np.array([0.0, RELAX_S]),
            base_from_tool=(here, here), compliance=RELAXING,
        )
    )  # fmt: skip


def _shakes(attempt: Attempt) -> bool:
    return attempt.context.kinematics.capabilities.resolution_rad >= COARSE_RAD


def force_at_rest_n(attempt: Attempt, in_tool: Array) -> float:
    """Return the mean force along a unit vector in tool axes while the arm stands still and does not vibrate, N."""
    wrench = attempt.run(Hold(name="feel at rest", duration_s=REST_S)).log.wrench
    return float(np.mean(wrench[len(wrench) // 2 :, :3] @ in_tool))


def onset(depth_m: Array, force_n: Array, deepest_m: float) -> tuple[float, float]:
    """Return the depth (m) at which the straight line fitted to the rising force is zero, and its slope (N/m).

    Args:
        depth_m, force_n: (N,) in the order of time.
        deepest_m: the depth to return when no sample shows a force.
    """
    # Only the last unbroken rise counts, because the arm's inertia can look like 1 N of contact while it speeds up.
    below = np.flatnonzero(force_n < ONSET_N)
    first = 0 if len(below) == 0 else int(below[-1]) + 1
    if first >= len(force_n):
        return deepest_m, 0.0
    d, f = depth_m[first:], force_n[first:]
    if len(d) < 3 or np.ptp(d) < 1e-5:
        return float(d[0]), 0.0
    slope, offset = np.polyfit(d, f, 1)
    if slope <= 0.0:
        return float(d[0]), 0.0
    # The line through the force of a spring with preload is zero up to 2 mm before the contact.
    quiet = np.flatnonzero(force_n[:first] < QUIET_N)
    free_m = float(depth_m[quiet[-1]]) if len(quiet) else float(depth_m[0])
    earliest_m = max(float(depth_m[0]), free_m - min(QUIET_N / slope, QUIET_M))
    return float(np.clip(-offset / slope, earliest_m, d[0])), float(slope)


def step(depth_m: Array, force_n: Array) -> float:
    """Return the depth (m) at which a force that stays constant begins: the best split into two means.

    Args:
        depth_m, force_n: (N,) in the order of time; the last samples show the force.
    """
    first = min(int(START_SHARE * len(force_n)), max(0, len(force_n) - 6))
    f = force_n[first:]
    if len(f) < 4:
        return float(depth_m[-1])
    n = np.arange(1, len(f))
    total = np.cumsum(f)
    before, after = total[:-1] / n, (total[-1] - total[:-1]) / (len(f) - n)
    gain = np.where(after > before, n * (len(f) - n) * (after - before) ** 2, 0.0)
    return float(depth_m[first + 1 + int(gain.argmax())])


def centre_between(attempt: Attempt, *, room_m: float, what: str) -> None:
    """Feel the object between the open fingers on both sides and go to the middle, before a cage or a grasp.

    Args:
        room_m: largest distance to the object on each side.
        what: its name, for the cause.

    Raises:
        SkillFailure: there is no contact on one of the sides (`missed`).
    """
    start = attempt.pose()
    across = start.rotation.apply([1.0, 0.0, 0.0])
    places = []
    for side in (1.0, -1.0):
        begun = float((attempt.pose().translation - start.translation) @ across)
        goal = shifted(start, (side * room_m, 0.0, 0.0))
        met = meet(attempt, goal, name="feel", speed_m_per_s=FEEL_M_PER_S, stop_n=FEEL_N)
        if not met.is_met:
            raise SkillFailure(Outcome.MISSED, f"there is no {what} between the fingers")
        places.append(begun + side * met.way_m)
    middle = shifted(start, (0.5 * (places[0] + places[1]), 0.0, 0.0))
    attempt.straight(middle, name="centre", speed_m_per_s=FEEL_M_PER_S)
