# ruff: noqa: PLR0912 - a compiled loop keeps one equation in one place
"""Compiled search for every local minimum of the reprojection error of four points. Conventions are those of `cost`."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.small_algebra import put1, put2
from perception.vision.quadrangle.cost import chi_square, find_minimum, turn_onto
from perception.vision.quadrangle.small_vectors import cross3, dot3, mix3, product3, times3, unit3
from perception.vision.quadrangle.three_point import three_point

MOST_MINIMA = 6


@inlined
def rotation_distance(A: Array, B: Array) -> float:
    """Return 2 (1 - cos) of the angle between two rotations: 3 - trace(A^T B)."""
    s = 3.0
    for i in range(3):
        for j in range(3):
            s -= A[i, j] * B[i, j]
    return s


@compiled
def ordered_seeds(X: Array, f: Array, m: Array, A: Array, Rs: Array, ts: Array, costs: Array) -> int:
    """Compute the poses of the four triples of points, with the chi-square over all four points; returns their number.

    f: (4, 3) unit rays. Fills Rs (16, 3, 3), ts (16, 3), costs (16,). Triples that are nearly on a line are left out.
    """
    P, F = np.empty((3, 3)), np.empty((3, 3))
    count = 0
    for left_out in range(4):
        n = 0
        for i in range(4):
            if i != left_out:
                put1(P[n], X[i])
                put1(F[n], f[i])
                n += 1
        side1, side2 = mix3(1.0, P[1], -1.0, P[0]), mix3(1.0, P[2], -1.0, P[0])
        area = cross3(side1, side2)
        size = dot3(side1, side1) + dot3(side2, side2)
        if dot3(area, area) < 1e-8 * size * size:
            continue
        found = three_point(P, F, Rs[count:], ts[count:])
        for k in range(count, count + found):
            costs[k] = chi_square(Rs[k], ts[k], X, m, A)
        count += found
    return count


@inlined
def mirrored(R: Array, t: Array, normal: Array) -> Array:
    """Return R with the object's normal reflected about the line of sight through the centroid.

    `normal` is in the object's axes. R is returned unchanged if the normal is perpendicular to the line of sight.
    """
    n = times3(R, normal)
    k = unit3(t)
    reflected = mix3(2.0 * dot3(n, k), k, -1.0, n)
    if dot3(n, reflected) < -0.999999:
        return R
    return product3(turn_onto(n, reflected), R)


@compiled
def all_minima(X: Array, m: Array, A: Array, normal: Array) -> tuple[Array, Array, Array, Array]:
    """Return the distinct local minima of chi-square: R (M,3,3), t (M,3), chi-square (M,), N (M,6,6).

    The starts are the best three-point pose, the mirror of its minimum, then every three-point pose that is far from
    earlier starts and minima. N are their Gauss-Newton matrices.
    """
    f = np.empty((4, 3))
    for i in range(4):
        norm = np.sqrt(m[i, 0] ** 2 + m[i, 1] ** 2 + 1.0)
        f[i, 0], f[i, 1], f[i, 2] = m[i, 0] / norm, m[i, 1] / norm, 1.0 / norm
    R_seed, t_seed, c_seed = np.empty((16, 3, 3)), np.empty((16, 3)), np.empty(16)
    available = ordered_seeds(X, f, m, A, R_seed, t_seed, c_seed)
    Rs, ts = np.empty((MOST_MINIMA, 3, 3)), np.empty((MOST_MINIMA, 3))
    costs, Ns = np.empty(MOST_MINIMA), np.empty((MOST_MINIMA, 6, 6))
    started = np.empty((8, 3, 3))
    runs = 0
    count = 0
    use_mirror = False
    while runs < 8:
        if use_mirror:
            R0, t0 = mirrored(Rs[0], ts[0], normal), mix3(1.0, ts[0], 0.0, ts[0])
        else:
            seed = -1
            for k in range(available):
                if np.isfinite(c_seed[k]) and (seed < 0 or c_seed[k] < c_seed[seed]):
                    seed = k
            if seed < 0:
                break
            c_seed[seed] = np.inf
            R0, t0 = R_seed[seed], t_seed[seed]
            near = False
            for k in range(runs):
                near = near or rotation_distance(R0, started[k]) < 0.05  # 13 deg
            for k in range(count):
                near = near or rotation_distance(R0, Rs[k]) < 0.05
            if near:
                continue
        put2(started[runs], R0)
        runs += 1
        R, t, cost, N = find_minimum(R0, t0, X, m, A)
        use_mirror = not use_mirror and runs == 1
        if not np.isfinite(cost):
            continue
        known = False
        for k in range(count):
            known = known or (rotation_distance(R, Rs[k]) < 1e-5 and abs(cost - costs[k]) < 1e-3 * (1.0 + cost))
        if known or count == MOST_MINIMA:
            continue
        put2(Rs[count], R)
        put1(ts[count], t)
        put2(Ns[count], N)
        costs[count] = cost
        count += 1
    return Rs[:count], ts[:count], costs[:count], Ns[:count]
