"""The nine local pose functions without approximation, and their gradients, compiled (paper eq 10).

Classes 1, 2, 3, 5, 6 and 9 have closed forms. In classes 4, 7 and 8 the sensed point and direction are coupled, and f is
the minimum over the directions v of

    F(v) = F0 + s (h.v)^2 / (v.A v) + v.M v,    |v| = 1

with (s, h, A) = (-1, C^-1 e, C^-1) for line-point and (+1, e, C) for plane-point; plane-line is plane-point with v
perpendicular to u. F has several minima. Each is reached by Newton's method on the sphere, started at the minima of
either term, on the arcs between those, and on a coarse grid.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.batch import Batch
from fusion.vectors import Vec, across, blend, cross, dot, normalised, turned, vec
from hal.arrays import Array
from hal.jit import compiled, inlined

# A symmetric matrix as eigenvalues and unit eigenvectors, so that v.S v is a sum of squares without cancellation.
Spectral = tuple[float, float, float, Vec, Vec, Vec]
REFINED = 8  # number of starts that Newton's method refines, best first
LONGEST = 0.7  # largest step on the sphere, rad (as a tangent)
CIRCLE = 24  # number of starts on the half circle of plane-line

# Half of the 26 neighbours of a cube's centre: any direction is within 23 degrees of one of them or its opposite.
_GRID = np.array([
    [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -1, 0], [1, 0, 1], [1, 0, -1], [0, 1, 1], [0, 1, -1],
    [1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1],
], float)  # fmt: skip


@inlined
def _place(b: Batch, i: int, inverse: bool) -> Spectral:
    """Return C of entry i, or C^-1."""
    X = b.axes[i]
    v1, v2, v3 = b.variance[i, 0], b.variance[i, 1], b.variance[i, 2]
    if inverse:
        v1, v2, v3 = 1.0 / v1, 1.0 / v2, 1.0 / v3
    return (v1, v2, v3, vec(X, 0), vec(X, 1), vec(X, 2))


@inlined
def _direction(b: Batch, i: int) -> Spectral:
    """Return M of entry i."""
    return (b.tilt[i, 0], b.tilt[i, 1], b.tilt[i, 2], vec(b.d, i), vec(b.a1, i), vec(b.a2, i))


@inlined
def weighted(a: Vec, M: Spectral, b: Vec) -> float:
    """Return a . M b."""
    return M[0] * dot(a, M[3]) * dot(b, M[3]) + M[1] * dot(a, M[4]) * dot(b, M[4]) + M[2] * dot(a, M[5]) * dot(b, M[5])


@inlined
def pulled(M: Spectral, a: Vec) -> Vec:
    """Return M a."""
    return blend(1.0, blend(M[0] * dot(a, M[3]), M[3], M[1] * dot(a, M[4]), M[4]), M[2] * dot(a, M[5]), M[5])


@inlined
def _line_value(e: Vec, A: Spectral, M: Spectral, v: Vec) -> float:
    """Return F of line-point: distance of the nearest point of the line plus the term of the direction.

    It subtracts before squaring, which avoids cancellation.
    """
    k = weighted(v, A, e) / weighted(v, A, v)
    y = blend(1.0, e, -k, v)
    return weighted(y, A, y) + weighted(v, M, v)


@inlined
def _plane_value(e: Vec, C: Spectral, M: Spectral, v: Vec) -> float:
    p = dot(v, e)
    return p * p / weighted(v, C, v) + weighted(v, M, v)


@inlined
def _value(line: bool, e: Vec, A: Spectral, M: Spectral, v: Vec) -> float:
    return _line_value(e, A, M, v) if line else _plane_value(e, A, M, v)


@inlined
def _step_on_sphere(h11: float, h12: float, h22: float, g1: float, g2: float) -> tuple[float, float]:
    """Return -|H|^-1 g for a 2x2 tangent Hessian H: Newton's step where F curves upwards, downhill where it does not.

    The step along each eigenvector is limited to LONGEST separately. A common shift of an indefinite H would be as
    large as its stiffest direction requires and would stop the motion along the other one, in the long valleys of line-
    point.
    """
    angle = 0.5 * math.atan2(2.0 * h12, h11 - h22)
    c, s = math.cos(angle), math.sin(angle)
    middle, radius = 0.5 * (h11 + h22), math.hypot(0.5 * (h11 - h22), h12)
    least = 1e-12 * (abs(middle) + radius) + 1e-300
    along = -(c * g1 + s * g2) / max(abs(middle + radius), least)
    across_it = -(c * g2 - s * g1) / max(abs(middle - radius), least)
    along, across_it = max(-LONGEST, min(LONGEST, along)), max(-LONGEST, min(LONGEST, across_it))
    return c * along - s * across_it, s * along + c * across_it


@inlined
def _newton(line: bool, e: Vec, A: Spectral, M: Spectral, v: Vec, steps: int) -> Vec:
    """Return a minimum of F near v.

    F is written for v of any length and has degree 0, so its tangent Hessian is the ordinary one.
    """
    h = pulled(A, e) if line else e
    s = -1.0 if line else 1.0
    best = _value(line, e, A, M, v)
    for _ in range(steps):
        b1 = across(v)
        b2 = cross(v, b1)
        q = weighted(v, A, v)
        tau = dot(h, v) / q
        c = blend(1.0, h, -2.0 * tau, pulled(A, v))
        pull = blend(2.0 * s * tau, blend(1.0, h, -tau, pulled(A, v)), 2.0, pulled(M, v))
        m = weighted(v, M, v)
        g1, g2 = dot(b1, pull), dot(b2, pull)
        c1, c2 = dot(b1, c), dot(b2, c)
        h11 = 2.0 * (s * (c1 * c1 / q - tau * tau * weighted(b1, A, b1)) + weighted(b1, M, b1) - m)
        h12 = 2.0 * (s * (c1 * c2 / q - tau * tau * weighted(b1, A, b2)) + weighted(b1, M, b2))
        h22 = 2.0 * (s * (c2 * c2 / q - tau * tau * weighted(b2, A, b2)) + weighted(b2, M, b2) - m)
        x1, x2 = _step_on_sphere(h11, h12, h22, g1, g2)
        size = math.hypot(x1, x2)
        scale, accepted = 1.0, False
        for _ in range(30):
            w = normalised(blend(1.0, v, scale, blend(x1, b1, x2, b2)))
            value = _value(line, e, A, M, w)
            if value < best:
                v, best, accepted = w, value, True
                break
            scale *= 0.4
            if scale * size < 1e-13:
                break
        if not accepted or size < 1e-13:
            break
    return v


@inlined
def _sphere(  # noqa: PLR0912 - one flat loop, for the compiler
    line: bool, e: Vec, A: Spectral, M: Spectral, d: Vec, a1: Vec, a2: Vec
) -> Vec:
    """Return where F is least on the whole sphere: starts are sorted by value, and the best ones refined."""
    starts, cost = np.empty((100, 3)), np.empty(100)
    n = 0
    for k in range(13):
        n = _start(starts, n, normalised(vec(_GRID, k)))
    for v in (d, a1, a2):
        n = _start(starts, n, v)
    size = math.sqrt(dot(e, e))
    if size > 1e-12:
        toward = blend(1.0 / size, e, 0.0, e)
        n1 = across(toward)
        n2 = cross(toward, n1)
        if line:
            # The minimum moves from d (direction known well) towards e (point known well) as |e| grows. Either term is
            # nearly constant along one great circle: the point's from e to the longest axis of C, the direction's from
            # d to a1.
            long = A[5]
            for k in range(1, 13):
                n = _arc(starts, n, d, toward, k / 12.0)
                n = _arc(starts, n, toward, long, (k - 0.5) / 12.0)
                n = _arc(starts, n, d, a1, (k - 0.5) / 12.0)
            n = _start(starts, n, normalised(cross(cross(toward, long), a2)))
        else:
            # The first term is 0 on the circle perpendicular to e; there the second is least at one of two directions.
            m11, m12, m22 = weighted(n1, M, n1), weighted(n1, M, n2), weighted(n2, M, n2)
            angle = 0.5 * math.atan2(2.0 * m12, m11 - m22)
            low = blend(-math.sin(angle), n1, math.cos(angle), n2)
            for k in range(1, 9):
                n = _arc(starts, n, d, low, k / 8.0)
            n = _start(starts, n, blend(math.cos(angle), n1, math.sin(angle), n2))
    for k in range(n):
        cost[k] = _value(line, e, A, M, vec(starts, k))
    best, least = d, np.inf
    for _ in range(REFINED):
        k = int(np.argmin(cost[:n]))
        if not np.isfinite(cost[k]):
            break
        start = vec(starts, k)
        v = _newton(line, e, A, M, start, 40)
        value = _value(line, e, A, M, v)
        if value < least:
            best, least = v, value
        for j in range(n):  # starts close to this minimum, or to its start, would lead here again
            if abs(dot(v, vec(starts, j))) > 0.995 or abs(dot(start, vec(starts, j))) > 0.98:
                cost[j] = np.inf
        cost[k] = np.inf
    return best


@inlined
def _start(starts: Array, n: int, v: Vec) -> int:
    starts[n, 0], starts[n, 1], starts[n, 2] = v[0], v[1], v[2]
    return n + 1


@inlined
def _arc(starts: Array, n: int, a: Vec, b: Vec, share: float) -> int:
    """Add two starts: between a and b, and between a and -b."""
    n = _start(starts, n, normalised(blend(1.0 - share, a, share, b)))
    return _start(starts, n, normalised(blend(1.0 - share, a, -share, b)))


@inlined
def _circle(e: Vec, C: Spectral, M: Spectral, u: Vec, d: Vec) -> Vec:
    """Return where F of plane-line is least, with v perpendicular to u, that is, over one angle.

    The stationary points are the roots of a polynomial of degree 6, so there are at most 6 in half a turn.
    """
    n1 = across(u)
    n2 = cross(u, n1)
    h1, h2 = dot(n1, e), dot(n2, e)
    c11, c12, c22 = weighted(n1, C, n1), weighted(n1, C, n2), weighted(n2, C, n2)
    m11, m12, m22 = weighted(n1, M, n1), weighted(n1, M, n2), weighted(n2, M, n2)
    # Numerators over t = tan(angle): F' = 2 (h1 + h2 t)(k0 + k1 t) / Q^2 + 2 (m12 + (m22 - m11) t - m12 t^2) / P^2
    k0, k1 = h2 * c11 - h1 * c12, h2 * c12 - h1 * c22
    n_0, n_1, n_2 = h1 * k0, h1 * k1 + h2 * k0, h2 * k1
    q0, q1, q2 = c11, 2.0 * c12, c22
    Q2 = (q0 * q0, 2.0 * q0 * q1, q1 * q1 + 2.0 * q0 * q2, 2.0 * q1 * q2, q2 * q2)
    P2 = (1.0, 0.0, 2.0, 0.0, 1.0)
    ratio, flat = (n_0, n_1, n_2), (m12, m22 - m11, -m12)
    poly = np.zeros(7, np.complex128)
    for i in range(3):
        for j in range(5):
            poly[6 - i - j] += ratio[i] * P2[j] + flat[i] * Q2[j]
    angles, n = np.empty(CIRCLE + 10), 0
    largest = np.max(np.abs(poly))
    if largest > 0.0:
        first = 0
        while first < 6 and abs(poly[first]) < 1e-14 * largest:
            first += 1
        if first < 6:
            for root in np.roots(poly[first:]):
                if abs(root.imag) < 1e-3 * (1.0 + abs(root.real)):
                    angles[n] = math.atan(root.real)
                    n += 1
    angles[n] = 0.5 * math.pi
    angles[n + 1] = math.atan2(dot(n2, d), dot(n1, d))
    angles[n + 2] = math.atan2(-h1, h2)
    n += 3
    for k in range(CIRCLE):
        angles[n] = math.pi * k / CIRCLE
        n += 1
    least, where = np.inf, 0.0
    for k in range(n):
        value = _plane_value(e, C, M, blend(math.cos(angles[k]), n1, math.sin(angles[k]), n2))
        if value < least:
            least, where = value, angles[k]
    where = _polish_angle(h1, h2, c11, c12, c22, m11, m12, m22, where)
    return blend(math.cos(where), n1, math.sin(where), n2)


@inlined
def _polish_angle(
    h1: float, h2: float, c11: float, c12: float, c22: float, m11: float, m12: float, m22: float, x: float
) -> float:
    """Refine the angle by Newton's method; keeps the best one where a step does not help."""
    best = np.inf
    kept = x
    for _ in range(25):
        c, s = math.cos(x), math.sin(x)
        p, dp = h1 * c + h2 * s, h2 * c - h1 * s
        q = c11 * c * c + 2 * c12 * c * s + c22 * s * s
        dq = 2 * ((c22 - c11) * c * s + c12 * (c * c - s * s))
        d2q = 2 * ((c22 - c11) * (c * c - s * s) - 4 * c12 * c * s)
        dm = 2 * ((m22 - m11) * c * s + m12 * (c * c - s * s))
        d2m = 2 * ((m22 - m11) * (c * c - s * s) - 4 * m12 * c * s)
        value = p * p / q + m11 * c * c + 2 * m12 * c * s + m22 * s * s
        if value < best:
            best, kept = value, x
        slope = 2 * p * dp / q - p * p * dq / q**2 + dm
        bend = 2 * (dp * dp - p * p) / q - 4 * p * dp * dq / q**2 - p * p * d2q / q**2 + 2 * p * p * dq**2 / q**3 + d2m
        if not bend > 0.0:
            break
        step = -slope / bend
        if abs(step) < 1e-15:
            break
        x += max(-0.2, min(0.2, step))
    return kept


