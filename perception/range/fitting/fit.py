"""Robust fits of primitives to depth residuals along each ray.

The error of the sensor lies along its ray, so the residual is `(z_measured - z_surface) / sigma(z)`. Orthogonal
distances would bias a radius by about sigma^2 / (2 r), and by more at grazing rays. A fit starts robustly, with Cauchy
weights whose scale falls from round to round; it ends with least squares on the residuals below `TRIM_SIGMAS`
(see `refine`). Samples are (4, N), N <= CHUNK: ray coordinates x and y, depth z and its standard deviation.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Mask
from hal.jit import as_numpy_scalar, compiled
from perception.range.fitting.equations import MISS_SIGMAS, TRIM_SIGMAS, error_row
from perception.range.fitting.initialisation import (
    is_ellipsoid,
    normal_axis,
    quadric_of_sphere,
    start_cone,
    start_cylinder,
    start_plane,
    start_sphere,
)
from perception.range.fitting.rays import ERROR, FILLED, LOADED, fill_rows
from perception.range.fitting.refine import Scratch, refine, scratch_of
from perception.range.fitting.surfaces import (
    CONE,
    CYLINDER,
    FREEDOM,
    PLANE,
    QUADRIC,
    SIZE,
    SPHERE,
    frame_of,
)

PER_MEDIAN = 1.4826  # standard deviation of a normal distribution per median of its absolute value
SCALE_PRECISION = 0.004  # relative precision of `middle_scale`
FALLS = 0.95  # another round with Cauchy weights follows only if the scale falls below this share of the previous one
ROUGH_SAMPLES = 36  # used by the rough fit that precedes a full one
ROUGH_LIMIT = 5.0  # sigmas; residuals of the rough fit are capped at this
ROUGH_STEPS = as_numpy_scalar(2)  # per round of the rough fit
# No ellipsoid is tried if the mean square of the simpler kinds exceeds this: a sphere is then no good initial guess.
ELLIPSOID_GIVE_UP = 14.0
LARGEST_RADIUS_M = 10.0  # fits of spheres and cylinders with a larger radius are rejected
LEAST_NORMALS = 10  # normals needed to start any kind but a plane
QUADRIC_PER_SAMPLE = 1.15  # a simple surface under white noise costs about 0.95 per sample plus its parameter penalty
AROUND_ZERO, AROUND_MEAN = as_numpy_scalar(False), as_numpy_scalar(True)  # centre of the scatter matrix of the normals


@compiled
def _fill_errors(kind: int, th: Array, n: int, perspective: bool, scratch: Scratch, held: int) -> int:
    """Compute row ERROR of `scratch`, the residuals in sigmas, unless it is `held`; returns which rows are valid then."""
    if held != LOADED:
        return held
    frame_of(kind, th, scratch.trial.frame)
    fill_rows(kind, th, scratch.trial.frame, n, perspective, scratch.work)
    error_row(n, scratch.work)
    return FILLED


@compiled
def middle_scale(e: Array) -> float:
    """Return the robust scale of the residuals e (N,): 1.48 times the upper median of |e|, at least 1. Overwrites e.

    NaN marks a ray that misses. The median is found by bisection to the relative precision `SCALE_PRECISION`: counting
    the smaller values needs no branch, and selection with a pivot takes ten times as long.
    """
    n = e.shape[0]
    most = 0.0
    for i in range(n):
        e[i] = abs(e[i]) if np.isfinite(e[i]) else MISS_SIGMAS
        most = max(most, e[i])
    low = middle = 1.0 / PER_MEDIAN
    while True:
        within = 0
        for i in range(n):
            within += e[i] <= middle
        if 2 * within > n:
            most = middle
        else:
            low = middle
        if most <= low * (1.0 + 2.0 * SCALE_PRECISION):
            return max(0.5 * PER_MEDIAN * (low + most), 1.0)
        middle = 0.5 * (low + most)


@compiled
def fit_robust(kind: int, th: Array, samples: Array, perspective: bool, rounds: int) -> tuple[Array, float]:
    """Fit with Cauchy weights whose scale falls with the residuals, then with trimmed least squares.

    Returns the parameters and the trimmed cost: the sum of squared residuals in squared sigmas, each at most
    `TRIM_SIGMAS` squared. `th` holds the initial parameters, and `rounds` is the largest number of rounds with Cauchy
    weights.
    """
    th = th.copy()
    _, _, cost = _robust(kind, th, samples.shape[1], perspective, rounds, scratch_of(samples))
    return th, cost


@compiled
def _robust(
    kind: int, th: Array, n: int, perspective: bool, rounds: int, scratch: Scratch,
) -> tuple[float, float, float]:  # fmt: skip
    """Fit as `fit_robust` to the `n` samples in `scratch`, but update `th` in place.

    Returns the mean squared residual of the kept samples, the share kept, and the trimmed cost.
    """
    held, is_last, before, cost, used = LOADED, rounds == 0, np.inf, 0.0, 0
    for turn in range(rounds + 1):
        scale, steps = 0.0, 3
        if not is_last:
            held = _fill_errors(kind, th, n, perspective, scratch, held)
            middle = middle_scale(scratch.work[ERROR : ERROR + n])
            is_last = middle > FALLS * before  # nearly the same weights would give the same surface again
            if not is_last:
                scale, steps, before = middle, 4, middle
        cost, used, held = refine(kind, th, n, perspective, steps, scale, scratch, held)
        if is_last:
            break
        is_last = scale <= 1.05 or turn + 1 == rounds
    kept = cost - (n - used) * TRIM_SIGMAS * TRIM_SIGMAS
    return max(kept, 0.0) / max(used - FREEDOM[kind], 1), used / max(n, 1), cost


@compiled
def _rough(kind: int, th: Array, n: int, perspective: bool, scratch: Scratch) -> float:
    """Update `th` by a few robust steps; returns the sum of squared residuals, each capped at `ROUGH_LIMIT` squared."""
    e, steps = scratch.work[ERROR : ERROR + n], ROUGH_STEPS
    held = _fill_errors(kind, th, n, perspective, scratch, LOADED)
    for _ in range(2):
        scale = middle_scale(e)
        _, _, held = refine(kind, th, n, perspective, steps, scale, scratch, held)
        held = _fill_errors(kind, th, n, perspective, scratch, held)
        if scale < 1.5:
            break
    cost = 0.0
    for i in range(n):
        cost += min(e[i] * e[i], ROUGH_LIMIT * ROUGH_LIMIT) if np.isfinite(e[i]) else ROUGH_LIMIT * ROUGH_LIMIT
    return cost


@compiled
def rough_mean_square(kind: int, th: Array, samples: Array, perspective: bool) -> float:
    """Return the mean squared residual of a rough fit that starts at `th`, each capped at `ROUGH_LIMIT` squared.

    About `ROUGH_SAMPLES` of the samples are used. Residuals are in sigmas.
    """
    few = np.ascontiguousarray(samples[:, :: max(1, samples.shape[1] // ROUGH_SAMPLES)])
    return float(_rough(kind, th.copy(), few.shape[1], perspective, scratch_of(few)) / few.shape[1])


@compiled
def points_of(samples: Array, perspective: bool) -> Array:
    """Return the positions (N, 3) of the samples, metres."""
    out = np.empty((samples.shape[1], 3))
    for i in range(samples.shape[1]):
        scale = samples[2, i] if perspective else 1.0
        out[i, 0], out[i, 1], out[i, 2] = samples[0, i] * scale, samples[1, i] * scale, samples[2, i]
    return out


@compiled
def fit_kinds(
    samples: Array, normals: Array, perspective: bool, kinds: Mask, correlated_samples: float, give_up: float,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Fit every kind in the (5,) mask `kinds` to one set of samples.

    `normals` (N, 3) are those of the tangent planes there, NaN where there is none; only the initialisation uses them.
    Every kind first takes a few robust steps on a subset of about `ROUGH_SAMPLES` samples. A kind is fitted fully only
    if its rough cost is close to the best one and its mean squared residual (each capped at `ROUGH_LIMIT` squared) is
    at most `give_up`.

    Returns for each kind: parameters (5, SIZE), mean squared residual, share of samples kept, and Schwarz's criterion
    `trimmed cost / correlated_samples + p ln n` for comparing kinds; it is infinite where a kind does not fit.
    """
    ths = np.zeros((5, SIZE))
    mean2, kept, score = np.full(5, np.inf), np.zeros(5), np.full(5, np.inf)
    n, points = samples.shape[1], points_of(samples, perspective)
    known = np.isfinite(normals[:, 0])
    P, N = points[known], normals[known]
    price = np.log(max(n / correlated_samples, 2.0))
    few = np.ascontiguousarray(samples[:, :: max(1, n // ROUGH_SAMPLES)])
    few_scratch, scratch, rounds = scratch_of(few), scratch_of(samples), np.array([2, 2, 2, 2, 3])
    per_sample = few.shape[1] / correlated_samples
    starts, rough, best_rough = np.zeros((QUADRIC, SIZE)), np.full(QUADRIC, np.inf), np.inf
    for kind in range(QUADRIC):
        if kind == CONE and best_rough < 1.3 * per_sample:
            break  # a cone is tried only if no simpler kind fits
        if kinds[kind] and _start(kind, points, P, N, starts[kind]):
            rough[kind] = _rough(kind, starts[kind], few.shape[1], perspective, few_scratch) / correlated_samples
            best_rough = min(best_rough, rough[kind])
    # A kind whose rough cost is clearly above the best one cannot have the best score.
    behind = 2.0 * best_rough + 0.5 * per_sample
    give_up = give_up * per_sample
    for kind in range(QUADRIC):
        if not rough[kind] <= min(behind, give_up):
            continue
        th = starts[kind].copy()
        m, share, cost = _robust(kind, th, n, perspective, rounds[kind], scratch)
        s = cost / correlated_samples + FREEDOM[kind] * price
        if s < score[kind] and _is_sane(kind, th):
            ths[kind], mean2[kind], kept[kind], score[kind] = th, m, share, s
    is_near = rough[SPHERE] <= behind and best_rough <= ELLIPSOID_GIVE_UP * per_sample
    # A quadric has nine parameters and fits almost anything, so it is tried only if no simpler kind fits.
    is_wanted = kinds[QUADRIC] and np.min(score) > n / correlated_samples * QUADRIC_PER_SAMPLE
    if is_wanted and is_near and starts[SPHERE, 3] < LARGEST_RADIUS_M:
        th = quadric_of_sphere(starts[SPHERE])
        m, share, cost = _robust(QUADRIC, th, n, perspective, rounds[QUADRIC], scratch)
        if is_ellipsoid(th):
            ths[QUADRIC], mean2[QUADRIC], kept[QUADRIC] = th, m, share
            score[QUADRIC] = cost / correlated_samples + 9 * price
    return ths, mean2, kept, score


@compiled
def _start(kind: int, points: Array, P: Array, N: Array, th: Array) -> bool:
    """Fill `th` with the algebraic initial parameters of a kind other than QUADRIC; returns whether they exist.

    `P` and `N` (M, 3) are the points that have a tangent plane, and its normals.
    """
    if kind == PLANE:
        th[:] = start_plane(points)
        return True
    if P.shape[0] < LEAST_NORMALS:
        return False
    if kind == SPHERE:
        start, exists = start_sphere(P, N)
    elif kind == CYLINDER:
        start, exists = start_cylinder(P, N, normal_axis(N, AROUND_ZERO))
    else:
        start, exists = start_cone(P, N, normal_axis(N, AROUND_MEAN))
    th[:] = start
    return exists


@compiled
def _is_sane(kind: int, th: Array) -> bool:
    """Return whether the radius, or the half angle of a cone, is within the accepted range."""
    if kind == CYLINDER:
        return bool(th[6] < LARGEST_RADIUS_M)
    if kind == SPHERE:
        return bool(th[3] < LARGEST_RADIUS_M)
    if kind == CONE:
        return bool(0.03 < th[6] < 1.45)
    return True
