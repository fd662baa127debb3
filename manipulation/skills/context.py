"""The inputs of a skill: the mover, the arm's kinematics, the panel and its estimated pose, and the limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.errors import Unreachable
from hal.geometry import UncertainPose, interpolate, transform
from hal.motion import JointTrajectory, Mover
from hal.panel import Panel, Shown
from manipulation.arm.kinematics import Kinematics
from manipulation.planning.collision import CollisionModel, placed
from manipulation.planning.hand import Hand
from manipulation.planning.shapes import CollisionBox, floor_box, panel_boxes
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.planning.transfer import THOROUGH, Effort, TransferPlanner

MOVE_IT = "move the panel nearer to the middle of the arm's workspace"
STROKE_MARGIN_M = 0.001
WAY_BACK_M = 0.05
NO_WAY_BACK_S = 3.0  # a stroke from which the hand cannot go straight back counts as so much longer
REACH_TURNS_RAD = np.linspace(-np.pi, np.pi, 12, endpoint=False)
LEANS_RAD = tuple(float(angle) for angle in np.radians([10.0, -10.0, 20.0, -20.0]))
FINGERS = ("finger_left", "finger_right")


class Blocked(Unreachable):
    """The arm can follow a stroke, but the hand would touch something else on its way; told as any place out of reach."""

    @property
    def type_name(self) -> str:
        """Return the name of the error of which this is a case."""
        return "unreachable"


def _always() -> bool:
    return True


def _no_progress(_fraction: float, _text: str) -> None:
    return None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SkillContext:
    """The fixed inputs of a skill.

    Attributes:
        mover: runs declared motions.
        base_from_panel: the panel's estimated pose with its covariance.
        flange_from_grip: pose of the finger tips on the flange, z along the fingers, x the closing direction.
        limits: speed of transfers.
        shown: present states of objects, by name, for collision checks; other moving parts block their whole way.
        park_rad: joints of the parking position.
        floor_z_m: height of the floor in the base frame.
        obstacles: further boxes in the base frame.
        progress: called with a fraction and a sentence.
        is_in_place: whether the newest look shows the panel where its pose has it; nothing is tried again where it does not.
        seed: random seed of the transfer planner.
    """

    mover: Mover
    kinematics: Kinematics
    panel: Panel
    base_from_panel: UncertainPose
    flange_from_grip: RigidTransform
    limits: SpeedLimits
    park_rad: Array
    hand: Hand = field(default_factory=Hand)
    shown: Mapping[str, Shown] = field(default_factory=dict)
    floor_z_m: float = 0.0
    obstacles: tuple[CollisionBox, ...] = ()
    progress: Callable[[float, str], None] = _no_progress
    is_in_place: Callable[[], bool] = _always
    seed: int = 0

    @property
    def panel_pose(self) -> RigidTransform:
        """Best estimate of base_from_panel."""
        return self.base_from_panel.parent_from_child

    def collision(self, *, width_m: float, may_touch: Sequence[str] = (), near_plate: bool = False) -> CollisionModel:
        """Return the collision model of arm, hand at an opening, panel, floor and obstacles.

        Args:
            may_touch: names of objects that the hand may touch.
            near_plate: whether the fingers may come down to the plate.
        """
        hand = self.hand.capsules(self.flange_from_grip, width_m)
        boxes = (
            floor_box(self.floor_z_m),
            *placed(panel_boxes(self.panel, self.shown), self.panel_pose),
            *self.obstacles,
        )
        ignored = [("", name) for name in may_touch]
        if near_plate:
            ignored += [(finger, "plate") for finger in FINGERS]
        return CollisionModel.build(self.kinematics, hand).with_boxes(boxes, ignored=ignored)

    def forgetting(self, name: str) -> SkillContext:
        """Return the context in which the place of an object's moving part is not known, because a hand has moved it."""
        return replace(self, shown={known: shown for known, shown in self.shown.items() if known != name})

    def transfer(
        self, start_rad: Array, goal_rad: Array, *, width_m: float, name: str, effort: Effort = THOROUGH
    ) -> JointTrajectory:
        """Plan a collision-free trajectory between two joint vectors.

        Raises:
            Unreachable: none found.
        """
        planner = TransferPlanner(
            model=self.collision(width_m=width_m),
            flange_from_tool=self.flange_from_grip,
            limits=self.limits,
            seed=self.seed,
        )
        return planner.plan(start_rad, goal_rad, name=name, effort=effort)

    def choose(
        self,
        options: Sequence[Sequence[RigidTransform]],
        *,
        near_rad: Array,
        width_m: float,
        may_touch: Sequence[str],
        must_go_back: bool = False,
    ) -> tuple[int, Array]:
        """Return which of several strokes the arm does best, and its joints (N, n) along it.

        The branch is chosen over the whole deed: way to the standoff, distance from joint limits and singularities on
        the stroke, and whether the hand can go back along its fingers from the stroke's end.

        Args:
            options: for each stroke its panel_from_grip poses, the first at the standoff.
            must_go_back: whether a stroke from whose end the hand cannot go back along its fingers is none.

        Raises:
            Unreachable: none can be followed on one branch of the arm without touching anything else.
        """
        model = self.collision(width_m=width_m, may_touch=may_touch, near_plate=True)
        failures, best = list[Unreachable](), None
        for index, poses in enumerate(options):
            flange = [self.panel_pose * pose * self.flange_from_grip.inv() for pose in poses]
            try:
                paths = self.kinematics.follow(flange, near_rad=near_rad)
            except Unreachable as failure:
                failures.append(failure)
                continue
            for path in paths:
                touching = next((q for q in path if not model.is_clear(q, margin_m=STROKE_MARGIN_M)), None)
                if touching is not None:
                    what = f"the stroke would bring {model.nearest(touching)} together"
                    failures.append(Blocked(what, hint="another turn of the tool or a smaller opening may do"))
                    continue
                goes_back = self._goes_back(model, flange[-1], path[-1])
                if must_go_back and not goes_back:
                    failures.append(Unreachable("the hand could not go back along its fingers", hint=MOVE_IT))
                    continue
                cost = self.kinematics.effort_s(path, near_rad) + (0.0 if goes_back else NO_WAY_BACK_S)
                if best is None or cost < best[0]:
                    best = (cost, index, path)
                if goes_back:
                    break
        if best is None:
            raise next((one for one in failures if isinstance(one, Blocked)), failures[-1])
        return best[1], best[2]

    def _goes_back(self, model: CollisionModel, base_from_flange: RigidTransform, q_rad: Array) -> bool:
        """Return whether the hand can move straight back along its fingers from the joints `q_rad` at a flange pose."""
        back = self.flange_from_grip * RigidTransform.from_translation([0.0, 0.0, -WAY_BACK_M])
        poses = [base_from_flange * interpolate(self.flange_from_grip, back, share) for share in (0.5, 1.0)]
        poses = [pose * self.flange_from_grip.inv() for pose in poses]
        path = self.kinematics.follow_from(q_rad, poses)
        return path is not None and all(model.is_clear(q, margin_m=STROKE_MARGIN_M) for q in path)