@inlined
def _least_across(M: Spectral, u: Vec) -> Vec:
    """Return the unit v perpendicular to u with the least v.M v (class 6)."""
    n1 = across(u)
    n2 = cross(u, n1)
    m11, m12, m22 = weighted(n1, M, n1), weighted(n1, M, n2), weighted(n2, M, n2)
    angle = 0.5 * math.atan2(2.0 * m12, m11 - m22)  # of the larger one
    return blend(-math.sin(angle), n1, math.cos(angle), n2)


@inlined
def local(b: Batch, i: int, u: Vec, e: Vec, v: Vec, search: bool) -> tuple[float, Vec, Vec, Vec]:
    """Return f, df/dx, df/du and v* of entry i.

    With `search` v* is sought over the whole sphere, else by Newton's method from v (classes 4, 7 and 8).
    """
    c = b.cls[i]
    C, A, M = _place(b, i, False), _place(b, i, True), _direction(b, i)
    zero = (0.0, 0.0, 0.0)
    if c == 1:
        Ae = pulled(A, e)
        return dot(e, Ae), blend(2.0, Ae, 0.0, Ae), zero, v
    if c in (2, 5):
        s = -weighted(u, A, e) / weighted(u, A, u)
        y = blend(1.0, e, s, u)
        Ay = pulled(A, y)
        f, gx, gu = dot(y, Ay), blend(2.0, Ay, 0.0, Ay), blend(2.0 * s, Ay, 0.0, Ay)
        if c == 5:
            Mu = pulled(M, u)
            f, gu = f + dot(u, Mu), blend(1.0, gu, 2.0, Mu)
        return f, gx, gu, u
    if c in (3, 6, 9):
        Cu = pulled(C, u)
        ue = dot(u, e)
        tau = ue / dot(u, Cu)
        f, gx, gu = ue * tau, blend(2.0 * tau, u, 0.0, u), blend(2.0 * tau, e, -2.0 * tau * tau, Cu)
        if c == 9:
            Mu = pulled(M, u)
            return f + dot(u, Mu), gx, blend(1.0, gu, 2.0, Mu), u
        if c == 6:
            v = _least_across(M, u)
            return f + weighted(v, M, v), gx, blend(1.0, gu, -2.0 * weighted(u, M, v), v), v
        return f, gx, gu, u
    d, a1, a2 = vec(b.d, i), vec(b.a1, i), vec(b.a2, i)
    if c == 4:
        v = _sphere(True, e, A, M, d, a1, a2) if search else _newton(True, e, A, M, v, 6)
        y = blend(1.0, e, -weighted(v, A, e) / weighted(v, A, v), v)
        Ay = pulled(A, y)
        return _line_value(e, A, M, v), blend(2.0, Ay, 0.0, Ay), zero, v
    if c == 7:
        v = _sphere(False, e, C, M, d, a1, a2) if search else _newton(False, e, C, M, v, 6)
        tau = dot(v, e) / weighted(v, C, v)
        return _plane_value(e, C, M, v), blend(2.0 * tau, v, 0.0, v), zero, v
    if search:
        v = _circle(e, C, M, u, d)
    else:
        n1 = across(u)
        n2 = cross(u, n1)
        x = _polish_angle(
            dot(n1, e), dot(n2, e), weighted(n1, C, n1), weighted(n1, C, n2), weighted(n2, C, n2),
            weighted(n1, M, n1), weighted(n1, M, n2), weighted(n2, M, n2), math.atan2(dot(n2, v), dot(n1, v)),
        )  # fmt: skip
        v = blend(math.cos(x), n1, math.sin(x), n2)
    Cv = pulled(C, v)
    tau = dot(v, e) / dot(v, Cv)
    held = tau * dot(u, e) - tau * tau * dot(u, Cv) + weighted(u, M, v)
    return _plane_value(e, C, M, v), blend(2.0 * tau, v, 0.0, v), blend(-2.0 * held, v, 0.0, v), v


@compiled
def evaluate(b: Batch, R: Array, t: Array, search: bool, f: Array, grad: Array, direction: Array) -> None:
    """Compute the exact f (N,), gradients grad (N, 6) over (translation, rotation), and v* as `direction` (N, 3).

    With `search` the global minimum over v is sought; otherwise `direction` is where to start (and is updated).
    """
    for i in range(b.cls.size):
        if b.cls[i] == 0:
            continue
        q, u, mu = turned(R, vec(b.m, i)), turned(R, vec(b.w, i)), vec(b.mu, i)
        e = (q[0] + t[0] - mu[0], q[1] + t[1] - mu[1], q[2] + t[2] - mu[2])
        f[i], gx, gu, v = local(b, i, u, e, vec(direction, i), search)
        turn, tilt = cross(q, gx), cross(u, gu)
        for k in range(3):
            grad[i, k], grad[i, 3 + k], direction[i, k] = gx[k], turn[k] + tilt[k], v[k]
