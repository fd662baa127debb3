"""Compares the paper's cubic correction with monomials computed by hand."""

from __future__ import annotations

import numpy as np

from perception.calibration.cubic_lens import CubicLens, cubic_monomials


def test_a_correction_is_linear_in_its_monomials() -> None:
    assert cubic_monomials([[1.0, 2.0]], (0.0, 0.0), 1.0).tolist() == [[1, 1, 2, 1, 2, 4, 1, 2, 4, 8]]
    shift = np.zeros((10, 2))
    shift[0] = [5.0, -3.0]
    shift[1, 0] = shift[2, 1] = 320.0
    lens = CubicLens(coefficients=shift, centre_px=(320.0, 240.0), scale_px=320.0, bias_px=0.0)
    np.testing.assert_allclose(lens.ideal([[330.0, 250.0]]), [[15.0, 7.0]])
