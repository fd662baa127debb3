"""Pictures that show no upright instrument: a reason or a typed error, never anything else, and nothing sure."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.photographs import METER_NUMERAL
from benchmarks.vision_dials import draw_dial
from benchmarks.vision_manometers import draw_manometer
from hal.errors import InvalidRequest
from perception.vision import read_photograph
from perception.vision.photographs.reader import PhotographKind

SURE = 0.8
GAUGE = draw_manometer(200003).image
DIAL = draw_dial(200003, circular=True, numeral=METER_NUMERAL).image
PICTURES: dict[str, NDArray[Any]] = {
    "noise": np.random.default_rng(0).integers(0, 255, (120, 120, 3)).astype(np.uint8),
    "nothing": np.full((120, 120, 3), 180, np.uint8),
    "two gauges": np.hstack([GAUGE, GAUGE]),
    "upside down": GAUGE[::-1, ::-1],
    "mirrored": GAUGE[:, ::-1],
    "the left half": GAUGE[:, : GAUGE.shape[1] // 2],
    "the upper third": GAUGE[: GAUGE.shape[0] // 3],
    "a dial upside down": DIAL[::-1, ::-1],
    "a dial mirrored": DIAL[:, ::-1],
}
NO_IMAGES = {
    "1 x 1": np.full((1, 1, 3), 9, np.uint8),
    "one row": np.full((1, 300), 99, np.uint8),
    "none": np.zeros((0, 0, 3), np.uint8),
    "40 megapixels": np.zeros((6400, 6300), np.uint8),
    "not of 8 bits": GAUGE.astype(float),
}


def read(picture: NDArray[Any], kind: PhotographKind) -> Any:
    return read_photograph(picture, kind, scale=None if kind == "display" else (0.0, 10.0))


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("kind", ["gauge", "dial"])
def test_what_is_no_upright_instrument_is_refused_or_not_sure(name: str, kind: PhotographKind) -> None:
    told = read(PICTURES[name], kind)
    assert told.confidence < SURE
    assert (told.value is None) == bool(told.reason)


@pytest.mark.parametrize("name", PICTURES)
def test_what_is_no_upright_gauge_has_no_sure_scale_either(name: str) -> None:
    told = read_photograph(PICTURES[name], "gauge")
    assert told.confidence < SURE
    assert (told.value is None) == bool(told.reason)


@pytest.mark.parametrize("name", PICTURES)
def test_where_nothing_is_told_nothing_wrong_is_sure(name: str) -> None:
    told = read_photograph(PICTURES[name])
    assert told.confidence < SURE
    assert (told.value is None) == bool(told.reason)


@pytest.mark.parametrize("name", ["noise", "nothing", "two gauges", "mirrored"])
def test_where_no_display_is_none_is_read(name: str) -> None:
    told = read(PICTURES[name], "display")
    assert told.text is None and told.reason and told.confidence < SURE


@pytest.mark.parametrize("name", NO_IMAGES)
@pytest.mark.parametrize("kind", ["gauge", "dial", "display"])
def test_what_is_no_image_is_an_error_that_says_so(name: str, kind: PhotographKind) -> None:
    with pytest.raises(InvalidRequest) as error:
        read(NO_IMAGES[name], kind)
    assert "image" in error.value.what


def test_gray_and_alpha_change_no_reading() -> None:
    colour = read(GAUGE, "gauge")
    gray = read(cv2.cvtColor(GAUGE, cv2.COLOR_RGB2GRAY), "gauge")
    alpha = read(np.dstack([GAUGE, np.full(GAUGE.shape[:2], 255, np.uint8)]), "gauge")
    assert colour.value is not None
    assert gray.value == pytest.approx(colour.value, abs=0.1)
    assert alpha.value == pytest.approx(colour.value, abs=0.01)
