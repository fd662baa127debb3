"""Basins of what a surface leaves over, with seams where it changes most (a watershed), joined over their weakest seams.

A step counts by how many of its standard deviations it is: first that of the mean along a seam, then that of the
planes through two basins. `usual`: (2, RUNS) for columns and rows, the standard deviation of the mean of differences
over 1, 2, 4 ... blocks in a line, by chance.
"""

from __future__ import annotations

import numpy as np
from numba import njit

RUNS, LONG_RUN = 8, 4  # of 1, 2, 4 ... blocks along an edge; the one that tells how many blocks share a noise value
SEAM_TIMES, PLANE_TIMES = 4.5, 7.0  # the standard deviation, that a step must be
LEAST_FIT = 8  # blocks that tell a plane
COLUMN_STEP, COLUMN_COUNT, ROW_STEP, ROW_COUNT, AT_COLUMN, AT_ROW, CONTACTS, SCORE = range(8)  # of a seam
SEAM = 8
MOMENTS, LIMIT = 11, 10  # of a basin: sums of 1, c, r, cc, cr, rr, e, ce, re, ee over its blocks, and of the least step


@njit(cache=True, error_model="numpy", nogil=True)
def basins_of(own, right, down):  # type: ignore[no-untyped-def]  # numba types it
    """(h, w) basin of each block, from 1 on, 0 = none, and their number: the steepest ways down from it end at one block."""
    h, w = own.shape
    strength = np.zeros((h, w))
    for r in range(h):
        for c in range(w):
            for d in (right[r, c], right[r, c - 1] if c > 0 else 0.0, down[r, c], down[r - 1, c] if r > 0 else 0.0):
                strength[r, c] = max(strength[r, c], abs(d)) if np.isfinite(d) else strength[r, c]
    to = np.arange(h * w)
    for r in range(h):
        for c in range(w):
            least = strength[r, c]
            for i, j in ((r - 1, c), (r, c - 1), (r, c + 1), (r + 1, c)):
                if not (0 <= i < h and 0 <= j < w and own[i, j] == own[r, c]):
                    continue
                # Of equals the first: a plateau is one basin.
                if strength[i, j] < least or (strength[i, j] == least and i * w + j < to[r * w + c]):
                    to[r * w + c], least = i * w + j, strength[i, j]
    basin, count = np.zeros((h, w), np.int32), 0
    flat, of = basin.ravel(), own.ravel()
    for i in range(h * w):
        if of[i] > 0 and to[i] == i:
            count += 1
            flat[i] = count
    for i in range(h * w):
        end = i
        while to[end] != end:
            end = to[end]
        flat[i] = flat[end]
    return basin, count


@njit(cache=True, error_model="numpy", nogil=True)
def seams_of(basin, count, own, right, down):  # type: ignore[no-untyped-def]  # numba types it
    """Pairs (P, 2), a < b, of basins of one surface that touch; and their seams (P, SEAM), steps from a to b."""
    h, w = basin.shape
    keys, contacts, n = np.empty(2 * h * w, np.int64), np.empty((2 * h * w, SEAM)), 0
    for r in range(h):
        for c in range(w):
            for i, j, d in ((r, c + 1, right[r, c]), (r + 1, c, down[r, c])):
                if i == h or j == w or own[r, c] == 0 or own[i, j] != own[r, c] or basin[i, j] == basin[r, c]:
                    continue
                p, q = np.int64(basin[r, c]), np.int64(basin[i, j])
                keys[n] = min(p, q) * (count + 1) + max(p, q)
                contacts[n] = 0.0
                if np.isfinite(d):
                    at = COLUMN_STEP if i == r else ROW_STEP
                    contacts[n, at], contacts[n, at + 1] = d if p < q else -d, 1.0
                contacts[n, AT_COLUMN], contacts[n, AT_ROW], contacts[n, CONTACTS] = 0.5 * (c + j), 0.5 * (r + i), 1.0
                n += 1
    return _gathered(keys[:n], contacts[:n], count + 1)


