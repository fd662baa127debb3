"""How a skill ended. Nothing is `done` without a read-back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from hal.motion import MotionReport


class Outcome(StrEnum):
    """Typed ends of a skill."""

    DONE = "done"  # the read-back confirms it
    STIFF = "stiff"  # it did not give way within the force that the panel file leads to expect
    STALLED = "stalled"  # it moved, and stopped before the target
    SLIPPED = "slipped"  # the hand went all the way, the object did not
    MISSED = "missed"  # the object was not where the hand went
    FORCE_LIMIT = "force_limit"  # the protective force limit ended it
    UNREACHABLE = "unreachable"  # no collision-free way
    UNVERIFIED = "unverified"  # mechanically finished; no read-back confirms it


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectState:
    """What a look says about an object: a named state, a value of its scale, or an angle clockwise from up.

    `sigma` is the look's own one sigma of value or angle.
    """

    name: str
    state: str | None = None
    value: float | None = None
    angle_rad: float | None = None
    sigma: float = 0.0


SURE = 2.0  # sigmas of the look; a cap 2.36 % off was once read as 1.9 and called done within 2


def surely_within(measured: float | None, goal: float, allowed: float, *, sigma: float) -> bool:
    """Is what was measured within `allowed` of the goal even if the look erred by as much as it does now and then?"""
    return measured is not None and abs(measured - goal) + SURE * sigma <= allowed


Verify = Callable[[], ObjectState | None]
"""The caller's second look; None when it cannot tell."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SkillReport:
    """What a skill did.

    Attributes:
        target: what was asked for, e.g. "open" or "62.0 %".
        reached: the mechanical estimate from measured tool motion, in the object's own terms; None when it tells
        nothing. seen: the last read-back.
        attempts: how often the stroke was tried.
        peak_force_n: over all motions.
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

    @property
    def is_done(self) -> bool:
        """Confirmed by a read-back?"""
        return self.outcome is Outcome.DONE

    @property
    def duration_s(self) -> float:
        """Seconds on the cell's clock."""
        return self.ended_s - self.started_s


class SkillFailure(Exception):
    """Ends an attempt with an outcome; never leaves the skills."""

    def __init__(self, outcome: Outcome, cause: str, *, reached: float | None = None) -> None:
        super().__init__(cause)
        self.outcome = outcome
        self.cause = cause
        self.reached = reached


def wrapped(angle_rad: float) -> float:
    """The angle in (-pi, pi]."""
    return float(-((-angle_rad + np.pi) % (2.0 * np.pi) - np.pi))
