"""Compiled posterior over the object's normal: its value at a given normal, and the share of the mirror pose.

Conventions are those of `cost`.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.least_squares import solve_damped
from hal.small_algebra import put1
from perception.vision.quadrangle.cost import LEAST_PIVOT, chi_square, expand, rotation_of, turn_onto
from perception.vision.quadrangle.small_vectors import back3, cross3, dot3, mix3, product3, times3, unit3

MIRROR_TURN_COS = 0.99619469809  # 5 degrees: poses whose normals are nearer than this count as one
RING_STEP_RAD = 0.10471975512  # 6 degrees; 2.5 degrees gave the same mass (correlation 0.999 over 8000 problems)
RING_COUNT = 12  # number of azimuths; 24 gave the same mass
RING_END_RAD = 1.308996939  # 75 degrees


@compiled
def profile(
    R: Array, t: Array, direction: Array, X: Array, m: Array, A: Array, normal: Array
) -> tuple[Array, Array, float, float]:
    """Minimise chi-square over position and roll while the object's normal points along `direction` (camera axes).

    Returns: R, t, chi-square, log determinant of the 4x4 information of position and roll.
    """
    n = times3(R, normal)
    if dot3(n, direction) > -0.99:
        R = product3(turn_onto(n, direction), R)
    g, N = np.empty(6), np.empty((6, 6))
    x4, N4, L4 = np.empty(4), np.empty((4, 4)), np.zeros((4, 4))
    cost = expand(R, t, X, m, A, g, N)
    for _ in range(12):
        if not np.isfinite(cost):
            break
        _contract(N, direction, N4)
        for i in range(3):
            x4[i] = -g[i]
        x4[3] = -g[3] * direction[0] - g[4] * direction[1] - g[5] * direction[2]
        if solve_damped(N4, N4, 1e-6, 0.0, LEAST_PIVOT, x4, L4, 4) < 0.0:
            break
        step = 1.0
        improved = False
        for _try in range(4):
            R_new = product3(rotation_of(mix3(step * x4[3], direction, 0.0, direction)), R)
            t_new = mix3(1.0, t, step, x4)
            new = chi_square(R_new, t_new, X, m, A)
            if new <= cost:
                improved = True
                break
            step *= 0.25
        if not improved:
            break
        fall = cost - new
        R, t = R_new, t_new
        cost = new
        if fall < 1e-3:
            break
        cost = expand(R, t, X, m, A, g, N)
    log_det = 0.0
    for i in range(4):
        log_det += 2.0 * np.log(L4[i, i])
    return R, t, cost, log_det


@inlined
def _contract(M: Array, direction: Array, out: Array) -> None:
    """Fill `out` with the 4x4 block of M over position and rotation about `direction`."""
    for i in range(3):
        for j in range(3):
            out[i, j] = M[i, j]
        s = 0.0
        for k in range(3):
            s += M[i, 3 + k] * direction[k]
        out[i, 3] = out[3, i] = s
    s = 0.0
    for i in range(3):
        for j in range(3):
            s += direction[i] * M[3 + i, 3 + j] * direction[j]
    out[3, 3] = s


@inlined
def opposite(normal_camera: Array, best: Array, far: float) -> bool:
    """Return whether a normal is nearer to the mirror of the best one than to the best one itself.

    It must also be distinct from the best one: `far` is the cosine of the least angle. Both face the camera (n . k >
    0), in axes of which the third is the line of sight k. The mirror of n is 2 (n.k) k - n.
    """
    lateral = normal_camera[0] * best[0] + normal_camera[1] * best[1]
    return bool(lateral < 1e-9 and lateral + normal_camera[2] * best[2] < far)


@inlined
def sight_frame(t: Array) -> Array:
    """Return an orthonormal frame as rows: two axes perpendicular to the line of sight to t, then the line of sight."""
    k = unit3(t)
    a = np.empty(3)
    if abs(k[1]) < 0.9:  # k x (0, 1, 0), or k x (1, 0, 0)
        a[0], a[1], a[2] = -k[2], 0.0, k[0]
    else:
        a[0], a[1], a[2] = 0.0, k[2], -k[1]
    a = unit3(a)
    F = np.empty((3, 3))
    put1(F[0], a)
    put1(F[1], cross3(k, a))
    put1(F[2], k)
    return F


@compiled
def ring_mass(
    R: Array, t: Array, cost: float, X: Array, m: Array, A: Array, normal: Array
) -> tuple[float, float, Array, Array, float]:
    """Sum the posterior mass of the normals on this and on the other side of the line of sight.

    The posterior density of the normal is exp(-chi2 / 2) det(information of position and roll)^(-1/2), with the same
    prior for all directions in space. It is summed over rings of tilt about the line of sight to the centroid.

    Returns: mass on this side and on the other side (sr, relative to the density at the best pose), and R, t,
    chi-square of the pose in the middle of the mass on the other side.
    """
    F = sight_frame(t)
    best = times3(F, times3(R, normal))
    side = 1.0 if best[2] > 0.0 else -1.0
    best = mix3(side, best, 0.0, best)
    _, _, _, reference = profile(R, t, back3(F, best, side), X, m, A, normal)
    tilt_best = np.arccos(min(1.0, best[2]))
    azimuth_best = np.arctan2(best[1], best[0])
    here = there = 0.0
    g = np.empty(3)
    middle = np.zeros(3)
    for a in range(RING_COUNT):
        azimuth = azimuth_best + 2.0 * np.pi * a / RING_COUNT
        Rw, tw = R, t
        tilt = 0.5 * RING_STEP_RAD
        while tilt < RING_END_RAD:
            g[0], g[1], g[2] = np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)
            Rn, tn, c, log_det = profile(Rw, tw, back3(F, g, side), X, m, A, normal)
            if np.isfinite(c):
                Rw, tw = Rn, tn
                w = np.exp(-0.5 * (c - cost) - 0.5 * (log_det - reference)) * np.sin(tilt)
                if opposite(g, best, MIRROR_TURN_COS):
                    there += w
                    for i in range(3):
                        middle[i] += w * g[i]
                else:
                    here += w
            if c - cost > 40.0 and tilt > 1.2 * tilt_best + RING_STEP_RAD:
                break
            tilt += RING_STEP_RAD
    cell = RING_STEP_RAD * 2.0 * np.pi / RING_COUNT
    if not dot3(middle, middle) > 0.0:
        return here * cell, 0.0, R, t, np.inf
    R, t, cost, _ = profile(R, t, back3(F, unit3(middle), side), X, m, A, normal)
    return here * cell, there * cell, R, t, cost
