"""Drives through free space for a task; `manipulation` plans the motions from the facts that are known now."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.devices import DeviceKind
from hal.geometry import transform_rpy
from hal.motion import JointTrajectory, MotionOutcome, MotionReport
from manipulation import (
    CollisionBox,
    Hand,
    Kinematics,
    SkillContext,
    SpeedLimits,
    back_out_of,
    plan_to_first,
    plan_to_joints,
    stands_clear,
    step_back,
)
from manipulation import park as park_arm
from manipulation import reachable as reachable_poses
from service.operations.session import Session


def go_to_camera_view(session: Session, base_from_camera: Iterable[RigidTransform], *, name: str) -> MotionReport:
    """Drive the camera to the first of the poses that the arm reaches without collision.

    Raises:
        Unreachable: none of them is reachable.
    """
    flange_from_camera = session.mount(session.first(DeviceKind.CAMERA)).parent_from_child
    return go_to_first(session, (pose * flange_from_camera.inv() for pose in base_from_camera), name=name)


def go_to_first(
    session: Session, base_from_flange: Iterable[RigidTransform], *, name: str, thorough: bool = True
) -> MotionReport:
    """Drive the flange to the first of the poses that is reachable without collision; see `plan_to_first`.

    Raises:
        Unreachable: none of them is reachable; the error names the obstacle of the last one.
        Cancelled: the task was cancelled meanwhile.
    """
    way = plan_to_first(
        skill_context(session),
        base_from_flange,
        name=name,
        thorough=thorough,
        between=session.context.task.check_cancelled,
    )
    return _drive(session, way)


def reachable(session: Session, base_from_flange: Sequence[RigidTransform]) -> list[int]:
    """Return the indices of the poses in which the arm touches nothing; the path there is not checked."""
    return reachable_poses(skill_context(session), base_from_flange)


def go_to_joints(session: Session, goal_rad: Array, *, name: str) -> bool:
    """Drive to a joint vector; returns False, and moves nothing, when there is no free path."""
    way = plan_to_joints(skill_context(session), goal_rad, name=name)
    if way is not None:
        _drive(session, way)
    return way is not None


def _drive(session: Session, way: JointTrajectory) -> MotionReport:
    """Execute a transfer; after a contact, go a little way back along it, and raise."""
    report = session.run(way, expect=(MotionOutcome.COMPLETED, MotionOutcome.FAULT))
    if report.outcome is MotionOutcome.COMPLETED:
        return report
    if report.device is None:
        step_back(skill_context(session), report)
    raise session.failure(report)


def park(session: Session) -> None:
    """Move back from the panel if necessary, then drive to the parking position of the cell file."""
    park_arm(skill_context(session))


def leave_the_panel(session: Session) -> None:
    """Move away if the arm is where the panel may be, because no path can be planned there once its pose is unknown.

    With a located panel the arm parks; otherwise, for example after a restart, it moves back along the fingers.

    Raises:
        Unreachable: the arm did not get away.
    """
    context, room = skill_context(session), _where_the_panel_may_be(session)
    if stands_clear(context, room):
        return
    if session.world.base_from_panel is not None:
        park_arm(context)
    else:
        back_out_of(context, room)


def skill_context(session: Session) -> SkillContext:
    """Return the inputs of skills from the known facts; an unlocated panel blocks all the space where it may be."""
    file = session.cell.file
    return SkillContext(
        mover=session.mover,
        kinematics=kinematics(session),
        panel=session.panel,
        base_from_panel=session.believed_panel(),
        flange_from_grip=session.mount(session.first(DeviceKind.GRIPPER)).parent_from_child,
        limits=SpeedLimits(tip_m_per_s=file.safety.speed_limit_m_per_s),
        hand=Hand.of(file.hand),
        park_rad=np.array(file.workspace.park_rad),
        angles_rad=lever_angles(session),
        floor_z_m=file.workspace.floor_z_m,
        obstacles=() if session.world.base_from_panel is not None else (_where_the_panel_may_be(session),),
        seed=file.cell.seed,
        progress=session.progress,
    )


def kinematics(session: Session) -> Kinematics:
    """Return the arm's kinematics, which are built once per cell."""
    connection = session.connection
    return session.world.kinematics(
        lambda: Kinematics.of(connection.device(session.first(DeviceKind.ARM)).capabilities())
    )


def lever_angles(session: Session) -> Mapping[str, float]:
    """Return the angles of the levers and selectors that have been read: the angle itself, or that of the state."""
    found: dict[str, float] = {}
    for one in session.panel.objects:
        reading, resting = session.world.readings.get(one.name), one.resting_angles
        if reading is None or not reading.answered or not resting:
            continue
        if one.value_is_angle and reading.value is not None:
            found[one.name] = reading.value
        elif reading.state is not None and reading.state in resting:
            found[one.name] = resting[reading.state]
    return found


def _where_the_panel_may_be(session: Session) -> CollisionBox:
    w, panel = session.cell.file.workspace, session.panel
    slack = w.position_tolerance_m + 0.5 * max(panel.width_m, panel.height_m) * np.sin(w.angle_tolerance_rad)
    return CollisionBox(
        name="where the panel may be",
        parent_from_box=transform_rpy(w.panel_position_m, w.panel_rpy_rad),
        half_m=(panel.width_m / 2 + w.position_tolerance_m, panel.height_m / 2 + w.position_tolerance_m, float(slack)),
    )
