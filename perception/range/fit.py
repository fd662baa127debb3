"""Fits of primitives on depth residuals along each ray.

Orthogonal distances bias a radius by about sigma^2 / (2 r) and more at grazing rays; the sensor errs along its ray, so
the residual is `(z_measured - z_surface) / sigma(z)`. Robust start (Cauchy weights under a falling scale), then a trim
at `TRIM_SIGMAS` and plain least squares (Levenberg's damping, Marquardt's scaling).
"""

# ruff: noqa: PLR0912, PLR0915 - the kinds are told apart in one compiled body
from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.rays import MISS_SIGMAS, SCRATCH, normal_equations, residuals
from perception.range.starts import (
    is_ellipsoid,
    normal_axis,
    quadric_of_sphere,
    solve_positive,
    start_cone,
    start_cylinder,
    start_plane,
    start_sphere,
)
from perception.range.surfaces import (
    CONE,
    CYLINDER,
    FREEDOM,
    PLANE,
    QUADRIC,
    SIZE,
    SPHERE,
    frame_of,
    stepped,
)

TRIM_SIGMAS = 3.0
ROUGH_SAMPLES = 36
ROUGH_LIMIT = 5.0
LARGEST_RADIUS_M = 10.0
QUADRIC_PER_SAMPLE = 1.15  # a simple surface under white noise costs about 0.95 a sample, and its price
STEP_GOAL = 1e-3  # of a standard deviation of each parameter: a step that small changes nothing that matters


@njit(cache=True, error_model="numpy")
def refine(kind, th, x, y, z, sigma, perspective, steps, scale, trim, fixed):  # type: ignore[no-untyped-def]
    """Minimise the ray residuals from `th`.

    Args:
        x, y, z, sigma: (N,) samples; coordinates as in `Grid`.
        scale: > 0: width of the Cauchy weights in sigmas; 0: trim at `trim` and plain least squares.
        fixed: (9,) bool, tangent parameters that a prior holds.

    Returns:
        parameters, information matrix (9, 9), cost, samples used.
    """
    p = FREEDOM[kind]
    frame, new_frame = np.zeros(6), np.zeros(6)
    H, g = np.zeros((9, 9)), np.zeros(9)
    H2, g2 = np.zeros((9, 9)), np.zeros(9)
    work = np.empty(SCRATCH)
    frame_of(kind, th, frame)
    cost, used = normal_equations(kind, th, frame, x, y, z, sigma, perspective, scale, trim, H, g, work)
    damping = 1e-4
    A, step = np.empty((p, p)), np.empty(p)
    for _ in range(steps):
        _damped(H, g, fixed, damping, p, A, step)
        if not solve_positive(A, step, p):
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        small = 0.0
        for a in range(p):
            small = max(small, abs(step[a]) * np.sqrt(H[a, a]))
        trial = stepped(kind, th, frame, step)
        frame_of(kind, trial, new_frame)
        new_cost, new_used = normal_equations(
            kind, trial, new_frame, x, y, z, sigma, perspective, scale, trim, H2, g2, work
        )
        if new_cost <= cost and new_used >= p:
            th, cost, used = trial, new_cost, new_used
            frame[:] = new_frame
            H[:] = H2
            g[:] = g2
            damping = max(damping * 0.2, 1e-9)
            if small < STEP_GOAL * 30.0:
                break
        else:
            damping *= 10.0
            if damping > 1e6 or small < STEP_GOAL:
                break
    return th, H, cost, used


