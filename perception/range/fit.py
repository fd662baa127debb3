"""Fits of primitives on depth residuals along each ray.

Orthogonal distances bias a radius by about sigma^2 / (2 r) and more at grazing rays; the sensor errs along its ray, so
the residual is `(z_measured - z_surface) / sigma(z)`. Robust start (Cauchy weights under a falling scale), then a trim
at `TRIM_SIGMAS` and plain least squares (Levenberg's damping, Marquardt's scaling).
"""


# bodies and plain comparisons are what compiles fast.
# ruff: noqa: PLR0912, PLR0915 - compiled loops are long

from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.rays import MISS_SIGMAS, SCRATCH, normal_equations, residuals
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
    tangent_frame,
)

TRIM_SIGMAS = 3.0
ROUGH_SAMPLES = 36
ROUGH_LIMIT = 5.0
LARGEST_RADIUS_M = 10.0
QUADRIC_PER_SAMPLE = 1.15  # a simple surface under white noise costs about 0.95 a sample, and its price
STEP_GOAL = 1e-3  # of a standard deviation of each parameter: a step that small changes nothing that matters


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
    work = np.empty(SCRATCH)
    frame_of(kind, th, frame)
    cost, used = normal_equations(kind, th, frame, x, y, z, sigma, perspective, scale, trim, H, g, work)
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


@njit(cache=True, nogil=True)
def refine_plane(th, x, y, z, sigma, perspective, trim):  # type: ignore[no-untyped-def]
    """One trimmed Gauss-Newton step of a plane in two passes over the samples; returns as `refine` does.

    The ray depth of the plane (a, b, c) is 1 / (a x + b y + c) or a x + b y + c, so the step is linear in them:
    dz = -z^2 (x, y, 1) dm or (x, y, 1) dm. The information matrix is carried over to tilts and offset.
    """
    m = np.zeros(3)
    if perspective:
        m[0], m[1], m[2] = th[0] / th[3], th[1] / th[3], th[2] / th[3]
    else:
        m[0], m[1], m[2] = -th[0] / th[2], -th[1] / th[2], th[3] / th[2]
    S = np.zeros((3, 3))
    cost, used = 0.0, 0
    for sweep in range(2):
        S[:] = 0.0
        b = np.zeros(3)
        cost, used = 0.0, 0
        for i in range(x.shape[0]):
            g = m[0] * x[i] + m[1] * y[i] + m[2]
            zm = 1.0 / g if perspective else g
            e = (z[i] - zm) / sigma[i]
            if not abs(e) <= trim:
                cost += trim * trim
                continue
            cost += e * e
            used += 1
            w = -zm * zm / sigma[i] if perspective else 1.0 / sigma[i]
            wx, wy = w * x[i], w * y[i]
            S[0, 0] += wx * wx
            S[0, 1] += wx * wy
            S[0, 2] += wx * w
            S[1, 1] += wy * wy
            S[1, 2] += wy * w
            S[2, 2] += w * w
            b[0] += wx * e
            b[1] += wy * e
            b[2] += w * e
        S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]
        if sweep == 0 and used > 3 and solve_positive(S.copy(), b, 3):
            for k in range(3):
                m[k] += b[k]
    out = th.copy()
    if perspective:
        length = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
        side = 1.0 if th[3] >= 0.0 else -1.0
        out[0], out[1], out[2], out[3] = side * m[0] / length, side * m[1] / length, side * m[2] / length, side / length
    else:
        length = np.sqrt(m[0] * m[0] + m[1] * m[1] + 1.0)
        side = 1.0 if th[2] >= 0.0 else -1.0
        side /= length
        out[0], out[1], out[2], out[3] = -side * m[0], -side * m[1], side, side * m[2]
    frame, B = np.zeros(6), np.zeros((3, 3))
    frame_of(PLANE, out, frame)
    n2, d = out[2], out[3]
    for k in range(2):
        for a in range(3):
            if perspective:
                B[a, k] = frame[3 * k + a] / d
            elif a < 2:
                B[a, k] = -(frame[3 * k + a] * n2 - out[a] * frame[3 * k + 2]) / (n2 * n2)
            else:
                B[a, k] = -d * frame[3 * k + 2] / (n2 * n2)
    for a in range(3):
        B[a, 2] = -out[a] / (d * d) if perspective else (1.0 / n2 if a == 2 else 0.0)
    H = np.zeros((9, 9))
    H[:3, :3] = B.T @ S @ B
    return out, H, cost, used


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
def centroid(P):  # type: ignore[no-untyped-def]
    """Mean of points (N, 3)."""
    c = np.zeros(3)
    n = P.shape[0]
    for i in range(n):
        for a in range(3):
            c[a] += P[i, a]
    for a in range(3):
        c[a] /= n
    return c


