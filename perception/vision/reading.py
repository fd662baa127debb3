"""What an object says: value, state or text with uncertainty and confidence, or the reason why it cannot be told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from perception.vision.view import Array

ANSWER_AT = 0.5  # below this confidence a reading is refused


@dataclass(frozen=True, slots=True, kw_only=True)
class Possible:
    """A number that what is seen of a refused display allows: how it is written, its value, and its probability."""

    text: str
    value: float
    probability: float

    @property
    def half_digit(self) -> float:
        """Half of what the last digit counts: the number's own uncertainty."""
        return 0.5 * 10.0 ** -len(self.text.partition(".")[2])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """At most one of `value`, `state` and `text` leads; a refusal has none of them, and a `reason`.

    Attributes:
        value: in `unit`; a display has its text's number here too.
        uncertainty: one sigma of `value`, same unit.
        confidence: 0 to 1, the expected share of right answers among such readings.
        reason: why no answer is given and what would help; None for an answer.
        possible: what a refused display may show, likeliest first; empty where nothing is known.
    """

    value: float | None = None
    unit: str = ""
    uncertainty: float | None = None
    state: str | None = None
    text: str | None = None
    confidence: float = 0.0
    reason: str | None = None
    possible: tuple[Possible, ...] = ()

    @property
    def answered(self) -> bool:
        """Whether there is an answer."""
        return self.reason is None


@dataclass(frozen=True, slots=True, kw_only=True)
class Status(Answer):
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

    def saying(self, status: Status) -> ObjectReading:
        """The object, found where it should be, with what its reader says of it."""
        return replace(self, present=True, **{field.name: getattr(status, field.name) for field in fields(Answer)})


def refused(reason: str, *, confidence: float = 0.0, unit: str = "", possible: tuple[Possible, ...] = ()) -> Status:
    """No answer, with its reason (cause, then what would help)."""
    return Status(reason=reason, confidence=confidence, unit=unit, possible=possible)


def gated(status: Status) -> Status:
    """The same answer, or a refusal when its confidence is too low."""
    if not status.answered or status.confidence >= ANSWER_AT:
        return status
    possible: tuple[Possible, ...] = ()
    if status.text is not None and status.value is not None:
        possible = (Possible(text=status.text, value=status.value, probability=status.confidence),)
    return refused(
        "the evidence is too weak: come closer, change the angle or the light",
        confidence=status.confidence,
        unit=status.unit,
        possible=possible,
    )


def probability(evidence: Sequence[tuple[float, float, float]]) -> float:
    """Confidence from independent pieces of evidence by a logistic sum.

    Args:
        evidence: `(measured, half, scale)` triples: each adds `(measured - half) / scale`. Doubt counts up to -6,
            assurance up to +1: no strong point outweighs a weak one.
    """
    total = sum(float(np.clip((measured - half) / scale, -6.0, 1.0)) for measured, half, scale in evidence)
    return float(1.0 / (1.0 + np.exp(-total)))


def limited(status: Status, most: float) -> Status:
    """The same status with a confidence of at most `most`."""
    return status if status.confidence <= most else replace(status, confidence=most)
