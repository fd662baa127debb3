"""Readings: value, state or text with uncertainty and confidence, or the reason for a refusal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

from hal.arrays import Array

ANSWER_AT = 0.5  # confidence below which a reading is refused, unless the caller asks for less or for more
MOST_DOUBTED = 0.49  # highest confidence of a guess that a reader has a reason to refuse
FULL_TURN_RAD = 2 * np.pi - 1e-6
NO_EDGE = "the cap's edge cannot be found: come closer or add light"
ALIKE = "pressed and released look alike from here: look from the side or closer"
TOO_WEAK = "the evidence is too weak: come closer, change the angle or the light"


@dataclass(frozen=True, slots=True, kw_only=True)
class Possible:
    """A number that a refused display may show: its text, its value, and its probability."""

    text: str
    value: float
    probability: float

    @property
    def half_digit(self) -> float:
        """Half a unit of the last digit, which is the uncertainty of the number as displayed."""
        return 0.5 * 10.0 ** -len(self.text.partition(".")[2])


@dataclass(frozen=True, slots=True, kw_only=True)
class Guess:
    """The reading that a refusal withholds; the fields are those of `Answer` of the same names."""

    value: float | None = None
    uncertainty: float | None = None
    state: str | None = None
    text: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """An answer or a refusal.

    An answer has `value`, `state` or `text`; a refusal has none of them, and a `reason`.

    Attributes:
        value: in `unit`; for a display the number of its text.
        uncertainty: standard deviation of `value`, same unit.
        confidence: 0 to 1, the expected share of correct answers among such readings; of a refusal, that its guess is
            correct.
        reason: why no answer is given and what would help; None for an answer.
        possible: numbers that a refused display may show, likeliest first; empty if nothing is known.
        guess: the reading that a refusal withholds, for callers that accept less than `ANSWER_AT` (see `answer_at`).
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
class SeenPointer:
    """One of several pointers on a face: its colour, its length as a share of the face's radius, and its value."""

    colour: str
    length: float
    value: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenScale:
    """The scale by which a gauge was read: its end values, and the pointer's angles there, rad clockwise from up.

    `by_numerals`: whether numerals on the face show it.
    """

    minimum: float
    maximum: float
    at_min_rad: float
    at_max_rad: float
    by_numerals: bool = False

    @property
    def is_full_turn(self) -> bool:
        """Whether the scale closes."""
        return abs(self.at_max_rad - self.at_min_rad) > FULL_TURN_RAD


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenFace:
    """Where the round face of an instrument is in a picture, seen aslant or not, px.

    Attributes:
        middle: (u, v).
        right, up: from the middle to the rim, where a pointer is that points to the right, and straight up.
    """

    middle: tuple[float, float]
    right: tuple[float, float]
    up: tuple[float, float]

    def moved(self, move: Array) -> SeenFace:
        """Return the face in the picture whose pixels are those of this one times the projective map `move` (3, 3)."""
        tips = np.array([self.middle, np.add(self.middle, self.right), np.add(self.middle, self.up)])
        there = np.column_stack([tips, np.ones(3)]) @ move.T
        middle, right, up = there[:, :2] / there[:, 2:]
        return SeenFace(
            middle=_pair(middle), right=_pair(right - middle), up=_pair(up - middle)
        )  # fmt: skip


def _pair(place: Array) -> tuple[float, float]:
    u, v = place
    return float(u), float(v)


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """How a reading changes over several pictures, oldest first.

    Attributes:
        values: in each picture; None where it was not read.
        amplitude: half of their range about the trend.
        trend: mean change from one picture to the next.
    """

    values: tuple[float | None, ...]
    amplitude: float
    trend: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchReading(Answer):
    """Reading of the object in a patch.

    Attributes:
        pointers: those of a gauge that has more than one.
        scale: of a gauge in a photograph, what was taken for its scale.
        face: of a gauge or a dial in a photograph, where its face is.
        motion: of an instrument in several pictures, of which `value` is the mean.
    """

    pointers: tuple[SeenPointer, ...] = ()
    scale: SeenScale | None = None
    face: SeenFace | None = None
    motion: Motion | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectReading(Answer):
    """Reading of one object of a taught panel in one image.

    Attributes:
        present: whether something that looks like the object is at the position in the panel file.
        centre_px: (2,) refined middle of the object in the image.
        centre_m: (3,) position in the panel frame according to this image, on the plate; None without a camera pose.
        centre_covariance_m2: (3, 3) of `centre_m`, panel axes.
        outline_px: (N, 2) contour in the image, for drawing.
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
        """Whether two states look alike from here, so that a nearer view from a side would help."""
        return self.reason in (NO_EDGE, ALIKE)

    def saying(self, status: PatchReading) -> ObjectReading:
        """Return the object as present, with the reading `status`."""
        return replace(self, present=True, **{field.name: getattr(status, field.name) for field in fields(Answer)})

    def in_doubt(self, reason: str) -> ObjectReading:
        """Return the object as refused for that reason, with its reading as the guess."""
        return doubted(self, reason)


def refused(reason: str, *, unit: str = "") -> PatchReading:
    """Return a refusal without a guess; `reason` states the cause, then what would help."""
    return PatchReading(reason=reason, unit=unit)


def doubted(status: A, reason: str) -> A:
    """Return a refusal with that reason, with the status as its guess."""
    return answer_at(limited(status, MOST_DOUBTED), ANSWER_AT, reason)


def gated(status: PatchReading, reason: str = TOO_WEAK, possible: tuple[Possible, ...] = ()) -> PatchReading:
    """Return the status unchanged, or, if its confidence is too low, a refusal with the status as its guess.

    Args:
        reason: of the refusal.
        possible: numbers that a display may show if it is refused.
    """
    refusal = answer_at(status, ANSWER_AT, reason)
    return replace(refusal, possible=possible) if possible and refusal.guess else refusal


def as_often_right(status: PatchReading, least: float) -> PatchReading:
    """Return the status with the confidence of a guess mapped to a range that begins at `least`.

    `least` is the share of guesses that are correct without any evidence. The confidence of readers is meant for
    deciding about refusals; for guesses of kinds with few states it is too low.
    """
    if status.guess is None:
        return status
    return replace(status, confidence=least + (MOST_DOUBTED - least) * status.confidence / ANSWER_AT)


def answer_at(answer: A, least_confidence: float, reason: str = TOO_WEAK) -> A:
    """Return the answer for a caller that requires the given confidence.

    Guesses that reach it become answers, and answers below it become refusals with a guess.
    """
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
    """Return the fields of an answer as a guess."""
    return Guess(**{field.name: getattr(answer, field.name) for field in fields(Guess)})


def _alone(answer: Answer) -> tuple[Possible, ...]:
    """Return the number of a display's answer as the only possible one; nothing for other objects."""
    if answer.text is None or answer.value is None:
        return ()
    return (Possible(text=answer.text, value=answer.value, probability=answer.confidence),)


def probability(evidence: Sequence[tuple[float, float, float]]) -> float:
    """Return the confidence from independent pieces of evidence, by a logistic sum.

    Args:
        evidence: triples `(measured, half, scale)`, each of which adds `(measured - half) / scale`, limited to -6 and
        +1:
            strong evidence for an answer cannot outweigh evidence against it.
    """
    total = sum(float(np.clip((measured - half) / scale, -6.0, 1.0)) for measured, half, scale in evidence)
    return float(1.0 / (1.0 + np.exp(-total)))


def limited(status: A, most: float) -> A:
    """Return the status with a confidence of at most `most`."""
    return status if status.confidence <= most else replace(status, confidence=most)
