"""Decides when a motion ends early: by the stop latch, its caller, its own guards, or the guards of every motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.config import SafetySection
from hal.motion import (
    STOPPING_S,
    DeclaredMotion,
    GripperMotion,
    Guard,
    Hold,
    JointTrajectory,
    MotionOutcome,
    Quantity,
    Reaction,
)
from manipulation.control.guards import GuardSet, Measured
from manipulation.control.sensing import Sample, ToolReading
from manipulation.plausibility.arm import FOLLOWING_LIMIT_M

TRACKING_TICKS = 5
LOADED_MORE_N = 10.0  # a motion that starts beyond the limit may add so much, so that a jammed hand can be freed
# A transfer touches nothing, and the hand's inertia shows at most 4 N in it. The force goes on rising while the arm stops.
TRANSFER_FORCE_N = 30.0
RAN = "ran to its declared end"
SETTLE_S = 0.3
CATCH_UP_S = 2.0  # additional time for a set-point that speed limits have delayed
SETTLED_RAD = 2e-4
SETTLED_RAD_PER_S = 0.02
UNITS = {
    Quantity.FORCE: "N",
    Quantity.RESISTANCE: "N",
    Quantity.TORQUE: "N m",
    Quantity.FORCE_RISE: "N",
    Quantity.TOUCH: "contacts",
    Quantity.PROXIMITY: "m",
    Quantity.TRAVEL: "m",
    Quantity.ROTATION: "rad",
    Quantity.TRACKING: "m",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Termination:
    """Why a motion is over."""

    outcome: MotionOutcome
    cause: str
    tripped: str | None = None
    device: str | None = None


class TerminationMonitor:
    """Checks every tick whether the motion must end.

    Args:
        declared: the motion's own guards.
        force_limit_n: limit of the contact force, which holds in every motion.
        look: the measurement at the start of the motion.
        arm: name of the device that is at fault when the arm does not follow.
        is_retreat: whether what pushes the hand the way it goes is no reason to end the motion: a door that swings towards
            a hand goes on pushing a hand that stands.
        is_latched, is_cancelled: called every tick.
    """

    def __init__(
        self,
        declared: Sequence[Guard],
        force_limit_n: float,
        look: ToolReading,
        *,
        arm: str,
        is_retreat: bool = False,
        is_latched: Callable[[], bool],
        is_cancelled: Callable[[], bool],
    ) -> None:
        self._guards = GuardSet(
            (*declared, *_standing_guards(force_limit_n, look.wrench, is_retreat=is_retreat)), look.base_from_tool
        )
        self._arm = arm
        self._is_latched = is_latched
        self._is_cancelled = is_cancelled

    def ending(self, elapsed_s: float, sample: Sample, look: ToolReading) -> Termination | None:
        """Return why the motion must end now, or None."""
        if self._is_latched():
            return Termination(outcome=MotionOutcome.STOPPED, cause="the stop latch was set")
        if self._is_cancelled():
            return Termination(outcome=MotionOutcome.CANCELLED, cause="cancelled by the caller")
        guard = self._guards.tripped(
            Measured(
                elapsed_s=elapsed_s,
                wrench=look.wrench,
                base_from_tool=look.base_from_tool,
                commanded_tip_m=look.commanded_tip_m,
                contacts=sample.contacts,
                proximity_m=sample.proximity_m,
            )
        )
        return None if guard is None else self._ending_of(guard, look)

    def _ending_of(self, guard: Guard, look: ToolReading) -> Termination:
        outcome = MotionOutcome.FAULT if guard.reaction is Reaction.FAULT else MotionOutcome.GUARD
        device = None
        match guard.name:
            case "force_limit":
                force_n = float(np.linalg.norm(look.wrench[:3]))
                rising = "" if force_n >= guard.limit else " and rising"
                cause = f"contact force {force_n:.0f} N{rising}; at most {guard.limit:.0f} N is allowed"
            case "tracking":
                behind_m = np.linalg.norm(look.base_from_tool[:3, 3] - look.commanded_tip_m)
                cause = f"{self._arm} does not follow: {1e3 * behind_m:.0f} mm away from its last set-point"
                device = self._arm
            case _:
                side = "at most" if guard.below else "at least"
                cause = f"guard {guard.name}: {guard.quantity} {side} {guard.limit:g} {UNITS[guard.quantity]}"
        return Termination(outcome=outcome, cause=cause, tripped=guard.name, device=device)


def force_limit_n(motion: DeclaredMotion, cell_limit_n: float) -> float:
    """Return the largest contact force of a motion: that of the cell or its own, or less in a transfer through free space."""
    limit_n = cell_limit_n if motion.limits.force_n is None else min(cell_limit_n, motion.limits.force_n)
    return min(limit_n, TRANSFER_FORCE_N) if isinstance(motion, JointTrajectory) else limit_n


def speed_limit_m_per_s(motion: DeclaredMotion, safety: SafetySection, *, is_reduced: bool) -> float:
    """Return the largest speed of the tip: that of the cell, of the motion or, while people are near, the reduced one."""
    limits = [safety.speed_limit_m_per_s]
    if is_reduced:
        limits.append(safety.reduced_speed_m_per_s)
    if motion.limits.speed_m_per_s is not None:
        limits.append(motion.limits.speed_m_per_s)
    return min(limits)


def _standing_guards(force_limit_n: float, wrench: Array, *, is_retreat: bool) -> tuple[Guard, ...]:
    """Return the guards of every motion: force and tracking.

    A motion that begins beyond the limit may go on while the load does not grow. The force limit foresees what the force
    rises by while the arm stops.
    """
    loaded_n = float(np.linalg.norm(wrench[:3]))
    force_n = force_limit_n if loaded_n < force_limit_n else loaded_n + LOADED_MORE_N
    return (
        Guard(
            name="force_limit",
            quantity=Quantity.RESISTANCE if is_retreat else Quantity.FORCE,
            limit=force_n,
            reaction=Reaction.FAULT,
            ahead_s=STOPPING_S,
        ),
        Guard(
            name="tracking",
            quantity=Quantity.TRACKING,
            limit=FOLLOWING_LIMIT_M,
            ticks=TRACKING_TICKS,
            reaction=Reaction.FAULT,
        ),
    )


def has_settled(motion: DeclaredMotion, left_rad: Array, velocity_rad_per_s: Array, over_s: float) -> bool:
    """Return whether a motion that has run to its end has also come to rest there.

    Args:
        left_rad: (n,) distance from the set-point to the wanted one, not negative.
        velocity_rad_per_s: (n,) of the arm.
        over_s: time since the motion has run to its end.
    """
    if isinstance(motion, Hold | GripperMotion):
        return True
    is_behind = left_rad.max() >= SETTLED_RAD
    if not is_behind and np.abs(velocity_rad_per_s).max() < SETTLED_RAD_PER_S:
        return True
    # A compliant path may stay away from its joints; the set-point of a trajectory is only late.
    return over_s >= (CATCH_UP_S if is_behind and isinstance(motion, JointTrajectory) else SETTLE_S)


def cause_of_end(motion: DeclaredMotion, left_rad: Array) -> str:
    """Say that a motion is completed, and whether limits have kept a trajectory's set-point from its end."""
    k = int(np.argmax(left_rad))
    if left_rad[k] < SETTLED_RAD or not isinstance(motion, JointTrajectory):
        return RAN
    return f"{RAN}, but joint {k + 1} is still {1e3 * left_rad[k]:.1f} mrad away from it"
