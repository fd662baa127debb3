"""States that are clearly visible in drawn panels must be read and not refused."""

from __future__ import annotations

import pytest

from benchmarks.panel_scene import draw_scene
from benchmarks.vision_held_out import read_scene

GRAY_POINTERS = (70029, 70042)  # on dark faces, beside brighter numerals
CABLES_BESIDE_A_CAP = (70062, 70080)  # the cable's edge could be that of a cap under it
FAINT_LENSES = (70066, 70028)  # unlit lenses at 0.75 and 0.80 of the plate's gray
BATS_LIKE_THE_PLATE = (70023, 70040)  # have contrast only with the nut at their foot
WIDE_BAT = 70001  # wider than the usual bat
CABLE_OVER_ONE_SIDE = 70072  # a dark bar where the bat would be in the other state


CABLES_BESIDE_A_FACE = (70009, 70084)  # the face is dark or shaded and has the cable's gray


@pytest.mark.parametrize("seed", FAINT_LENSES)
def test_a_flat_lens_darker_than_the_plate_is_unlit(seed: int) -> None:
    lamps = [row for row in read_scene(draw_scene(seed, "hard")) if row.kind == "lamp"]
    assert lamps and all(row.is_right for row in lamps)


@pytest.mark.parametrize("seed", [*BATS_LIKE_THE_PLATE, WIDE_BAT])
def test_a_bat_is_read_by_what_it_stands_out_from(seed: int) -> None:
    toggles = [row for row in read_scene(draw_scene(seed, "hard")) if row.kind == "toggle"]
    assert toggles and all(row.is_right for row in toggles)


def test_a_cable_where_the_bat_is_not_makes_no_state() -> None:
    toggles = [row for row in read_scene(draw_scene(CABLE_OVER_ONE_SIDE, "hard")) if row.kind == "toggle"]
    assert toggles and not any(row.answered and not row.is_right for row in toggles)


@pytest.mark.parametrize("seed", CABLES_BESIDE_A_FACE)
def test_a_face_of_a_cables_gray_is_not_taken_for_what_hides_it(seed: int) -> None:
    gauges = [row for row in read_scene(draw_scene(seed, "hard")) if row.kind == "gauge"]
    assert gauges and all(row.is_right for row in gauges)


@pytest.mark.parametrize("seed", GRAY_POINTERS)
def test_the_gap_between_a_pointer_and_a_numeral_is_no_pointer(seed: int) -> None:
    gauges = [row for row in read_scene(draw_scene(seed, "medium")) if row.kind == "gauge"]
    assert gauges and not any(row.answered and not row.is_right for row in gauges)


@pytest.mark.parametrize("seed", CABLES_BESIDE_A_CAP)
def test_a_cable_a_cap_away_does_not_hide_the_cap_that_shows(seed: int) -> None:
    sliders = [row for row in read_scene(draw_scene(seed, "hard")) if row.kind == "slider"]
    assert sliders and all(row.is_right for row in sliders)
