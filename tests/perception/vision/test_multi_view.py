"""Several views of an object are combined into one reading, never into a number that one of them excludes."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from perception.vision.multi_view import merge_views
from perception.vision.reading import ObjectReading, PatchReading, Possible

NOWHERE = ObjectReading(name="t", kind="display", present=True, centre_px=np.zeros(2), outline_px=np.zeros((4, 2)))


def shows(text: str, confidence: float) -> ObjectReading:
    return NOWHERE.saying(PatchReading(text=text, value=float(text), confidence=confidence, uncertainty=0.05))


def may_show(**share: float) -> ObjectReading:
    """Return a refused display reading; `_64_1=0.5` means the number 64.1 with probability 0.5."""
    numbers = tuple(
        Possible(text=(text := name[1:].replace("_", ".")), value=float(text), probability=probability)
        for name, probability in share.items()
    )
    return NOWHERE.saying(
        PatchReading(reason="something lies across", possible=numbers, confidence=max(share.values()))
    )


def measures(value: float, sigma: float, confidence: float = 0.9) -> ObjectReading:
    return NOWHERE.saying(PatchReading(value=value, unit="bar", uncertainty=sigma, confidence=confidence))


def test_one_look_is_what_it_is() -> None:
    for look in (shows("64.1", 0.9), may_show(_64_1=0.5, _84_1=0.5), NOWHERE):
        assert merge_views([look]) is look


def test_the_surest_answer_holds_in_any_order() -> None:
    looks = [may_show(_64_1=0.45, _84_1=0.45), shows("64.1", 0.7), shows("64.1", 0.9)]
    for order in permutations(looks):
        assert merge_views(order) is looks[2]


@pytest.mark.parametrize(
    "looks",
    [
        [shows("64.1", 0.95), shows("84.1", 0.6)],
        [may_show(_64_1=0.5, _84_1=0.45), shows("61.1", 0.9)],
        [measures(4.0, 0.02), measures(4.5, 0.05)],
    ],
)
def test_looks_that_contradict_each_other_are_no_answer(looks: list[ObjectReading]) -> None:
    for order in permutations(looks):
        told = merge_views(order)
        assert not told.answered and told.value is None and told.text is None
        assert told.present and "contradict" in (told.reason or "") and "look again" in (told.reason or "")


def test_values_within_their_uncertainty_agree_and_so_does_a_list_that_is_unsure_of_itself() -> None:
    sure = measures(4.0, 0.02, 0.95)
    assert merge_views([measures(4.05, 0.02), sure]) is sure
    number = shows("61.1", 0.9)
    assert merge_views([may_show(_64_1=0.2, _84_1=0.1), number]) is number


def test_numbers_that_every_look_leaves_open_are_weighed_together() -> None:
    told = merge_views([may_show(_64_1=0.47, _84_1=0.47), may_show(_64_1=0.45, _64_7=0.45)])
    assert told.answered and told.text == "64.1" and told.value == 64.1 and told.uncertainty == 0.05
    assert 0.5 < told.confidence <= 0.9


def test_the_same_doubt_twice_stays_a_doubt() -> None:
    looks = [may_show(_64_1=0.47, _84_1=0.47), may_show(_64_1=0.46, _84_1=0.47)]
    assert merge_views(looks) is looks[0]


def test_where_the_object_showed_counts_before_where_it_did_not() -> None:
    unseen = ObjectReading(
        name="t", kind="display", present=False, centre_px=np.zeros(2), outline_px=np.zeros((4, 2)), reason="covered"
    )
    seen = may_show(_64_1=0.4, _84_1=0.4)
    assert merge_views([unseen, seen]) is seen
    assert merge_views([unseen, unseen]) is unseen
