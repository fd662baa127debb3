"""The way out: open the hand, back off along the fingers, and go to the parking joints."""

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
    """Open the hand and back off along the fingers; for the way out after any error.

    Raises:
        DeviceFault, Stopped, Cancelled: the cell does not obey.
    """
    attempt = attempt or Attempt(context)
    width = min(context.hand.max_width_m, context.mover.state().gripper_width_m + 0.02)
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


def park(context: SkillContext) -> None:
    """Back off from the panel if near it, then go to the parking joints.

    Raises:
        Unreachable: no free way, even after backing off.
        MotionError: something held the arm up on the way.
        DeviceFault, Stopped, Cancelled: the cell does not obey.
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
