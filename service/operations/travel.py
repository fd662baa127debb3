"""Driving through free space: which arm configuration, along which collision-free way."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import Unreachable
from hal.geometry import transform_rpy
from hal.motion import MotionReport
from manipulation import (
    QUICK,
    THOROUGH,
    Attempt,
    CollisionBox,
    CollisionModel,
    Effort,
    Kinematics,
    SkillContext,
    SkillFailure,
    SpeedLimits,
    retreat,
)
from manipulation import park as park_arm
from service.operations.session import Session

ENOUGH_CONDITIONING = 0.06  # smallest singular value over the largest: below it, small moves need fast wrists
CLEAR_M = 0.004
MOST_TRIES, MOST_THOROUGH = 24, 3  # goals that are searched for quickly, and then thoroughly
# The largest turn of a joint between neighbouring views; 3.9 s to another branch of the arm, 1.1 s without.
NEAR_RAD = 1.5
MOST_STEPS_BACK = 6  # of 50 mm: further than the room of an unlocated panel reaches


def go_to_camera_view(session: Session, base_from_camera: Iterable[RigidTransform], *, name: str) -> MotionReport:
    """Drive the camera to the first of the poses that the arm reaches without collision.

    Raises:
        Unreachable: none of them.
    """
    flange_from_camera = session.mount(session.first(DeviceKind.CAMERA)).parent_from_child
    return go_to_first(session, (pose * flange_from_camera.inv() for pose in base_from_camera), name=name)


def go_to_first(
    session: Session, base_from_flange: Iterable[RigidTransform], *, name: str, thorough: bool = True
) -> MotionReport:
    """Drive the flange to the first of the poses that is reachable without collision.

    A pose that is near by goes before one that another branch of the arm must be taken for, and one that a quick search
    finds a way to before one that needs a long search: where there is no way, a long one takes ten seconds.

    Args:
        thorough: False where other poses would do as well: only quick searches.

    Raises:
        Unreachable: none of them; says what is in the way of the last one.
    """
    context = skill_context(session)
    state = session.mover.state()
    model = context.collision(width_m=state.gripper_width_m)
    tried: list[Array] = []
    reason = "no arm configuration reaches any of the poses"

    def goals() -> Iterator[tuple[Array, Effort]]:
        every = (goal for pose in base_from_flange for goal in _goals(model, pose, state.position_rad))
        for goal in islice(near_first(every, state.position_rad), MOST_TRIES):
            tried.append(goal)
            yield goal, QUICK
        if thorough:
            yield from ((goal, THOROUGH) for goal in tried[:MOST_THOROUGH])

    for goal, effort in goals():
        session.context.task.check_cancelled()
        try:
            way = context.transfer(state.position_rad, goal, width_m=state.gripper_width_m, name=name, effort=effort)
        except Unreachable as error:
            reason = error.what
            continue
        return session.run(way)
    raise Unreachable(f"{name}: {reason}", hint="move the panel or the arm's foot; see workspace in the cell file")


def reachable(session: Session, base_from_flange: Sequence[RigidTransform]) -> list[int]:
    """Which of the poses the arm can stand in without touching anything; says nothing about the way there."""
    state = session.mover.state()
    model = skill_context(session).collision(width_m=state.gripper_width_m)
    return [k for k, pose in enumerate(base_from_flange) if _goals(model, pose, state.position_rad)]


def go_to_joints(session: Session, goal_rad: Array, *, name: str) -> bool:
    """Drive to a joint vector; False when something is in the way, and nothing moved."""
    context = skill_context(session)
    state = session.mover.state()
    if not context.collision(width_m=state.gripper_width_m).is_clear(goal_rad, margin_m=CLEAR_M):
        return False
    try:
        trajectory = context.transfer(state.position_rad, goal_rad, width_m=state.gripper_width_m, name=name)
    except Unreachable:
        return False
    session.run(trajectory)
    return True


def park(session: Session) -> None:
    """Back off from the panel if need be, then drive to the parking place of the cell file."""
    park_arm(skill_context(session))


def leave_the_panel(session: Session) -> None:
    """Go away if the arm stands where the panel may be, as after a deed: with no belief no way can be planned there.

    With a located panel it parks; otherwise, as after a restart in the middle of work, it backs off along the fingers.

    Raises:
        Unreachable: it did not get away.
    """
    if _stands_clear(session):
        return
    if session.world.base_from_panel is not None:
        park(session)
        return
    context = skill_context(session)
    retreat(context)
    attempt = Attempt(context)
    for _ in range(MOST_STEPS_BACK):
        if _stands_clear(session):
            return
        with suppress(SkillFailure):  # something strong in the way: the next look tells
            attempt.leave()
    raise Unreachable(
        f"the arm stands where the panel may be, and {MOST_STEPS_BACK} steps back along its fingers did not free it",
        hint="drive it away from the panel by its own control, then send this again",
    )


def skill_context(session: Session) -> SkillContext:
    """What skills work with, from what is known now; an unlocated panel takes all the room that it may stand in."""
    file = session.cell.file
    return SkillContext(
        mover=session.mover,
        kinematics=kinematics(session),
        panel=session.panel,
        base_from_panel=session.believed_panel(),
        flange_from_grip=session.mount(session.first(DeviceKind.GRIPPER)).parent_from_child,
        limits=SpeedLimits(tip_m_per_s=file.safety.speed_limit_m_per_s),
        park_rad=np.array(file.workspace.park_rad),
        angles_rad=lever_angles(session),
        floor_z_m=file.workspace.floor_z_m,
        obstacles=() if session.world.base_from_panel is not None else (_where_the_panel_may_be(session),),
        seed=file.cell.seed,
        progress=session.progress,
    )


def kinematics(session: Session) -> Kinematics:
    """The arm's kinematics, made once a cell."""
    connection = session.connection
    return session.world.kinematics(
        lambda: Kinematics.of(connection.device(session.first(DeviceKind.ARM)).capabilities())
    )


