"""Retreats: frees the hand, moves back along the fingers or along the way that it came, and goes to the parking joints.

A retreat needs the arm only. Its motions go on when a force, touch, gripper or proximity sensor fails; without measured
forces they are slow.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from hal.arrays import Array
from hal.errors import DeviceFault, MotionError, MotionRefused
from hal.motion import STOPPING_S, CartesianPath, Compliance, GripperMotion, Guard, MotionReport, Quantity
from manipulation.planning.cartesian_path import line, shifted
from manipulation.planning.smooth_path import SmoothPath
from manipulation.planning.time_parameterization import SpeedLimits, timed
from manipulation.skills.attempt import LET_GO_N, PADS_M_PER_S, RETREAT_M, RETREAT_M_PER_S, Attempt
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import SkillFailure

PULL_N = (40.0, 50.0, 60.0)  # of one pull after the other; nothing on a panel is pulled harder to free a hand
PULL_M_PER_S = 0.04  # of a hand that is held; at 0.15 m/s the force overshoots by 25 N
PULLS = len(PULL_N)
OPEN_MORE_M = 0.02
OPENING_N = 12.0  # a larger rise while the pads open means that a finger presses against something from within
LOOSER_M = 0.003  # the pads go this far back from where they met something on either side
RELAX_M = 0.002
UNFELT_M_PER_S = 0.05  # where no force is measured
TURN_BACK_RAD = 0.3  # how far back along its own way the arm goes from what it met in a transfer
THIN_RAD = 0.01
HELD_N = 10.0  # a hand that rests with more force on it is not free; weight and drift leave at most half of it
HELD_NM = 0.4
ACROSS_RATIO = 0.7  # of the force along the fingers: with less across them it is friction, and nothing hooks the hand
INF = float("inf")
# Soft across the fingers, so that a finger slides out of what hooks it and a wheel may turn with it.
YIELDING = Compliance(
    stiffness=(500.0, 500.0, INF, INF, INF, INF),
    damping=(500.0, 500.0, 500.0, 10.0, 10.0, 10.0),
    max_offset_m=0.012,
)
# Almost no stiffness: across the fingers and about them the arm goes where the forces push it, slowly, until they are small.
# Two fingers that press spokes are held by their friction, although no force across them is left.
GIVING_WAY = Compliance(
    stiffness=(50.0, 50.0, INF, INF, INF, 0.5),
    damping=(4000.0, 4000.0, 4000.0, 10.0, 10.0, 3.0),
    mass=(100.0, 100.0, 100.0, 1.0, 1.0, 0.1),
    max_offset_m=0.012,
    max_offset_rad=0.5,
)
GIVE_WAY_S = 0.5
HELD_HINT = "something holds the hand: look at it, free it by hand or by the arm's own control, then park"


def retreat(context: SkillContext, attempt: Attempt | None = None, *, distance_m: float = RETREAT_M) -> None:
    """Free the hand and move it back along the fingers, for example after an error.

    Before each pull the arm gives way to the forces across the fingers. The first pull is light;
    the next ones are stronger and slow, with the pads further open, and with the pads moved to where they press on nothing.
    After a transfer that met something,
    the arm goes a little way back along it instead.

    Raises:
        MotionError: the hand did not come free.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    if attempt is not None and attempt.is_stopped_in_transfer:
        step_back(context, attempt.reports[-1])
        return
    attempt = attempt or Attempt(context)
    against_n, cause = 0.0, "no path leads back along the fingers"
    for number, pull_n in enumerate(PULL_N):
        # A gripper that fails, or has an implausible reading, does not end the retreat. Pads that move while the hand is
        # wedged wedge it more: a hand that is pressed from a side gives way first, and pulls once with the pads as they are.
        was_pressed, is_pushed_out = _is_pressed(context), _is_pushed_out(context)
        with suppress(SkillFailure, MotionRefused):
            if (
                not is_pushed_out
            ):  # what moves towards the hand goes on pushing while the arm gives way to nothing across
                _give_way(attempt)
        with suppress(SkillFailure, MotionRefused, DeviceFault):
            if number > 1:
                _loosen(attempt)
            elif number == 1 or not was_pressed:
                _open(attempt)
        try:
            pulled = _pull(
                attempt, distance_m, pull_n, slowly=number > 0 or (not is_pushed_out and _is_pressed(context))
            )
        except (SkillFailure, MotionRefused) as failure:
            cause = str(failure)
            continue
        if pulled.tripped is None:
            return
        against_n = max(against_n, float(np.linalg.norm(pulled.wrench[:3])))
        cause = f"{against_n:.0f} N hold it"
        with suppress(SkillFailure, MotionRefused):
            _pull(attempt, -RELAX_M, pull_n, slowly=True)
    raise MotionError(f"the hand did not come free in {PULLS} pulls: {cause}", hint=HELD_HINT, force_n=against_n)


def is_free(context: SkillContext) -> bool:
    """Return whether the hand rests with no contact force and the model shows nothing near it."""
    state = context.mover.state()
    if _is_pressed(context):
        return False
    model = context.collision(width_m=max(state.gripper_width_m, 0.0))
    return model.is_clear(state.position_rad, margin_m=0.002)


