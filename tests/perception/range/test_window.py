"""Tests of windows and codes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.errors import InvalidRequest
from perception.range.window import Window, decode_scaled


@given(near=st.floats(0.1, 2.0), span=st.floats(0.01, 5.0), levels=st.sampled_from([15, 255, 4095]))
def test_decoding_undoes_coding_to_half_a_step(near, span, levels):
    window = Window(near_m=near, far_m=near + span, levels=levels)
    depth = np.linspace(near, near + span, 97)
    codes = np.rint((depth - near) / window.step_m).astype(int)
    assert np.abs(window.decode(codes) - depth).max() <= 0.5001 * window.step_m


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
