"""Fit of a pointer's axis through its ink: theta(r) = theta0 + e / r, with e the pivot's lateral offset."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jit import compiled

# Largest ratio of a row's ink to this percentile of all rows; numerals and ticks may be beside half of the rows.
NUMERAL, PLAIN = 1.8, 35.0
HALF_LEVEL = 0.3  # of a row's strongest ink; less belongs to the pointer's blur
OWN_WIDTH = (35.0, 0.6)  # percentile of the rows' widths, and half width of the next search relative to it
ROUNDS, WEIGHINGS = 3, 5
LEAST_ROWS = 3
BESIDE = 2  # columns around hidden ones, whose blur affects them
PIVOTS_AT_MOST = 2.0  # largest weight of a row, relative to a typical one


@compiled
def fitted_line(r: Array, theta: Array, mass: Array, e_sigma: float, least_m: float) -> tuple[float, float, float]:
    """Fit theta(r) = theta0 + e / r by Cauchy-weighted least squares; returns theta0, e and the variance of theta0.

    Args:
        r, theta, mass: (N,) of rows with ink: m, rad, and amount of ink.
        e_sigma: prior standard deviation of e, m.
        least_m: least standard deviation of a row's centre across the pointer, m.
    """
    weight = np.minimum(mass / np.median(mass), PIVOTS_AT_MOST)
    theta0, e, variance = float(np.median(theta)), 0.0, 0.0
    for _ in range(WEIGHINGS):
        residual_m = (theta - theta0 - e / r) * r
        scale = max(1.4826 * float(np.median(np.abs(residual_m))), least_m)
        w = weight / (1.0 + (residual_m / (1.5 * scale)) ** 2) * r**2 / scale**2
        # Normal equations of the two unknowns.
        a, b, c = w.sum(), (w / r).sum(), (w / r**2).sum() + 1.0 / e_sigma**2
        p, q = (w * theta).sum(), (w * theta / r).sum()
        determinant = a * c - b * b
        theta0, e, variance = (c * p - b * q) / determinant, (a * q - b * p) / determinant, c / determinant
    return theta0, e, variance


def pointer_axis(
    ink: NDArray[np.float32], hidden: NDArray[np.bool_], r: Array, offset: Array, reach_rad: float, e_sigma: float, px_per_m: float
) -> tuple[float, float]:  # fmt: skip
    """Return the angle (rad, as `offset`) of the pointer near offset 0, and its variance; NaN if too few rows have ink.

    Things that touch the pointer (a numeral, a tick) widen some rows, so each round searches within the pointer's own
    width. A pointer has one gray: rows with much stronger ink belong to a numeral or a tick beside it. If the ink
    continues under an occluder, its visible centre is not the pointer's centre, so the row is dropped.

    Args:
        ink, hidden: (rows, angles).
        r: (rows,) m.
        offset: (angles,) rad from the rough pointer.
        reach_rad: half width of the search in the first round.
        e_sigma: standard deviation of the pivot's offset, m.
    """
    close = np.abs(offset) < 2.0 * reach_rad  # a refined search may reach beyond the first one
    ink, offset = ink[:, close], offset[close]
    beside = cv2.dilate(hidden.astype(np.uint8), np.ones((1, 2 * BESIDE + 1), np.uint8))[:, close] > 0
    near, theta0, variance = np.abs(offset) < reach_rad, np.nan, np.nan
    for _ in range(ROUNDS):
        shown = np.where(near, ink, 0.0)
        top = shown.max(axis=1, initial=0.0)
        goes_under = (beside & (shown > HALF_LEVEL * top[:, None])).any(axis=1)
        if (top > 0.0).any():
            top = np.where(goes_under | (top > NUMERAL * _percentile(top[top > 0.0], PLAIN)), 0.0, top)
        there = top > 0.0
        if there.sum() < LEAST_ROWS:
            return np.nan, np.nan
        over = np.maximum(shown[there] - HALF_LEVEL * top[there, None], 0.0)
        mass, at = over.sum(axis=1), r[there]
        theta0, e, variance = fitted_line(at, over @ offset / mass, mass, e_sigma, 0.15 / px_per_m)
        width = mass * abs(offset[1] - offset[0]) / ((1.0 - HALF_LEVEL) * top[there])
        half_m = OWN_WIDTH[1] * (_percentile(width * at, OWN_WIDTH[0]) + 1.0 / px_per_m)
        near = np.abs(offset - (theta0 + e / r)[:, None]) < (half_m / r)[:, None]
    return theta0, variance


def _percentile(values: Array, percent: float) -> float:
    """Return `np.percentile`, which takes as long as all the rest on the few rows of a pointer."""
    ordered = np.sort(values)
    return float(np.interp(percent / 100.0 * (len(ordered) - 1), np.arange(len(ordered)), ordered))
