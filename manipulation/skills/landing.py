"""Brings open fingers down between the parts of an object; from what a finger lands on, it goes aside and tries again.

The wrench at rest shows what a finger has landed on: a flank pushes the finger aside, and where nothing does, the torque
about the tips shows which part of which finger is loaded.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.motion import Compliance, Guard, Hold, Quantity
from manipulation.planning.cartesian_path import shifted
from manipulation.planning.hand import Hand
from manipulation.skills.attempt import APPROACH_M_PER_S, CONTACT_N, Attempt
from manipulation.skills.outcome import Outcome, SkillFailure

TRIES = 4
LIFT_M = 0.006
ASIDE_M = 0.0025  # of one try; about what the places of a finger and of what it fits between are known to
REST_S = 0.12
FLANK_RATIO = 0.2  # of the force along the fingers: with less across them, a finger stands on top of something
BETWEEN_RATIO = 0.5  # of the distance of a finger from the middle: a load nearer to the middle is one on both fingers
INF = float("inf")
# Soft across the fingers, so that a finger that meets a flank slides down beside it.
SLIDING = Compliance(
    stiffness=(600.0, 600.0, INF, INF, INF, INF),
    damping=(400.0,) * 3 + (10.0,) * 3,
    mass=(20.0,) * 3 + (1.0,) * 3,
    max_offset_m=0.004,
)


def come_down(attempt: Attempt, distance_m: float, *, what: str) -> None:
    """Move along the fingers by `distance_m`.

    Raises:
        SkillFailure: a finger landed on the object in every try.
    """
    goal = shifted(attempt.pose(), (0.0, 0.0, distance_m))
    guard = Guard(name="contact", quantity=Quantity.FORCE, limit=CONTACT_N, axis=(0.0, 0.0, -1.0))
    for number in range(TRIES):
        down = attempt.straight(
            goal, name="approach", speed_m_per_s=APPROACH_M_PER_S, guards=(guard,), compliance=SLIDING
        )
        if down.tripped is None:
            return
        if number + 1 == TRIES:
            break
        wrench = _wrench_at_rest(attempt)
        width_m = attempt.context.mover.state().gripper_width_m
        aside = away_from_load(wrench, attempt.context.hand, width_m)
        lifted = shifted(attempt.pose(), (0.0, 0.0, -LIFT_M))
        attempt.straight(lifted, name="lift", speed_m_per_s=APPROACH_M_PER_S)
        if aside is None:
            break
        offset = ASIDE_M * 0.5**number * aside  # a finger that lands on the other side has gone too far
        attempt.straight(shifted(attempt.pose(), offset), name="aside", speed_m_per_s=APPROACH_M_PER_S)
        goal = _below(attempt.pose(), goal)
    raise SkillFailure(Outcome.MISSED, f"a finger landed on {what}")


def away_from_load(wrench: Array, hand: Hand, width_m: float) -> Array | None:
    """Return the direction (3,) across the fingers that leads away from what loads them; None when both are loaded.

    Args:
        wrench: contact wrench (6,) in tool axes about the tips, of a hand that stands on something.
        width_m: opening of the fingers.
    """
    push_n = max(1e-6, -float(wrench[2]))
    across = np.array([wrench[0], wrench[1], 0.0])
    if np.linalg.norm(across) > FLANK_RATIO * push_n:
        return np.asarray(across / np.linalg.norm(across))
    # A force (0, 0, -F) at (x, y, 0) has the torque (-y F, x F, 0) about the tips.
    x, y = float(wrench[4]) / push_n, -float(wrench[3]) / push_n
    middle = 0.5 * (width_m + hand.finger_thickness_m)
    if abs(x) < BETWEEN_RATIO * middle:
        return None
    from_middle = np.array(
        [2.0 * (x - np.sign(x) * middle) / hand.finger_thickness_m, 2.0 * y / hand.finger_width_m, 0.0]
    )
    length = float(np.linalg.norm(from_middle))
    return None if length < 1e-9 else np.asarray(-from_middle / length)


def _wrench_at_rest(attempt: Attempt) -> Array:
    wrench = attempt.run(Hold(name="feel at rest", duration_s=REST_S)).log.wrench
    return np.asarray(wrench[len(wrench) // 2 :].mean(axis=0))


def _below(pose: RigidTransform, goal: RigidTransform) -> RigidTransform:
    """Return the pose below `pose`, as deep as `goal` and turned like it."""
    depth_m = float(goal.inv().apply(pose.translation)[2])
    return RigidTransform.from_components(pose.translation, goal.rotation) * RigidTransform.from_translation(
        [0.0, 0.0, -depth_m]
    )