def free_hand(context: SkillContext) -> None:
    """Free the hand unless it is free already, for example before the next deed.

    Raises:
        MotionError: the hand did not come free.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    if not is_free(context):
        retreat(context)


def _give_way(attempt: Attempt) -> None:
    """Stay, but yield to the forces across the fingers; does nothing if the hand is free."""
    if attempt.context.mover.state().faults or not _is_pressed(attempt.context):
        return
    here = attempt.pose()
    attempt.run(
        CartesianPath(
            name="give way", flange_from_tool=attempt.context.flange_from_grip, times_s=np.array([0.0, GIVE_WAY_S]),
            base_from_tool=(here, here), compliance=GIVING_WAY, is_retreat=True,
        )
    )  # fmt: skip


def _is_pressed(context: SkillContext) -> bool:
    """Return whether something presses on the hand: a force, or a torque about the fingers."""
    wrench = context.mover.state().wrench
    along = context.flange_from_grip.rotation.apply([0.0, 0.0, 1.0])
    return float(np.linalg.norm(wrench[:3])) >= HELD_N or abs(float(wrench[3:] @ along)) >= HELD_NM


def _is_pushed_out(context: SkillContext) -> bool:
    """Return whether something pushes the hand back along its fingers, with little across them: a door that swings, say."""
    wrench = context.mover.state().wrench
    along = context.flange_from_grip.rotation.apply([0.0, 0.0, 1.0])
    out_n = -float(wrench[:3] @ along)
    across_n = float(np.linalg.norm(wrench[:3] + out_n * along))
    return out_n >= HELD_N and across_n < ACROSS_RATIO * out_n


def _open(attempt: Attempt) -> None:
    """Open the pads further, until a finger presses against something from within; then close them a little."""
    state = attempt.context.mover.state()
    width_m = min(attempt.context.hand.max_width_m, state.gripper_width_m + OPEN_MORE_M)
    report = _pads(attempt, width_m, OPENING_N + 1.2 * float(np.linalg.norm(state.wrench[:3])))
    if report.tripped is not None:
        _pads(attempt, attempt.context.mover.state().gripper_width_m - LOOSER_M, INF)


def _loosen(attempt: Attempt) -> None:
    """Close the pads until they touch what is between them, or each other, and open them a little again."""
    _pads(attempt, 0.0, OPENING_N + 1.2 * float(np.linalg.norm(attempt.context.mover.state().wrench[:3])))
    _pads(attempt, attempt.context.mover.state().gripper_width_m + LOOSER_M, INF)


def _pads(attempt: Attempt, width_m: float, stop_n: float) -> MotionReport:
    guards = () if stop_n == INF else (Guard(name="pads", quantity=Quantity.FORCE, limit=stop_n),)
    return attempt.run(
        GripperMotion(
            name="let go", width_m=max(0.0, width_m), force_n=LET_GO_N, speed_m_per_s=PADS_M_PER_S, must_arrive=False,
            guards=guards, is_retreat=True,
        )
    )  # fmt: skip


def _pull(attempt: Attempt, distance_m: float, pull_n: float, *, slowly: bool) -> MotionReport:
    """Move back along the fingers (negative: forwards), and yield across them."""
    context = attempt.context
    start = attempt.pose()
    against = Guard(
        name="held",
        quantity=Quantity.FORCE,
        limit=pull_n,
        axis=(0.0, 0.0, 1.0 if distance_m > 0.0 else -1.0),
        ahead_s=STOPPING_S,
    )
    speed_m_per_s = PULL_M_PER_S if slowly else RETREAT_M_PER_S
    motion = line(
        start,
        shifted(start, (0.0, 0.0, -distance_m)),
        name="retreat" if distance_m > 0.0 else "relax",
        speed_m_per_s=min(speed_m_per_s, UNFELT_M_PER_S) if context.mover.state().faults else speed_m_per_s,
        flange_from_tool=context.flange_from_grip,
        guards=(against,),
        compliance=YIELDING,
    )
    return attempt.run(replace(motion, is_retreat=True))


def step_back(context: SkillContext, report: MotionReport) -> None:
    """Go a little way back along the joints of a motion that met something, where nothing was in the way before.

    Raises:
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    path = _reversed(report.log.positions_rad, report.position_rad)
    if len(path) < 2:
        return
    motion = timed(
        context.kinematics,
        SmoothPath.of(path),
        flange_from_tool=context.flange_from_grip,
        limits=SpeedLimits(tip_m_per_s=UNFELT_M_PER_S),
        name="step back",
    )
    with suppress(SkillFailure, MotionRefused):
        Attempt(context).run(replace(motion, is_retreat=True))


def _reversed(logged_rad: Array, here_rad: Array) -> Array:
    """Return the logged joints (N, n) from the last to the first ones, not further than `TURN_BACK_RAD`."""
    path = [np.asarray(here_rad, float)]
    gone = 0.0
    for q in logged_rad[::-1]:
        step = float(np.linalg.norm(q - path[-1]))
        if step < THIN_RAD:
            continue
        gone += step
        if gone > TURN_BACK_RAD:
            break
        path.append(np.asarray(q, float))
    return np.array(path)


def park(context: SkillContext) -> None:
    """Move back from the panel if near it, then go to the parking joints.

    Raises:
        Unreachable: there is no collision-free path, even after moving back.
        MotionError: the hand did not come free, or a contact stopped the arm on the way.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    try:
        _park(context)
    except SkillFailure as failure:
        hint = "something is in the way, or the panel is not where it was: look at the arm, then send this again"
        raise MotionError(failure.cause, hint=hint) from failure


def _park(context: SkillContext) -> None:
    state = context.mover.state()
    width = max(state.gripper_width_m, 0.0)
    if not context.collision(width_m=width).is_clear(state.position_rad, margin_m=0.010):
        retreat(context)
        width = context.mover.state().gripper_width_m
    if context.mover.state().faults:
        context = replace(context, limits=SpeedLimits(tip_m_per_s=UNFELT_M_PER_S))
    attempt = Attempt(context)
    motion = context.transfer(attempt.joints(), context.park_rad, width_m=width, name="to park")
    attempt.run(replace(motion, is_retreat=True))
