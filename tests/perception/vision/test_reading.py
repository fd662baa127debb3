"""A refusal keeps its best guess, and the caller chooses the confidence that is sufficient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from perception.vision.reading import (
    ANSWER_AT,
    MOST_DOUBTED,
    Guess,
    ObjectReading,
    PatchReading,
    Possible,
    answer_at,
    as_often_right,
    doubted,
    gated,
    refused,
)

SHOWS = PatchReading(value=4.5, unit="bar", uncertainty=0.1, confidence=0.3)
NUMBERS = tuple(Possible(text=text, value=float(text), probability=0.3) for text in ("4.5", "4.8"))
NOWHERE = ObjectReading(name="t", kind="gauge", present=False, centre_px=np.zeros(2), outline_px=np.zeros((4, 2)))


def test_a_sure_answer_passes_the_gate_as_it_is() -> None:
    sure = replace(SHOWS, confidence=ANSWER_AT)
    assert gated(sure) is sure and gated(sure, "odd", NUMBERS) is sure


def test_a_refusal_says_nothing_aloud_and_keeps_what_it_would_have_said() -> None:
    refusal = gated(SHOWS, "too dark: add light")
    assert not refusal.answered and refusal.value is None and refusal.uncertainty is None
    assert (refusal.reason, refusal.unit, refusal.confidence) == ("too dark: add light", "bar", 0.3)
    assert refusal.guess == Guess(value=4.5, uncertainty=0.1)


def test_who_asks_for_less_gets_the_guess_and_its_confidence() -> None:
    refusal = gated(SHOWS)
    for least in (0.0, 0.2, 0.3):
        said = answer_at(refusal, least)
        assert said.answered and (said.value, said.uncertainty, said.confidence) == (4.5, 0.1, 0.3)
        assert said.guess is None
    assert answer_at(refusal, 0.31) is refusal


def test_who_asks_for_more_is_refused_what_others_get() -> None:
    sure = replace(SHOWS, confidence=0.8)
    assert answer_at(sure, 0.8) is sure
    refusal = answer_at(sure, 0.9)
    assert not refusal.answered and refusal.reason and refusal.value is None
    assert answer_at(refusal, ANSWER_AT).value == 4.5


def test_the_default_changes_nothing() -> None:
    for status in (replace(SHOWS, confidence=0.7), gated(SHOWS), refused("not there: come closer")):
        assert answer_at(status, ANSWER_AT) is status


def test_a_refusal_without_a_guess_stays_one_whatever_is_asked_for() -> None:
    refusal = refused("glare: change the angle")
    assert answer_at(refusal, 0.0) is refusal and as_often_right(refusal, 0.4) is refusal


def test_a_display_keeps_its_possible_numbers_on_both_sides_of_the_gate() -> None:
    shown = replace(SHOWS, text="4.5")
    assert gated(shown).possible == (Possible(text="4.5", value=4.5, probability=0.3),)
    refusal = gated(shown, "a cable", NUMBERS)
    assert refusal.possible == NUMBERS
    assert answer_at(refusal, 0.0).text == "4.5" and answer_at(refusal, 0.0).possible == NUMBERS


def test_what_a_reader_doubts_is_refused_however_sure_and_never_surer_than_an_answer() -> None:
    doubt = doubted(PatchReading(state="on", confidence=0.97), "no bat stands out: add light")
    assert not doubt.answered and doubt.confidence == MOST_DOUBTED < ANSWER_AT
    assert answer_at(doubt, 0.0).state == "on"


@pytest.mark.parametrize("least", [0.0, 0.2, 0.45])
def test_stretched_confidences_keep_their_order_and_stay_refused(least: float) -> None:
    weak = [
        as_often_right(gated(replace(SHOWS, confidence=float(c))), least).confidence for c in np.linspace(0, 0.499, 20)
    ]
    assert weak[0] == pytest.approx(least) and (np.diff(weak) > 0).all() and weak[-1] < ANSWER_AT
    sure = replace(SHOWS, confidence=0.6)
    assert as_often_right(sure, least) is sure


def test_an_object_keeps_its_place_through_the_gate() -> None:
    reading = NOWHERE.saying(gated(SHOWS))
    said = answer_at(reading, 0.0)
    assert said.present and said.answered and said.value == 4.5 and said.centre_px is reading.centre_px
    assert not answer_at(NOWHERE, 0.0).answered, "what is not there says nothing"