@njit(cache=True, error_model="numpy", nogil=True)
def last_step(kind, th, x, y, z, sigma, perspective, fixed):  # type: ignore[no-untyped-def]
    """One Gauss-Newton step on all samples from a start that is good already, in a single pass over them.

    The matrix and the trim are those of the start; the cost after the step follows from the quadratic model.

    Returns:
        parameters, information matrix (9, 9), squared residuals of the kept samples, samples kept.
    """
    p = FREEDOM[kind]
    H, g, frame = np.zeros((9, 9)), np.zeros(9), np.zeros(6)
    frame_of(kind, th, frame)
    cost, used = normal_equations(
        kind, th, frame, x, y, z, sigma, perspective, 0.0, TRIM_SIGMAS, H, g, np.empty(SCRATCH)
    )
    kept = max(cost - (x.shape[0] - used) * TRIM_SIGMAS * TRIM_SIGMAS, 0.0)
    A, step = np.empty((p, p)), np.empty(p)
    _damped(H, g, fixed, 0.0, p, A, step)
    if used <= p or not solve_positive(A, step, p):
        return th, H, kept, used
    for a in range(p):
        kept -= 0.0 if fixed[a] else g[a] * step[a]
    return stepped(kind, th, frame, step), H, max(kept, 0.0), used


@njit(cache=True, error_model="numpy")
def _damped(H, g, fixed, damping, p, A, step):  # type: ignore[no-untyped-def]
    """The system of one step into `A` (p, p) and `step` (p,): fixed parameters stay where they are."""
    for a in range(p):
        for b in range(p):
            A[a, b] = 0.0 if fixed[a] or fixed[b] else H[a, b]
        A[a, a] = A[a, a] * (1.0 + damping) + 1e-12 if not fixed[a] else 1.0
        step[a] = 0.0 if fixed[a] else g[a]


@njit(cache=True, error_model="numpy")
def _middle_scale(kind, th, x, y, z, sigma, perspective):  # type: ignore[no-untyped-def]
    """Robust residual scale, 1.48 times the median of |e|, at least 1."""
    e = np.empty(x.shape[0])
    residuals(kind, th, x, y, z, sigma, perspective, e)
    for i in range(e.shape[0]):
        e[i] = abs(e[i]) if np.isfinite(e[i]) else MISS_SIGMAS
    return max(1.0, 1.4826 * np.median(e))


@njit(cache=True, error_model="numpy")
def fit_robust(kind, th, x, y, z, sigma, perspective, fixed, rounds):  # type: ignore[no-untyped-def]
    """Refine under Cauchy weights whose scale falls with the residuals; ends with the trimmed fit.

    Returns parameters, information matrix, mean squared residual of the kept samples, share kept.
    """
    for _ in range(rounds):
        scale = _middle_scale(kind, th, x, y, z, sigma, perspective)
        th, H, cost, used = refine(kind, th, x, y, z, sigma, perspective, 4, scale, TRIM_SIGMAS, fixed)
        if scale <= 1.05:
            break
    th, H, cost, used = refine(kind, th, x, y, z, sigma, perspective, 3, 0.0, TRIM_SIGMAS, fixed)
    n = x.shape[0]
    kept = cost - (n - used) * TRIM_SIGMAS * TRIM_SIGMAS
    return th, H, max(kept, 0.0) / max(used - FREEDOM[kind], 1), used / max(n, 1), cost


@njit(cache=True, error_model="numpy")
def trimmed_cost(kind, th, x, y, z, sigma, perspective, limit, stride):  # type: ignore[no-untyped-def]
    """Sum of squared residuals, each at most limit^2, over every `stride`-th sample."""
    e = np.empty(x.shape[0])
    residuals(kind, th, x, y, z, sigma, perspective, e)
    cost = 0.0
    for i in range(0, x.shape[0], stride):
        cost += min(e[i] * e[i], limit * limit) if np.isfinite(e[i]) else limit * limit
    return cost


