"""Tests of the display reader's parts: likelihood of characters, score of the grid, cables, the point."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.display_drawing import draw_photograph, draw_taught
from benchmarks.display_report import read_case
from perception.vision.patch import Patch
from perception.vision.photographs.photo_display import read_photographed_display
from perception.vision.status.decimal_point import dot_levels, find_decimal_point
from perception.vision.status.digit_grid import LIT_SHARES, DigitGrid, find_digit_grids, segment_means
from perception.vision.status.digit_grid_fit import grid_worth
from perception.vision.status.digit_grid_worth import LEFT_OVER, apartness, cell_worth
from perception.vision.status.display import read_window
from perception.vision.status.glyphs import LIT, NAMES, Levels, likelihoods, numbers, separate
from perception.vision.status.ink import segment_ink
from perception.vision.status.levels import segment_levels, with_hidden_ends
from perception.vision.status.occluder_bands import lying_across
from tests.perception.vision.status.test_display import window


def levels_of(text: str, *, hidden: tuple[tuple[int, int], ...] = ()) -> Levels:
    ink = np.array([LIT[NAMES.index(c)] * 80.0 if c != " " else np.zeros(7) for c in text])
    seen = np.ones_like(ink)
    for cell, segment in hidden:
        ink[cell, segment], seen[cell, segment] = 0.0, 0.0
    found = separate(ink, seen, np.zeros(len(text)), np.ones(len(text)))
    assert found is not None
    return found


@pytest.mark.parametrize("text", ["0123456789", "   7", " -42", "-  5", "888"])
def test_clear_segments_say_one_number(text: str) -> None:
    listed = numbers(*likelihoods(levels_of(text)))
    assert listed[0].characters == text
    assert len(listed) == 1 or listed[0].log_likelihood - listed[1].log_likelihood > 3.5


def test_what_a_hidden_segment_decides_stays_open() -> None:
    b = 1  # upper right segment: distinguishes 5 and 9
    listed = numbers(*likelihoods(levels_of("19", hidden=((1, b),))))
    assert {n.characters for n in listed[:2]} == {"15", "19"}
    assert listed[0].log_likelihood == pytest.approx(listed[1].log_likelihood, abs=0.1)


@pytest.mark.parametrize(("before", "wanted"), [(95.0, "99"), (54.0, "59"), (None, None)])
def test_the_previous_reading_tells_between_what_is_left(before: float | None, wanted: str | None) -> None:
    gray = window("99", slant=0.0)
    status = read_window(
        gray, digits=2, decimals=0, dark=False, limits=(0.0, 200.0), hidden=over_segment_b(gray), before=before
    )
    assert status.text == wanted


def test_the_range_tells_between_what_is_left() -> None:
    gray = window("99", slant=0.0)
    status = read_window(gray, digits=2, decimals=0, dark=False, limits=(60.0, 120.0), hidden=over_segment_b(gray))
    assert status.text == "99"


def test_a_refusal_names_what_it_may_be() -> None:
    gray = window("99", slant=0.0)
    status = read_window(gray, digits=2, decimals=0, dark=False, limits=(0.0, 200.0), hidden=over_segment_b(gray))
    assert not status.answered and "59" in (status.reason or "") and "99" in (status.reason or "")


def test_a_refusal_lists_what_it_may_be_for_programs() -> None:
    gray = window("99", slant=0.0)
    status = read_window(gray, digits=2, decimals=0, dark=False, limits=(0.0, 200.0), hidden=over_segment_b(gray))
    first, second = status.possible[:2]
    assert (first.text, first.value) == ("99", 99.0)  # of equally likely numbers the one further from zero
    assert second.text == "59" and second.probability == pytest.approx(first.probability, rel=0.01)
    assert status.confidence == first.probability and sum(p.probability for p in status.possible) <= 1.0
    assert not read_window(gray, digits=2, decimals=0, dark=False).possible  # nothing is hidden, so it is answered


def over_segment_b(gray: np.ndarray) -> np.ndarray:
    """Return a mask over the upper right segment of the first of two digits in `window`."""
    hidden = np.zeros(gray.shape, bool)
    left = 0.5 * (gray.shape[1] - 1.5 * 20 - 20)
    hidden[17:32, round(left + 20 - 5) : round(left + 20 + 4)] = True
    return hidden


def test_a_cells_worth_is_what_its_best_character_explains_less_what_it_leaves() -> None:
    random = np.random.default_rng(3)
    for _ in range(50):
        levels, areas, loops = random.uniform(0, 90, 7), random.uniform(5, 20, 7), float(random.uniform(0, 2e4))
        total = loops + float((areas * levels**2).sum())
        explained = [float((areas * levels)[lit].sum()) ** 2 / float(areas[lit].sum()) for lit in LIT]
        wanted = max(0.0, *(e - LEFT_OVER * (total - e) for e in explained))
        assert cell_worth(levels, areas, loops, LIT_SHARES) == pytest.approx(wanted)


def test_the_true_grid_is_worth_more_than_any_shifted_one() -> None:
    ink, seen = segment_ink(window("2048", slant=0.0), is_dark=False)
    _, grid = find_digit_grids(ink, seen)[0]
    assert (
        grid.count == 4 and grid.height_px == pytest.approx(40.0, abs=3.0) and grid.pitch_px == pytest.approx(30, abs=1)
    )
    means, shares = segment_means(ink, seen, True, grid.width_px, grid.height_px)
    worth = grid_worth(means, shares, True, grid.numbers, 4, LIT_SHARES)
    for k, step in ((0, 5.0), (0, -5.0), (1, 3.0), (3, 6.0), (4, -6.0)):
        moved = grid.numbers
        moved[k] += step
        assert grid_worth(means, shares, True, moved, 4, LIT_SHARES) < worth


def test_neighbours_that_share_an_upright_count_less() -> None:
    gaps = np.linspace(0.0, 0.4, 30)
    factors = np.array([apartness(float(g)) for g in gaps])
    assert (np.diff(factors) >= 0).all() and factors[0] < 0.5 and factors[-1] == 1.0


def in_glare(gray: np.ndarray, added: float) -> np.ndarray:
    """Return the window with a glare at its right end, added in linear light."""
    columns = np.arange(gray.shape[1]) / gray.shape[1]
    light = 0.5 * (gray / 255.0) ** 2.2 + added * np.exp(-((columns - 0.95) ** 2) / (2 * 0.3**2))
    return np.asarray(np.round(255 * np.clip(light, 0, 1) ** (1 / 2.2)), np.uint8)


def test_strokes_stand_out_alike_in_glare() -> None:
    plain = window("8888", slant=0.0)
    for added, spread in ((0.0, 0.1), (0.3, 0.15), (0.6, 0.2)):
        ink, seen = segment_ink(in_glare(plain, added), is_dark=False)
        _, grid = find_digit_grids(ink, seen)[0]
        cells = segment_levels(ink, seen, grid)[0].mean(axis=1)
        assert grid.count == 4 and np.ptp(cells) < spread * cells.mean()


@pytest.mark.parametrize("text", ["7669", "5.37", "3847"])
@pytest.mark.parametrize("added", [0.3, 0.6])
def test_a_window_in_glare_is_read(text: str, added: float) -> None:
    status = read_window(in_glare(window(text), added), digits=None, decimals=None, dark=False, bare=True)
    assert status.text == text


def test_a_blank_within_a_number_is_a_digit_that_nobody_saw() -> None:
    gray = window("4972", slant=0.0)
    wiped = gray.copy()
    wiped[:, 78:102] = 20  # a cable of the window's gray hides the 7
    assert read_window(gray, digits=None, decimals=0, dark=False, bare=True).text == "4972"
    status = read_window(wiped, digits=None, decimals=0, dark=False, bare=True)
    assert not status.answered and status.confidence < 0.1


@pytest.mark.parametrize(("text", "place"), [("26.48", 2), ("2.648", 1), ("2648", None)])
def test_a_dot_stands_out_from_gaps_without_one(text: str, place: int | None) -> None:
    ink, seen = segment_ink(window(text, slant=0.0), is_dark=False)
    _, grid = find_digit_grids(ink, seen)[0]
    lit = np.array([LIT[NAMES.index(c)] * 150.0 for c in "2648"])
    levels, clear = dot_levels(ink, seen, grid, lit)
    assert clear.all()
    for gap, level in enumerate(levels, start=1):
        assert level > 0.8 if gap == place else level < 0.35
    assert find_decimal_point(ink, seen, grid, lit).place == place


def test_a_dot_that_a_cable_hides_in_part_is_found_and_a_bare_part_of_a_gap_says_nothing() -> None:
    lit = np.array([LIT[NAMES.index(c)] * 150.0 for c in "2648"])
    for text, place in (("26.48", 2), ("2648", None)):
        ink, seen = segment_ink(window(text, slant=0.0), is_dark=False)
        _, grid = find_digit_grids(ink, seen)[0]
        middle = round(grid.left_px + 1.5 * grid.pitch_px + 0.5 * grid.width_px)
        seen[:, middle - 6 : middle] = 0.0  # hides the left half of the second gap
        assert not dot_levels(ink, seen, grid, lit)[1][1]
        found = find_decimal_point(ink, seen, grid, lit)
        assert found.place == place and (found.probability > 0.95 if place else found.probability < 0.8)


def test_a_dot_in_both_gaps_is_no_number_without_a_point() -> None:
    """Ink in every gap is not the normal level of a gap, but means that the strokes are not where they are assumed."""
    lit = np.array([LIT[NAMES.index(c)] * 150.0 for c in "264"])
    ink, seen = segment_ink(window("264", slant=0.0), is_dark=False)
    _, grid = find_digit_grids(ink, seen)[0]
    for gap in range(2):
        u = grid.left_px + gap * grid.pitch_px + 0.5 * (grid.width_px + grid.pitch_px)
        radius = round(0.075 * grid.height_px)
        cv2.circle(ink, (round(u), round(grid.bottom_px)), radius, float(ink.max()), -1, cv2.LINE_AA)
    assert (dot_levels(ink, seen, grid, lit)[0] > 0.6).all()
    assert find_decimal_point(ink, seen, grid, lit).probability < 0.8


def plate_patch(*, cable: tuple[int, int] | None, cable_gray: int = 60) -> Patch:
    gray = np.full((110, 200), 170, np.uint8)
    gray[25:85, 30:170] = 25
    if cable is not None:
        cv2.line(gray, (cable[0], -5), (cable[1], 115), cable_gray, 12, cv2.LINE_AA)
    gray = cv2.GaussianBlur(gray, (0, 0), 1.2)
    noise = np.random.default_rng(0).normal(0, 1.5, gray.shape)
    return Patch(
        gray=np.clip(gray + noise, 0, 255).astype(np.uint8), colour=None, inside=np.ones(gray.shape, bool), px_per_m=1000.0,
        image_px_per_m=1000.0, origin_px=np.array([99.5, 54.5]), parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip


@pytest.mark.parametrize("gray", [60, 170])  # nearly the gray of the window, and that of the plate
@pytest.mark.parametrize("cable", [(100, 100), (60, 95), (150, 120)])
def test_a_cable_is_masked_where_it_lies(cable: tuple[int, int], gray: int) -> None:
    patch = plate_patch(cable=cable, cable_gray=gray)
    found = lying_across(patch, half_width_m=0.07, half_height_m=0.03, is_round=False, dark_ink=False)
    assert found is not None
    drawn = np.zeros(found.shape, np.uint8)
    cv2.line(drawn, (cable[0], -5), (cable[1], 115), 1, 8)
    inside = np.zeros(found.shape, bool)
    inside[25:85, 30:170] = True
    assert found[(drawn > 0) & inside].mean() > 0.97
    assert found[inside].mean() < 0.3  # the cable takes 12 px of 140


def test_a_cable_in_a_dark_picture_is_masked_too() -> None:
    bright = plate_patch(cable=(60, 95))
    dark = replace(bright, gray=(bright.gray * 0.35).astype(np.uint8))
    masks = [
        lying_across(p, half_width_m=0.07, half_height_m=0.03, is_round=False, dark_ink=False) for p in (bright, dark)
    ]
    assert masks[0] is not None and masks[1] is not None
    assert (masks[0] & masks[1]).sum() > 0.85 * (masks[0] | masks[1]).sum()


def test_nothing_is_masked_without_a_cable() -> None:
    assert (
        lying_across(plate_patch(cable=None), half_width_m=0.07, half_height_m=0.03, is_round=False, dark_ink=False)
        is None
    )


@pytest.mark.parametrize("level", ["easy", "medium"])
def test_own_renderings_are_read_when_their_digits_are_known(level: str) -> None:
    cases = [draw_taught(seed, level) for seed in range(6)]
    assert sum(read_case(case, known=True).text == case.text for case in cases) >= 5


def test_a_cable_and_glare_never_make_many_sure_wrong_readings() -> None:
    cases = [draw_taught(seed, "hard") for seed in range(12)]
    answers = [(case, read_case(case, known=False)) for case in cases]
    assert sum(s.answered and s.text != c.text and s.confidence > 0.8 for c, s in answers) <= 1
    assert sum(s.text == c.text for c, s in answers) >= 4


@pytest.mark.parametrize("seed", [3065, 3093, 3108, 3124, 3171])
def test_a_digit_that_a_cable_crosses_is_not_left_out(seed: int) -> None:
    case = draw_taught(seed, "hard")
    status = read_case(case, known=True)
    assert status.text in (None, case.text)


def test_cells_beside_a_grid_belong_to_it_where_they_are_hidden() -> None:
    seen = np.ones((40, 200), np.float32)
    seen[:, 150:165] = 0.0
    grid = DigitGrid(left_px=60.0, pitch_px=30.0, width_px=15.0, top_px=8.0, bottom_px=32.0, slant=0.1, count=3)
    assert with_hidden_ends(seen, grid, 8) == replace(grid, count=4)
    assert with_hidden_ends(seen, grid, 3) == grid  # the display has no more digits
    assert with_hidden_ends(seen[:, ::-1].copy(), grid, 8) == replace(grid, left_px=30.0, count=4)
    assert with_hidden_ends(seen[:, :160], grid, 8) == grid  # no space for a fourth digit


@pytest.mark.parametrize(("seed", "level"), [(5010, "easy"), (5172, "hard")])
def test_a_grid_that_is_too_high_does_not_win(seed: int, level: str) -> None:
    case = draw_taught(seed, level)
    assert read_case(case, known=True).text == case.text


def test_photographs_of_low_contrast_are_read_by_and_large() -> None:
    cases = [draw_photograph(seed, "low contrast") for seed in range(6)]
    assert sum(read_photographed_display(case.image, scene=False).text == case.text for case in cases) >= 4


def washed_out(text: str, *, glare_from: float) -> np.ndarray:
    """Return a window with dark segments and saturated background, where the right segments saturate, too."""
    gray = window(text, dark=True, slant=0.0, contrast=120.0).astype(float) + 90.0
    gray[:, round(glare_from * gray.shape[1]) :] += 140.0
    return np.clip(gray, 0, 255).astype(np.uint8)


def test_dark_digits_on_a_saturated_ground_are_read() -> None:
    status = read_window(washed_out("2648", glare_from=1.0), digits=4, decimals=0, dark=True)
    assert status.text == "2648"


def test_what_glare_washes_out_is_not_taken_for_blank() -> None:
    status = read_window(washed_out("2648", glare_from=0.55), digits=4, decimals=0, dark=True)
    assert status.text is None
