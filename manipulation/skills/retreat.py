"""Retreats: opens the hand, moves back along the fingers, and goes to the parking joints."""

from __future__ import annotations

from contextlib import suppress

from hal.errors import MotionError, MotionRefused
from hal.motion import GripperMotion
from manipulation.skills.attempt import LET_GO_N, PADS_M_PER_S, RETREAT_M, RETREAT_M_PER_S, Attempt
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import SkillFailure

PULLS = 3
PULL_N = 90.0  # after a failure the hand may be jammed; just below the cell's protective limit


def retreat(context: SkillContext, attempt: Attempt | None = None, *, distance_m: float = RETREAT_M) -> None:
    """Open the hand and move back along the fingers, for example after an error.

    Raises:
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    attempt = attempt or Attempt(context)
    width = min(context.hand.max_width_m, context.mover.state().gripper_width_m + 0.02)
    with suppress(SkillFailure, MotionRefused):
        # A gripper with an implausible reading does not end the retreat; the pull shows whether the hand is free.
        attempt.run(
            GripperMotion(name="let go", width_m=width, force_n=LET_GO_N, speed_m_per_s=PADS_M_PER_S, must_arrive=False)
        )
    # Something may hold the hand, so it is pulled several times; `park` checks whether it came free.
    for _ in range(PULLS):
        with suppress(SkillFailure, MotionRefused):
            pulled = attempt.advance(-distance_m, name="retreat", speed_m_per_s=RETREAT_M_PER_S, stop_n=PULL_N)
            if pulled.tripped is None:
                return


def park(context: SkillContext) -> None:
    """Move back from the panel if near it, then go to the parking joints.

    Raises:
        Unreachable: there is no collision-free path, even after moving back.
        MotionError: a contact stopped the arm on the way.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    try:
        _park(context)
    except SkillFailure as failure:
        hint = "something is in the way, or the panel is not where it was: look at the arm, then send this again"
        raise MotionError(failure.cause, hint=hint) from failure


def _park(context: SkillContext) -> None:
    attempt = Attempt(context)
    state = context.mover.state()
    width = max(state.gripper_width_m, 0.0)
    if not context.collision(width_m=width).is_clear(state.position_rad, margin_m=0.010):
        retreat(context, attempt)
        width = context.mover.state().gripper_width_m
    attempt.go_to(context.park_rad, width_m=width, name="to park")
