"""The steps that skills share: run a motion, go to a standoff, touch down, retreat, park; and the frame of an
attempt.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import Cancelled, DeviceFault, MotionError, MotionRefused, Stopped, Unreachable
from hal.motion import (
    Compliance,
    DeclaredMotion,
    GripperMotion,
    Guard,
    MotionOutcome,
    MotionReport,
    Quantity,
)
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify
from manipulation.stroke import line, shifted, through
from manipulation.workcell import Workcell

APPROACH_M_PER_S = 0.06
CONTACT_N = 8.0
STANDOFF_M = 0.030  # of the tips above the object's highest place
RETREAT_M = 0.050
RETREAT_M_PER_S = 0.15
PADS_M_PER_S = 0.1
LET_GO_N = 15.0
CLOSED_M = 0.0005
GRASP_M_PER_S = 0.03
PULLS = 3
PULL_N = 90.0  # after a failure the hand may be jammed; just below the cell's protective limit
FREE_N = 40.0  # more than this in a move that should be free is a collision
MAX_ATTEMPTS = 3


class Attempt:
    """Runs declared motions for one skill and keeps their reports."""

    def __init__(self, cell: Workcell) -> None:
        self.cell = cell
        self.reports: list[MotionReport] = []

    def run(self, motion: DeclaredMotion) -> MotionReport:
        """Execute; returns when the motion completed or one of its own guards ended it.

        Raises:
            SkillFailure: a protective guard tripped.
            DeviceFault, Stopped, Cancelled: what the cell met; these end the task, not only the attempt.
        """
        report = self.cell.mover.execute(motion)
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
        """Measured joints (n,)."""
        return self.cell.mover.state().position_rad

    def pose(self) -> RigidTransform:
        """Measured base_from_grip."""
        return self.cell.kinematics.tool(self.joints(), self.cell.flange_from_grip)

    def open_to(self, width_m: float, *, force_n: float = LET_GO_N, name: str = "set opening") -> None:
        """Move the pads to an opening while the arm holds; closed pads that shall be closed are left alone."""
        width = min(width_m, self.cell.hand.max_width_m)
        if max(width, self.cell.mover.state().gripper_width_m) <= CLOSED_M:
            return
        self.run(GripperMotion(name=name, width_m=width, force_n=force_n, speed_m_per_s=PADS_M_PER_S))

    def grasp(self, force_n: float, *, name: str) -> float:
        """Close slowly until the pads press with `force_n`; returns the opening left, m.

        Fast pads stop on the peak of their own impact and hold nothing.
        """
        self.run(GripperMotion(name=name, width_m=0.0, force_n=force_n, speed_m_per_s=GRASP_M_PER_S))
        return self.cell.mover.state().gripper_width_m

    def go_to(self, goal_rad: Array, *, width_m: float, name: str) -> None:
        """A collision-free transfer; any strong contact on the way ends the attempt."""
        motion = self.cell.transfer(self.joints(), goal_rad, width_m=width_m, name=name)
        self.run(motion)

    def straight(
        self,
        goal: RigidTransform,
        *,
        name: str,
        speed_m_per_s: float,
        guards: tuple[Guard, ...] = (),
        compliance: Compliance | None = None,
    ) -> MotionReport:
        """A straight move of the tips from where they are to `goal` (base_from_grip)."""
        motion = line(
            self.pose(), goal, name=name, speed_m_per_s=speed_m_per_s, flange_from_tool=self.cell.flange_from_grip,
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
        """A move through dense poses (base_from_grip), the first where the tool is."""
        motion = through(
            poses, name=name, speed_m_per_s=speed_m_per_s, flange_from_tool=self.cell.flange_from_grip, guards=guards,
            compliance=compliance, slow_last_m=slow_last_m,
        )  # fmt: skip
        return self.run(motion)

    def advance(
        self, distance_m: float, *, name: str, speed_m_per_s: float = APPROACH_M_PER_S, stop_n: float = CONTACT_N
    ) -> MotionReport:
        """Move along the fingers (negative: back) until a contact of `stop_n` against the motion."""
        sign = -1.0 if distance_m > 0 else 1.0
        guard = Guard(name="contact", quantity=Quantity.FORCE, limit=stop_n, axis=(0.0, 0.0, sign))
        goal = shifted(self.pose(), (0.0, 0.0, distance_m))
        return self.straight(goal, name=name, speed_m_per_s=speed_m_per_s, guards=(guard,))

    def leave(self, distance_m: float = RETREAT_M) -> None:
        """Back off along the fingers."""
        self.advance(-distance_m, name="retreat", speed_m_per_s=RETREAT_M_PER_S, stop_n=FREE_N)

    def begin(
        self,
        options: Sequence[Sequence[RigidTransform]],
        *,
        may_touch: Sequence[str],
        width_m: float,
        name: str,
    ) -> int:
        """Set the opening, go to the standoff of the best way, and tare there; returns which way it is.

        `options`: for each way its panel_from_grip poses, the first at the standoff.
        """
        index, path = self.cell.choose(options, near_rad=self.joints(), width_m=width_m, may_touch=may_touch)
        self.open_to(width_m)
        self.go_to(path[0], width_m=width_m, name=f"to {name}")
        self.cell.mover.tare()
        return index


Stroke = Callable[[Attempt], float | None]
"""One try of the deed; returns the mechanical estimate; raises `SkillFailure`."""


def perform(
    cell: Workcell,
    stroke: Stroke,
    *,
    skill: str,
    object_name: str,
    target: str,
    is_reached: Callable[[ObjectState], bool],
    verify: Verify | None,
    attempts: int = MAX_ATTEMPTS,
    repeats: bool = True,
) -> SkillReport:
    """Try a stroke, retreat, look again, and try at most twice more while the look disagrees.

    Args:
        repeats: may a stroke that ended as declared be tried again when the look disagrees? Not for a button, whose
            second press undoes the first.

    Raises:
        DeviceFault, Stopped, Cancelled: the cell cannot go on; the caller parks when that is possible.
    """
    attempt = Attempt(cell)
    started_s = cell.mover.state().stamp_s
    seen: ObjectState | None = None
    reached: float | None = None
    outcome, cause, tries = Outcome.UNREACHABLE, "", 0
    for tries in range(1, attempts + 1):
        cell.progress((tries - 1) / attempts, f"{skill} {object_name}: attempt {tries}")
        outcome, cause, reached = _try(attempt, stroke)
        looks = outcome is Outcome.UNVERIFIED and verify is not None
        cell.progress((tries - 0.5) / attempts, f"{skill} {object_name}: {'look again' if looks else cause}")
        if outcome is Outcome.UNREACHABLE:
            break
        seen = None if verify is None else verify()
        if seen is not None and is_reached(seen):
            outcome, cause = Outcome.DONE, "the read-back confirms it"
            break
        if outcome is Outcome.UNVERIFIED and seen is None:
            cause += "; nobody looked" if verify is None else "; the look afterwards could not tell"
            break
        if outcome is Outcome.UNVERIFIED:
            outcome, cause = Outcome.SLIPPED, "the hand went all the way; the read-back does not show the target"
            if not repeats:
                break
        if outcome is Outcome.STALLED and seen is None and not repeats:
            cause += "; whether it counted nobody can tell, and another try might undo it"
            break
        if outcome is Outcome.STIFF:
            break
    return SkillReport(
        skill=skill,
        object=object_name,
        target=target,
        outcome=outcome,
        cause=cause,
        reached=reached,
        seen=seen,
        attempts=tries,
        started_s=started_s,
        ended_s=cell.mover.state().stamp_s,
        peak_force_n=max((report.peak_force_n for report in attempt.reports), default=0.0),
        motions=tuple(attempt.reports),
    )


def _try(attempt: Attempt, stroke: Stroke) -> tuple[Outcome, str, float | None]:
    try:
        return Outcome.UNVERIFIED, "the stroke ended as declared", stroke(attempt)
    except SkillFailure as failure:
        retreat(attempt.cell, attempt)
        return failure.outcome, failure.cause, failure.reached
    except Unreachable as failure:
        return Outcome.UNREACHABLE, f"{failure.what}; {failure.hint}", None
    except MotionRefused as failure:
        retreat(attempt.cell, attempt)
        return Outcome.UNREACHABLE, failure.what, None


def retreat(cell: Workcell, attempt: Attempt | None = None, *, distance_m: float = RETREAT_M) -> None:
    """Open the hand and back off along the fingers; for the way out after any error.

    Raises:
        DeviceFault, Stopped, Cancelled: the cell does not obey.
    """
    attempt = attempt or Attempt(cell)
    width = min(cell.hand.max_width_m, cell.mover.state().gripper_width_m + 0.02)
    with suppress(SkillFailure, MotionRefused):
        # The way out does not wait for a gripper that says nonsense: it has let go, or the pull will tell.
        attempt.run(
            GripperMotion(name="let go", width_m=width, force_n=LET_GO_N, speed_m_per_s=PADS_M_PER_S, must_arrive=False)
        )
    # Something may hold the hand: it is pulled several times, and `park` sees whether it came free.
    for _ in range(PULLS):
        with suppress(SkillFailure, MotionRefused):
            pulled = attempt.advance(-distance_m, name="retreat", speed_m_per_s=RETREAT_M_PER_S, stop_n=PULL_N)
            if pulled.tripped is None:
                return


def park(cell: Workcell) -> None:
    """Back off from the panel if near it, then go to the parking joints.

    Raises:
        Unreachable: no free way, even after backing off.
        MotionError: something held the arm up on the way.
        DeviceFault, Stopped, Cancelled: the cell does not obey.
    """
    try:
        _park(cell)
    except SkillFailure as failure:
        hint = "something is in the way, or the panel is not where it was: look at the arm, then send this again"
        raise MotionError(failure.cause, hint=hint) from failure


def _park(cell: Workcell) -> None:
    attempt = Attempt(cell)
    state = cell.mover.state()
    width = max(state.gripper_width_m, 0.0)
    if not cell.collision(width_m=width).is_clear(state.position_rad, margin_m=0.010):
        retreat(cell, attempt)
        width = cell.mover.state().gripper_width_m
    attempt.go_to(cell.park_rad, width_m=width, name="to park")
