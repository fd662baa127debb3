"""Outcomes and reports of skills. Nothing is `done` without a read-back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from hal.motion import ContactForce, MotionReport


class Outcome(StrEnum):
    """How a skill ended."""

    DONE = "done"  # the read-back confirms it
    STIFF = "stiff"  # the object did not move within the force expected from the panel file
    STALLED = "stalled"  # the object moved but stopped before the target
    SLIPPED = "slipped"  # the hand completed the stroke, but the object did not follow
    MISSED = "missed"  # the object was not where it was expected
    FORCE_LIMIT = "force_limit"  # the protective force limit ended the stroke
    UNREACHABLE = "unreachable"  # no collision-free path
    UNVERIFIED = "unverified"  # mechanically finished; no read-back confirms it


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectState:
    """What an observation says about an object: a named state, a value of its scale, or an angle clockwise from up.

    `sigma` is one standard deviation of the value or angle. `turned_rad` is the angle, with its whole turns, to which the
    object was turned before; an observation shows one turn only.
    """

    name: str
    state: str | None = None
    value: float | None = None
    angle_rad: float | None = None
    sigma: float = 0.0
    turned_rad: float | None = None


def mean_of(first: ObjectState, second: ObjectState) -> ObjectState:
    """Return the mean of two looks at a control that did not move between them.

    It keeps the sigma of the less sure look, because two looks share a part of their errors: the pose of the panel and the
    light are the same. The mean of two different states is the second look as it is.
    """
    if first.state != second.state:
        return second
    value, angle_rad = second.value, second.angle_rad
    if first.value is not None and value is not None:
        value += 0.5 * (first.value - value)
    if first.angle_rad is not None and angle_rad is not None:
        angle_rad += 0.5 * wrapped(first.angle_rad - angle_rad)
    return replace(second, value=value, angle_rad=angle_rad, sigma=max(first.sigma, second.sigma))


SURE = 2.0  # sigmas added to the error; otherwise an object outside of the tolerance may be read as inside it


def surely_within(measured: float | None, goal: float, allowed: float, *, sigma: float) -> bool:
    """Return whether a measurement is within `allowed` of the goal even if it errs by `SURE` sigmas."""
    return measured is not None and abs(measured - goal) + SURE * sigma <= allowed


def doubt_within(measured: float | None, goal: float, allowed: float, *, sigma: float) -> str:
    """Return why a measurement tells neither that it is within `allowed` of the goal nor that it is not; else nothing."""
    if measured is None:
        return "the look shows no value"
    if surely_within(measured, goal, allowed, sigma=sigma) or abs(measured - goal) - SURE * sigma > allowed:
        return ""
    return (
        f"a look that shows {measured:.4g} and is sure to {SURE * sigma:.2g} does not tell whether it is within "
        f"{allowed:.2g} of {goal:.4g}"
    )


Verify = Callable[[], ObjectState | None]
"""The caller's read-back; it returns None when it is inconclusive."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SkillReport:
    """Report of one run of a skill.

    Attributes:
        target: what was asked for, e.g. "open" or "62.0 %".
        reached: the mechanical estimate from measured tool motion, in the object's own terms; None when there is none.
        seen: the last read-back.
        attempts: how often the stroke was tried.
        peak_force_n: over all motions.
        was_missed: whether a try did not meet the control where it was expected.
    """

    skill: str
    object: str
    target: str
    outcome: Outcome
    cause: str
    reached: float | None
    seen: ObjectState | None
    attempts: int
    started_s: float
    ended_s: float
    peak_force_n: float
    motions: tuple[MotionReport, ...]
    was_missed: bool = False

    @property
    def is_done(self) -> bool:
        """Whether a read-back confirmed the target."""
        return self.outcome is Outcome.DONE

    @property
    def force(self) -> ContactForce:
        """Impulse and chatter of the contact force over all motions."""
        return sum((motion.force for motion in self.motions), start=ContactForce())

    @property
    def duration_s(self) -> float:
        """Seconds on the cell's clock."""
        return self.ended_s - self.started_s


class SkillFailure(Exception):
    """Ends an attempt with an outcome; it is caught within the skills.

    `is_sure`: the hand felt that the target is not reached, so that no look alone can say that it is.
    """

    def __init__(self, outcome: Outcome, cause: str, *, reached: float | None = None, is_sure: bool = False) -> None:
        super().__init__(cause)
        self.outcome = outcome
        self.cause = cause
        self.reached = reached
        self.is_sure = is_sure


def wrapped(angle_rad: float) -> float:
    """Return the angle in (-pi, pi]."""
    return float(-((-angle_rad + np.pi) % (2.0 * np.pi) - np.pi))
