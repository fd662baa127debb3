"""Compiled inner loops of the pose of four points: reprojection chi-square, its derivatives and a local minimiser.

Points in the image are normalised coordinates `m` (4, 2) with information `A` (4, 3) = (a_uu, a_uv, a_vv) each; object
points are `X` (4, 3), with the origin at their centroid. A pose is `R` (3, 3) and `t` (3,), camera_from_object.
Perturbations are ordered translation, then rotation: t <- t + d, R <- Exp(w) R. Costs are chi-squares.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.least_squares import DampingRule, next_damping, solve_damped
from perception.vision.quadrangle.small_vectors import cross3, mix3, product3

CONVERGED = 1e-9  # predicted decrease of chi-square at which to stop: 3e-5 of a standard deviation
MAX_STEPS = 60
RULE = DampingRule(fall=0.1, rise=8.0, least=0.0, restart=1e-4, most=1e12)
LEAST_PIVOT = 1e-14  # relative to the Gauss-Newton matrix; below it the Hessian counts as indefinite


@inlined
def rotation_of(w: Array) -> Array:
    """Return the rotation matrix of a rotation vector (Rodrigues)."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    s = 1.0 - angle2 / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    c = 0.5 - angle2 / 24.0 if angle < 1e-4 else (1.0 - np.cos(angle)) / angle2
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = c * w[i] * w[j]
        R[i, i] += 1.0 - c * angle2
    R[0, 1] -= s * w[2]
    R[1, 0] += s * w[2]
    R[0, 2] += s * w[1]
    R[2, 0] -= s * w[1]
    R[1, 2] -= s * w[0]
    R[2, 1] += s * w[0]
    return R


@inlined
def turn_onto(a: Array, b: Array) -> Array:
    """Return the smallest rotation that turns unit vector a onto unit vector b, which must not be opposite to a."""
    v = cross3(a, b)
    c = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    k = 1.0 / (1.0 + c)
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = k * v[i] * v[j]
        R[i, i] += c
    R[0, 1] -= v[2]
    R[1, 0] += v[2]
    R[0, 2] += v[1]
    R[2, 0] -= v[1]
    R[1, 2] -= v[0]
    R[2, 1] += v[0]
    return R


@compiled
def chi_square(R: Array, t: Array, X: Array, m: Array, A: Array) -> float:
    """Return the reprojection chi-square of a pose; infinite if a point is behind the camera."""
    total = 0.0
    for i in range(X.shape[0]):
        z = R[2, 0] * X[i, 0] + R[2, 1] * X[i, 1] + R[2, 2] * X[i, 2] + t[2]
        if not z > 0.0:
            return np.inf
        eu = (R[0, 0] * X[i, 0] + R[0, 1] * X[i, 1] + R[0, 2] * X[i, 2] + t[0]) / z - m[i, 0]
        ev = (R[1, 0] * X[i, 0] + R[1, 1] * X[i, 1] + R[1, 2] * X[i, 2] + t[1]) / z - m[i, 1]
        total += A[i, 0] * eu * eu + 2.0 * A[i, 1] * eu * ev + A[i, 2] * ev * ev
    return total


@compiled
def expand(R: Array, t: Array, X: Array, m: Array, A: Array, g: Array, N: Array, H: Array) -> float:
    """Return the chi-square; fills its derivatives with respect to the pose.

    These are half the gradient g (6,), the Gauss-Newton matrix N (6, 6) and half the exact Hessian H (6, 6).
    """
    for a in range(6):
        g[a] = 0.0
        for b in range(6):
            N[a, b] = H[a, b] = 0.0
    Ju = np.empty(6)
    Jv = np.empty(6)
    total = 0.0
    for i in range(X.shape[0]):
        y0 = R[0, 0] * X[i, 0] + R[0, 1] * X[i, 1] + R[0, 2] * X[i, 2]
        y1 = R[1, 0] * X[i, 0] + R[1, 1] * X[i, 1] + R[1, 2] * X[i, 2]
        y2 = R[2, 0] * X[i, 0] + R[2, 1] * X[i, 1] + R[2, 2] * X[i, 2]
        z = y2 + t[2]
        if not z > 0.0:
            return np.inf
        iz = 1.0 / z
        u = (y0 + t[0]) * iz
        v = (y1 + t[1]) * iz
        eu = u - m[i, 0]
        ev = v - m[i, 1]
        lu = A[i, 0] * eu + A[i, 1] * ev
        lv = A[i, 1] * eu + A[i, 2] * ev
        total += lu * eu + lv * ev
        # du/dq = (1, 0, -u)/z, dv/dq = (0, 1, -v)/z; a . (w x y) = w . (y x a)
        Ju[0] = iz
        Ju[1] = 0.0
        Ju[2] = -u * iz
        Ju[3] = y1 * Ju[2]
        Ju[4] = y2 * iz - y0 * Ju[2]
        Ju[5] = -y1 * iz
        Jv[0] = 0.0
        Jv[1] = iz
        Jv[2] = -v * iz
        Jv[3] = y1 * Jv[2] - y2 * iz
        Jv[4] = -y0 * Jv[2]
        Jv[5] = y0 * iz
        for a in range(6):
            g[a] += lu * Ju[a] + lv * Jv[a]
            pu = A[i, 0] * Ju[a] + A[i, 1] * Jv[a]
            pv = A[i, 1] * Ju[a] + A[i, 2] * Jv[a]
            for b in range(a + 1):
                N[a, b] += pu * Ju[b] + pv * Jv[b]
        bend(y0, y1, y2, iz, u, v, lu, lv, H)
    for a in range(6):
        for b in range(a + 1):
            H[a, b] += N[a, b]
            H[b, a] = H[a, b]
            N[b, a] = N[a, b]
    return total