@njit(cache=True, error_model="numpy", nogil=True)
def _gathered(keys, contacts, count):  # type: ignore[no-untyped-def]  # numba types it
    """Pairs (P, 2) and seams (P, SEAM) of contacts (N, SEAM) of pairs a * `count` + b."""
    order = np.argsort(keys, kind="mergesort")
    pairs, seams, found = np.empty((keys.shape[0], 2), np.int64), np.zeros((keys.shape[0], SEAM)), 0
    for m in range(keys.shape[0]):
        k = order[m]
        if m == 0 or keys[k] != keys[order[m - 1]]:
            pairs[found, 0], pairs[found, 1] = keys[k] // count, keys[k] % count
            found += 1
        for i in range(SCORE):
            seams[found - 1, i] += contacts[k, i]
    return pairs[:found].copy(), seams[:found].copy()


@njit(cache=True, error_model="numpy", nogil=True)
def moments_of(basin, e, limits, count):  # type: ignore[no-untyped-def]  # numba types it
    """(count + 1, MOMENTS) of each basin."""
    out = np.zeros((count + 1, MOMENTS))
    for r in range(e.shape[0]):
        for c in range(e.shape[1]):
            if basin[r, c] > 0:
                x, y, v = float(c), float(r), e[r, c]
                terms = (1.0, x, y, x * x, x * y, y * y, v, x * v, y * v, v * v, limits[r, c])
                for m in range(MOMENTS):
                    out[basin[r, c], m] += terms[m]
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def joined_basins(pairs, seams, moments, usual, least):  # type: ignore[no-untyped-def]  # numba types it
    """(count + 1,) the basin that each belongs to in the end; changes `moments`.

    In each round those are joined that differ less from each other than either does from any other.
    """
    owner = np.arange(moments.shape[0])
    # So many blocks share one value of the noise: their mean over a long run scatters more than by chance.
    shared = 1.0
    for side in range(2):
        shared *= max((1 << LONG_RUN) * (usual[side, LONG_RUN] / max(usual[side, 0], 1e-12)) ** 2, 1.0)
    for is_last in (False, True):
        is_moving = True
        while is_moving:
            for k in range(pairs.shape[0]):
                seams[k, SCORE] = _evidence(is_last, pairs[k], seams[k], moments, usual, shared)
            is_moving = _join_weakest(pairs, seams, moments, owner, PLANE_TIMES if is_last else SEAM_TIMES, 0)
            if is_last and not is_moving:
                is_moving = _join_weakest(pairs, seams, moments, owner, np.inf, least)
            if is_moving:
                pairs, seams = _rewired(pairs, seams, owner)
    for k in range(owner.shape[0]):
        owner[k] = root_of(owner, k)
    return owner


@njit(cache=True, error_model="numpy")
def _join_weakest(pairs, seams, moments, owner, limit, least):  # type: ignore[no-untyped-def]  # numba types it
    """Join the pairs that are each other's weakest, below the limit; where `least` is given, basins of fewer blocks to theirs.

    Changes `moments` and `owner`; returns whether any were joined.
    """
    weakest = np.full(owner.shape[0], -1)
    for k in range(pairs.shape[0]):
        for m in pairs[k]:
            if weakest[m] < 0 or seams[k, SCORE] < seams[weakest[m], SCORE]:
                weakest[m] = k
    is_any = False
    for k in range(pairs.shape[0]):
        a, b = pairs[k]
        is_mutual = weakest[a] == k and weakest[b] == k
        is_small = (weakest[a] == k and moments[a, 0] < least) or (weakest[b] == k and moments[b, 0] < least)
        if not (seams[k, SCORE] < limit and (is_small if least else is_mutual)):
            continue
        a, b = root_of(owner, a), root_of(owner, b)
        if a != b:
            owner[max(a, b)] = min(a, b)
            moments[min(a, b)] += moments[max(a, b)]
            is_any = True
    return is_any


