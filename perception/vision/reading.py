"""Readings: value, state or text with uncertainty and confidence, or the reason for a refusal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

from hal.arrays import Array

ANSWER_AT = 0.5  # below this confidence a reading is refused, unless the caller asks for less or for more
MOST_DOUBTED = 0.49  # confidence of a guess that a reader has a reason to refuse
NO_EDGE = "the cap's edge cannot be found: come closer or add light"
ALIKE = "pressed and released look alike from here: look from the side or closer"
TOO_WEAK = "the evidence is too weak: come closer, change the angle or the light"


@dataclass(frozen=True, slots=True, kw_only=True)
class Possible:
    """A number that what is seen of a refused display allows: how it is written, its value, and its probability."""

    text: str
    value: float
    probability: float

    @property
    def half_digit(self) -> float:
        """Half a unit of the last digit: the uncertainty of the number as displayed."""
        return 0.5 * 10.0 ** -len(self.text.partition(".")[2])


@dataclass(frozen=True, slots=True, kw_only=True)
class Guess:
    """What a refusal would have said: as the fields of `Answer` of the same names."""

    value: float | None = None
    uncertainty: float | None = None
    state: str | None = None
    text: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """At most one of `value`, `state` and `text` leads; a refusal has none of them, and a `reason`.

    Attributes:
        value: in `unit`; a display has its text's number here too.
        uncertainty: one sigma of `value`, same unit.
        confidence: 0 to 1, the expected share of right answers among such readings; of a refusal, that its guess is right.
        reason: why no answer is given and what would help; None for an answer.
        possible: what a refused display may show, likeliest first; empty where nothing is known.
        guess: what a refusal would have said, for callers who want less than `ANSWER_AT` (see `answer_at`).
    """

    value: float | None = None
    unit: str = ""
    uncertainty: float | None = None
    state: str | None = None
    text: str | None = None
    confidence: float = 0.0
    reason: str | None = None
    possible: tuple[Possible, ...] = ()
    guess: Guess | None = None

    @property
    def answered(self) -> bool:
        """Whether there is an answer."""
        return self.reason is None


A = TypeVar("A", bound=Answer)


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchReading(Answer):
    """What a reader says of the object in its patch."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectReading(Answer):
    """One object of a taught panel in one image, with what it says.

    Attributes:
        present: whether something that looks like the object is where the panel file says.
        centre_px: (2,) refined middle of the object on the image.
        centre_m: (3,) its place in the panel frame by this image (plate height), None without a camera pose.
        centre_covariance_m2: (3, 3) of `centre_m`, panel axes.
        outline_px: (N, 2) contour in the image, for drawing and for the robot's look.
    """

    name: str
    kind: str
    present: bool
    centre_px: Array
    outline_px: Array
    centre_m: Array | None = None
    centre_covariance_m2: Array | None = None

    @property
    def answered(self) -> bool:
        """Whether the object was read."""
        return self.present and self.reason is None

    @property
    def needs_closer_sides(self) -> bool:
        """Whether the refusal is that two states look alike from here, so that a nearer look from a side would tell."""
        return self.reason in (NO_EDGE, ALIKE)

    def saying(self, status: PatchReading) -> ObjectReading:
        """The object, found where it should be, with what its reader says of it."""
        return replace(self, present=True, **{field.name: getattr(status, field.name) for field in fields(Answer)})


def refused(reason: str, *, unit: str = "") -> PatchReading:
    """No answer and no guess either, with the reason (cause, then what would help)."""
    return PatchReading(reason=reason, unit=unit)


def doubted(status: PatchReading, reason: str) -> PatchReading:
    """A refusal with that reason, which keeps what the status says as its guess."""
    return answer_at(limited(status, MOST_DOUBTED), ANSWER_AT, reason)


def gated(status: PatchReading, reason: str = TOO_WEAK, possible: tuple[Possible, ...] = ()) -> PatchReading:
    """The same answer, or a refusal with that reason when its confidence is too low, which keeps it as its guess.

    Args:
        possible: what a display may show if it is refused.
    """
    refusal = answer_at(status, ANSWER_AT, reason)
    return replace(refusal, possible=possible) if possible and refusal.guess else refusal


def as_often_right(status: PatchReading, least: float) -> PatchReading:
    """The same status; a guess's confidence is stretched to the range from `least`, what it is worth without any evidence.

    Readers are made to tell when to refuse; what they say below that is too low for kinds with few states.
    """
    if status.guess is None:
        return status
    return replace(status, confidence=least + (MOST_DOUBTED - least) * status.confidence / ANSWER_AT)


def answer_at(answer: A, least_confidence: float, reason: str = TOO_WEAK) -> A:
    """The same answer for a caller to whom so much confidence is enough: guesses become answers, doubtful answers guesses."""
    if answer.reason is None and answer.confidence < least_confidence:
        return replace(
            answer, value=None, uncertainty=None, state=None, text=None, reason=reason, guess=_guess_of(answer),
            possible=answer.possible or _alone(answer),
        )  # fmt: skip
    if answer.guess is not None and answer.confidence >= least_confidence:
        said = {field.name: getattr(answer.guess, field.name) for field in fields(Guess)}
        return replace(answer, **said, reason=None, guess=None)
    return answer


def _guess_of(answer: Answer) -> Guess:
    return Guess(**{field.name: getattr(answer, field.name) for field in fields(Guess)})


def _alone(answer: Answer) -> tuple[Possible, ...]:
    """What a display may show of which one number is known."""
    if answer.text is None or answer.value is None:
        return ()
    return (Possible(text=answer.text, value=answer.value, probability=answer.confidence),)


def probability(evidence: Sequence[tuple[float, float, float]]) -> float:
    """Confidence from independent pieces of evidence by a logistic sum.

    Args:
        evidence: `(measured, half, scale)` triples: each adds `(measured - half) / scale`. Doubt counts up to -6,
            assurance up to +1: no strong point outweighs a weak one.
    """
    total = sum(float(np.clip((measured - half) / scale, -6.0, 1.0)) for measured, half, scale in evidence)
    return float(1.0 / (1.0 + np.exp(-total)))


def limited(status: PatchReading, most: float) -> PatchReading:
    """The same status with a confidence of at most `most`."""
    return status if status.confidence <= most else replace(status, confidence=most)
