"""Rehearses a skill up to its first motion: is there room for the hand at the control, whatever the pose of the panel?

The skill itself runs, with a context that checks only the hand against the plate and the other objects, in the frame of
the panel. What is refused here would therefore be refused by the skill too, after the arm had moved there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import NoRoom
from hal.geometry import certain, identity, matrix_of
from hal.motion import DeclaredMotion, MotionReport, RobotState
from hal.panel import NumberGoal, Panel, PanelObject, Shown
from manipulation.arm.kinematics import Kinematics
from manipulation.planning.clearance import segment_box
from manipulation.planning.hand import Hand
from manipulation.planning.shapes import Capsule, CollisionBox, envelope, panel_boxes
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.skills.context import FINGERS, STROKE_MARGIN_M, Blocked, SkillContext
from manipulation.skills.operate import operate
from manipulation.skills.outcome import ObjectState

NEAR_RAD = 0.2  # a stroke to an angle comes from this far before it, whatever its start
AROUND_RAD = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)[1:]


class _Fits(Exception):
    """There is room for the hand, which ends the rehearsal."""


class _Moves(Exception):
    """The skill would move now, which ends the rehearsal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gap:
    """Least free space on a stroke, m, negative where the hand would overlap; between which part of it and what."""

    free_m: float
    part: str
    obstacle: str


