"""Fits of primitives on depth residuals along each ray.

Orthogonal distances bias a radius by about sigma^2 / (2 r) and more at grazing rays; the sensor errs along its ray, so
the residual is `(z_measured - z_surface) / sigma(z)`. Robust start (Cauchy weights under a falling scale), then a trim
at `TRIM_SIGMAS` and plain least squares (Levenberg's damping, Marquardt's scaling).
"""

# ruff: noqa: PLR0917 - compiled loops take plain arrays, and long
# bodies and plain comparisons are what compiles fast.
from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.surfaces import (
    CONE,
    CYLINDER,
    FREEDOM,
    GRAZING_COSINE,
    PLANE,
    QUADRIC,
    SIZE,
    SPHERE,
    depth_and_jacobian,
    frame_of,
    stepped,
)

TRIM_SIGMAS = 3.0
MISS_SIGMAS = 6.0  # a ray that misses the surface costs as much as a residual of this size
CAUCHY_WIDTH = 2.0
STEP_GOAL = 1e-3  # of a standard deviation of each parameter: a step that small changes nothing that matters


@njit(cache=True)
def residuals(kind, th, x, y, z, sigma, perspective, out):  # type: ignore[no-untyped-def]
    """Fill `out` (N,) with residuals in sigmas, lessened at grazing rays; NaN where the ray misses."""
    J = np.empty(9)
    frame = np.zeros(6)
    frame_of(kind, th, frame)
    for i in range(x.shape[0]):
        zm, cosine = depth_and_jacobian(kind, th, frame, x[i], y[i], perspective, J)
        out[i] = (z[i] - zm) / sigma[i] * min(1.0, cosine / GRAZING_COSINE)


@njit(cache=True)
def _normal_equations(kind, th, frame, x, y, z, sigma, perspective, scale, trim, H, g):  # type: ignore[no-untyped-def]
    """Gauss-Newton matrix, gradient, cost and number of used samples; Cauchy of `scale`, or a trim when scale is 0."""
    p = FREEDOM[kind]
    J = np.empty(9)
    H[:] = 0.0
    g[:] = 0.0
    cost, used = 0.0, 0
    c2 = scale * scale * CAUCHY_WIDTH * CAUCHY_WIDTH
    for i in range(x.shape[0]):
        zm, cosine = depth_and_jacobian(kind, th, frame, x[i], y[i], perspective, J)
        grazing = min(1.0, cosine / GRAZING_COSINE)
        missed = not np.isfinite(zm)
        w = grazing / sigma[i]
        e = MISS_SIGMAS if missed else (z[i] - zm) * w
        if scale > 0.0:
            ratio = e * e / c2
            cost += c2 * np.log1p(ratio)
            weight = 1.0 / (1.0 + ratio)
        else:
            cost += min(e * e, trim * trim)
            weight = 1.0 if abs(e) <= trim else 0.0
        if missed or weight == 0.0:
            continue
        used += 1
        wj = weight * w
        for a in range(p):
            ja = wj * J[a]
            g[a] += ja * e
            jaw = ja * w
            for b in range(a + 1):
                H[a, b] += jaw * J[b]
    for a in range(p):
        for b in range(a):
            H[b, a] = H[a, b]
    return cost, used


