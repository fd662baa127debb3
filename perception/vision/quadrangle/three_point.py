"""Compiled poses of three points: the first half of the paper's direct route (Section II-B), and refinement starts.

`three_point`, at the end, uses the functions above it. Conventions are those of `cost`.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.small_algebra import put2
from perception.vision.quadrangle.small_vectors import cross3, dot3, mix3, product3, unit3


@inlined
def real_cubic_root(b: float, c: float, d: float) -> float:
    """Return the largest real root of x^3 + b x^2 + c x + d (Viete and Cardano, then two Newton steps)."""
    p = c - b * b / 3.0
    q = 2.0 * b * b * b / 27.0 - b * c / 3.0 + d
    disc = q * q / 4.0 + p * p * p / 27.0
    if disc > 0.0:
        s = np.sqrt(disc)
        w = -q / 2.0 + s if q < 0.0 else -q / 2.0 - s
        w = np.cbrt(w)
        x = w - p / (3.0 * w) if w != 0.0 else 0.0
    else:
        r = np.sqrt(max(-p / 3.0, 0.0))
        cosine = -q / (2.0 * r * r * r) if r > 0.0 else 1.0
        x = 2.0 * r * np.cos(np.arccos(min(1.0, max(-1.0, cosine))) / 3.0)
    x -= b / 3.0
    for _ in range(2):
        slope = (3.0 * x + 2.0 * b) * x + c
        value = ((x + b) * x + c) * x + d
        if abs(value) < 1e-3 * (1.0 + abs(x)) * abs(slope):  # small steps only: the slope vanishes at a double root
            x -= value / slope
    return x


@inlined
def cofactors(M: Array) -> Array:
    """Return the adjugate of a symmetric 3x3 matrix."""
    B = np.empty((3, 3))
    B[0, 0] = M[1, 1] * M[2, 2] - M[1, 2] * M[1, 2]
    B[1, 1] = M[0, 0] * M[2, 2] - M[0, 2] * M[0, 2]
    B[2, 2] = M[0, 0] * M[1, 1] - M[0, 1] * M[0, 1]
    B[0, 1] = B[1, 0] = M[0, 2] * M[1, 2] - M[0, 1] * M[2, 2]
    B[0, 2] = B[2, 0] = M[0, 1] * M[1, 2] - M[0, 2] * M[1, 1]
    B[1, 2] = B[2, 1] = M[0, 1] * M[0, 2] - M[1, 2] * M[0, 0]
    return B


@inlined
def triad(p0: Array, p1: Array, p2: Array) -> Array:
    """Return the orthonormal frame (columns) of three points: along p1 - p0, in their plane, normal to it."""
    a = unit3(mix3(1.0, p1, -1.0, p0))
    n = unit3(cross3(a, mix3(1.0, p2, -1.0, p0)))
    b = cross3(n, a)
    F = np.empty((3, 3))
    for i in range(3):
        F[i, 0], F[i, 1], F[i, 2] = a[i], b[i], n[i]
    return F


@inlined
def refine_depths(s: Array, d2: Array, cosines: Array) -> None:
    """Refine the depths s (3,) by Newton steps on the three law-of-cosines equations; stops where they are singular."""
    for _ in range(3):
        e0 = s[1] * s[1] + s[2] * s[2] - 2.0 * s[1] * s[2] * cosines[0] - d2[0]
        e1 = s[0] * s[0] + s[2] * s[2] - 2.0 * s[0] * s[2] * cosines[1] - d2[1]
        e2 = s[0] * s[0] + s[1] * s[1] - 2.0 * s[0] * s[1] * cosines[2] - d2[2]
        # Jacobian rows / 2: (0, a, b), (c, 0, d), (e, f, 0)
        a = s[1] - s[2] * cosines[0]
        b = s[2] - s[1] * cosines[0]
        c = s[0] - s[2] * cosines[1]
        d = s[2] - s[0] * cosines[1]
        e = s[0] - s[1] * cosines[2]
        f = s[1] - s[0] * cosines[2]
        det = a * d * e + b * c * f
        if abs(det) < 1e-9 * d2[0] ** 1.5:
            return
        r0, r1, r2 = 0.5 * e0, 0.5 * e1, 0.5 * e2
        x0 = (-d * f * r0 + b * f * r1 + a * d * r2) / det
        x1 = (d * e * r0 - b * e * r1 + b * c * r2) / det
        x2 = (c * f * r0 + a * e * r1 - a * c * r2) / det
        s[0] -= x0
        s[1] -= x1
        s[2] -= x2


@inlined
def laws_of_cosines(P: Array, f: Array, d2: Array, cosines: Array) -> None:
    """Fill the squared sides d2 (3,) of the points P (3, 3) and the cosines (3,) between the unit rays f (3, 3).

    Entry k belongs to the side opposite to point k.
    """
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        side = mix3(1.0, P[i], -1.0, P[j])
        d2[k] = dot3(side, side)
        cosines[k] = dot3(f[i], f[j])


@inlined
def conics(d2: Array, cosines: Array) -> tuple[Array, Array]:
    """Return two conics in the depths s, s^T D s = 0, in which the constant terms of the laws of cosines cancel.

    D1 = d2[1] M0 - d2[0] M1 and D2 = d2[2] M0 - d2[0] M2, both divided by d2[0], with M_k the quadratic form of law k.
    """
    r1, r2 = d2[1] / d2[0], d2[2] / d2[0]
    D1, D2 = np.zeros((3, 3)), np.zeros((3, 3))
    D1[0, 0], D1[1, 1], D1[2, 2] = -1.0, r1, r1 - 1.0
    D2[0, 0], D2[1, 1], D2[2, 2] = -1.0, r2 - 1.0, r2
    D1[1, 2] = D1[2, 1] = -r1 * cosines[0]
    D2[1, 2] = D2[2, 1] = -r2 * cosines[0]
    D1[0, 2] = D1[2, 0] = cosines[1]
    D2[0, 1] = D2[1, 0] = cosines[2]
    return D1, D2


@inlined
def line_pair(D1: Array, D2: Array, lines: Array) -> bool:
    """Fill `lines` (2, 3) with the two lines of a degenerate conic w1 D1 + w2 D2; returns False if there is none."""
    C1, C2 = cofactors(D1), cofactors(D2)
    c3 = c2 = c1 = c0 = 0.0
    for i in range(3):
        c3 += D2[0, i] * C2[0, i]
        c0 += D1[0, i] * C1[0, i]
        for j in range(3):
            c2 += D1[i, j] * C2[i, j]
            c1 += D2[i, j] * C1[i, j]
    # det(D1 + g D2) = c3 g^3 + c2 g^2 + c1 g + c0; solved for 1/g if that is better conditioned.
    if abs(c3) >= abs(c0):
        if c3 == 0.0:
            return False
        w1, w2 = 1.0, real_cubic_root(c2 / c3, c1 / c3, c0 / c3)
    else:
        w1, w2 = real_cubic_root(c1 / c0, c2 / c0, c3 / c0), 1.0
    split(w1 * D1 + w2 * D2, lines)
    return True


@inlined
def split(D: Array, lines: Array) -> None:
    """Fill `lines` (2, 3) with the lines l, m of a degenerate conic D = l m^T + m l^T.

    -adj(D) = p p^T, with p their intersection, and D + [p]x has rank one.
    """
    B = cofactors(D)
    k = 0
    for i in range(1, 3):
        if abs(B[i, i]) > abs(B[k, k]):
            k = i
    beta = np.sqrt(max(-B[k, k], 0.0))
    p = np.zeros(3)
    if beta > 0.0:
        for i in range(3):
            p[i] = B[i, k] / beta
    E = D.copy()
    E[0, 1] += p[2]
    E[0, 2] -= p[1]
    E[1, 0] -= p[2]
    E[1, 2] += p[0]
    E[2, 0] += p[1]
    E[2, 1] -= p[0]
    bi, bj = 0, 0
    for i in range(3):
        for j in range(3):
            if abs(E[i, j]) > abs(E[bi, bj]):
                bi, bj = i, j
    for i in range(3):
        lines[0, i], lines[1, i] = E[bi, i], E[i, bj]


@inlined
def crossings(line: Array, D1: Array, S: Array) -> int:
    """Fill S (2, 3) with the ratios of depths at which a line meets the conic D1; returns their number.

    That is 2, or 0 if the line is zero.
    """
    k = 0
    for i in range(1, 3):
        if abs(line[i]) > abs(line[k]):
            k = i
    if line[k] == 0.0:
        return 0
    i, j = (k + 1) % 3, (k + 2) % 3
    # s_k = -(l_i s_i + l_j s_j) / l_k into D1: q2 x^2 + q1 x + q0 = 0 for x = s_i / s_j
    e, h = -line[i] / line[k], -line[j] / line[k]
    q2 = D1[i, i] + 2.0 * e * D1[i, k] + e * e * D1[k, k]
    q1 = 2.0 * (D1[i, j] + h * D1[i, k] + e * D1[j, k] + e * h * D1[k, k])
    q0 = D1[j, j] + 2.0 * h * D1[j, k] + h * h * D1[k, k]
    root = np.sqrt(max(q1 * q1 - 4.0 * q2 * q0, 0.0))
    w = -0.5 * (q1 + root) if q1 >= 0.0 else -0.5 * (q1 - root)
    S[0, i], S[0, j] = w, q2
    S[1, i], S[1, j] = q0, w
    for n in range(2):
        S[n, k] = e * S[n, i] + h * S[n, j]
    return 2


@inlined
def sized(s: Array, d2: Array, cosines: Array) -> bool:
    """Scale depths s (3,), known up to a factor, to the size of the sides and refine them.

    Returns False if a point is not in front of the camera.
    """
    sign = -1.0 if s[0] + s[1] + s[2] < 0.0 else 1.0
    for n in range(3):
        s[n] *= sign
    if not (s[0] > 0.0 and s[1] > 0.0 and s[2] > 0.0):
        return False
    total = 0.0
    for n in range(3):
        a, b = (n + 1) % 3, (n + 2) % 3
        total += s[a] * s[a] + s[b] * s[b] - 2.0 * s[a] * s[b] * cosines[n]
    if not total > 0.0:
        return False
    size = np.sqrt((d2[0] + d2[1] + d2[2]) / total)
    refined = np.empty(3)
    for n in range(3):
        s[n] *= size
        refined[n] = s[n]
    refine_depths(refined, d2, cosines)
    if refined[0] > 0.0 and refined[1] > 0.0 and refined[2] > 0.0 and np.isfinite(refined[0]):
        s[:] = refined
    return True


@inlined
def carried(P: Array, f: Array, s: Array, R: Array, t: Array) -> bool:
    """Fill R, t with the pose that moves the points P (3, 3) to depths s (3,) along the rays f.

    Returns False if that is not defined.
    """
    Q = np.empty((3, 3))
    for n in range(3):
        for a in range(3):
            Q[n, a] = s[n] * f[n, a]
    put2(R, product3(triad(Q[0], Q[1], Q[2]), triad(P[0], P[1], P[2]).T))
    if not np.isfinite(R[0, 0]):
        return False
    for a in range(3):
        total = 0.0
        for n in range(3):
            total += Q[n, a] - R[a, 0] * P[n, 0] - R[a, 1] * P[n, 1] - R[a, 2] * P[n, 2]
        t[a] = total / 3.0
    return True


@compiled
def three_point(P: Array, f: Array, Rs: Array, ts: Array) -> int:
    """Compute the poses that move three points (3, 3) onto three unit rays (3, 3); fills Rs, ts, returns their number.

    At most 4 are found. The depths s solve three law-of-cosines equations. Two combinations without a constant term are
    conics in s; the pencil of both contains a pair of lines (the root of a cubic), each of which meets a conic twice.
    Where noise makes an intersection complex its real part is kept, because the true pose is then near a double root.

    Source: Grunert 1841; the pencil of conics as in Finsterwalder, see Haralick et al., IJCV 13(3), 1994, Section 2.
    """
    d2, cosines = np.empty(3), np.empty(3)
    laws_of_cosines(P, f, d2, cosines)
    D1, D2 = conics(d2, cosines)
    lines, S = np.empty((2, 3)), np.empty((2, 3))
    if not line_pair(D1, D2, lines):
        return 0
    count = 0
    for which in range(2):
        for branch in range(crossings(lines[which], D1, S)):
            s = S[branch]
            if sized(s, d2, cosines) and carried(P, f, s, Rs[count], ts[count]):
                count += 1
    return count
