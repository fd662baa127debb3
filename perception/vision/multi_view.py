"""Merging of several views of one object, because an occluder in one view rarely hides the same part in another."""

from __future__ import annotations

import math
from collections.abc import Sequence

from perception.vision.reading import ANSWER_AT, ObjectReading, PatchReading

UNLISTED = 0.01  # probability of a number that a view does not list, because the view may be wrong
MOST_CONFIDENT = 0.9  # highest confidence in a number that no single view could determine
SIGMAS = 5.0  # largest difference of two consistent values, in standard deviations


def merge_views(looks: Sequence[ObjectReading]) -> ObjectReading:
    """Merge the readings of several views into one.

    The most confident answer is returned unless another view contradicts it. If no view gives an answer, the numbers of
    a display that the views leave possible are weighted together; a number that one view excludes is unlikely.

    Args:
        looks: readings of one object, the most frontal first; at least one.
    """
    answers = [look for look in looks if look.answered]
    if not answers:
        return _from_what_is_left(looks)
    best = max(answers, key=lambda look: look.confidence)
    against = next((look for look in looks if not _allows(look, best)), None)
    if against is None:
        return best
    return best.saying(
        PatchReading(
            unit=best.unit,
            possible=against.possible,
            reason=f"two looks contradict each other ({_said(best)} and {_said(against)}): look again, or change the light",
        )
    )


def _allows(look: ObjectReading, answer: ObjectReading) -> bool:
    """Return whether a view's reading is compatible with `answer`."""
    if look.answered:
        if look.text is not None or look.state is not None:
            return (look.text, look.state) == (answer.text, answer.state)
        if look.value is None or answer.value is None:
            return True
        sigma = math.hypot(look.uncertainty or 0.0, answer.uncertainty or 0.0)
        return abs(look.value - answer.value) <= SIGMAS * sigma
    listed = {number.text: number.probability for number in look.possible}
    return answer.text in listed or sum(listed.values()) < ANSWER_AT


def _from_what_is_left(looks: Sequence[ObjectReading]) -> ObjectReading:
    """Return the number that all views of a display leave possible, or a refusal.

    The refusal is that of the first view that shows the object.
    """
    first = next((look for look in looks if look.present), looks[0])
    lists = [{number.text: number.probability for number in look.possible} for look in looks if look.possible]
    if len(lists) < 2:
        return first
    numbers = {number.text: number for look in looks for number in look.possible}
    likelihood = {text: math.prod(listed.get(text, UNLISTED) for listed in lists) for text in numbers}
    best = max(likelihood, key=lambda text: likelihood[text])
    trust = min(sum(listed.values()) for listed in lists)
    confidence = min(trust * likelihood[best] / sum(likelihood.values()), MOST_CONFIDENT)
    if confidence < ANSWER_AT:
        return first
    number = numbers[best]
    return first.saying(
        PatchReading(
            value=number.value, unit=first.unit, uncertainty=number.half_digit, text=number.text, confidence=confidence
        )
    )


def _said(look: ObjectReading) -> str:
    """Return the answer of a view as a short text."""
    if look.answered:
        return look.text or look.state or f"{look.value:.4g} {look.unit}".strip()
    return " or ".join(number.text for number in look.possible)
