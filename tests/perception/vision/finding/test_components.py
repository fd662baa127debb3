"""Compares connected components by runs, circles and noise with OpenCV and plain numpy."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception.vision.finding.circles import CIRCLE_SAMPLES, NORMALS, _covered, circle_coverage, find_circles
from perception.vision.finding.components import bridged, components, runs_of
from perception.vision.finding.shapes import distinct, find_edges
from perception.vision.noise import noise_sigma


@pytest.mark.parametrize("diagonal", [False, True])
@pytest.mark.parametrize("share", [0.05, 0.4, 0.6, 0.95])
def test_parts_are_those_of_opencv(diagonal: bool, share: float) -> None:
    random = np.random.default_rng(round(100 * share))
    for _ in range(10):
        height, width = random.integers(1, 40, 2)
        mask = (random.random((height, width)) < share).astype(np.uint8)
        count, _, stats, middle = cv2.connectedComponentsWithStats(mask, connectivity=8 if diagonal else 4)
        wanted = np.column_stack([stats[1:count, :4], middle[1:count]])
        found = components(mask, diagonal=diagonal)
        assert found.shape == wanted.shape
        np.testing.assert_allclose(found[np.lexsort(found.T)], wanted[np.lexsort(wanted.T)], atol=1e-9)


def test_an_empty_mask_has_no_parts() -> None:
    assert components(np.zeros((5, 7), np.uint8), diagonal=True).shape == (0, 6)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 6))
def test_gaps_are_bridged_and_short_runs_left_out(seed: int, gap_px: int, least_px: int) -> None:
    mask = (np.random.default_rng(seed).random((6, 40)) < 0.4).astype(np.uint8)
    wanted = []
    for row, pixels in enumerate(mask):
        filled = re.sub(rf"(?<=1)0{{1,{gap_px}}}(?=1)", lambda gap: "1" * len(gap[0]), "".join(map(str, pixels)))
        wanted += [(run.start(), run.end() - 1, row) for run in re.finditer("1+", filled) if len(run[0]) >= least_px]
    assert list(zip(*bridged(runs_of(mask), gap_px, least_px).tolist(), strict=True)) == wanted


def test_rows_that_nearly_equal_an_earlier_one_are_left_out() -> None:
    random = np.random.default_rng(4)
    values, apart = random.uniform(0, 12, (300, 3)), np.array([2.0, 2.0, 4.0])
    kept = distinct(values, apart)
    close = (np.abs(values[:, None] - values[kept][None]) < apart).all(axis=2)
    assert close.any(axis=1).all(), "each is near one that is kept"
    assert close[kept].sum() == len(kept), "and those are not near each other"


def disc(u: float, v: float, radius: float) -> np.ndarray:
    y, x = np.mgrid[:200, :260]
    return np.asarray(80 + 90 * np.clip(radius + 0.5 - np.hypot(x - u, y - v), 0, 1), np.uint8)


def test_a_disc_is_found_where_it_is_drawn() -> None:
    circle = find_circles(find_edges(disc(120.0, 90.0, 31.0)), least_px=8.0, most_px=60.0)[0]
    assert np.hypot(circle.u - 120.0, circle.v - 90.0) < 1.5
    assert abs(circle.radius - 31.0) < 1.5
    assert circle.coverage > 0.9


def test_the_compiled_coverage_is_that_of_plain_numpy() -> None:
    edges = find_edges(disc(120.0, 90.0, 31.0))
    random = np.random.default_rng(5)
    circles = np.column_stack(
        [random.uniform(-20, 280, 200), random.uniform(-20, 220, 200), random.uniform(4, 60, 200)]
    )
    circles[:20] = np.array([120.0, 90.0, 31.0]) + random.normal(0, 1.0, (20, 3))
    maps = (edges.along_x, edges.along_y, edges.strength, edges.strong)
    compiled = np.array([_covered(*maps, NORMALS, *circle) for circle in circles])
    # A gradient exactly at the limit of its direction may be on either side, which is one sample of the outline.
    assert np.abs(compiled - circle_coverage(edges, circles)).max() <= 1.0 / CIRCLE_SAMPLES + 1e-12
    assert compiled.max() > 0.5


@pytest.mark.parametrize("sigma", [2.0, 6.0, 12.0])
def test_the_noise_of_a_flat_picture_is_measured(sigma: float) -> None:
    noisy = 120.0 + np.random.default_rng(3).normal(0.0, sigma, (240, 320))
    assert noise_sigma(np.clip(np.round(noisy), 0, 255).astype(np.uint8)) == pytest.approx(sigma, rel=0.08)


def test_the_noise_of_pictures_without_an_inside_is_the_rounding() -> None:
    assert noise_sigma(np.zeros((1, 1), np.uint8)) == noise_sigma(np.full((2, 50), 9, np.uint8)) == 0.3
