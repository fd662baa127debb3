"""Drives through free space for a task; `manipulation` plans the motions from the facts that are known now."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import MotionRefused, Unreachable
from hal.geometry import transform_rpy
from hal.motion import DeclaredMotion, JointTrajectory, MotionOutcome, MotionReport, RobotState
from hal.panel import Panel, PanelObject, Shown
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
from perception.vision import viewpoints
from service.missions.progress import Progress
from service.operations.session import Session
from service.schema.mission_file import FeelStep, InspectStep, SetStep, conditions_of
from service.schema.mission_results import MissionPlan, MissionResult, PlannedStation


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
        shown={
            name: Shown(value=one.value, state=one.state)
            for name, one in session.world.readings.items()
            if one.answered
        },
        floor_z_m=file.workspace.floor_z_m,
        obstacles=(session.world.obstacles or ())
        if session.world.base_from_panel is not None
        else (_where_the_panel_may_be(session),),
        seed=file.cell.seed,
        progress=session.progress,
    )


def kinematics(session: Session) -> Kinematics:
    """Return the arm's kinematics, which are built once per cell."""
    connection = session.connection
    return session.world.kinematics(
        lambda: Kinematics.of(
            connection.device(session.first(DeviceKind.ARM)).capabilities(),
            connection.cell.file.safety.joint_limits_rad,
        )
    )


def _where_the_panel_may_be(session: Session) -> CollisionBox:
    w, panel = session.cell.file.workspace, session.panel
    slack = w.position_tolerance_m + 0.5 * max(panel.width_m, panel.height_m) * np.sin(w.angle_tolerance_rad)
    return CollisionBox(
        name="where the panel may be",
        parent_from_box=transform_rpy(w.panel_position_m, w.panel_rpy_rad),
        half_m=(panel.width_m / 2 + w.position_tolerance_m, panel.height_m / 2 + w.position_tolerance_m, float(slack)),
    )


POINTS_SHOWN = 24  # of each planned way
CONTACT_S = (
    15.0  # of the cell's clock at one control, from standoff to standoff: the mean of the bench panel's controls
)


def plan_mission(session: Session, progress: Progress) -> MissionResult:
    """Plan the stations of a mission from where the arm is now; nothing moves.

    The panel is taken to be where it was located last or, if it was not, where the cell file expects it.
    """
    pose = session.believed_panel().parent_from_child
    lens, panel = session.lens(), session.panel
    planner = _Planner(session)
    planner.add("", "overview", viewpoints.overview_poses(pose, panel, lens, 0.01))
    contacts = 0
    for step in progress.all_steps():
        names = {condition.object for condition in conditions_of(step)}
        if isinstance(step, InspectStep):
            names |= set(step.objects or [one.name for one in panel.objects])
        planner.add_close_ups(step.name, [one for one in panel.objects if one.name in names])
        if isinstance(step, SetStep):
            worked = [panel.object(step.object)] if step.object else _one_of_each_kind(panel)
            for one in worked:
                planner.add_close_ups(step.name, [panel.object(one.shown_by)])
            contacts += len(worked)
        contacts += step.touches if isinstance(step, FeelStep) else 0
    planner.add_park()
    ways_s = sum(station.way_s or 0.0 for station in planner.stations)
    plan = MissionPlan(
        stations=planner.stations,
        is_possible=all(station.problem is None for station in planner.stations),
        located=session.world.base_from_panel is not None,
        ways_s=ways_s,
        contact_s=CONTACT_S * contacts,
        expected_s=ways_s + CONTACT_S * contacts,
    )
    return MissionResult(
        mission="", succeeded=True, report=None, actions=[], fused=None, depths=[], plan=plan, cell_s=0.0, wall_s=0.0
    )


def _one_of_each_kind(panel: Panel) -> list[PanelObject]:
    """Return the controls that a step with `each_kind` operates."""
    ranked = [one for one in panel.objects if one.mission_rank is not None and not one.forbidden and not one.confirm]
    first: dict[str, PanelObject] = {}
    for one in sorted(ranked, key=lambda each: each.mission_rank or 0.0):
        first.setdefault(one.kind, one)
    return list(first.values())


class _Planner:
    """Plans one way after the other, each from the end of the one before."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._context = replace(skill_context(session), obstacles=session.world.obstacles or ())
        self._state = session.mover.state()
        self._flange_from_camera = session.mount(session.first(DeviceKind.CAMERA)).parent_from_child
        self.stations: list[PlannedStation] = []

    def add(self, step: str, what: str, base_from_camera: Iterable[RigidTransform]) -> None:
        """Plan the way of the camera to the first of the poses that can be reached."""
        self._session.progress(0.5, "plan", what)
        poses = (pose * self._flange_from_camera.inv() for pose in base_from_camera)
        check = self._session.context.task.check_cancelled
        try:
            way = plan_to_first(self._from_here(), poses, name=what, thorough=False, between=check)
        except Unreachable as error:
            self._note(step, what, None, error.what)
        else:
            self._note(step, what, way, None)

    def add_close_ups(self, step: str, objects: Sequence[PanelObject]) -> None:
        """Plan the ways to the views in which the objects are read."""
        distance_m = viewpoints.reading_distance_m(self._session.lens())
        pose = self._session.believed_panel().parent_from_child
        for centre_m, names in viewpoints.close_up_groups(objects, self._session.lens(), distance_m) if objects else ():
            self.add(
                step, f"close-up of {', '.join(names)}", viewpoints.close_up_poses(pose, tuple(centre_m), distance_m)
            )

    def add_park(self) -> None:
        """Plan the way to the parking position."""
        way = plan_to_joints(self._from_here(), self._context.park_rad, name="park")
        self._note("", "park", way, None if way is not None else "there is no free way to the parking position")

    def _from_here(self) -> SkillContext:
        return replace(self._context, mover=_Standing(self._state))

    def _note(self, step: str, what: str, way: JointTrajectory | None, problem: str | None) -> None:
        way_s, flange_m = None, list[list[float]]()
        if way is not None:
            way_s = float(way.times_s[-1])
            self._state = replace(self._state, position_rad=way.positions_rad[-1])
            shown = way.positions_rad[np.linspace(0, len(way.positions_rad) - 1, POINTS_SHOWN).round().astype(int)]
            flange_m = [np.round(self._context.kinematics.flange(q).translation, 4).tolist() for q in shown]
        self.stations.append(PlannedStation(step=step, what=what, way_s=way_s, problem=problem, flange_m=flange_m))


class _Standing:
    """A motion port of an arm that stands somewhere and cannot move, for planning."""

    def __init__(self, state: RobotState) -> None:
        self._state = state

    def state(self) -> RobotState:
        """Return where the arm stands."""
        return self._state

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        """Refuse any motion."""
        raise MotionRefused(f"{motion.name} was to be planned only", hint="please report this defect")

    def tare(self) -> Array:
        """Refuse, as for a motion."""
        raise MotionRefused("the sensor cannot be zeroed while a mission is planned", hint="please report this defect")

    def cancel(self) -> None:
        """Do nothing, because nothing moves."""
