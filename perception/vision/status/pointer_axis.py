"""Compiled fit of a pointer's axis through its ink: theta(r) = theta0 + e / r, with e the pivot's lateral offset."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jit import compiled, inlined

# Largest ratio of a row's ink to this percentile of all rows; numerals and ticks may be beside half of the rows.
NUMERAL, PLAIN = 1.8, 35.0
HALF_LEVEL = 0.3  # of a row's strongest ink; less belongs to the pointer's blur
OWN_WIDTH = (35.0, 0.6)  # percentile of the rows' widths, and half width of the next search relative to it
ROUNDS, WEIGHINGS = 3, 5
LEAST_ROWS = 3
BESIDE = 2  # columns around hidden ones, whose blur affects them
PIVOTS_AT_MOST = 2.0  # largest weight of a row, relative to a typical one


@inlined
def row_centres(
    ink: NDArray[np.float32], hidden: NDArray[np.bool_], offset: Array, middle: Array, half: Array
) -> tuple[Array, Array, Array]:
    """Return the centre of the ink (rad), its mass and its width (rad) in every row, within `half` of `middle`.

    (rows,) each. A pointer has one gray: rows with much stronger ink belong to a numeral or a tick beside it. If the
    ink continues under an occluder, its visible centre is not the pointer's centre, so the row is dropped.

    Args:
        ink, hidden: (rows, angles).
        offset: (angles,) rad.
        middle, half: (rows,) rad.
    """
    rows, columns = ink.shape
    top = np.zeros(rows)
    for i in range(rows):
        for j in range(columns):
            if abs(offset[j] - middle[i]) < half[i]:
                top[i] = max(top[i], ink[i, j])
    most = NUMERAL * np.percentile(top[top > 0.0], PLAIN) if top.max() > 0.0 else 0.0
    step = abs(offset[1] - offset[0])
    centre, mass, width = np.zeros(rows), np.zeros(rows), np.zeros(rows)
    for i in range(rows):
        if top[i] <= 0.0 or top[i] > most or _goes_under(ink[i], hidden[i], offset, middle[i], half[i], top[i]):
            continue
        moment = 0.0
        for j in range(columns):
            if abs(offset[j] - middle[i]) < half[i]:
                over = max(ink[i, j] - HALF_LEVEL * top[i], 0.0)
                mass[i] += over
                moment += over * offset[j]
        centre[i] = moment / mass[i]
        width[i] = mass[i] * step / ((1.0 - HALF_LEVEL) * top[i])
    return centre, mass, width


@inlined
def _goes_under(
    ink: NDArray[np.float32], hidden: NDArray[np.bool_], offset: Array, middle: float, half: float, top: float
) -> bool:
    """Return whether the relevant ink of a row is adjacent to hidden samples."""
    columns = len(ink)
    for j in range(columns):
        if abs(offset[j] - middle) < half and ink[j] > HALF_LEVEL * top:
            for k in range(max(0, j - BESIDE), min(columns, j + BESIDE + 1)):
                if hidden[k]:
                    return True
    return False


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


@compiled
def pointer_axis(
    ink: NDArray[np.float32],
    hidden: NDArray[np.bool_],
    r: Array,
    offset: Array,
    reach_rad: float,
    e_sigma: float,
    px_per_m: float,
) -> tuple[float, float]:
    """Return the angle (rad, as `offset`) of the pointer near offset 0, and its variance; NaN if too few rows have ink.

    Things that touch the pointer (a numeral, a tick) widen some rows, so each round searches within the pointer's own
    width.

    Args:
        ink, hidden: (rows, angles).
        r: (rows,) m.
        offset: (angles,) rad from the rough pointer.
        reach_rad: half width of the search in the first round.
        e_sigma: standard deviation of the pivot's offset, m.
    """
    middle, half = np.zeros(len(r)), np.full(len(r), reach_rad)
    theta0, variance = np.nan, np.nan
    for _ in range(ROUNDS):
        theta, mass, width = row_centres(ink, hidden, offset, middle, half)
        there = mass > 0
        if there.sum() < LEAST_ROWS:
            return np.nan, np.nan
        theta0, e, variance = fitted_line(r[there], theta[there], mass[there], e_sigma, 0.15 / px_per_m)
        half_m = OWN_WIDTH[1] * (np.percentile((width * r)[there], OWN_WIDTH[0]) + 1.0 / px_per_m)
        middle, half = theta0 + e / r, half_m / r
    return theta0, variance
