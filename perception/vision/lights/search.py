# ruff: noqa: PLR0912, PLR0915 - a compiled loop keeps one sum in one place
# mypy: disallow-untyped-defs=False
"""Compiled search for the taught quadrangle among blobs: every ordered triple, its poses, the fourth light."""

from __future__ import annotations

import numpy as np

from perception.vision.quadrangle.jit import jit
from perception.vision.quadrangle.three_point import three_point

SIZE_SPREAD = 0.2  # standard deviation of log diameter among equal lamps
CONTRAST_SPREAD = 0.6  # of log contrast: uneven light, ageing, angle
RADIUS_SPREAD = 0.5  # of the log of the lamps' radius about the taught or usual one
MISSING_INSIDE = 2.0  # what a light inside the image costs that is not seen
MISSING_OUTSIDE = 1.0  # ... and outside, plus the next figure for every image width that it is outside
OUTSIDE_PER_WIDTH = 20.0
ROUNDER = 0.2  # a disc tilted by t has aspect cos t; blur makes it rounder by this much
UNCHECKED = 3.0  # three points fit always: what a hypothesis without a fourth light to check it costs


@jit
def spread(values, n):
    """Sum of squared deviations of the first n values from their mean."""
    mean = 0.0
    for i in range(n):
        mean += values[i] / n
    total = 0.0
    for i in range(n):
        total += (values[i] - mean) ** 2
    return total


@jit
def search(centres, traits, X, upright, camera, frame, prior, omit, best, chosen):
    """The best hypotheses, highest score first, into best (M,) and chosen (M, 4) (-1 = not seen).

    Args:
        centres: (n, 2) ideal pixels. traits: (4, n) reward, log diameter, log contrast and aspect of the candidates.
        X: (4, 3) lights in the panel's frame. upright: (3, 3) expected camera_from_panel rotation.
        camera: fx, fy, cx, cy. frame: width, height.
        prior: standard deviations of tilt (rad), roll (rad) and of the fourth light's place (px); lamp radius (m).
        omit: the light that is predicted from the other three.

    Score = sum of rewards - sum of squares / 2 of size and contrast spread, tilt, roll, roundness and the fourth
    light's miss.
    """
    n = centres.shape[0]
    reward, log_size, log_contrast, aspect = traits[0], traits[1], traits[2], traits[3]
    most = 0.0
    for i in range(n):
        most = max(most, reward[i])
    names = np.empty(3, np.int64)
    at = 0
    for o in range(4):
        if o != omit:
            names[at] = o
            at += 1
    P, f = np.empty((3, 3)), np.empty((3, 3))
    for a in range(3):
        P[a] = X[names[a]]
    rays = np.empty((n, 3))
    for i in range(n):
        u, v = (centres[i, 0] - camera[2]) / camera[0], (centres[i, 1] - camera[3]) / camera[1]
        norm = np.sqrt(u * u + v * v + 1.0)
        rays[i, 0], rays[i, 1], rays[i, 2] = u / norm, v / norm, 1.0 / norm
    e1, e2 = upright @ (P[1] - P[0]), upright @ (P[2] - P[0])
    turn = e1[0] * e2[1] - e1[1] * e2[0]
    Rs, ts = np.empty((4, 3, 3)), np.empty((4, 3))
    sizes, contrasts = np.empty(4), np.empty(4)
    order = np.empty(4, np.int64)
    for i in range(n):
        for j in range(n):
            if j == i or abs(log_size[i] - log_size[j]) > 1.2:
                continue
            for k in range(n):
                if k in (i, j) or abs(log_size[i] - log_size[k]) > 1.2:
                    continue
                cross = (centres[j, 0] - centres[i, 0]) * (centres[k, 1] - centres[i, 1]) - (
                    centres[j, 1] - centres[i, 1]
                ) * (centres[k, 0] - centres[i, 0])
                if cross * turn <= 0.0:
                    continue
                base = reward[i] + reward[j] + reward[k]
                if base + most <= best[best.shape[0] - 1]:
                    continue  # everything else only costs
                roundness = (aspect[i] + aspect[j] + aspect[k]) / 3.0
                f[0], f[1], f[2] = rays[i], rays[j], rays[k]
                found = three_point(P, f, Rs, ts)
                for s in range(found):
                    Q = Rs[s] @ upright.T
                    tilt = np.arccos(min(1.0, max(-1.0, Q[2, 2])))
                    roll = np.arctan2(Q[1, 0] - Q[0, 1], Q[0, 0] + Q[1, 1])
                    score = base - 0.5 * (tilt / prior[0]) ** 2 - 0.5 * (roll / prior[1]) ** 2
                    score -= 0.5 * (max(roundness - Q[2, 2], 0.0) / ROUNDER) ** 2
                    order[names[0]], order[names[1]], order[names[2]], order[omit] = i, j, k, -1
                    for a in range(3):
                        c = order[names[a]]
                        z = Rs[s, 2, 0] * P[a, 0] + Rs[s, 2, 1] * P[a, 1] + Rs[s, 2, 2] * P[a, 2] + ts[s, 2]
                        sizes[a] = log_size[c] + np.log(max(z, 1e-9))
                        contrasts[a] = log_contrast[c]
                    q = Rs[s] @ X[omit] + ts[s]
                    if q[2] <= 0.0:
                        continue
                    u, v = camera[0] * q[0] / q[2] + camera[2], camera[1] * q[1] / q[2] + camera[3]
                    beyond = max(-u, u - frame[0], 0.0) + max(-v, v - frame[1], 0.0)
                    seen = score - UNCHECKED
                    if beyond > 0.0:
                        seen -= MISSING_OUTSIDE + OUTSIDE_PER_WIDTH * beyond / frame[0]
                    else:
                        seen -= MISSING_INSIDE
                    # A lamp of radius r shows sqrt(area) = sqrt(pi) r f / z.
                    usual = np.log(1.7725 * prior[3] * camera[0])
                    mean = (sizes[0] + sizes[1] + sizes[2]) / 3.0
                    score -= 0.5 * ((mean - usual) / RADIUS_SPREAD) ** 2
                    seen -= 0.5 * ((mean - usual) / RADIUS_SPREAD) ** 2
                    seen -= 0.5 * spread(sizes, 3) / SIZE_SPREAD**2 + 0.5 * spread(contrasts, 3) / CONTRAST_SPREAD**2
                    for fourth in range(n):
                        if fourth in (i, j, k):
                            continue
                        miss2 = ((centres[fourth, 0] - u) ** 2 + (centres[fourth, 1] - v) ** 2) / prior[2] ** 2
                        if miss2 > 16.0:
                            continue
                        sizes[3] = log_size[fourth] + np.log(q[2])
                        contrasts[3] = log_contrast[fourth]
                        with_fourth = score + reward[fourth] - 0.5 * miss2
                        with_fourth -= 0.5 * spread(sizes, 4) / SIZE_SPREAD**2
                        with_fourth -= 0.5 * spread(contrasts, 4) / CONTRAST_SPREAD**2
                        if with_fourth > seen:
                            seen = with_fourth
                            order[omit] = fourth
                    insert(seen, order, best, chosen)


@jit
def insert(score, order, best, chosen):
    """Put a hypothesis into the list of the best ones, each set of blobs once."""
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
