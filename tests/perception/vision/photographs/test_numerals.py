"""Numbers around a dial, the scale that they tell, and gauges of which nothing is told."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.printed_text import Print
from benchmarks.vision_manometers import Way, draw_manometer
from hal.arrays import Image
from perception.vision import read_photograph
from perception.vision.photographs.numeral_scale import printed_scales
from perception.vision.photographs.numerals import Number, find_numbers

RADIUS_PX = 200
STEPS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 20.0, 50.0, 100.0)


def face(texts: dict[str, tuple[float, float]]) -> Image:
    """Return a bright square with texts at (angle from up, clockwise, rad; distance over the radius)."""
    gray = np.full((2 * RADIUS_PX + 20, 2 * RADIUS_PX + 20), 220, np.uint8)
    for text, (angle_rad, off) in texts.items():
        (w, h), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 0.9, 2)
        x = RADIUS_PX + 10 + off * RADIUS_PX * np.sin(angle_rad) - w / 2
        y = RADIUS_PX + 10 - off * RADIUS_PX * np.cos(angle_rad) + h / 2
        cv2.putText(gray, text, (round(x), round(y)), cv2.FONT_HERSHEY_DUPLEX, 0.9, 30, 2, cv2.LINE_AA)
    return gray


def numbers_on(gray: Image) -> dict[str, Number]:
    upright_dark = find_numbers(gray, RADIUS_PX + 10, RADIUS_PX + 10, RADIUS_PX)[0]
    return {number.text: number for number in upright_dark}


def test_numbers_are_found_with_points_and_signs_at_their_places() -> None:
    places = {"-20": (-2.0, 0.7), "0.5": (-1.0, 0.75), "160": (0.0, 0.7), "37": (1.2, 0.75), "2.5": (2.2, 0.7)}
    found = numbers_on(face(places))
    for text, (angle_rad, off) in places.items():
        assert found[text].value == float(text)
        assert found[text].angle_rad == pytest.approx(angle_rad, abs=0.09)
        assert found[text].off == pytest.approx(off, abs=0.06)


def test_digits_of_a_word_are_no_number() -> None:
    found = numbers_on(face({"EN837W": (0.0, 0.5), "60": (2.0, 0.75)}))
    assert "60" in found and not {"8", "3", "7", "837"} & set(found)


def printed(value: float, angle_rad: float, off: float = 0.75, height: float = 0.1, probability: float = 0.9) -> Number:
    return Number(
        value=value,
        text=f"{value:g}",
        angle_rad=float(np.angle(np.exp(1j * angle_rad))),
        off=off,
        height=height,
        probability=probability,
    )


@given(
    step=st.sampled_from(STEPS),
    count=st.integers(5, 11),
    first=st.sampled_from([0, 0, 0, -2, 3]),
    span_rad=st.floats(1.5, 5.5),
    begin_rad=st.floats(-3.1, 3.1),
    falls=st.booleans(),
    wrong=st.lists(st.tuples(st.integers(0, 99), st.floats(-3.1, 3.1), st.floats(0.4, 0.9)), max_size=8),
    seed=st.integers(0, 1000),
)
def test_a_scale_is_told_by_its_numbers_whatever_stands_between_them(
    step: float, count: int, first: int, span_rad: float, begin_rad: float, falls: bool,
    wrong: list[tuple[int, float, float]], seed: int,
) -> None:  # fmt: skip
    """Two-digit numbers with angles that err by a degree are found among as many others on any ring."""
    values = [round((first + k) * step, 6) for k in range(count)]
    angles = begin_rad + np.linspace(0.0, span_rad, count) * (-1 if falls else 1)
    angles += np.random.default_rng(seed).uniform(-0.015, 0.015, count)
    numbers = [printed(value, angle) for value, angle in zip(values, angles, strict=True)]
    others = [printed(value, angle, off, height=0.05) for value, angle, off in wrong]
    scales = printed_scales([[*others, *numbers], []])
    assert any((one.minimum, one.maximum) == pytest.approx((values[0], values[-1])) for one in scales)
    found = next(one for one in scales if (one.minimum, one.maximum) == pytest.approx((values[0], values[-1])))
    assert found.at_max - found.at_min == pytest.approx(-span_rad if falls else span_rad, abs=0.06)
    assert np.exp(1j * (found.at_min - angles[0])) == pytest.approx(1.0, abs=0.05)


def test_few_numbers_are_not_sure_and_a_scale_goes_on_to_where_it_is_upright() -> None:
    read = [printed(value, angle) for value, angle in ((0.0, -2.356), (40.0, -1.178), (80.0, 0.0), (120.0, 1.178))]
    found = printed_scales([read])[0].whole()
    assert (found.maximum, found.at_max) == (160.0, pytest.approx(2.356, abs=0.01))
    assert found.confidence < 0.8
    assert printed_scales([read[:2]]) == []


def test_numbers_that_no_scale_has_tell_none() -> None:
    assert printed_scales([[printed(value, 0.7 * k) for k, value in enumerate((3.0, 81.0, 17.0, 55.0))]]) == []


@pytest.mark.parametrize("how", [Print(font="DejaVuSans", height=0.11, is_radial=radial) for radial in (False, True)])
def test_gauges_of_which_nothing_is_told_are_read(how: Print) -> None:
    right = answered = 0
    for seed in (301, 310, 322, 240):
        drawn = draw_manometer(seed, Way(print=how))
        found = read_photograph(drawn.image, "gauge")
        answered += found.answered
        right += found.value is not None and abs(found.value - 0.1 * drawn.full * drawn.reading) < 0.025 * drawn.full
        assert found.scale is None or found.confidence < 0.8 or found.scale.maximum == drawn.full
    assert right == answered == 4


def test_a_gauge_whose_numerals_run_the_other_way_is_read_so() -> None:
    drawn = draw_manometer(208, Way(print=Print(font="DejaVuSans", height=0.11, is_radial=False), falls=True))
    found = read_photograph(drawn.image, "gauge")
    assert found.value == pytest.approx(0.1 * drawn.full * drawn.reading, abs=0.025 * drawn.full)
    assert found.scale is not None and found.scale.at_max_rad < found.scale.at_min_rad