@inlined
def bend(y0: float, y1: float, y2: float, iz: float, u: float, v: float, lu: float, lv: float, H: Array) -> None:
    """Add to H (lower triangle) the second-order terms of one point that Gauss-Newton neglects: l_u d2u + l_v d2v.

    Hq, the Hessian of the projection, has only a last row and column; [-y]x = [[0, y2, -y1], [-y2, 0, y0], [y1, -y0,
    0]].
    """
    iz2 = iz * iz
    hx = -lu * iz2
    hy = -lv * iz2
    hz = 2.0 * (lu * u + lv * v) * iz2
    H[2, 0] += hx
    H[2, 1] += hy
    H[2, 2] += hz
    # Hq @ [-y]x, rows x, y, z
    m00 = hx * y1
    m01 = -hx * y0
    m10 = hy * y1
    m11 = -hy * y0
    m20 = -hy * y2 + hz * y1
    m21 = hx * y2 - hz * y0
    m22 = -hx * y1 + hy * y0
    H[3, 0] += m00
    H[4, 0] += m01
    H[3, 1] += m10
    H[4, 1] += m11
    H[3, 2] += m20
    H[4, 2] += m21
    H[5, 2] += m22
    # ([-y]x)^T Hq [-y]x + (g y^T + y g^T)/2 - (g . y) I, with g the gradient with respect to the point
    gx = lu * iz
    gy = lv * iz
    gz = -(lu * u + lv * v) * iz
    dot = gx * y0 + gy * y1 + gz * y2
    H[3, 3] += -y2 * m10 + y1 * m20 + gx * y0 - dot
    H[4, 3] += y2 * m00 - y0 * m20 + 0.5 * (gy * y0 + gx * y1)
    H[5, 3] += -y1 * m00 + y0 * m10 + 0.5 * (gz * y0 + gx * y2)
    H[4, 4] += y2 * m01 - y0 * m21 + gy * y1 - dot
    H[5, 4] += -y1 * m01 + y0 * m11 + 0.5 * (gz * y1 + gy * y2)
    H[5, 5] += gz * y2 - dot


@inlined
def newton_step(H: Array, N: Array, damping: float, fallback: float, g: Array, x: Array, L: Array) -> float:
    """Fill x (n,) with the damped Newton step at gradient g; returns the predicted decrease, -1 where there is no step.

    Where the Hessian H is indefinite, the step is that of the Gauss-Newton matrix N, damped by `fallback`. `L` (n, n)
    receives the Cholesky factor.
    """
    n = g.shape[0]
    for i in range(n):
        x[i] = -g[i]
    fall = solve_damped(H, N, damping, 0.0, LEAST_PIVOT, x, L, n)
    return fall if fall >= 0.0 else solve_damped(N, N, fallback, 0.0, LEAST_PIVOT, x, L, n)


@compiled
def minimise(R: Array, t: Array, X: Array, m: Array, A: Array) -> tuple[Array, Array, float, Array, int]:
    """Find the local minimum of chi-square near a start by damped Newton steps.

    Where the Hessian is indefinite, a Gauss-Newton step is taken instead. Gauss-Newton alone converges slowly near
    fronto-parallel poses, where two minima merge.

    Returns: R, t, chi-square, Gauss-Newton matrix (6, 6), steps taken.
    """
    g, x = np.empty(6), np.empty(6)
    N, H, L = np.empty((6, 6)), np.empty((6, 6)), np.zeros((6, 6))
    cost = expand(R, t, X, m, A, g, N, H)
    if not np.isfinite(cost):
        return R, t, np.inf, N, 0
    damping = 1e-4
    steps = 0
    while steps < MAX_STEPS:
        steps += 1
        fall = newton_step(H, N, damping, damping, g, x, L)
        if fall < 0.0:
            damping = next_damping(damping, False, RULE)
            continue
        R_new = product3(rotation_of(x[3:]), R)
        t_new = mix3(1.0, t, 1.0, x)
        if fall < CONVERGED:
            cost_new = chi_square(R_new, t_new, X, m, A)
            if cost_new <= cost:
                return R_new, t_new, cost_new, N, steps
            return R, t, cost, N, steps
        cost_new = chi_square(R_new, t_new, X, m, A)
        is_lower = cost_new < cost
        if is_lower:
            R, t = R_new, t_new
            cost = expand(R, t, X, m, A, g, N, H)
        damping = next_damping(damping, is_lower, RULE)
        if damping > RULE.most:
            break
    return R, t, cost, N, steps