def lever_angles(session: Session) -> Mapping[str, float]:
    """Angles of the levers and selectors whose state has been read."""
    readings = session.world.readings
    return {
        name: angles[state]
        for name, angles in ((one.name, one.resting_angles) for one in session.panel.objects)
        if name in readings and (state := readings[name].state) is not None and state in angles
    }


def _stands_clear(session: Session) -> bool:
    """Is the arm outside all the room that an unlocated panel may take?"""
    context = replace(skill_context(session), obstacles=(_where_the_panel_may_be(session),))
    state = session.mover.state()
    return context.collision(width_m=state.gripper_width_m).is_clear(state.position_rad, margin_m=CLEAR_M)


def _where_the_panel_may_be(session: Session) -> CollisionBox:
    w, panel = session.cell.file.workspace, session.panel
    slack = w.position_tolerance_m + 0.5 * max(panel.width_m, panel.height_m) * np.sin(w.angle_tolerance_rad)
    return CollisionBox(
        name="where the panel may be",
        parent_from_box=transform_rpy(w.panel_position_m, w.panel_rpy_rad),
        half_m=(panel.width_m / 2 + w.position_tolerance_m, panel.height_m / 2 + w.position_tolerance_m, float(slack)),
    )


def near_first(goals: Iterable[Array], here: Array) -> Iterator[Array]:
    """The goals within `NEAR_RAD` of the joints `here` as they come, then the others in their order."""
    far: list[Array] = []
    for goal in goals:
        if np.abs(goal - here).max() <= NEAR_RAD:
            yield goal
        else:
            far.append(goal)
    yield from far


def _goals(model: CollisionModel, base_from_flange: RigidTransform, here: Array) -> list[Array]:
    """Arm configurations for a flange pose, well-conditioned and free ones, nearest first."""
    found = [
        q
        for q in model.kinematics.inverse(base_from_flange)
        if model.kinematics.conditioning(q) > ENOUGH_CONDITIONING and model.is_clear(q, margin_m=CLEAR_M)
    ]
    return sorted(found, key=lambda q: float(np.abs(q - here).max()))[:3]
