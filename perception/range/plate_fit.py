"""Least-squares fit of a plane to the pixels of a plate that carries other things, with a covariance from its residuals.

Indices, frames and cables stand out by less than the noise of one pixel, so no pixel shows them, but the mean of a tile does.
Tiles that stand out are left out. What is left of their errors, and errors common to one line of a scanner, make the
residuals of neighbours alike; the covariance therefore sums them by clusters:

V = A^-1 (sum_c s_c s_c^T) A^-1 + J M J^T,   A = sum_i w_i g_i g_i^T,   s_c = sum_(i in c) w_i e_i g_i

e is the distance of a pixel's point from the plane, g its derivative and w the inverse variance (Liang and Zeger,
Biometrika 73, 1986); with tiles and lines at once: V_tiles + V_lines - V_(lines in tiles) (Cameron, Gelbach and Miller,
J. Bus. Econ. Stat. 29, 2011). M is the covariance of a swept scanner's mount, and J what it does to the plane. If the planes
of the two passes of a sweep differ by q, the mean of them has the variance q q^T / 4 by errors that one pass has alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter

from hal.arrays import Array, Indices, Mask
from perception.range.sweep import SweptErrors

TILES_ACROSS, LEAST_TILE_PX = 21, 6  # 3 cm of a panel in an overview
CLUSTER_TILES = 2
ROUNDS = 6
STANDS_OUT, BESIDE = 3.0, 1.0  # sigmas of a tile's mean; beside such a tile, which may show the edge of the same thing
LEAST_KEPT_SHARE = 0.5  # of a tile's measured pixels; with fewer on the plane it shows the edge of something
LEAST_TILES = 12
OUTLIER_PASSES, LEAST_COMMON = 5.0, 200  # sigmas of a pixel; pixels
MEDIAN_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlateFit:
    """Plane n . X = d.

    Attributes:
        frame: (2, 3) unit vectors in the plane.
        covariance: (3, 3) of the two tilts of n towards `frame`, rad, and of d, m.
    """

    normal: Array
    offset_m: float
    frame: Array
    covariance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pixels:
    """The measured pixels: points (N, 3), standard deviations of their depths (N,), and what each belongs to (N,).

    `apart_m` (N,) is the difference of the depths by two passes, NaN where there is none.
    """

    points_m: Array
    apart_m: Array
    sigma_m: Array
    tile: Indices
    row: Indices
    cluster: Indices
    across: int  # tiles of a row

    def weights(self, normal: Array) -> Array:
        """Return the inverse variances of the distances from a plane, which are depth errors seen along its normal."""
        depth_m = self.points_m[:, 2]
        slope = np.abs(self.points_m @ normal) / np.maximum(depth_m, 1e-6)
        return np.asarray(1.0 / np.square(np.maximum(slope, 0.05) * self.sigma_m))


def fit_plate(
    points_m: Array,
    sigma_m: Array,
    *,
    normal: Array,
    offset_m: float,
    frame: Array,
    gate: float,
    swept: SweptErrors | None = None,
) -> PlateFit | None:
    """Refine a plane; None if too few tiles lie on it.

    Args:
        points_m: (H, W, 3) in the sensor frame; NaN where nothing was measured.
        sigma_m: (H, W) standard deviation of depth.
        normal, offset_m, frame: initial plane, and two unit vectors (2, 3) in it.
        gate: pixels further away, in sigmas, are of something else.
        swept: errors of the sweep from which the image was put together; then each row may have an error of its own.
    """
    pixels = _pixels(points_m, sigma_m, None if swept is None else swept.apart_m)
    n, d, f = np.asarray(normal, float), float(offset_m), np.asarray(frame, float)
    kept = np.zeros(len(pixels.points_m), bool)
    for _ in range(ROUNDS):
        e, w = pixels.points_m @ n - d, pixels.weights(n)
        near = np.abs(e) <= gate / np.sqrt(w)
        kept = near & _calm_tiles(pixels, e, w, near)[pixels.tile]
        if len(np.unique(pixels.tile[kept])) < LEAST_TILES:
            return None
        g = _derivatives(pixels.points_m[kept], f)
        step = -np.linalg.solve((g * w[kept, None]).T @ g, g.T @ (w[kept] * e[kept]))
        n = n + step[:2] @ f
        length = float(np.linalg.norm(n))
        n, d = n / length, (d + step[2]) / length
        first = f[0] - (f[0] @ n) * n
        first = first / np.linalg.norm(first)
        f = np.stack([first, np.sign(np.linalg.det([*f, n])) * np.cross(n, first)])
    return PlateFit(normal=n, offset_m=d, frame=f, covariance=_covariance(pixels, kept, n, d, f, swept))


def _pixels(points_m: Array, sigma_m: Array, apart_m: Array | None) -> _Pixels:
    seen = np.isfinite(points_m[..., 2])
    row, column = np.nonzero(seen)
    tile_px = max(LEAST_TILE_PX, round(seen.shape[1] / TILES_ACROSS))
    cluster_px, across = tile_px * CLUSTER_TILES, seen.shape[1] // tile_px + 1
    return _Pixels(
        points_m=points_m[seen],
        apart_m=(np.full(seen.shape, np.nan) if apart_m is None else apart_m)[seen],
        sigma_m=sigma_m[seen],
        tile=row // tile_px * across + column // tile_px,
        row=row,
        cluster=row // cluster_px * across + column // cluster_px,
        across=across,
    )


def _calm_tiles(pixels: _Pixels, e: Array, w: Array, near: Mask) -> Mask:
    """Return for each tile whether its pixels lie on the plane, as far as their mean can tell."""
    count = (int(pixels.tile.max()) // pixels.across + 1) * pixels.across
    measured = np.bincount(pixels.tile, minlength=count)
    used = np.bincount(pixels.tile[near], minlength=count)
    weight = np.bincount(pixels.tile[near], weights=w[near], minlength=count)
    mean = np.bincount(pixels.tile[near], weights=(w * e)[near], minlength=count) / np.maximum(weight, 1e-30)
    whole = (used >= LEAST_KEPT_SHARE * measured) & (used >= LEAST_KEPT_SHARE * measured.max())
    if not whole.any():
        return np.asarray(whole)
    normed = mean * np.sqrt(weight)
    spread = MEDIAN_TO_SIGMA * float(np.median(np.abs(normed[whole] - np.median(normed[whole]))))
    size = np.abs(normed) / max(spread, 1.0)
    stands_out = (measured > 0) & ~(whole & (size <= STANDS_OUT))
    beside = maximum_filter(stands_out.reshape(-1, pixels.across), size=3).ravel()
    return np.asarray(whole & (size <= np.where(beside, BESIDE, STANDS_OUT)))


def _derivatives(points_m: Array, frame: Array) -> Array:
    """Return the (N, 3) derivatives of the distance with the two tilts and the offset."""
    return np.column_stack([points_m @ frame.T, -np.ones(len(points_m))])


def _covariance(pixels: _Pixels, kept: Mask, n: Array, d: float, frame: Array, swept: SweptErrors | None) -> Array:
    points_m = pixels.points_m[kept]
    g, w, e = _derivatives(points_m, frame), pixels.weights(n)[kept], points_m @ n - d
    inverse = np.linalg.inv((g * w[:, None]).T @ g)
    scores, tile, row = g * (w * e)[:, None], pixels.cluster[kept], pixels.row[kept]
    meat = _summed(scores, tile)
    if swept is not None:
        meat = meat + _summed(scores, row) - _summed(scores, tile * (int(row.max()) + 1) + row)
    independent = np.asarray(inverse * max(float(np.mean(w * e * e)), 1e-12))
    found = _at_least(np.asarray(inverse @ meat @ inverse), independent)
    if swept is not None:
        plane_of = inverse @ (g * w[:, None]).T  # of distances from the plane
        J = plane_of @ swept.distances(points_m, n)
        late = swept.sigma_turn_rad * (plane_of @ swept.turned(points_m, n))
        far = swept.sigma_range_m * (plane_of @ swept.farther(points_m, n))
        apart = _between_passes(points_m, pixels.apart_m[kept], g, w, n)
        found = found + J @ swept.covariance @ J.T + np.outer(late, late) + np.outer(far, far)
        found = found + np.outer(apart, apart) / 4.0
    return found


def _between_passes(points_m: Array, apart_m: Array, g: Array, w: Array, n: Array) -> Array:
    """Return the difference (3,) between the planes of the two passes of a sweep; zero if there is too little of both."""
    along_m = apart_m * (points_m @ n) / points_m[:, 2]
    known = np.isfinite(along_m)
    known[known] &= np.abs(along_m[known]) * np.sqrt(w[known]) < OUTLIER_PASSES
    if known.sum() < LEAST_COMMON:
        return np.zeros(3)
    gk, wk = g[known], w[known]
    return np.asarray(np.linalg.solve((gk * wk[:, None]).T @ gk, gk.T @ (wk * along_m[known])))


def _summed(scores: Array, cluster: Indices) -> Array:
    """Return the sum of the clusters' squared scores, corrected for the three fitted parameters."""
    _, index = np.unique(cluster, return_inverse=True)
    sums = np.stack([np.bincount(index, weights=column) for column in scores.T], axis=1)
    return np.asarray(sums.T @ sums * (len(sums) / max(len(sums) - 3, 1)))


def _at_least(covariance: Array, least: Array) -> Array:
    """Return the covariance, raised in each direction in which it is smaller than that of independent pixels."""
    root = np.linalg.cholesky(least)
    scaled = np.linalg.solve(root, np.linalg.solve(root, covariance).T)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    return np.asarray(root @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ root.T)
