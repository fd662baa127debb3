"""One attempt of a skill: runs declared motions, goes to a standoff, approaches, and keeps the reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import Cancelled, DeviceFault, Stopped, Unreachable
from hal.motion import (
    Compliance,
    DeclaredMotion,
    GripperMotion,
    Guard,
    JointTrajectory,
    MotionOutcome,
    MotionReport,
    Quantity,
)
from manipulation.planning.cartesian_path import line, shifted, through
from manipulation.planning.hand import CLOSED_M
from manipulation.skills.context import Blocked, SkillContext, leaning
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure

APPROACH_M_PER_S = 0.06
CONTACT_N = 8.0
STANDOFF_M = 0.020  # distance of the tips from the object's highest point
LEAVE_M = 0.030  # of the tips after a stroke: 10 mm beyond the standoff, to which the arm could move before
RETREAT_M = 0.050  # the same after an error
RETREAT_M_PER_S = 0.15
PADS_M_PER_S = 0.1
LET_GO_N = 15.0
GRASP_M_PER_S = 0.03
ENDED = "the stroke ended as declared"
FREE_N = 40.0  # a larger force in a move that should be free is a collision


class Attempt:
    """Runs the declared motions of one skill and keeps their reports.

    Attributes:
        felt: the state of the object that the fingers felt after the stroke; None if the stroke proves none.
        is_against: whether the fingers felt that the target is not reached.
        cause: how the stroke ended, for people.
    """

    def __init__(self, context: SkillContext) -> None:
        self.context = context
        self.reports: list[MotionReport] = []
        self.is_stopped_in_transfer = False
        self.felt: ObjectState | None = None
        self.is_against = False
        self.cause = ENDED

    def run(self, motion: DeclaredMotion) -> MotionReport:
        """Execute a motion; returns when it completed or one of its own guards ended it.

        Raises:
            SkillFailure: a protective guard tripped.
            DeviceFault, Stopped, Cancelled: the cell failed or was stopped; these end the task, not only the attempt.
        """
        report = self.context.mover.execute(motion)
        self.reports.append(report)
        match report.outcome:
            case MotionOutcome.COMPLETED | MotionOutcome.GUARD:
                return report
            case MotionOutcome.STOPPED:
                raise Stopped(f"{motion.name}: {report.cause}", hint="reset the stop, then command again")
            case MotionOutcome.CANCELLED:
                raise Cancelled(f"{motion.name}: {report.cause}", hint="send the request again")
            case MotionOutcome.FAULT if report.device is None:
                raise SkillFailure(Outcome.FORCE_LIMIT, f"{motion.name}: {report.cause}")
            case MotionOutcome.FAULT:
                hint = "run `panelwright devices`; an arm that failed stays there until the stop is reset"
                raise DeviceFault(f"{motion.name}: {report.cause}", hint=hint, device=report.device)

    def joints(self) -> Array:
        """Return the measured joints (n,), rad."""
        return self.context.mover.state().position_rad

    def pose(self) -> RigidTransform:
        """Return the measured base_from_grip."""
        return self.context.kinematics.tool(self.joints(), self.context.flange_from_grip)

    def open_to(self, width_m: float, *, force_n: float = LET_GO_N, name: str = "set opening") -> None:
        """Move the pads to an opening while the arm holds; does nothing if closed pads are to be closed."""
        motion = self._opening(width_m, force_n=force_n, name=name)
        if motion is not None:
            self.run(motion)

    def _opening(self, width_m: float, *, force_n: float, name: str) -> GripperMotion | None:
        width = min(width_m, self.context.hand.max_width_m)
        if max(width, self.context.mover.state().gripper_width_m) <= CLOSED_M:
            return None
        return GripperMotion(name=name, width_m=width, force_n=force_n, speed_m_per_s=PADS_M_PER_S)

    def grasp(self, force_n: float, *, name: str) -> float:
        """Close slowly until the pads press with `force_n`; returns the opening that is left, m.

        Fast pads would stop at the peak force of their own impact and then hold nothing.
        """
        self.run(GripperMotion(name=name, width_m=0.0, force_n=force_n, speed_m_per_s=GRASP_M_PER_S))
        return self.context.mover.state().gripper_width_m

    def go_to(self, goal_rad: Array, *, width_m: float, name: str) -> None:
        """Make a collision-free transfer; a strong contact on the way ends the attempt."""
        motion = self.context.transfer(self.joints(), goal_rad, width_m=width_m, name=name)
        self._run_transfer(motion)

    def _run_transfer(self, motion: JointTrajectory) -> None:
        self.is_stopped_in_transfer = True
        self.run(motion)
        self.is_stopped_in_transfer = False

    def go_to_opening(self, goal_rad: Array, *, width_m: float, name: str) -> None:
        """Make a collision-free transfer, and set the opening on the way where there is room for the wider hand."""
        pads = self._opening(width_m, force_n=LET_GO_N, name="set opening")
        if pads is None:
            self.go_to(goal_rad, width_m=width_m, name=name)
            return
        widest_m = max(pads.width_m, self.context.mover.state().gripper_width_m)
        try:
            motion = self.context.transfer(self.joints(), goal_rad, width_m=widest_m, name=name)
        except Unreachable:
            self.run(pads)
            self.go_to(goal_rad, width_m=width_m, name=name)
            return
        self._run_transfer(replace(motion, pads=pads))

    def straight(
        self,
        goal: RigidTransform,
        *,
        name: str,
        speed_m_per_s: float,
        guards: tuple[Guard, ...] = (),
        compliance: Compliance | None = None,
    ) -> MotionReport:
        """Move the tips in a straight line from where they are to `goal` (base_from_grip)."""
        motion = line(
            self.pose(), goal, name=name, speed_m_per_s=speed_m_per_s, flange_from_tool=self.context.flange_from_grip,
            guards=guards, compliance=compliance,
        )  # fmt: skip
        return self.run(motion)

    def along(
        self,
        poses: Sequence[RigidTransform],
        *,
        name: str,
        speed_m_per_s: float,
        guards: tuple[Guard, ...] = (),
        compliance: Compliance | None = None,
        slow_last_m: float = 0.0,
    ) -> MotionReport:
        """Move through closely spaced poses (base_from_grip), the first of which is where the tool is."""
        motion = through(
            poses, name=name, speed_m_per_s=speed_m_per_s, flange_from_tool=self.context.flange_from_grip, guards=guards,
            compliance=compliance, slow_last_m=slow_last_m,
        )  # fmt: skip
        return self.run(motion)

    def advance(
        self, distance_m: float, *, name: str, speed_m_per_s: float = APPROACH_M_PER_S, stop_n: float = CONTACT_N
    ) -> MotionReport:
        """Move along the fingers (negative: back) until a contact force of `stop_n` against the motion."""
        sign = -1.0 if distance_m > 0 else 1.0
        guard = Guard(name="contact", quantity=Quantity.FORCE, limit=stop_n, axis=(0.0, 0.0, sign))
        goal = shifted(self.pose(), (0.0, 0.0, distance_m))
        return self.straight(goal, name=name, speed_m_per_s=speed_m_per_s, guards=(guard,))

    def leave(self, distance_m: float = LEAVE_M) -> None:
        """Move back along the fingers.

        Raises:
            SkillFailure: something held the hand, which the caller then frees (`unverified`: the stroke itself ended).
        """
        back = self.advance(-distance_m, name="retreat", speed_m_per_s=RETREAT_M_PER_S, stop_n=FREE_N)
        if back.tripped is not None:
            force_n = float(np.linalg.norm(back.wrench[:3]))
            raise SkillFailure(Outcome.UNVERIFIED, f"the stroke ended as declared, but {force_n:.0f} N held the hand")

    def begin(
        self,
        options: Sequence[Sequence[RigidTransform]],
        *,
        may_touch: Sequence[str],
        width_m: float,
        name: str,
        leans_about: Sequence[int] = (),
    ) -> int:
        """Choose the best of several strokes, set the opening, go to its standoff and tare there; returns its index.

        Args:
            options: for each stroke its panel_from_grip poses, the first at the standoff.
            leans_about: its own axes about which the hand may lean where the arm cannot follow any of them.

        Raises:
            Unsupported: the hand must open for it and cannot; nothing has moved.
        """
        self.context.hand.check_opens(width_m)
        choose = partial(self.context.choose, near_rad=self.joints(), width_m=width_m, may_touch=may_touch)
        try:
            index, path = choose(options)
        except Unreachable as straight:
            if not leans_about or isinstance(straight, Blocked):
                raise
            try:
                index, path = choose(leaning(options, leans_about), must_go_back=True)
            except Unreachable:
                raise straight from None
            index %= len(options)
        self.go_to_opening(path[0], width_m=width_m, name=f"to {name}")
        self.context.mover.tare()
        return index
