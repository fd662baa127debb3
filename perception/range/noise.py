"""Estimation of the noise model of a range image from the image itself.

Three kinds of noise are distinguished, because a method tuned to one fails on the others: white noise, which is visible
in small windows; correlated (slow) noise, which only larger windows show; and the step between depth codes, which hides
noise smaller than itself. Each grows with depth z as `a + b z^2`, the law of triangulating sensors; for laser scanners
b is near 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from math import sqrt

import numpy as np

from hal.arrays import Array
from hal.jit import compiled
from perception.range.quadratics import quadratics, window_rms
from perception.range.sensor import RangeSensorModel

WINDOW = 5  # samples along a window; a window of 25 samples rarely holds a gross error
BASIS = quadratics(WINDOW)
WINDOWS_ACROSS = 24  # of the small windows, along the shorter side of a large image
LARGE_SHARE = 1 / 60  # spacing of the large window's samples, as a ratio of the shorter side; at least 2 pixels
QUANTILE = 0.25  # windows on creases, jumps and gross errors lie above this quantile in all but the busiest scenes
WORST_SHARE = 0.03  # of the depth: an image that scatters more shows no surface, and no model may explain it as one
NORMAL_QUANTILE = -0.6745  # of the standard normal distribution, at QUANTILE
DEPTH_BINS = 6  # ranges of depth, each of which gives one point of the law
TYPICAL_SAMPLES = 2048  # depths from which `typical_depths_m` is estimated
CODE_SAMPLES = 1024  # depths by which continuous depth is recognised
STEPPED_SHARE = 0.25  # depth is coded if the number of distinct values is below this share of the number of pixels
FLOOR_RATIO = 0.15  # least sigma per pixel pitch: real surfaces are no smoother, and noise-free images need weights too


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseModel:
    """Standard deviation of depth as a function of depth z in metres.

    Each part is a pair `(a, b)` of the law `a + b z^2` (m, 1/m): white noise, noise that neighbouring pixels share, and the
    step between neighbouring depth codes.
    """

    white: tuple[float, float]
    correlated: tuple[float, float]
    step: tuple[float, float]

    def sigma_m(self, depth_m: Array | float) -> Array:
        """Return the total standard deviation of one pixel at `depth_m` in metres: white, correlated and coding noise."""
        z2 = np.asarray(depth_m, float) ** 2
        white, slow, step = (a + b * z2 for a, b in (self.white, self.correlated, self.step))
        return np.asarray(np.sqrt(np.maximum(white**2, step**2 / 12.0) + slow**2))

    def sigma_of(self, depth_m: float) -> float:
        """Return `sigma_m` of a single depth, without the cost of arrays."""
        z2 = depth_m * depth_m
        white, slow, step = (a + b * z2 for a, b in (self.white, self.correlated, self.step))
        return sqrt(max(white**2, step**2 / 12.0) + slow**2)

    def slow_share(self, depth_m: float) -> float:
        """Return the share of the variance at `depth_m` that neighbouring pixels have in common, 0 to 1."""
        slow = self.correlated[0] + self.correlated[1] * depth_m**2
        return float(slow**2 / max(self.sigma_of(depth_m) ** 2, 1e-30))

    def packed(self) -> Array:
        """Return the white, correlated and step pairs as an array (6,), the form that compiled loops read."""
        return np.array([*self.white, *self.correlated, *self.step])

    def scaled(self, factor: float) -> NoiseModel:
        """Return this model with every part multiplied by `factor`."""
        white, correlated, step = ((factor * a, factor * b) for a, b in (self.white, self.correlated, self.step))
        return NoiseModel(white=white, correlated=correlated, step=step)

    def widened(self, factor: float, depths_m: Array) -> NoiseModel:
        """Return a model with `factor` times the total sigma at the given depths (N,); the excess counts as correlated."""
        z2 = depths_m**2
        total = factor * self.sigma_m(depths_m)
        white = self.white[0] + self.white[1] * z2
        return replace(self, correlated=_fit_law(z2, np.sqrt(np.maximum(total**2 - white**2, 0.0))))

    @property
    def is_stepped(self) -> bool:
        """Whether the step between codes at one metre is coarser than the noise that it should resolve."""
        return self.step[0] + self.step[1] > 2.0 * (self.white[0] + self.white[1])


def estimate_noise(depth_m: Array, sensor: RangeSensorModel, *, depths_m: Array | None = None) -> NoiseModel:
    """Estimate the noise model of an (H, W) depth image in metres, NaN where there is no reading.

    Smooth surfaces are locally quadratic in 1/z (pinhole) or z (orthographic), so the residual of a quadratic fitted to a
    window is noise. A low quantile over the windows ignores those that contain an edge.

    Args:
        depths_m: (5,) `typical_depths_m` of the image, if they are already known.
    """
    packed = sensor.packed()
    perspective = packed[0] > 0
    g = 1.0 / depth_m if perspective else depth_m
    z2 = (typical_depths_m(depth_m) if depths_m is None else depths_m) ** 2
    floor = np.array([FLOOR_RATIO * sensor.pitch_m(float(z)) for z in np.sqrt(z2)])
    small = _window_law(g, perspective, spacing_px=1, stride_px=max(7, min(g.shape) // WINDOWS_ACROSS))
    spacing = max(2, round(LARGE_SHARE * min(g.shape)))
    large = _window_law(g, perspective, spacing_px=spacing, stride_px=3 * spacing)
    step = coding_step(depth_m)
    white = _fit_law(z2, np.maximum(small[0] + small[1] * z2, floor))
    # The slow part is the noise in the large windows in excess of that in the small ones and of the code step.
    seen = np.maximum(white[0] + white[1] * z2, (step[0] + step[1] * z2) / np.sqrt(12.0))
    slow = np.sqrt(np.maximum((large[0] + large[1] * z2) ** 2 - 1.4 * seen**2, 0.0))
    law = NoiseModel(white=white, correlated=_fit_law(z2, slow), step=step)
    share = float(np.median(law.sigma_m(np.sqrt(z2)) / np.maximum(np.sqrt(z2), 1e-9)))
    return law.scaled(min(1.0, WORST_SHARE / max(share, 1e-12)))


def coding_step(depth_m: Array) -> tuple[float, float]:
    """Return `(a, b)` of the step `a + b z^2` between neighbouring depth codes; (0, 0) for continuous depth."""
    # A sample decides quickly whether the depth is continuous; only coded depth is worth a full sort.
    sample = valid_sample(depth_m, CODE_SAMPLES)
    if sample.size < 16 or np.unique(sample).size > 0.7 * sample.size:
        return 0.0, 0.0
    values = depth_m[np.isfinite(depth_m)]
    codes = np.unique(values)
    if codes.size > STEPPED_SHARE * values.size or codes.size < 4:
        return 0.0, 0.0
    gaps, middles = np.diff(codes), 0.5 * (codes[1:] + codes[:-1])
    bins = np.array_split(np.arange(gaps.size), min(DEPTH_BINS, max(1, gaps.size // 8)))
    # Unused codes make gaps too long, never too short.
    low = np.array([np.quantile(gaps[b], 0.25) for b in bins])
    at = np.array([middles[b].mean() for b in bins])
    return _fit_law(at**2, low)


def typical_depths_m(depth_m: Array) -> Array:
    """Return five quantiles (5,) of the valid depths in metres, at which noise models are evaluated; ones without any."""
    sample = np.sort(valid_sample(depth_m, TYPICAL_SAMPLES))
    if sample.size == 0:
        return np.ones(5)
    return np.asarray(sample[(np.array([0.1, 0.3, 0.5, 0.7, 0.9]) * (sample.size - 1)).astype(int)], float)


def valid_sample(depth: Array, most: int) -> Array:
    """Return about `most` of the valid depths, evenly spread in raster order; all of them if most readings are missing."""
    flat = depth.ravel()
    few = flat[:: max(1, flat.size // most)]
    known = few[np.isfinite(few)]
    return known if 4 * known.size > most else flat[np.isfinite(flat)]


def _window_law(g: Array, perspective: bool, *, spacing_px: int, stride_px: int) -> tuple[float, float]:
    """Return the noise law `(a, b)` of the residuals in windows of `WINDOW` samples across, `spacing_px` apart.

    `g` (H, W) is 1 / depth (`perspective`) or depth; (0, 0) if the image is too small for a window.
    """
    if min(g.shape) <= (WINDOW - 1) * spacing_px:
        return 0.0, 0.0
    freedom = WINDOW * WINDOW - BASIS.shape[0]
    z, _, rms = window_rms(g, BASIS, 3, spacing_px=spacing_px, stride_px=stride_px, perspective=perspective)
    if z.size == 0:
        return 0.0, 0.0
    rms *= WINDOW / np.sqrt(freedom)
    order = np.argsort(z)
    z, rms = z[order], rms[order]
    bins = min(DEPTH_BINS, max(1, z.size // 24))
    ends = np.arange(bins + 1) * z.size // bins
    # rms^2 freedom / sigma^2 is chi-square: Wilson and Hilferty's quantile removes the bias of looking low.
    expected = (1.0 - 2.0 / (9.0 * freedom) + NORMAL_QUANTILE * np.sqrt(2.0 / (9.0 * freedom))) ** 1.5
    low = np.array([np.sort(rms[a:b])[int(QUANTILE * (b - a))] for a, b in pairwise(ends.tolist())]) / expected
    at = np.add.reduceat(z, ends[:-1]) / np.diff(ends)
    return _fit_law(at**2, low)


@compiled
def _fit_law(z2: Array, values: Array) -> tuple[float, float]:
    """Fit the law `a + b z^2` with a, b >= 0 to values at squared depths `z2`; returns `(a, b)`.

    It is robust to depths at which no window is free of edges. Residuals are weighted by the inverse of the values,
    because relative errors count.
    """
    typical = float(np.median(values))
    if typical <= 0.0:
        return float(np.mean(values)), 0.0
    w = 1.0 / np.maximum(values, 0.1 * typical)
    a, b = typical, 0.0
    for _ in range(3):
        a, b = _two_non_negative(w, w * z2, w * values)
        for i in range(w.shape[0]):
            # A bin far above the law contains edges rather than noise.
            w[i] *= 0.25 if values[i] > 1.5 * (a + b * z2[i]) else 1.0
    return a, b


@compiled
def _two_non_negative(p: Array, q: Array, y: Array) -> tuple[float, float]:
    """Solve y = a p + b q for a, b >= 0 by least squares; where the free solution is negative, a or b is 0."""
    pp, qq, pq, py, qy = np.sum(p * p), np.sum(q * q), np.sum(p * q), np.sum(p * y), np.sum(q * y)
    det = pp * qq - pq * pq
    if det > 1e-9 * pp * qq:
        a, b = (qq * py - pq * qy) / det, (pp * qy - pq * py) / det
        if a >= 0.0 and b >= 0.0:
            return a, b
    only_a, only_b = max(py / pp, 0.0), max(qy / qq, 0.0)
    if only_a * py >= only_b * qy:
        return only_a, 0.0
    return 0.0, only_b
