"""Pose of four points in compiled code: all minima with covariance, and the posterior mass of each."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.small_algebra import put1, put2
from perception.vision.quadrangle.arrays import inverse6, log_det6, move_origin, plane_of, prepare
from perception.vision.quadrangle.minima import all_minima
from perception.vision.quadrangle.posterior import MIRROR_TURN_COS, normal_spread, opposite, ring_mass, sight_frame
from perception.vision.quadrangle.small_vectors import mix3, times3

WORTHLESS = 60.0  # a minimum with a chi-square so far above the best has odds of 1 in 1e13


@compiled
def solve(
    points: Array,
    pixels: Array,
    covariance: Array,
    camera: Array,
    near_sigmas2: float,
    Rs: Array,
    ts: Array,
    costs: Array,
    Cs: Array,
    masses: Array,
) -> tuple[int, int, int]:
    """Compute everything about one view: minima with covariance and posterior mass, lowest chi-square first.

    Args:
        points, pixels, covariance: (4, 3) in m, (4, 2) and (4, 2, 2) in px.
        camera: (9,) fx, fy, cx, cy, k1, k2, p1, p2, k3.
        near_sigmas2: the posterior is summed over rings (`ring_mass`) if the squared distance of the best normal from
        the
            line of sight, in standard deviations, is smaller.
        Rs (M, 3, 3), ts (M, 3), costs (M,), Cs (M, 6, 6), masses (M,): outputs. Poses are those of the object's own
        origin.
            If the other side of the line of sight has mass but no minimum, the middle of that mass is appended as a
            pose with covariance 0.

    Returns: number of poses, number of them that are minima, error code (0 fine, others in `pose`).
    """
    m, A, X = np.empty((4, 2)), np.empty((4, 3)), np.empty((4, 3))
    bad = prepare(pixels, covariance, camera, m, A)
    if bad >= 0:
        return bad, 0, 1
    c, size = centred(points, X)
    normal, spread = plane_of(X)
    if not spread > 1e-6 * size:
        return 0, 0, 2
    Ns = np.empty((Rs.shape[0], 6, 6))
    count = all_minima(X, m, A, normal, Rs[:-1], ts[:-1], costs[:-1], Ns[:-1])
    if count == 0:
        return 0, 0, 3
    while costs[count - 1] - costs[0] > WORTHLESS:  # such as runs that diverged to infinity, where the cost is flat
        count -= 1
    if not weigh(Ns, costs, Cs, masses, count):
        return 0, 0, 4
    minima = count
    area, gate = normal_spread(Rs[0], ts[0], Cs[0], normal)
    if gate < near_sigmas2:
        here, there, R, t, cost = ring_mass(Rs[0], ts[0], costs[0], X, m, A, normal)
        ratio = there / max(here, 2.0 * np.pi * area)
        if not share(ratio, Rs, ts[0], normal, masses, count) and ratio > 1e-4 and np.isfinite(cost):
            put2(Rs[count], R)
            put1(ts[count], t)
            costs[count], masses[count] = cost, ratio
            Cs[count, :, :] = 0.0
            count += 1
    for k in range(count):
        lever = times3(Rs[k], c)
        move_origin(Cs[k], lever)
        put1(ts[k], mix3(1.0, ts[k], -1.0, lever))
    return count, minima, 0


@inlined
def centred(points: Array, X: Array) -> tuple[Array, float]:
    """Fill X (4, 3) with the points relative to their centroid; returns centroid and sum of squared distances."""
    c = np.zeros(3)
    for i in range(4):
        for j in range(3):
            c[j] += 0.25 * points[i, j]
    size = 0.0
    for i in range(4):
        for j in range(3):
            X[i, j] = points[i, j] - c[j]
            size += X[i, j] ** 2
    return c, size


@inlined
def weigh(Ns: Array, costs: Array, Cs: Array, masses: Array, count: int) -> bool:
    """Fill the covariances Cs and the posterior masses by Laplace's approximation, relative to the best minimum.

    Ns: (M, 6, 6) Gauss-Newton matrices. Returns whether every one is positive definite.
    """
    for k in range(count):
        if not inverse6(Ns[k], Cs[k]):
            return False
        masses[k] = 1.0
        if k > 0:
            masses[k] = np.exp(-0.5 * (costs[k] - costs[0]) + 0.5 * (log_det6(Cs[k]) - log_det6(Cs[0])))
    return True


@inlined
def share(ratio: float, Rs: Array, t: Array, normal: Array, masses: Array, count: int) -> bool:
    """Scale the masses of the minima on the other side of the line of sight so that their sum is at least `ratio`.

    Returns: whether there is such a minimum with mass.
    """
    F = sight_frame(t)
    best = times3(F, times3(Rs[0], normal))
    side = 1.0 if best[2] > 0.0 else -1.0
    best = mix3(side, best, 0.0, best)
    is_there = np.zeros(count, np.bool_)
    mass = 0.0
    for k in range(1, count):
        other = mix3(side, times3(F, times3(Rs[k], normal)), 0.0, best)
        is_there[k] = opposite(other, best, MIRROR_TURN_COS)
        if is_there[k]:
            mass += masses[k]
    if not mass > 0.0:
        return False
    for k in range(1, count):
        if is_there[k]:
            masses[k] *= max(1.0, ratio / mass)
    return True