@njit(cache=True, error_model="numpy")
def fit_kinds(points, P, N, x, y, z, sigma, perspective, kinds, correlated_samples, give_up):  # type: ignore[no-untyped-def]
    """Fit every kind in the (5,) mask `kinds` to one set of samples, `points` (N, 3).

    `P` and `N` (M, 3) are those points that have a tangent plane, and its normal; only starts use them. All starts
    run a few robust steps on a quarter of the samples; those that may still win are fitted to the end, and none whose
    squared residuals, each at most `ROUGH_LIMIT` squared, still have a mean beyond `give_up`.

    Returns per kind: parameters (5, SIZE), mean squared residual, share kept, and the criterion
    `trimmed cost / correlated_samples + p ln n` by which kinds compete (Schwarz), infinite where a kind does not fit.
    """
    ths = np.zeros((5, SIZE))
    mean2, kept, score = np.full(5, np.inf), np.zeros(5), np.full(5, np.inf)
    n = x.shape[0]
    price = np.log(max(n / correlated_samples, 2.0))
    starts, start_kind, rough = np.zeros((6, SIZE)), np.full(6, -1), np.full(6, np.inf)
    if kinds[PLANE]:
        starts[0], start_kind[0] = start_plane(points), PLANE
    if P.shape[0] >= 10:
        if kinds[SPHERE] or kinds[QUADRIC]:
            starts[1], ok = start_sphere(P, N)
            start_kind[1] = SPHERE if ok else -1
        for attempt in range(2):
            axis = normal_axis(N, attempt == 1)
            if kinds[CYLINDER]:
                starts[2 + 2 * attempt], ok = start_cylinder(P, N, axis)
                start_kind[2 + 2 * attempt] = CYLINDER if ok else -1
            if kinds[CONE]:
                starts[3 + 2 * attempt], ok = start_cone(P, N, axis)
                start_kind[3 + 2 * attempt] = CONE if ok else -1
    free = np.zeros(9, np.bool_)
    stride = max(1, n // ROUGH_SAMPLES)
    rx, ry, rz, rs = x[::stride].copy(), y[::stride].copy(), z[::stride].copy(), sigma[::stride].copy()
    best_rough = np.inf
    for k in range(6):
        kind = start_kind[k]
        if kind < 0 or (k >= 4 and best_rough < 1.3 * rx.shape[0] / correlated_samples):
            continue  # the second axis is for components that the first cannot explain
        th = starts[k].copy()
        for _ in range(2):
            scale = _middle_scale(kind, th, rx, ry, rz, rs, perspective)
            th, _, _, _ = refine(kind, th, rx, ry, rz, rs, perspective, 2, scale, TRIM_SIGMAS, free)
            if scale < 1.5:
                break
        starts[k] = th
        rough[k] = trimmed_cost(kind, th, rx, ry, rz, rs, perspective, ROUGH_LIMIT, 1) / correlated_samples
        best_rough = min(best_rough, rough[k])
    # A start that is clearly behind after the rough fit is not going to win.
    per_sample = rx.shape[0] / correlated_samples
    allowed = min(2.0 * best_rough + 0.5 * per_sample, give_up * per_sample)
    for k in range(6):
        kind = start_kind[k]
        if kind < 0 or rough[k] > allowed or not kinds[kind]:
            continue
        th, _, m, share, cost = fit_robust(kind, starts[k].copy(), x, y, z, sigma, perspective, free, 2)
        s = cost / correlated_samples + FREEDOM[kind] * price
        if s < score[kind] and _is_sane(kind, th):
            ths[kind], mean2[kind], kept[kind], score[kind] = th, m, share, s
    if kinds[QUADRIC] and best_rough <= allowed and start_kind[1] >= 0 and starts[1, 3] < LARGEST_RADIUS_M:
        # Nine parameters explain most things: they are tried when nothing simpler does.
        simple = np.min(score)
        if simple > n / correlated_samples * QUADRIC_PER_SAMPLE:
            th = quadric_of_sphere(starts[1])
            th, _, m, share, cost = fit_robust(QUADRIC, th, x, y, z, sigma, perspective, free, 3)
            if is_ellipsoid(th):
                ths[QUADRIC], mean2[QUADRIC], kept[QUADRIC] = th, m, share
                score[QUADRIC] = cost / correlated_samples + 9 * price
    return ths, mean2, kept, score


@njit(cache=True, error_model="numpy")
def _is_sane(kind, th):  # type: ignore[no-untyped-def]
    if kind == CYLINDER:
        return th[6] < LARGEST_RADIUS_M
    if kind == SPHERE:
        return th[3] < LARGEST_RADIUS_M
    if kind == CONE:
        return 0.03 < th[6] < 1.45
    return True
