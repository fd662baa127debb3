"""Travel through free space: chooses the arm configuration and a collision-free path to it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import MotionError, Stopped, Unreachable
from hal.motion import JointTrajectory
from manipulation.planning.collision import CollisionModel
from manipulation.planning.shapes import CollisionBox
from manipulation.planning.transfer import QUICK, THOROUGH, Effort
from manipulation.skills.attempt import Attempt
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import SkillFailure
from manipulation.skills.retreat import retreat

ENOUGH_CONDITIONING = 0.06  # least ratio of smallest to largest singular value; below it small moves need fast wrists
CLEAR_M = 0.004
MOST_TRIES, MOST_THOROUGH = 24, 3  # goals that are searched for quickly, and then thoroughly
# Largest turn of a joint that counts as near; a move to another branch of the arm takes 3.9 s instead of 1.1 s.
NEAR_RAD = 1.5
MOST_STEPS_BACK = 6  # of 50 mm each: more than the depth of the space that an unlocated panel may occupy


def _nothing() -> None:
    return None


def plan_to_first(
    context: SkillContext,
    base_from_flange: Iterable[RigidTransform],
    *,
    name: str,
    thorough: bool = True,
    between: Callable[[], None] = _nothing,
) -> JointTrajectory:
    """Plan a path for the flange to the first of the poses that is reachable without collision.

    Near goals are tried before those that need another branch of the arm, and every goal gets a quick search before any
    gets a long one, because a long search that finds no path takes ten seconds.

    Args:
        thorough: False where other poses would do as well, and only quick searches are worth their time.
        between: called before each search; may raise to give up.

    Raises:
        Unreachable: there is no path to any of them; names the obstacle of the last one.
    """
    state = context.mover.state()
    model = context.collision(width_m=state.gripper_width_m)
    tried: list[Array] = []
    reason = "no arm configuration reaches any of the poses"

    def goals() -> Iterator[tuple[Array, Effort]]:
        every = (goal for pose in base_from_flange for goal in clear_goals(model, pose, state.position_rad))
        for goal in islice(near_first(every, state.position_rad), MOST_TRIES):
            tried.append(goal)
            yield goal, QUICK
        if thorough:
            yield from ((goal, THOROUGH) for goal in tried[:MOST_THOROUGH])

    for goal, effort in goals():
        between()
        try:
            return context.transfer(state.position_rad, goal, width_m=state.gripper_width_m, name=name, effort=effort)
        except Unreachable as error:
            reason = error.what
    raise Unreachable(f"{name}: {reason}", hint="move the panel or the arm's foot; see workspace in the cell file")


def plan_to_joints(context: SkillContext, goal_rad: Array, *, name: str) -> JointTrajectory | None:
    """Plan a path to a joint vector (n,); None when there is none."""
    state = context.mover.state()
    if not context.collision(width_m=state.gripper_width_m).is_clear(goal_rad, margin_m=CLEAR_M):
        return None
    try:
        return context.transfer(state.position_rad, goal_rad, width_m=state.gripper_width_m, name=name)
    except Unreachable:
        return None


def reachable(context: SkillContext, base_from_flange: Sequence[RigidTransform]) -> list[int]:
    """Return the indices of the poses in which the arm touches nothing; the path there is not checked."""
    state = context.mover.state()
    model = context.collision(width_m=state.gripper_width_m)
    return [k for k, pose in enumerate(base_from_flange) if clear_goals(model, pose, state.position_rad)]


def stands_clear(context: SkillContext, room: CollisionBox) -> bool:
    """Return whether the arm is clear of everything and outside `room`."""
    state = context.mover.state()
    model = replace(context, obstacles=(room,)).collision(width_m=state.gripper_width_m)
    return model.is_clear(state.position_rad, margin_m=CLEAR_M)


def back_out_of(context: SkillContext, room: CollisionBox) -> None:
    """Move back along the fingers until the arm is outside `room`, where no path can be planned.

    Raises:
        Unreachable: the arm did not get out.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    try:
        retreat(context)
    except Stopped:
        raise
    except MotionError:
        pass  # the steps below show whether the hand came free
    attempt = Attempt(context)
    for _ in range(MOST_STEPS_BACK):
        if stands_clear(context, room):
            return
        with suppress(SkillFailure):  # stopped by a strong contact; the next check shows whether the arm is clear
            attempt.leave()
    raise Unreachable(
        f"the arm stands where the panel may be, and {MOST_STEPS_BACK} steps back along its fingers did not free it",
        hint="drive it away from the panel by its own control, then send this again",
    )


def near_first(goals: Iterable[Array], here: Array) -> Iterator[Array]:
    """Yield the goals within `NEAR_RAD` of the joints `here` as they come, then the others in their order."""
    far: list[Array] = []
    for goal in goals:
        if np.abs(goal - here).max() <= NEAR_RAD:
            yield goal
        else:
            far.append(goal)
    yield from far


def clear_goals(model: CollisionModel, base_from_flange: RigidTransform, here: Array) -> list[Array]:
    """Return up to three well-conditioned, collision-free arm configurations for a flange pose, nearest first."""
    found = [
        q
        for q in model.kinematics.inverse(base_from_flange)
        if model.kinematics.conditioning(q) > ENOUGH_CONDITIONING and model.is_clear(q, margin_m=CLEAR_M)
    ]
    return sorted(found, key=lambda q: float(np.abs(q - here).max()))[:3]
