"""Gauges with two pointers, and with values that fall clockwise: the asked pointer is read, none is guessed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.vision_dials import draw_dial
from benchmarks.vision_manometers import UNUSUAL, USUAL, Way, draw_manometer
from hal.arrays import Image
from perception.vision import read_photograph
from perception.vision.photographs.dial import BY_TICKS, NARROW, NARROW_RAD, RED_UNASKED
from perception.vision.photographs.hands import Pointer, find_hands

TWO = Way(has_red=True)
SCALE, ENDS = (0.0, 10.0), (TWO.angle_rad(0.0), TWO.angle_rad(1.0))
SEEDS = range(200000, 200006)


@pytest.mark.parametrize("seed", SEEDS)
def test_of_two_pointers_the_asked_one_is_read(seed: int) -> None:
    drawn = draw_manometer(seed, TWO)
    for pointer, truth in (("black", drawn.reading), ("red", drawn.red)):
        asked: Pointer = "red" if pointer == "red" else "black"
        told = read_photograph(drawn.image, "gauge", scale=SCALE, ends_rad=ENDS, pointer=asked)
        assert told.value == pytest.approx(truth, abs=0.25)


@pytest.mark.parametrize("seed", SEEDS)
def test_of_two_pointers_none_is_guessed_and_both_are_named(seed: int) -> None:
    drawn = draw_manometer(seed, TWO)
    told = read_photograph(drawn.image, "gauge", scale=SCALE, ends_rad=ENDS)
    assert told.value is None and told.reason is not None and "two pointers" in told.reason and "red" in told.reason
    assert {seen.colour for seen in told.pointers} == {"black", "red"}
    values = {seen.colour: seen.value for seen in told.pointers}
    assert values["black"] == pytest.approx(drawn.reading, abs=0.25)
    assert values["red"] == pytest.approx(drawn.red, abs=0.25)
    assert all(0.3 <= seen.length <= 1.0 for seen in told.pointers)


def test_a_red_pointer_that_is_not_there_is_not_read() -> None:
    drawn = draw_manometer(5)
    told = read_photograph(drawn.image, "gauge", scale=SCALE, pointer="red")
    assert told.value is None and told.reason is not None and "no red pointer" in told.reason
    gray = cv2.cvtColor(draw_manometer(SEEDS[0], TWO).image, cv2.COLOR_RGB2GRAY)
    colourless = read_photograph(gray, "gauge", scale=SCALE, pointer="red")
    assert colourless.value is None and colourless.reason is not None and "colour" in colourless.reason


def test_the_length_of_a_pointer_is_a_share_of_the_radius() -> None:
    picture = np.full((220, 220, 3), 235, np.uint8)
    for length, angle, colour in ((0.85, 1.0, (20, 20, 20)), (0.65, -1.4, (200, 30, 30))):
        tip = (round(110 + 100 * length * np.sin(angle)), round(110 - 100 * length * np.cos(angle)))
        cv2.line(picture, (110, 110), tip, colour, 4, cv2.LINE_AA)
    hands = find_hands(picture, (110.0, 110.0, 100.0), None)
    assert not isinstance(hands, str)
    lengths = {hand.colour: hand.length for hand in hands}
    assert lengths["black"] == pytest.approx(0.85, abs=0.04)
    assert lengths["red"] == pytest.approx(0.65, abs=0.04)


@pytest.mark.parametrize("seed", range(200000, 200004))
def test_values_that_fall_clockwise_are_read_where_the_scale_is_told_so(seed: int) -> None:
    gauge = draw_manometer(seed, Way(falls=True))
    told = read_photograph(gauge.image, "gauge", scale=(10.0, 0.0))
    assert told.value == pytest.approx(gauge.reading, abs=0.25)
    assert told.uncertainty is not None and told.uncertainty > 0.0
    dial = draw_dial(seed, falls=True, circular=True)
    turn = read_photograph(dial.image, "dial", scale=(10.0, 0.0))
    assert turn.value is None or abs((turn.value - dial.reading + 5.0) % 10.0 - 5.0) < 0.2


@pytest.mark.parametrize("way", [USUAL, *UNUSUAL.values()])
def test_a_falling_scale_given_by_its_ends_is_the_rising_one_mirrored(way: Way) -> None:
    drawn = draw_manometer(70003, way)
    low, high = way.angle_rad(0.0), way.angle_rad(1.0)
    rising = read_photograph(drawn.image, "gauge", scale=(0.0, 10.0), ends_rad=(low, high))
    falling = read_photograph(drawn.image, "gauge", scale=(10.0, 0.0), ends_rad=(low, high))
    assert rising.value is not None and falling.value is not None
    assert rising.value + falling.value == pytest.approx(10.0)


def test_ends_that_no_tick_confirms_are_not_sure() -> None:
    picture = np.full((220, 220, 3), 235, np.uint8)
    cv2.circle(picture, (110, 110), 104, (40, 40, 40), 4, cv2.LINE_AA)
    cv2.line(picture, (110, 110), (175, 70), (20, 20, 20), 4, cv2.LINE_AA)
    told = read_photograph(picture, "gauge", scale=SCALE, least_confidence=0.0)
    assert told.confidence <= BY_TICKS
    sure = read_photograph(picture, "gauge", scale=SCALE, ends_rad=ENDS)
    assert sure.confidence > BY_TICKS


def test_a_bright_gap_beside_a_pointer_is_not_read() -> None:
    """In this drawing the gap between a pointer and a shadow was read surely, 2 % of the scale away."""
    drawn = draw_manometer(200000, TWO)
    told = read_photograph(drawn.image, "gauge", scale=SCALE, ends_rad=ENDS, pointer="black")
    assert told.value == pytest.approx(drawn.reading, abs=0.25)


@pytest.mark.parametrize("seed", [910002, 310102, 320191])
def test_a_red_pointer_is_never_read_for_a_black_one(seed: int) -> None:
    """In these drawings the red pointer is so thin or so lit that the search in redness alone misses it."""
    drawn = draw_manometer(seed, TWO)
    told = read_photograph(drawn.image, "gauge", scale=SCALE, ends_rad=ENDS, pointer="black")
    assert told.value is None or told.value == pytest.approx(drawn.reading, abs=0.25)


def test_a_red_pointer_that_nobody_asked_for_is_not_sure() -> None:
    picture = _face_with_line((200, 30, 30))
    assert read_photograph(picture, "gauge", scale=SCALE, ends_rad=ENDS, least_confidence=0.0).confidence <= RED_UNASKED
    asked = read_photograph(picture, "gauge", scale=SCALE, ends_rad=ENDS, pointer="red")
    black = read_photograph(_face_with_line((20, 20, 20)), "gauge", scale=SCALE, ends_rad=ENDS)
    assert asked.confidence > RED_UNASKED and black.confidence > RED_UNASKED


def test_a_reading_on_a_narrow_scale_is_not_sure() -> None:
    half = 0.49 * NARROW_RAD
    picture = _face_with_line((20, 20, 20), angle_rad=0.2)
    narrow = read_photograph(picture, "gauge", scale=SCALE, ends_rad=(-half, half), least_confidence=0.0)
    wide = read_photograph(picture, "gauge", scale=SCALE, ends_rad=(-2 * half, 2 * half))
    assert narrow.confidence <= NARROW < wide.confidence


@pytest.mark.parametrize("seed", [310005, 310071])
def test_a_pointer_off_the_middle_or_in_a_reflection_still_comes_from_the_hub(seed: int) -> None:
    drawn = draw_manometer(seed, USUAL)
    told = read_photograph(drawn.image, "gauge", scale=SCALE, ends_rad=ENDS)
    assert told.value == pytest.approx(drawn.reading, abs=0.25)


def _face_with_line(colour: tuple[int, int, int], angle_rad: float = 1.0) -> Image:
    """Draw a white face with a rim and one pointer."""
    picture = np.full((220, 220, 3), 235, np.uint8)
    cv2.circle(picture, (110, 110), 104, (40, 40, 40), 4, cv2.LINE_AA)
    tip = (round(110 + 85 * np.sin(angle_rad)), round(110 - 85 * np.cos(angle_rad)))
    cv2.line(picture, (110, 110), tip, colour, 4, cv2.LINE_AA)
    return picture