@njit(cache=True)
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
    frame_of(kind, th, frame)
    cost, used = _normal_equations(kind, th, frame, x, y, z, sigma, perspective, scale, trim, H, g)
    damping = 1e-4
    for _ in range(steps):
        A = np.empty((p, p))
        step = np.empty(p)
        for a in range(p):
            for b in range(p):
                A[a, b] = 0.0 if fixed[a] or fixed[b] else H[a, b]
            A[a, a] = A[a, a] * (1.0 + damping) + 1e-12 if not fixed[a] else 1.0
            step[a] = 0.0 if fixed[a] else g[a]
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
        new_cost, new_used = _normal_equations(
            kind, trial, new_frame, x, y, z, sigma, perspective, scale, trim, H2, g2
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


@njit(cache=True)
def solve_positive(A, b, p):  # type: ignore[no-untyped-def]
    """Solve A x = b by Cholesky, overwriting both; False when A is not positive definite."""
    for i in range(p):
        top = A[i, i]
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            if i == j:
                if s <= 1e-13 * top:
                    return False
                A[i, i] = np.sqrt(s)
            else:
                A[i, j] = s / A[j, j]
    for i in range(p):
        s = b[i]
        for k in range(i):
            s -= A[i, k] * b[k]
        b[i] = s / A[i, i]
    for i in range(p - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, p):
            s -= A[k, i] * b[k]
        b[i] = s / A[i, i]
    return True


@njit(cache=True)
def _middle_scale(kind, th, x, y, z, sigma, perspective):  # type: ignore[no-untyped-def]
    """Robust residual scale, 1.48 times the median of |e|, at least 1."""
    e = np.empty(x.shape[0])
    residuals(kind, th, x, y, z, sigma, perspective, e)
    for i in range(e.shape[0]):
        e[i] = abs(e[i]) if np.isfinite(e[i]) else MISS_SIGMAS
    return max(1.0, 1.4826 * np.median(e))


@njit(cache=True)
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


@njit(cache=True)
def start_plane(P):  # type: ignore[no-untyped-def]
    """Plane through points (N, 3) by principal axes."""
    th = np.zeros(SIZE)
    c = np.zeros(3)
    for i in range(P.shape[0]):
        c += P[i]
    c /= P.shape[0]
    S = np.zeros((3, 3))
    for i in range(P.shape[0]):
        d = P[i] - c
        for a in range(3):
            for b in range(3):
                S[a, b] += d[a] * d[b]
    _, V = np.linalg.eigh(S)
    n = V[:, 0].copy()
    if n[2] > 0:  # towards the sensor, but for planes that the ray only grazes
        n = -n
    th[:3] = n
    th[3] = n @ c
    return th


@njit(cache=True)
def start_sphere(P, N):  # type: ignore[no-untyped-def]
    """Algebraic sphere |X|^2 = 2 c . X + k about the centroid; side from the normals."""
    th = np.zeros(SIZE)
    c0 = np.zeros(3)
    for i in range(P.shape[0]):
        c0 += P[i]
    c0 /= P.shape[0]
    A, b = np.zeros((4, 4)), np.zeros(4)
    row = np.ones(4)
    for i in range(P.shape[0]):
        d = P[i] - c0
        row[:3] = 2.0 * d
        s = d @ d
        for a in range(4):
            b[a] += row[a] * s
            for e in range(4):
                A[a, e] += row[a] * row[e]
    for a in range(4):
        A[a, a] *= 1.0 + 1e-9
        A[a, a] += 1e-18
    if not solve_positive(A, b, 4):
        return th, False
    th[:3] = c0 + b[:3]
    th[3] = np.sqrt(max(b[3] + b[:3] @ b[:3], 1e-12))
    outward = 0.0
    for i in range(P.shape[0]):
        outward += N[i] @ (P[i] - th[:3])
    th[4] = 1.0 if outward >= 0 else -1.0
    return th, True


@njit(cache=True)
def _normal_axis(N, centred):  # type: ignore[no-untyped-def]
    """Direction that the normals avoid (cylinder), or along which they are constant (cone, centred)."""
    m = np.zeros(3)
    if centred:
        for i in range(N.shape[0]):
            m += N[i]
        m /= N.shape[0]
    S = np.zeros((3, 3))
    for i in range(N.shape[0]):
        d = N[i] - m
        for a in range(3):
            for b in range(3):
                S[a, b] += d[a] * d[b]
    _, V = np.linalg.eigh(S)
    return V[:, 0].copy()


@njit(cache=True)
def start_cylinder(P, N, axis):  # type: ignore[no-untyped-def]
    """Circle (algebraic) of the points seen along `axis`."""
    th = np.zeros(SIZE)
    e1x, e1y, e1z, e2x, e2y, e2z = tangent_frame_of(axis)
    e1, e2 = np.array([e1x, e1y, e1z]), np.array([e2x, e2y, e2z])
    c0 = np.zeros(3)
    for i in range(P.shape[0]):
        c0 += P[i]
    c0 /= P.shape[0]
    A, b, row = np.zeros((3, 3)), np.zeros(3), np.ones(3)
    for i in range(P.shape[0]):
        d = P[i] - c0
        p, q = d @ e1, d @ e2
        row[0], row[1] = 2.0 * p, 2.0 * q
        s = p * p + q * q
        for a in range(3):
            b[a] += row[a] * s
            for e in range(3):
                A[a, e] += row[a] * row[e]
    for a in range(3):
        A[a, a] = A[a, a] * (1.0 + 1e-9) + 1e-18
    if not solve_positive(A, b, 3):
        return th, False
    th[:3] = c0 + b[0] * e1 + b[1] * e2
    th[3:6] = axis
    th[6] = np.sqrt(max(b[2] + b[0] * b[0] + b[1] * b[1], 1e-12))
    outward = 0.0
    for i in range(P.shape[0]):
        outward += N[i] @ (P[i] - th[:3])
    th[7] = 1.0 if outward >= 0 else -1.0
    return th, True


@njit(cache=True)
def tangent_frame_of(axis):  # type: ignore[no-untyped-def]
    """`tangent_frame` of a (3,) array."""
    frame = np.zeros(6)
    th = np.zeros(SIZE)
    th[:3] = axis
    frame_of(PLANE, th, frame)
    return frame[0], frame[1], frame[2], frame[3], frame[4], frame[5]


@njit(cache=True)
def start_cone(P, N, axis):  # type: ignore[no-untyped-def]
    """Apex from n . X = n . apex; the angle from n . axis = -sin(angle)."""
    th = np.zeros(SIZE)
    c0 = np.zeros(3)
    for i in range(P.shape[0]):
        c0 += P[i]
    c0 /= P.shape[0]
    A, b = np.zeros((3, 3)), np.zeros(3)
    along = 0.0
    for i in range(P.shape[0]):
        s = N[i] @ (P[i] - c0)
        for a in range(3):
            b[a] += N[i, a] * s
            for e in range(3):
                A[a, e] += N[i, a] * N[i, e]
        along += N[i] @ axis
    along /= P.shape[0]
    trace = A[0, 0] + A[1, 1] + A[2, 2]
    for a in range(3):
        A[a, a] += 1e-6 * trace
    if not solve_positive(A, b, 3):
        return th, False
    th[:3] = c0 + b
    inward = axis if (c0 - th[:3]) @ axis > 0 else -axis
    outward = 0.0
    for i in range(P.shape[0]):
        d = P[i] - th[:3]
        outward += N[i] @ (d - (d @ inward) * inward)
    th[3:6] = inward
    th[6] = min(max(np.arcsin(min(abs(along), 0.999)), 0.02), 1.5)
    th[7] = 1.0 if outward >= 0 else -1.0
    return th, True


@njit(cache=True)
def quadric_of_sphere(th):  # type: ignore[no-untyped-def]
    """The sphere as a quadric centred on it: the start of an ellipsoid fit."""
    out = np.zeros(SIZE)
    out[:3] = th[:3]
    out[3] = max(th[3], 1e-6)
    out[4], out[5], out[6], out[13] = 1.0, 1.0, 1.0, -1.0
    return out


@njit(cache=True)
def is_ellipsoid(th):  # type: ignore[no-untyped-def]
    """Whether the quadric is a real ellipsoid of sane proportions (longest radius at most 8 times the shortest)."""
    A = np.array([
        [th[4], 0.5 * th[7], 0.5 * th[8]], [0.5 * th[7], th[5], 0.5 * th[9]], [0.5 * th[8], 0.5 * th[9], th[6]]
    ])
    b = 0.5 * th[10:13]
    w, V = np.linalg.eigh(A)
    if w[0] <= 1e-3:
        return False
    t = V.T @ b
    rest = t[0] * t[0] / w[0] + t[1] * t[1] / w[1] + t[2] * t[2] / w[2] - th[13]
    return rest > 0 and w[2] < 64.0 * w[0]


@njit(cache=True)
def fit_kinds(points, P, N, x, y, z, sigma, perspective, kinds, correlated_samples):  # type: ignore[no-untyped-def]
    """Fit every kind in the (5,) mask `kinds` to one set of samples, `points` (N, 3).

    `P` and `N` (M, 3) are those points that have a tangent plane, and its normal; only starts use them.

    Returns per kind: parameters (5, SIZE), mean squared residual, share kept, and the criterion
    `trimmed cost / correlated_samples + p ln n` by which kinds compete (Schwarz), infinite where a kind does not fit.
    """
    ths = np.zeros((5, SIZE))
    mean2, kept, score = np.full(5, np.inf), np.zeros(5), np.full(5, np.inf)
    free = np.zeros(9, np.bool_)
    n = x.shape[0]
    price = np.log(max(n / correlated_samples, 2.0))
    if kinds[PLANE]:
        th = start_plane(points)
        ths[PLANE], _, mean2[PLANE], kept[PLANE], cost = fit_robust(PLANE, th, x, y, z, sigma, perspective, free, 4)
        score[PLANE] = cost / correlated_samples + 3 * price
    if P.shape[0] < 10:
        return ths, mean2, kept, score
    sphere, ok = start_sphere(P, N)
    if ok and (kinds[SPHERE] or kinds[QUADRIC]):
        sphere, _, m, k, cost = fit_robust(SPHERE, sphere, x, y, z, sigma, perspective, free, 4)
        if kinds[SPHERE]:
            ths[SPHERE], mean2[SPHERE], kept[SPHERE] = sphere, m, k
            score[SPHERE] = cost / correlated_samples + 4 * price
    if kinds[CYLINDER] or kinds[CONE]:
        for attempt in range(2):
            axis = _normal_axis(N, attempt == 1)
            th, ok = start_cylinder(P, N, axis)
            if ok and kinds[CYLINDER]:
                th, _, m, k, cost = fit_robust(CYLINDER, th, x, y, z, sigma, perspective, free, 4)
                s = cost / correlated_samples + 5 * price
                if s < score[CYLINDER] and th[6] < 10.0:
                    ths[CYLINDER], mean2[CYLINDER], kept[CYLINDER], score[CYLINDER] = th, m, k, s
            if kinds[CONE]:
                th, ok = start_cone(P, N, axis)
                if ok:
                    th, _, m, k, cost = fit_robust(CONE, th, x, y, z, sigma, perspective, free, 4)
                    s = cost / correlated_samples + 6 * price
                    if s < score[CONE] and 0.03 < th[6] < 1.45:
                        ths[CONE], mean2[CONE], kept[CONE], score[CONE] = th, m, k, s
    if kinds[QUADRIC] and ok and sphere[3] < 10.0:
        th = quadric_of_sphere(sphere)
        th, _, m, k, cost = fit_robust(QUADRIC, th, x, y, z, sigma, perspective, free, 4)
        if is_ellipsoid(th):
            ths[QUADRIC], mean2[QUADRIC], kept[QUADRIC] = th, m, k
            score[QUADRIC] = cost / correlated_samples + 9 * price
    return ths, mean2, kept, score