@njit(cache=True)
def scatter(P, c):  # type: ignore[no-untyped-def]
    """(3, 3) sum of (P_i - c)(P_i - c)'."""
    S = np.zeros((3, 3))
    for i in range(P.shape[0]):
        x, y, z = P[i, 0] - c[0], P[i, 1] - c[1], P[i, 2] - c[2]
        S[0, 0] += x * x
        S[1, 1] += y * y
        S[2, 2] += z * z
        S[0, 1] += x * y
        S[0, 2] += x * z
        S[1, 2] += y * z
    S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]
    return S


@njit(cache=True)
def start_plane(P):  # type: ignore[no-untyped-def]
    """Plane through points (N, 3) by principal axes."""
    th = np.zeros(SIZE)
    c = centroid(P)
    _, V = np.linalg.eigh(scatter(P, c))
    side = -1.0 if V[2, 0] > 0 else 1.0  # towards the sensor, but for planes that the ray only grazes
    for a in range(3):
        th[a] = side * V[a, 0]
        th[3] += th[a] * c[a]
    return th


@njit(cache=True)
def _least_squares(rows, values):  # type: ignore[no-untyped-def]
    """Solve rows (N, m) x = values (N,) by normal equations; (x, solved)."""
    n, m = rows.shape
    A, b = np.zeros((m, m)), np.zeros(m)
    for i in range(n):
        for j in range(m):
            r = rows[i, j]
            b[j] += r * values[i]
            for k in range(j + 1):
                A[j, k] += r * rows[i, k]
    for j in range(m):
        for k in range(j):
            A[k, j] = A[j, k]
        A[j, j] = A[j, j] * (1.0 + 1e-9) + 1e-18
    return b, solve_positive(A, b, m)


@njit(cache=True)
def _side(P, N, th, axis):  # type: ignore[no-untyped-def]
    """+1 when the normals point away from the centre or axis of `th`, -1 when towards it."""
    outward = 0.0
    for i in range(P.shape[0]):
        x, y, z = P[i, 0] - th[0], P[i, 1] - th[1], P[i, 2] - th[2]
        h = x * axis[0] + y * axis[1] + z * axis[2]
        outward += N[i, 0] * (x - h * axis[0]) + N[i, 1] * (y - h * axis[1]) + N[i, 2] * (z - h * axis[2])
    return 1.0 if outward >= 0 else -1.0


@njit(cache=True)
def start_sphere(P, N):  # type: ignore[no-untyped-def]
    """Algebraic sphere |X|^2 = 2 c . X + k about the centroid; side from the normals."""
    th = np.zeros(SIZE)
    c = centroid(P)
    n = P.shape[0]
    rows, values = np.ones((n, 4)), np.zeros(n)
    for i in range(n):
        for a in range(3):
            d = P[i, a] - c[a]
            rows[i, a] = 2.0 * d
            values[i] += d * d
    b, ok = _least_squares(rows, values)
    if not ok:
        return th, False
    square = b[3]
    for a in range(3):
        th[a] = c[a] + b[a]
        square += b[a] * b[a]
    th[3] = np.sqrt(max(square, 1e-12))
    th[4] = _side(P, N, th, np.zeros(3))
    return th, True


@njit(cache=True)
def normal_axis(N, centred):  # type: ignore[no-untyped-def]
    """Direction that the normals avoid (cylinder), or along which they are constant (cone, centred)."""
    _, V = np.linalg.eigh(scatter(N, centroid(N) if centred else np.zeros(3)))
    return V[:, 0].copy()


@njit(cache=True)
def start_cylinder(P, N, axis):  # type: ignore[no-untyped-def]
    """Circle (algebraic) of the points seen along `axis`."""
    th = np.zeros(SIZE)
    e = tangent_frame(axis[0], axis[1], axis[2])
    c = centroid(P)
    n = P.shape[0]
    rows, values = np.ones((n, 3)), np.zeros(n)
    for i in range(n):
        x, y, z = P[i, 0] - c[0], P[i, 1] - c[1], P[i, 2] - c[2]
        p, q = x * e[0] + y * e[1] + z * e[2], x * e[3] + y * e[4] + z * e[5]
        rows[i, 0], rows[i, 1] = 2.0 * p, 2.0 * q
        values[i] = p * p + q * q
    b, ok = _least_squares(rows, values)
    if not ok:
        return th, False
    for a in range(3):
        th[a] = c[a] + b[0] * e[a] + b[1] * e[3 + a]
        th[3 + a] = axis[a]
    th[6] = np.sqrt(max(b[2] + b[0] * b[0] + b[1] * b[1], 1e-12))
    th[7] = _side(P, N, th, axis)
    return th, True


