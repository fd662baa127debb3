"""Rows of digits are found in images without prior knowledge; sides of frames are not taken for ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.display_drawing import draw_photograph
from perception.vision.photographs.digit_search import CELL_PX, MARGIN, STRIDE, cell_scores, find_digit_rows
from perception.vision.photographs.photo_display import FEW_OF_SCENE, ROWS_TRIED, _agreed, read_photographed_display
from perception.vision.reading import PatchReading, refused
from perception.vision.status.digit_grid import LIT_SHARES
from perception.vision.status.digit_grid_worth import cell_boxes
from perception.vision.status.display import read_window
from perception.vision.status.glyphs import LIT
from perception.vision.status.ink import without_border
from tests.perception.vision.status.test_display import window


@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("high", [22, 40, 70])
def test_a_row_of_digits_is_found_where_it_lies(dark: bool, high: int) -> None:
    gray = np.full((300, 480), 120, np.uint8)
    display = window("2608", dark=dark, high=high, slant=0.08)
    gray[60 : 60 + display.shape[0], 90 : 90 + display.shape[1]] = display
    rows = find_digit_rows(gray)[:ROWS_TRIED]  # the gaps between digits resemble digits of the other polarity
    row = next(row for row in rows if row.is_dark == dark)
    assert row.height == pytest.approx(high, rel=0.25)
    assert (row.top + row.bottom) / 2 == pytest.approx(60 + 0.35 * high + high / 2, abs=0.2 * high)
    assert 90 < (row.left + row.right) / 2 < 90 + display.shape[1]


def test_a_cells_score_is_the_share_that_its_best_character_explains() -> None:
    random = np.random.default_rng(4)
    ink = random.uniform(0, 60, (64, 64)).astype(np.float32)
    width = 0.5 * CELL_PX
    boxes = cell_boxes(0.0, CELL_PX, width)
    sums, squares = (np.asarray(cv2.integral(i, sdepth=cv2.CV_64F)) for i in (ink, ink * ink))
    scores = cell_scores(sums, squares, boxes, width, LIT_SHARES)
    row, column = 6, 9
    y, x, border = row * STRIDE, column * STRIDE, int(MARGIN * CELL_PX)
    around = ink[y - border : y + int(CELL_PX) + border, x - border : x + int(width) + border]
    corners = np.floor(boxes[:7] + 0.5).astype(int)
    parts = [ink[y + y0 : y + y1, x + x0 : x + x1] for x0, y0, x1, y1 in corners]
    shares = [
        sum(p.sum() for p, on in zip(parts, lit, strict=True) if on) ** 2
        / sum(p.size for p, on in zip(parts, lit, strict=True) if on) / (around.astype(float) ** 2).sum()
        for lit in LIT if lit.sum() > 3
    ]  # fmt: skip
    assert scores[row, column] == pytest.approx(max(shares), rel=1e-4)


def test_nothing_is_found_in_an_even_picture() -> None:
    gray = np.full((120, 160), 90, np.uint8)
    assert find_digit_rows(gray) == []
    assert not read_photographed_display(gray, scene=True).answered


def test_a_frames_sides_are_no_ones() -> None:
    gray = window("8.0", slant=0.0, pitch=1.6)
    framed = cv2.copyMakeBorder(gray, 0, 0, 12, 12, cv2.BORDER_CONSTANT, value=25)
    framed[:, 8:12] = framed[:, -12:-8] = 170
    assert read_window(framed, digits=None, decimals=None, dark=False).text == "8.0"


@pytest.mark.parametrize("turned_deg", [-6.0, 5.0])
def test_a_turned_crop_is_straightened(turned_deg: float) -> None:
    gray = cv2.copyMakeBorder(window("26.08", dark=True, high=60), 12, 12, 12, 12, cv2.BORDER_REPLICATE)
    size = gray.shape[::-1]
    turn = cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), turned_deg, 1.0)
    assert (
        read_photographed_display(cv2.warpAffine(gray, turn, size, borderMode=cv2.BORDER_REPLICATE), scene=False).text
        == "26.08"
    )


def test_a_frame_that_stands_out_more_than_the_digits_is_left_aside() -> None:
    ink = np.zeros((60, 140), np.float32)
    ink[20:40, 60:64] = 20.0
    ink[:, :6], ink[54:, :] = 200.0, 90.0
    left, _ = without_border(ink, framed=True)
    assert left[20:40, 60:64].min() == 20.0
    left[20:40, 60:64] = 0.0
    assert left.max() < 20.0


@given(st.lists(st.tuples(st.sampled_from(["260", "8.8", None]), st.floats(0.5, 0.96)), min_size=1, max_size=6))
def test_rivals_make_an_answer_less_sure(read: list[tuple[str | None, float]]) -> None:
    answers = [(1.0, PatchReading(text=t, value=1.0, confidence=c) if t else refused("no")) for t, c in read]
    agreed = _agreed(answers)
    assert agreed.confidence <= max((c for t, c in read if t), default=0.0)
    if len({t for t, _ in read if t}) == 1:
        assert agreed.answered and agreed.confidence == pytest.approx(max(c for t, c in read if t))


@pytest.mark.parametrize("text", ["1", "-1", "7"])
def test_a_few_strokes_alone_are_not_sure_since_any_bar_makes_some(text: str) -> None:
    sure = PatchReading(text=text, value=float(text), confidence=0.97)
    assert _agreed([(1.0, sure)], FEW_OF_SCENE).confidence < 0.5
    assert _agreed([(1.0, sure)]).confidence < 0.6


def test_what_stands_in_a_doubtful_place_is_not_sure() -> None:
    sure = PatchReading(text="260", value=260.0, confidence=0.97)
    assert _agreed([(0.4, sure)]).confidence < 0.7
    assert _agreed([(0.4, sure), (1.0, sure)]).confidence == 0.97


@pytest.mark.parametrize(("high", "low", "text"), [(0.3, 0.7, "12:58"), (0.3, None, None)])
def test_two_dots_between_digits_are_a_clocks_colon(high: float, low: float | None, text: str | None) -> None:
    gray = window("1258", dark=True, high=60, slant=0.0, pitch=1.6)
    for y in (high, low):
        if y is not None:
            cv2.circle(gray, (gray.shape[1] // 2, round(60 * (0.35 + y))), 5, 40, -1, cv2.LINE_AA)
    status = read_photographed_display(gray, scene=False)
    assert status.text == text if text else ":" not in (status.text or "")
    assert status.value is None if text else True


@pytest.mark.parametrize("shown", ["digit", "sign"])
def test_a_digit_or_a_sign_beside_those_that_were_read_is_a_doubt(shown: str) -> None:
    gray = window("2608", dark=True, high=60, slant=0.0, pitch=1.6)
    alone = read_window(gray, digits=None, decimals=None, dark=True)
    width, left = 30, 0.5 * (gray.shape[1] - 4 * 48 + 18)
    wide = cv2.copyMakeBorder(gray, 0, 0, 60, 0, cv2.BORDER_REPLICATE)
    x, y = round(60 + left - width), 21 + 30
    first, last = ((x, y - 30), (x, y + 30)) if shown == "digit" else ((x - 12, y), (x + 10, y))
    cv2.line(wide, first, last, 60, 6)
    status = read_window(wide, digits=None, decimals=None, dark=True)
    assert alone.confidence > 0.8
    assert status.text != "2608" or status.confidence < 0.8


def test_own_scenes_are_read_by_and_large() -> None:
    cases = [draw_photograph(seed, "scene") for seed in range(5)]
    assert sum(read_photographed_display(case.image, scene=True).text == case.text for case in cases) >= 3
