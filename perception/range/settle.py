"""Pixels that two surfaces explain about equally go where their neighbours are.

Near a crease, and on the whole ring where a wrong plane cuts a ball, the depth of one pixel cannot tell two surfaces
apart, least of all under slow noise, which pixels share. So a pixel's residual competes with the labels around it
(iterated conditional modes; Besag, J. R. Stat. Soc. B 48(3), 1986).
"""

# ruff: noqa: PLR0912 - compiled loops take plain arrays, and long
# bodies and plain comparisons are what compiles fast.
from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.claim import CLAIM_SIGMAS, NO_LABEL, add_row, contested, misfit_of
from perception.range.grid import sigma_at

REACH_PX = 2  # neighbours of 5 x 5
SHARED_PX = 25.0  # they share one value of the slow noise
NEIGHBOUR_WEIGHT = 3.0  # in units of half a squared residual, for a pixel whose neighbours all bear the other label
MOST = 12


@njit(cache=True, nogil=True, error_model="numpy")
def settle(depth, sen, noise, slow_share, earlier, labels, kinds, ths, out, top, bottom):  # type: ignore[no-untyped-def]
    """Judge again the rows [top, bottom) of `labels` (H, W) where labels meet; writes `out` (H, W).

    `earlier`: the labels before the last sweep, -1 at first. A pixel around which nothing has changed since would be
    judged as it was, so it is not judged again.
    """
    H, W = depth.shape
    perspective = sen[0] > 0
    near, votes = np.empty(MOST, np.int32), np.empty(MOST)
    least, most, change = np.empty(W + 2, np.int32), np.empty(W + 2, np.int32), np.empty(W + 4, np.int32)
    judged = np.empty(W, np.bool_)
    is_first = earlier[0, 0] < 0
    evidence = 0.5 / (1.0 + slow_share * (SHARED_PX - 1.0))
    for v in range(top, bottom):
        y = (v - sen[4]) / sen[2]
        out[v] = labels[v]
        if not is_first:
            change[:] = 0
            for i in range(max(0, v - REACH_PX), min(H, v + REACH_PX + 1)):
                _add_changes(earlier[i], labels[i], change[2:-2])
            if not change.any():
                continue
        least[:], most[:] = NO_LABEL, 0
        for i in range(max(0, v - 1), min(H, v + 2)):
            add_row(labels[i], least[1:-1], most[1:-1])
        contested(labels[v], least, most, judged)
        if not is_first:
            _keep_changed(change, judged)
        for u in range(W):
            z = depth[v, u]
            if not judged[u] or not np.isfinite(z):
                continue
            n, total = _counted(labels, v, u, near, votes)
            own = labels[v, u]
            if n == 0 or (n == 1 and near[0] == own):
                continue
            x = (u - sen[3]) / sen[1]
            sigma = sigma_at(noise, z)
            best, label = np.inf, 0
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
            if label > 0 or own == 0:
                out[v, u] = label


@njit(cache=True, error_model="numpy")
def _counted(labels, v, u, near, votes):  # type: ignore[no-untyped-def]
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


@njit(cache=True, error_model="numpy")
def _add_changes(earlier, labels, change):  # type: ignore[no-untyped-def]
    for u in range(labels.shape[0]):
        change[u] |= labels[u] ^ earlier[u]


@njit(cache=True, error_model="numpy")
def _keep_changed(change, judged):  # type: ignore[no-untyped-def]
    """Clear `judged` where no pixel of the five columns around changed."""
    for u in range(judged.shape[0]):
        judged[u] &= (change[u] | change[u + 1] | change[u + 2] | change[u + 3] | change[u + 4]) != 0