@njit(cache=True, error_model="numpy")
def _rewired(pairs, seams, owner):  # type: ignore[no-untyped-def]  # numba types it
    """The seams that are left between the basins that others have gone to."""
    keys, n = np.empty(pairs.shape[0], np.int64), 0
    for k in range(pairs.shape[0]):
        a, b = root_of(owner, pairs[k, 0]), root_of(owner, pairs[k, 1])
        if a == b:
            continue
        keys[n] = min(a, b) * owner.shape[0] + max(a, b)
        seams[n] = seams[k]
        if a > b:  # steps are told from the smaller number to the larger
            seams[n, COLUMN_STEP], seams[n, ROW_STEP] = -seams[n, COLUMN_STEP], -seams[n, ROW_STEP]
        n += 1
    return _gathered(keys[:n], seams[:n], owner.shape[0])


@njit(cache=True, error_model="numpy")
def _evidence(is_last, pair, seam, moments, usual, shared):  # type: ignore[no-untyped-def]  # numba types it
    """How many of its standard deviations the step between two basins is; next to nothing where it is too small."""
    p, q = moments[pair[0]], moments[pair[1]]
    if is_last:
        c, r = seam[AT_COLUMN] / seam[CONTACTS], seam[AT_ROW] / seam[CONTACTS]
        before, variance = _plane_at(p, c, r, shared)
        after, more = _plane_at(q, c, r, shared)
        step, sigma = abs(after - before), np.sqrt(variance + more)
    else:
        n = seam[COLUMN_COUNT] + seam[ROW_COUNT]
        if n == 0.0:
            return 0.0
        across = seam[COLUMN_COUNT] * _spread(usual[0], seam[COLUMN_COUNT])
        down = seam[ROW_COUNT] * _spread(usual[1], seam[ROW_COUNT])
        step, sigma = abs(seam[COLUMN_STEP] + seam[ROW_STEP]) / n, np.hypot(across, down) / n
    times = step / max(sigma, 1e-12)
    return times if step >= (p[LIMIT] + q[LIMIT]) / (p[0] + q[0]) else 1e-3 * times


@njit(cache=True, error_model="numpy")
def _spread(usual, n):  # type: ignore[no-untyped-def]  # numba types it
    """Standard deviation of the mean of n differences in a line, from `_chance`."""
    position = min(np.log2(max(n, 1.0)), RUNS - 1.0)
    k = min(int(position), RUNS - 2)
    return usual[k] + (usual[k + 1] - usual[k]) * (position - k)


@njit(cache=True, error_model="numpy")
def _plane_at(m, c, r, shared):  # type: ignore[no-untyped-def]  # numba types it
    """Residual at column c and row r of the plane through blocks of some moments, and its variance.

    `shared`: blocks that share one value of the noise; three such values fit any plane and tell nothing.
    """
    n = m[0]
    mc, mr, me = m[1] / n, m[2] / n, m[6] / n
    cc, cr, rr = m[3] / n - mc * mc, m[4] / n - mc * mr, m[5] / n - mr * mr
    ce, re, ee = m[7] / n - mc * me, m[8] / n - mr * me, m[9] / n - me * me
    det = cc * rr - cr * cr
    if n < LEAST_FIT or n <= 3.0 * shared or det < 0.05:
        return me, np.inf
    a, b = (rr * ce - cr * re) / det, (cc * re - cr * ce) / det
    left = shared * max(ee - a * ce - b * re, 0.0) / (n - 3.0 * shared)
    u, v = c - mc, r - mr
    return me + a * u + b * v, left * (1.0 + (rr * u * u - 2.0 * cr * u * v + cc * v * v) / det)


@njit(cache=True, error_model="numpy")
def root_of(parent, k):  # type: ignore[no-untyped-def]  # numba types it
    while parent[k] != k:
        k = parent[k]
    return k