@njit(cache=True)
def start_cone(P, N, axis):  # type: ignore[no-untyped-def]
    """Apex from n . X = n . apex; the angle from n . axis = -sin(angle)."""
    th = np.zeros(SIZE)
    c = centroid(P)
    n = P.shape[0]
    values = np.zeros(n)
    along = 0.0
    for i in range(n):
        for a in range(3):
            values[i] += N[i, a] * (P[i, a] - c[a])
            along += N[i, a] * axis[a] / n
    b, ok = _least_squares(N, values)
    if not ok:
        return th, False
    inward = 1.0 if b[0] * axis[0] + b[1] * axis[1] + b[2] * axis[2] < 0 else -1.0
    for a in range(3):
        th[a] = c[a] + b[a]
        th[3 + a] = inward * axis[a]
    th[6] = min(max(np.arcsin(min(abs(along), 0.999)), 0.02), 1.5)
    th[7] = _side(P, N, th, th[3:6])
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
    A = np.array(
        [[th[4], 0.5 * th[7], 0.5 * th[8]], [0.5 * th[7], th[5], 0.5 * th[9]], [0.5 * th[8], 0.5 * th[9], th[6]]]
    )
    b = 0.5 * th[10:13]
    w, V = np.linalg.eigh(A)
    if w[0] <= 1e-3:
        return False
    t = V.T @ b
    rest = t[0] * t[0] / w[0] + t[1] * t[1] / w[1] + t[2] * t[2] / w[2] - th[13]
    return rest > 0 and w[2] < 64.0 * w[0]


@njit(cache=True)
def trimmed_cost(kind, th, x, y, z, sigma, perspective, limit, stride):  # type: ignore[no-untyped-def]
    """Sum of squared residuals, each at most limit^2, over every `stride`-th sample."""
    e = np.empty(x.shape[0])
    residuals(kind, th, x, y, z, sigma, perspective, e)
    cost = 0.0
    for i in range(0, x.shape[0], stride):
        cost += min(e[i] * e[i], limit * limit) if np.isfinite(e[i]) else limit * limit
    return cost


@njit(cache=True)
def fit_kinds(points, P, N, x, y, z, sigma, perspective, kinds, correlated_samples):  # type: ignore[no-untyped-def]
    """Fit every kind in the (5,) mask `kinds` to one set of samples, `points` (N, 3).

    `P` and `N` (M, 3) are those points that have a tangent plane, and its normal; only starts use them. All starts
    run a few robust steps on a quarter of the samples; those that may still win are fitted to the end.

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
    allowed = 2.0 * best_rough + 0.5 * rx.shape[0] / correlated_samples
    for k in range(6):
        kind = start_kind[k]
        if kind < 0 or rough[k] > allowed or not kinds[kind]:
            continue
        th, _, m, share, cost = fit_robust(kind, starts[k].copy(), x, y, z, sigma, perspective, free, 2)
        s = cost / correlated_samples + FREEDOM[kind] * price
        if s < score[kind] and _is_sane(kind, th):
            ths[kind], mean2[kind], kept[kind], score[kind] = th, m, share, s
    if kinds[QUADRIC] and start_kind[1] >= 0 and starts[1, 3] < LARGEST_RADIUS_M:
        # Nine parameters explain most things: they are tried when nothing simpler does.
        simple = np.min(score)
        if simple > n / correlated_samples * QUADRIC_PER_SAMPLE:
            th = quadric_of_sphere(starts[1])
            th, _, m, share, cost = fit_robust(QUADRIC, th, x, y, z, sigma, perspective, free, 3)
            if is_ellipsoid(th):
                ths[QUADRIC], mean2[QUADRIC], kept[QUADRIC] = th, m, share
                score[QUADRIC] = cost / correlated_samples + 9 * price
    return ths, mean2, kept, score


@njit(cache=True)
def _is_sane(kind, th):  # type: ignore[no-untyped-def]
    if kind == CYLINDER:
        return th[6] < LARGEST_RADIUS_M
    if kind == SPHERE:
        return th[3] < LARGEST_RADIUS_M
    if kind == CONE:
        return 0.03 < th[6] < 1.45
    return True
