"""Pixels that two surfaces explain about equally go where their neighbours are.

Near a crease, and on the whole ring where a wrong plane cuts a ball, the depth of one pixel cannot tell two surfaces
apart, least of all under slow noise, which pixels share. So a pixel's residual competes with the labels around it
(iterated conditional modes; Besag, J. R. Stat. Soc. B 48(3), 1986).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.claim import CLAIM_SIGMAS, NO_LABEL, PLAIN_SIGMAS, add_row, contested, misfit_of
from perception.range.grid import sigma_at
from perception.range.surfaces import LEAN

REACH_PX = 2  # neighbours of 5 x 5
SHARED_PX = 25.0  # they share one value of the slow noise
NEIGHBOUR_WEIGHT = 3.0  # in units of half a squared residual, for a pixel whose neighbours all bear the other label
MOST = 12
SAFE_NEIGHBOURS = 5  # of eight: as many as a pixel beside a straight border has; with them, one that fits well stays


@njit(cache=True, nogil=True, error_model="numpy")
def settle(depth, sen, noise, slow_share, earlier, labels, kinds, ths, out, top, bottom):  # type: ignore[no-untyped-def]  # numba types it
    """Judge again the rows [top, bottom) of `labels` (H, W) where labels meet; writes `out` (H, W).

    `earlier`: the labels before the last sweep, -1 at first. A pixel around which nothing has changed since would be
    judged as it was, so it is not judged again.
    """
    H, W = depth.shape
    near, votes = np.empty(MOST, np.int32), np.empty(MOST)
    evidence = 0.5 / (1.0 + slow_share * (SHARED_PX - 1.0))
    out[top:bottom] = labels[top:bottom]
    if earlier[0, 0] < 0:
        least, most, judged = np.empty(W + 2, np.int32), np.empty(W + 2, np.int32), np.empty(W, np.bool_)
        for v in range(top, bottom):
            least[:], most[:] = NO_LABEL, 0
            for i in range(max(0, v - 1), min(H, v + 2)):
                add_row(labels[i], least[1:-1], most[1:-1])
            contested(labels[v], least, most, judged)
            for u in range(W):
                if judged[u]:
                    out[v, u] = _best(depth, sen, noise, evidence, labels, v, u, kinds, ths, near, votes)
        return
    seen = np.zeros((bottom - top, W), np.bool_)
    for row in range(max(0, top - REACH_PX), min(H, bottom + REACH_PX)):
        if not _differ(earlier[row], labels[row]):
            continue
        for column in range(W):
            if earlier[row, column] == labels[row, column]:
                continue
            for v in range(max(top, row - REACH_PX), min(bottom, row + REACH_PX + 1)):
                for u in range(max(0, column - REACH_PX), min(W, column + REACH_PX + 1)):
                    if not seen[v - top, u]:
                        seen[v - top, u] = True
                        out[v, u] = _best(depth, sen, noise, evidence, labels, v, u, kinds, ths, near, votes)


@njit(cache=True, error_model="numpy", **LEAN)
def _differ(a, b):  # type: ignore[no-untyped-def]  # numba types it
    """Whether two rows differ, without a branch a pixel."""
    change = np.int32(0)
    for u in range(a.shape[0]):
        change |= a[u] ^ b[u]
    return change != 0


@njit(cache=True, error_model="numpy", **LEAN)
def _best(depth, sen, noise, evidence, labels, v, u, kinds, ths, near, votes):  # type: ignore[no-untyped-def]  # numba types it
    """The label of one pixel, its own where no other touches it; `near` and `votes` (MOST,) are scratch."""
    own, z = labels[v, u], depth[v, u]
    same, other = _beside(labels, v, u)
    if other == 0 or not np.isfinite(z):
        return own
    perspective = sen[0] > 0
    x, y = (u - sen[3]) / sen[1], (v - sen[4]) / sen[2]
    sigma = sigma_at(noise, z)
    if same >= SAFE_NEIGHBOURS and own > 0 and misfit_of(own, kinds, ths, x, y, z, sigma, perspective) < PLAIN_SIGMAS:
        return own
    n, total = _counted(labels, v, u, near, votes)
    best, label = np.inf, own
    for m in range(n):
        least_cost = NEIGHBOUR_WEIGHT * (1.0 - votes[m] / total)
        if least_cost >= best:
            continue  # not even a perfect fit would win
        e = misfit_of(near[m], kinds, ths, x, y, z, sigma, perspective)
        if not e < CLAIM_SIGMAS:
            continue
        cost = evidence * e * e + least_cost
        if cost < best:
            best, label = cost, near[m]
    return label


@njit(cache=True, error_model="numpy", **LEAN)
def _beside(labels, v, u):  # type: ignore[no-untyped-def]  # numba types it
    """How many of the eight neighbours bear the pixel's own label, and how many another one."""
    H, W = labels.shape
    own = labels[v, u]
    same, other = -1, 0
    for i in range(max(0, v - 1), min(H, v + 2)):
        for j in range(max(0, u - 1), min(W, u + 2)):
            k = labels[i, j]
            same += k == own
            other += (k != own) & (k > 0)
    return same, other


@njit(cache=True, error_model="numpy", **LEAN)
def _counted(labels, v, u, near, votes):  # type: ignore[no-untyped-def]  # numba types it
    """Labels of the neighbours into `near`, how many bear each into `votes`; their number, and that of neighbours."""
    H, W = labels.shape
    n, total = 0, 0.0
    for i in range(max(0, v - REACH_PX), min(H, v + REACH_PX + 1)):
        for j in range(max(0, u - REACH_PX), min(W, u + REACH_PX + 1)):
            k = labels[i, j]
            if k == 0 or (i == v and j == u):
                continue
            total += 1.0
            at = -1
            for m in range(n):
                if near[m] == k:
                    at = m
                    break
            if at >= 0:
                votes[at] += 1.0
            elif n < MOST:
                near[n], votes[n] = k, 1.0
                n += 1
    return n, total
