"""Compiled search for the taught quadrangle among blobs: every ordered triple, its poses, and the fourth light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jit import compiled, inlined
from perception.vision.quadrangle.three_point import three_point

SIZE_SPREAD = 0.2  # standard deviation of the log diameter among equal lamps
CONTRAST_SPREAD = 0.6  # of the log contrast, because of uneven light, ageing and viewing angle
RADIUS_SPREAD = 0.5  # of the log radius about the taught or usual one
MISSING_INSIDE = 2.0  # score penalty for a light inside the image that is not visible
MISSING_OUTSIDE = 1.0  # the same for one outside the image
OUTSIDE_PER_WIDTH = 20.0  # additional penalty per image width by which it is outside
ROUNDER = 0.2  # a disc tilted by t has aspect cos t; blur increases the aspect by about this
UNCHECKED = 3.0  # penalty for a hypothesis without a fourth light, because three points always fit
# Squared, in standard deviations; a blob farther from the predicted place is not the fourth light.
FARTHEST_MISS2 = 16.0
UNLIKE = 1.2  # log ratio of diameters above which two blobs cannot be equal lamps at any tilt
SHOWN_WIDTH = 1.7725  # a lamp of radius r shows sqrt(area) = sqrt(pi) r f / z


@inlined
def spread(values: Array, n: int) -> float:
    """Return the sum of squared deviations of the first n values from their mean."""
    mean = 0.0
    for i in range(n):
        mean += values[i] / n
    total = 0.0
    for i in range(n):
        total += (values[i] - mean) ** 2
    return total


@inlined
def rays_of(centres: Array, camera: Array) -> Array:
    """Return unit rays (n, 3) through ideal pixels."""
    rays = np.empty((centres.shape[0], 3))
    for i in range(centres.shape[0]):
        u, v = (centres[i, 0] - camera[2]) / camera[0], (centres[i, 1] - camera[3]) / camera[1]
        norm = np.sqrt(u * u + v * v + 1.0)
        rays[i, 0], rays[i, 1], rays[i, 2] = u / norm, v / norm, 1.0 / norm
    return rays


@inlined
def turns(centres: Array, i: int, j: int, k: int) -> float:
    """Return twice the signed area of the triangle of three blobs; its sign is that of their orientation."""
    ij, ik = centres[j] - centres[i], centres[k] - centres[i]
    return float(ij[0] * ik[1] - ij[1] * ik[0])


@compiled
def pose_score(R: Array, upright: Array, roundness: float, prior: Array) -> float:
    """Return the score penalty of a rotation for tilt and roll, and for lamps that look rounder than it predicts."""
    Q = R @ upright.T
    tilt = np.arccos(min(1.0, max(-1.0, Q[2, 2])))
    roll = np.arctan2(Q[1, 0] - Q[0, 1], Q[0, 0] + Q[1, 1])
    flat = max(roundness - Q[2, 2], 0.0)
    return float(-0.5 * ((tilt / prior[0]) ** 2 + (roll / prior[1]) ** 2 + (flat / ROUNDER) ** 2))


@inlined
def alike(sizes: Array, contrasts: Array, n: int) -> float:
    """Return the score penalty for differences in size and contrast among the first n lamps."""
    return -0.5 * (spread(sizes, n) / SIZE_SPREAD**2 + spread(contrasts, n) / CONTRAST_SPREAD**2)


@inlined
def unseen(u: float, v: float, frame: Array) -> float:
    """Return the score penalty for a fourth light that is not visible at its predicted place."""
    beyond = max(-u, u - frame[0], 0.0) + max(-v, v - frame[1], 0.0)
    missing = MISSING_OUTSIDE + OUTSIDE_PER_WIDTH * beyond / frame[0] if beyond > 0.0 else MISSING_INSIDE
    return -UNCHECKED - missing


@compiled
def choose_fourth(
    centres: Array,
    traits: Array,
    q: Array,
    camera: Array,
    frame: Array,
    prior: Array,
    omit: int,
    order: NDArray[np.int64],
    sizes: Array,
    contrasts: Array,
) -> float:
    """Find the best blob for the light `omit` and write it into `order` (-1 if none is better than none).

    Returns the score.

    Args:
        q: (3,) predicted position of the light, camera frame.
        sizes, contrasts: (4,) logarithms for the other three lamps; the last entry is used here.
    """
    u, v = camera[0] * q[0] / q[2] + camera[2], camera[1] * q[1] / q[2] + camera[3]
    score = unseen(u, v, frame) + alike(sizes, contrasts, 3)
    order[omit] = -1
    for c in range(centres.shape[0]):
        miss2 = ((centres[c, 0] - u) ** 2 + (centres[c, 1] - v) ** 2) / prior[2] ** 2
        if miss2 > FARTHEST_MISS2 or c in (order[0], order[1], order[2], order[3]):
            continue
        sizes[3] = traits[1, c] + np.log(q[2])
        contrasts[3] = traits[2, c]
        mine = traits[0, c] - 0.5 * miss2 + alike(sizes, contrasts, 4)
        if mine > score:
            score, order[omit] = mine, c
    return score


@compiled
def search(
    centres: Array,
    traits: Array,
    X: Array,
    upright: Array,
    camera: Array,
    frame: Array,
    prior: Array,
    omit: int,
    best: Array,
    chosen: NDArray[np.int64],
) -> None:
    """Find the best hypotheses and insert them, highest score first, into best (M,) and chosen (M, 4).

    -1 = not visible.

    Args:
        centres: (n, 2) ideal pixels.
        traits: (4, n) reward, log diameter, log contrast and aspect of the candidates.
        X: (4, 3) lights in the panel's frame.
        upright: (3, 3) expected camera_from_panel rotation.
        camera: fx, fy, cx, cy.
        frame: width, height.
        prior: standard deviations of tilt (rad), roll (rad) and of the fourth light's place (px); lamp radius (m).
        omit: the light that is predicted from the other three.

    The score is the sum of the rewards minus half the squared deviations, in standard deviations, of sizes, contrasts,
    tilt, roll, roundness and the fourth light's place.
    """
    n = centres.shape[0]
    reward, log_size = traits[0], traits[1]
    most = max(reward.max(), 0.0) if n > 0 else 0.0
    names = np.array([(omit + 1) % 4, (omit + 2) % 4, (omit + 3) % 4])
    names.sort()
    P, f = np.empty((3, 3)), np.empty((3, 3))
    for a in range(3):
        P[a] = X[names[a]]
    rays = rays_of(centres, camera)
    e1, e2 = upright @ (P[1] - P[0]), upright @ (P[2] - P[0])
    turn = e1[0] * e2[1] - e1[1] * e2[0]
    order = np.empty(4, np.int64)
    for i in range(n):
        for j in range(n):
            if j == i or abs(log_size[i] - log_size[j]) > UNLIKE:
                continue
            for k in range(n):
                if k in (i, j) or abs(log_size[i] - log_size[k]) > UNLIKE:
                    continue
                if turns(centres, i, j, k) * turn <= 0.0:
                    continue
                base = reward[i] + reward[j] + reward[k]
                if base + most <= best[best.shape[0] - 1]:
                    continue  # all other terms are negative
                f[0], f[1], f[2] = rays[i], rays[j], rays[k]
                order[names[0]], order[names[1]], order[names[2]] = i, j, k
                try_triple(
                    P, f, names, base, centres, traits, X, upright, camera, frame, prior, omit, order, best, chosen
                )


@compiled
def try_triple(
    P: Array,
    f: Array,
    names: NDArray[np.int64],
    base: float,
    centres: Array,
    traits: Array,
    X: Array,
    upright: Array,
    camera: Array,
    frame: Array,
    prior: Array,
    omit: int,
    order: NDArray[np.int64],
    best: Array,
    chosen: NDArray[np.int64],
) -> None:
    """Score every pose that three blobs allow, each with the best fourth blob.

    P: (3, 3) the lights `names` in the panel's frame; f: (3, 3) rays to their blobs; base: sum of their rewards.
    """
    Rs, ts = np.empty((4, 3, 3)), np.empty((4, 3))
    sizes, contrasts = np.empty(4), np.empty(4)
    usual = np.log(SHOWN_WIDTH * prior[3] * camera[0])
    roundness = (traits[3, order[names[0]]] + traits[3, order[names[1]]] + traits[3, order[names[2]]]) / 3.0
    for s in range(three_point(P, f, Rs, ts)):
        q = Rs[s] @ X[omit] + ts[s]
        if q[2] <= 0.0:
            continue
        for a in range(3):
            c = order[names[a]]
            z = Rs[s, 2, 0] * P[a, 0] + Rs[s, 2, 1] * P[a, 1] + Rs[s, 2, 2] * P[a, 2] + ts[s, 2]
            sizes[a] = traits[1, c] + np.log(max(z, 1e-9))
            contrasts[a] = traits[2, c]
        strange = ((sizes[0] + sizes[1] + sizes[2]) / 3.0 - usual) / RADIUS_SPREAD
        score = base + pose_score(Rs[s], upright, roundness, prior) - 0.5 * strange**2
        score += choose_fourth(centres, traits, q, camera, frame, prior, omit, order, sizes, contrasts)
        insert(score, order, best, chosen)


@compiled
def insert(score: float, order: NDArray[np.int64], best: Array, chosen: NDArray[np.int64]) -> None:
    """Insert a hypothesis into the list of the best ones, which contains each choice of blobs once."""
    m = best.shape[0]
    if score <= best[m - 1]:
        return
    at = m - 1
    for r in range(m):
        same = True
        for a in range(4):
            same = same and chosen[r, a] == order[a]
        if same:
            if best[r] >= score:
                return
            at = r
            break
    while at > 0 and best[at - 1] < score:
        best[at] = best[at - 1]
        chosen[at] = chosen[at - 1]
        at -= 1
    best[at] = score
    for a in range(4):
        chosen[at, a] = order[a]
