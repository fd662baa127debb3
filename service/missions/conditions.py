"""Decides whether conditions are met by what was just seen: met, unmet, or unknown, with the reason as a sentence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from service.schema.mission_file import Condition

if TYPE_CHECKING:
    from perception.vision import ObjectReading

INTERVAL_SIGMAS = 1.96  # an interval that holds the true value in 95 % of cases


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What a fresh look has shown of one object; a refused reading has a `cause` and nothing else."""

    value: float | None = None
    sigma: float = 0.0
    state: str | None = None
    cause: str | None = None

    @classmethod
    def of(cls, reading: ObjectReading) -> Seen:
        """Return what a reading shows."""
        if not reading.answered:
            return cls(cause=reading.reason or "it is not where the panel file says")
        return cls(value=reading.value, sigma=reading.uncertainty or 0.0, state=reading.state)


class Answer(StrEnum):
    """The answer to a condition."""

    MET = "met"
    UNMET = "unmet"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """The answer to all conditions of a step together, and the sentences about those that are not met."""

    answer: Answer
    says: str = ""


def judge(conditions: Iterable[Condition], seen: Mapping[str, Seen]) -> Finding:
    """Return whether all conditions are met; one that is unmet decides, whatever is unknown."""
    answers = [answer_of(condition, seen.get(condition.object)) for condition in conditions]
    for answer in (Answer.UNMET, Answer.UNKNOWN):
        if told := [says for found, says in answers if found is answer]:
            return Finding(answer=answer, says="; ".join(told))
    return Finding(answer=Answer.MET)


def answer_of(condition: Condition, seen: Seen | None) -> tuple[Answer, str]:
    """Return the answer to one condition, with a sentence."""
    name = condition.object
    if seen is None or seen.cause is not None:
        why = "it was not looked at" if seen is None else seen.cause
        return Answer.UNKNOWN, f"{name} cannot be read: {why}"
    if condition.state is not None:
        if seen.state is None:
            return Answer.UNKNOWN, f"{name} shows no state"
        is_met = seen.state == condition.state
        return (Answer.MET if is_met else Answer.UNMET), f"{name} is {seen.state}, not {condition.state}"
    if seen.value is None:
        return Answer.UNKNOWN, f"{name} shows no value"
    return _of_value(condition, seen.value, INTERVAL_SIGMAS * seen.sigma)


def _of_value(condition: Condition, value: float, half: float) -> tuple[Answer, str]:
    told = f"{condition.object} shows {value:.4g} {condition.unit or ''}".rstrip()
    sides = ((1.0, condition.below, "below"), (-1.0, condition.above, "above"))
    excesses = [(sign * (value - limit), word, limit) for sign, limit, word in sides if limit is not None]
    for excess, word, limit in excesses:
        if excess >= half and excess >= 0.0:
            return Answer.UNMET, f"{told}, not {word} {limit:g}"
    for excess, word, limit in excesses:
        if excess > -half:
            interval = f"{value - half:.4g} to {value + half:.4g}"
            return Answer.UNKNOWN, f"{told}, and its interval {interval} straddles {word} {limit:g}"
    return Answer.MET, told
