# ruff: noqa: PLR0912 - a compiled loop keeps one equation in one place
# mypy: disallow-untyped-defs=False
"""Compiled whole of the four-light pose: minima with covariance, and how much of the posterior each of them holds."""

from __future__ import annotations

import numpy as np

from perception.vision.quadrangle.arrays import inverse6, log_det6, move_origin, plane_of, prepare
from perception.vision.quadrangle.jit import jit, mix3, put1, put2, times3
from perception.vision.quadrangle.minima import all_minima
from perception.vision.quadrangle.posterior import MIRROR_TURN_COS, normal_spread, opposite, ring_mass, sight_frame

WORTHLESS = 60.0  # chi-square above the best at which a minimum has odds of 1 in 1e13


@jit
def solve(points, pixels, covariance, camera, near_sigmas2, Rs, ts, costs, Cs, masses):
    """Everything about one view: minima with covariance and posterior mass, lowest chi-square first.

    Args:
        near_sigmas2: the rings are summed when the line of sight is nearer to the best normal (sigmas squared).
        Rs (M, 3, 3), ts (M, 3), costs (M,), Cs (M, 6, 6), masses (M,): filled. Poses are of the object's own origin.
            When the other side of the line of sight has mass but no minimum, its middle is appended, covariance 0.

    Returns: number of poses, number of them that are minima, error code (0 fine, others in `pose`).
    """
    m, A, X = np.empty((4, 2)), np.empty((4, 3)), np.empty((4, 3))
    bad = prepare(pixels, covariance, camera, m, A)
    if bad >= 0:
        return bad, 0, 1
    c = np.zeros(3)
    for i in range(4):
        for j in range(3):
            c[j] += 0.25 * points[i, j]
    size = 0.0
    for i in range(4):
        for j in range(3):
            X[i, j] = points[i, j] - c[j]
            size += X[i, j] ** 2
    normal, spread = plane_of(X)
    if not spread > 1e-6 * size:
        return 0, 0, 2
    Ns = np.empty((Rs.shape[0], 6, 6))
    count = all_minima(X, m, A, normal, Rs[:-1], ts[:-1], costs[:-1], Ns[:-1])
    if count == 0:
        return 0, 0, 3
    while costs[count - 1] - costs[0] > WORTHLESS:  # among them runs that fled to infinity, where everything is flat
        count -= 1
    F = sight_frame(ts[0])
    best = times3(F, times3(Rs[0], normal))
    side = 1.0 if best[2] > 0.0 else -1.0
    best = mix3(side, best, 0.0, best)
    area0 = gate = 0.0
    over_there = 0.0
    there_too = np.zeros(Rs.shape[0], np.bool_)
    for k in range(count):
        if not inverse6(Ns[k], Cs[k]):
            return 0, 0, 4
        # Laplace: mass of a minimum over all six parameters, relative to the best one's.
        ratio = 1.0
        if k == 0:
            area0, gate = normal_spread(Rs[0], ts[0], Cs[0], normal)
        else:
            ratio = np.exp(-0.5 * (costs[k] - costs[0]) + 0.5 * (log_det6(Cs[k]) - log_det6(Cs[0])))
        masses[k] = ratio
        there_too[k] = k > 0 and opposite(
            mix3(side, times3(F, times3(Rs[k], normal)), 0.0, best), best, MIRROR_TURN_COS
        )
        if there_too[k]:
            over_there += ratio
    minima = count
    if gate < near_sigmas2:
        here, there, R, t, cost = ring_mass(Rs[0], ts[0], costs[0], X, m, A, normal)
        laplace = 2.0 * np.pi * area0
        ratio = there / max(here, laplace)
        if over_there > 0.0:  # share the better figure among the minima over there
            for k in range(1, count):
                if there_too[k]:
                    masses[k] *= max(1.0, ratio / over_there)
        elif ratio > 1e-4 and np.isfinite(cost):
            put2(Rs[count], R)
            put1(ts[count], t)
            costs[count], masses[count] = cost, ratio
            for i in range(6):
                for j in range(6):
                    Cs[count, i, j] = 0.0
            count += 1
    for k in range(count):
        lever = times3(Rs[k], c)
        move_origin(Cs[k], lever)
        put1(ts[k], mix3(1.0, ts[k], -1.0, lever))
    return count, minima, 0
