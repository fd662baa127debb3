"""Windows, codes and what quantisation costs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.errors import InvalidRequest, NotFound
from perception.range.window import Window, choose_window, decode_scaled, stretch


@given(near=st.floats(0.1, 2.0), span=st.floats(0.01, 5.0), levels=st.sampled_from([15, 255, 4095]))
def test_decoding_undoes_coding_to_half_a_step(near, span, levels):
    window = Window(near_m=near, far_m=near + span, levels=levels)
    depth = np.linspace(near, near + span, 97)
    assert np.abs(window.decode(window.encode(depth)) - depth).max() <= 0.5001 * window.step_m


def test_the_papers_shares():
    depth = np.linspace(0.6, 0.7, 1000).reshape(20, 50)
    for share in (0.1, 0.25, 0.5, 1.0):
        window = Window(near_m=0.6, far_m=0.6 + 0.1 / share)
        assert window.share_used(depth) == pytest.approx(share, rel=0.02)


def test_the_chosen_window_ignores_gross_errors_and_holes():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 0.6, (60, 60))
    depth[0, :5] = 9.0
    depth[1, :5] = np.nan
    window = choose_window(depth)
    assert 0.49 < window.near_m < 0.5 and 0.6 < window.far_m < 0.61
    assert window.quantisation_sigma_m < 0.00015


def test_a_region_narrows_the_window():
    depth = np.full((10, 10), 2.0)
    depth[:, :5] = np.linspace(0.5, 0.52, 10)[:, None]
    region = np.zeros((10, 10), bool)
    region[:, :5] = True
    assert choose_window(depth, region=region).far_m < 0.53


def test_stretching_moves_codes_but_adds_no_level():
    coarse, fine = Window(near_m=0.0, far_m=10.0), Window(near_m=4.5, far_m=5.5)
    codes = np.arange(115, 141)
    assert np.unique(stretch(codes, coarse, fine)).size <= codes.size


def test_millimetre_images():
    depth = decode_scaled(np.array([[0, 1500]], np.uint16), 0.001)
    assert np.isnan(depth[0, 0]) and depth[0, 1] == pytest.approx(1.5)


@pytest.mark.parametrize("bad", [(1.0, 1.0), (2.0, 1.0), (np.nan, 1.0)])
def test_an_empty_window_is_refused(bad):
    with pytest.raises(InvalidRequest):
        Window(near_m=bad[0], far_m=bad[1])


def test_wrong_input_is_refused():
    with pytest.raises(InvalidRequest):
        Window(near_m=0.0, far_m=1.0).decode(np.array([0.5]))
    with pytest.raises(InvalidRequest):
        decode_scaled(np.array([1]), 0.0)
    with pytest.raises(InvalidRequest):
        decode_scaled(np.array([1.0]), 0.001)
    with pytest.raises(NotFound):
        choose_window(np.full((3, 3), np.nan))