class _StillMover:
    """A mover of an arm that stands still."""

    def __init__(self, joints: int) -> None:
        self._joints = np.zeros(joints)

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        raise _Moves(motion.name)

    def cancel(self) -> None:
        return None

    def tare(self) -> Array:
        raise _Moves("tare")

    def state(self) -> RobotState:
        return RobotState(
            stamp_s=0.0, position_rad=self._joints, velocity_rad_per_s=np.zeros_like(self._joints),
            base_from_flange=identity(), wrench=np.zeros(6), contacts=(), proximity_m=(),
            gripper_width_m=0.0, is_moving=False, is_stopped=False,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rehearsal(SkillContext):
    """A context without an arm, whose choice of a stroke looks at the hand alone; `tried` keeps what is in the way."""

    tried: list[Gap] = field(default_factory=list)

    def choose(
        self,
        options: Sequence[Sequence[RigidTransform]],
        *,
        near_rad: Array,  # noqa: ARG002 - of the arm, which is left out here
        width_m: float,
        may_touch: Sequence[str],
        must_go_back: bool = False,  # noqa: ARG002 - of the arm, too
    ) -> tuple[int, Array]:
        """End the rehearsal if one of the strokes has room for the hand.

        Raises:
            Blocked: none has.
        """
        capsules = self.hand.capsules(self.flange_from_grip, width_m)
        obstacles = [_Obstacle.of([panel_boxes(self.panel)[0]])]
        for one in self.panel.objects:
            if one.name not in may_touch:
                places: list[Shown | None] = [Shown(state=name) for name in one.resting_angles]
                obstacles.append(_Obstacle.of([envelope(one, place) for place in places or [None]]))
        for poses in options:
            gaps = (gap for pose in poses for gap in _gaps(capsules, pose, obstacles))
            least = min(gaps, key=lambda gap: gap.free_m)
            if least.free_m >= STROKE_MARGIN_M:
                raise _Fits
            self.tried.append(least)
        raise Blocked("there is no room for the hand", hint="see what is in its way")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Obstacle:
    """The plate, or an object in each of its states: boxes as rotation (3, 3), middle (3,) and half edges (3,)."""

    name: str
    states: tuple[tuple[Array, Array, Array], ...]

    @classmethod
    def of(cls, boxes: Sequence[CollisionBox]) -> _Obstacle:
        poses = [(box.parent_from_box, np.array(box.half_m)) for box in boxes]
        states = tuple((matrix_of(pose), np.asarray(pose.translation), half) for pose, half in poses)
        return cls(name=boxes[0].name, states=states)


def _gaps(capsules: Sequence[Capsule], pose: RigidTransform, obstacles: Sequence[_Obstacle]) -> Iterator[Gap]:
    """Give the space between each part of the hand and each obstacle; of an obstacle's states the best one counts."""
    for capsule in capsules:
        start, end = pose.apply(np.array([capsule.start_m, capsule.end_m]))
        for obstacle in obstacles:
            if obstacle.name == "plate" and capsule.name in FINGERS:
                continue
            free_m = max(segment_box(start, end, *state) for state in obstacle.states)
            yield Gap(free_m=float(free_m) - capsule.radius_m, part=capsule.name, obstacle=obstacle.name)


def rehearse(kinematics: Kinematics, panel: Panel, hand: Hand, panel_object: PanelObject, goal: str | float) -> None:
    """Refuse a deed for which the hand has no room at the control in any state that the control may have now.

    Raises:
        NoRoom: what is in the way, and by how many millimetres.
        Unprovable: no look and no touch could confirm the goal.
        InvalidRequest, Unsupported: the skill refuses the goal, or needs another hand.
    """
    found: list[Gap] = []
    for current in _may_be_now(panel_object, goal):
        context = _Rehearsal(
            mover=_StillMover(len(kinematics.dh)), kinematics=kinematics, panel=panel,
            base_from_panel=certain(identity()), flange_from_grip=identity(),
            limits=SpeedLimits(tip_m_per_s=1.0), park_rad=np.zeros(len(kinematics.dh)), hand=hand,
        )  # fmt: skip
        try:
            operate(context, panel_object, goal, current=current)
        except _Fits:
            return
        except _Moves:
            pass  # to retreat, because it found no stroke; or it chose none
        if not context.tried:
            return
        found += context.tried
    best = max(found, key=lambda gap: gap.free_m)
    lacks_mm = 1e3 * (STROKE_MARGIN_M - best.free_m)
    raise NoRoom(
        f"{panel_object.name} stands too near to {best.obstacle}: on the best of {len(found)} strokes "
        f"{best.part} lacks {lacks_mm:.1f} mm of free space",
        hint=f"move {panel_object.name} or {best.obstacle} on the panel, correct the panel file, or use a slimmer hand",
        object=panel_object.name,
        obstacle=best.obstacle,
        lacks_mm=round(lacks_mm, 2),
    )


def _may_be_now(panel_object: PanelObject, goal: str | float) -> Iterator[ObjectState]:
    """Give states just before the goal, through which any stroke comes; of a wheel, all angles that it may stand at."""
    name, angles = panel_object.name, panel_object.resting_angles
    if isinstance(goal, str):
        if goal in angles:
            for side in (-NEAR_RAD, NEAR_RAD):
                yield ObjectState(name=name, angle_rad=angles[goal] + side)
        else:
            yield ObjectState(name=name)
        return
    wanted = panel_object.goal
    if not isinstance(wanted, NumberGoal):
        yield ObjectState(name=name)
    elif panel_object.turns_round:
        for angle in (*(goal - AROUND_RAD), *(goal + AROUND_RAD)):
            if wanted.low <= angle <= wanted.high:
                yield ObjectState(name=name, angle_rad=float(angle), turned_rad=float(angle))
    else:
        for value in (goal - wanted.tolerance, goal + wanted.tolerance):
            if wanted.low <= value <= wanted.high:
                yield ObjectState(name=name, value=value)


def out_of_reach_m(kinematics: Kinematics, flange_from_grip: RigidTransform, point_m: Array) -> float:
    """Return how far a point (3,) of the base frame is surely beyond the arm with its hand, m; negative within.

    The sum of all links is a bound that no configuration reaches, so what is beyond it is out of reach for certain.
    """
    d, a = kinematics.dh[:, 0], kinematics.dh[:, 1]
    longest_m = float(np.hypot(d, a)[1:].sum() + abs(a[0]) + np.linalg.norm(flange_from_grip.translation))
    shoulder = np.array([0.0, 0.0, d[0]])
    return float(np.linalg.norm(point_m - shoulder)) - longest_m