def panel_from_grip(point_m: Sequence[float], turn_rad: float) -> RigidTransform:
    """Return a grip pose in the panel frame, with the fingers perpendicular to the plate.

    The closing direction is at `turn_rad` from the panel's x axis. Columns: x = (cos, sin, 0), z = (0, 0, -1), y = z
    cross x.
    """
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return transform([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]], point_m)


def leaning(strokes: Sequence[Sequence[RigidTransform]], axes: Sequence[int]) -> list[list[RigidTransform]]:
    """Return strokes (panel_from_grip poses) with a hand that leans, for an arm that does not reach them straight.

    The fingertips stay where they are. The hand leans by 10 and 20 degrees about its own `axes` (0: the closing direction, 1: the
    width of the fingers), and the standoff, which comes first, is as far back along the fingers as before.
    """
    leaned = []
    for lean in (Rotation.from_rotvec(angle * np.eye(3)[axis]) for angle in LEANS_RAD for axis in axes):
        for standoff, *poses in strokes:
            tips = [pose * RigidTransform.from_rotation(lean) for pose in poses]
            back_m = float(np.linalg.norm(standoff.translation - poses[0].translation))
            leaned.append([tips[0] * RigidTransform.from_translation([0.0, 0.0, -back_m]), *tips])
    return leaned


def is_in_reach(
    kinematics: Kinematics, base_from_panel: RigidTransform, flange_from_grip: RigidTransform, point_m: Sequence[float]
) -> bool:
    """Return whether the fingertips can be at a point of the panel (panel frame, m), perpendicular to it, at any turn.

    Only joint limits count; collisions and the path to the point are not checked.
    """
    grips = (base_from_panel * panel_from_grip(point_m, float(turn)) for turn in REACH_TURNS_RAD)
    return any(len(kinematics.inverse(grip * flange_from_grip.inv())) > 0 for grip in grips)
