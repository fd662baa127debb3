"""Steps that noise hides: two parallel faces that one surface takes, a seat before its base, a picture before a wall.

A step that is lost in the noise of a pixel is many times that of a mean along an edge, or of a face's plane. So what a
surface leaves over is cut into basins, far too many, with seams where it changes most (a watershed). The two that show
the least step between them are joined, first by the step along their seam, held against what straight lines across
the image's own surfaces show by chance, which knows slow noise as no model does; then by the step between the planes
through them.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.range.fitting.surfaces import PLANE, depth_on
from perception.range.segmentation.compete import Candidates, fit_best
from perception.range.segmentation.faces import labels_of_blocks
from perception.range.segmentation.grid import Grid, sigma_at
from perception.range.segmentation.segment import Task

Array = NDArray[np.float64]
Labels = NDArray[np.int32]

COARSE_SHARE = 0.004  # of the depth: where three sigmas are less, single pixels tell faces apart
ACROSS = 3  # blocks on either side of an edge, 2 at least
ALONG = 2  # blocks to either side along it, for basins
MOST_SIGMAS = 4.0  # of a pixel: beyond are gross errors
RUNS, LONG_RUN = (
    8,
    4,
)  # of 1, 2, 4 ... blocks along an edge; the one that tells how many blocks share a value of the noise
RUN_SAMPLES, LEAST_RUNS = 4000, 24
SEAM_TIMES, PLANE_TIMES = 4.5, 7.0  # the standard deviation, that a step must be
LEAST_SIGMAS, LEAST_DEPTH = 1.35, 0.0025  # of a pixel, and of the depth, that it must be too
LEAST_TIMES = 1.5  # the smallest surface
SAME_SIGMAS = 0.7  # of parts on both sides of what hides them: they are one face
LEAST_FIT = 8  # blocks that tell a plane
COLUMN_STEP, COLUMN_COUNT, ROW_STEP, ROW_COUNT, AT_COLUMN, AT_ROW, CONTACTS, SCORE = range(8)  # of a seam
SEAM = 8
MOMENTS, LIMIT = 11, 10  # of a basin: sums of 1, c, r, cc, cr, rr, e, ce, re, ee over its blocks, and of the least step


def cut_at_steps(task: Task, law: Array, grid: Grid, labels: Labels, found: Candidates) -> Labels:
    """Labels (H, W) after surfaces with a step across were cut; extends `found` by a surface for each part cut off."""
    z = abs(float(task.depths_m[2]))
    if 3.0 * float(sigma_at(law, z)) < COARSE_SHARE * z:
        return labels
    size, blocks = grid.size_px, labels_of_blocks(labels, grid)
    least = max(LEAST_FIT, round(LEAST_TIMES * task.least_pixels / size**2))
    parts, owners = step_parts(blocks, grid.x, grid.y, grid.z, law, *found.arrays(), grid.perspective, least)
    if owners.size == 1:
        return labels
    fine = np.repeat(np.repeat(parts, size, 0), size, 1)[: labels.shape[0], : labels.shape[1]]
    names = np.zeros(owners.size, np.int32)
    for part, k in enumerate(owners.tolist()[1:], 1):
        kind, th, slack = found.kinds[k - 1], found.parameters[k - 1], found.slack[k - 1]
        if kind != PLANE:
            # A bent surface through two faces is neither's.
            fitted, better, _ = fit_best(grid, np.flatnonzero(parts == part), slack)
            kind, th = (fitted, better) if fitted >= 0 else (kind, th)
        names[part] = found.add(kind, th.copy(), slack)
    return np.where((fine > 0) & (labels == owners[fine]), names[fine], labels)


@njit(cache=True, error_model="numpy", nogil=True)
def step_parts(blocks, x, y, z, law, kinds, table, perspective, least):  # type: ignore[no-untyped-def]  # numba types it
    """(h, w) the part that each block belongs to, from 1 on, 0 for a surface's largest; and the surface of each part.

    Args:
        blocks: (h, w) surface of each block, 0 = none, of `kinds` and `table`; `x`, `y`, `z` as in `Grid`.
        law: of the noise, as `NoiseModel.packed`.
        least: blocks of a part.
    """
    e, limits = _residuals(blocks, x, y, z, law, kinds, table, perspective)
    own = np.where(np.isfinite(e), blocks, np.int32(0))
    right, down = _differences(e, own), _differences(e.T.copy(), own.T.copy())
    usual = np.stack((_chance(right.T.copy()), _chance(down.T.copy())))
    basin, count = _basins(own, _along(right, own), _along(down, own.T.copy()).T.copy())
    pairs, seams = _seams(basin, count, own, right, down.T.copy())
    owner = _joined(pairs, seams, _moments(basin, e, limits, count), usual, least)
    return _parts(basin, owner, own, e, kinds.shape[0], least)


@njit(cache=True, error_model="numpy", nogil=True)
def _residuals(blocks, x, y, z, law, kinds, table, perspective):  # type: ignore[no-untyped-def]  # numba types it
    """(h, w) how far each block lies behind its surface in sigmas of a pixel, NaN without one; and the least step there."""
    e, limits = np.full(z.shape, np.nan), np.zeros(z.shape)
    for r in range(z.shape[0]):
        for c in range(z.shape[1]):
            k = blocks[r, c]
            if k > 0 and np.isfinite(z[r, c]):
                sigma = sigma_at(law, z[r, c])
                off = (z[r, c] - depth_on(kinds[k], table[k], x[r, c], y[r, c], perspective)) / sigma
                limits[r, c] = max(LEAST_SIGMAS, LEAST_DEPTH * abs(z[r, c]) / sigma)
                if np.isfinite(off):
                    e[r, c] = min(max(off, -MOST_SIGMAS), MOST_SIGMAS)
    return e, limits


@njit(cache=True, error_model="numpy", nogil=True)
def _differences(e, own):  # type: ignore[no-untyped-def]  # numba types it
    """(h, w) mean residual of the blocks after the edge behind each in its row, less that of those before; NaN without."""
    h, w = e.shape
    out = np.full((h, w), np.nan)
    for r in range(h):
        for c in range(w - 1):
            if own[r, c] > 0 and own[r, c + 1] == own[r, c]:
                before, n = _side(e[r], own[r], c, -1)
                after, m = _side(e[r], own[r], c + 1, 1)
                if n > 1 and m > 1:
                    out[r, c] = after / m - before / n
    return out


@njit(cache=True, error_model="numpy")
def _side(e, own, c, step):  # type: ignore[no-untyped-def]  # numba types it
    """Sum and number of up to `ACROSS` residuals of one surface from c on."""
    k, total, n = own[c], 0.0, 0
    while 0 <= c < e.shape[0] and n < ACROSS and own[c] == k:
        total += e[c]
        n += 1
        c += step
    return total, n


@njit(cache=True, error_model="numpy", nogil=True)
def _along(d, own):  # type: ignore[no-untyped-def]  # numba types it
    """(h, w) means of the differences along their edges, those of one surface."""
    h, w = d.shape
    out = np.full((h, w), np.nan)
    for r in range(h):
        for c in range(w):
            if np.isfinite(d[r, c]):
                total, n = 0.0, 0
                for i in range(max(r - ALONG, 0), min(r + ALONG + 1, h)):
                    if own[i, c] == own[r, c] and np.isfinite(d[i, c]):
                        total += d[i, c]
                        n += 1
                out[r, c] = total / n
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def _chance(lines):  # type: ignore[no-untyped-def]  # numba types it
    """(RUNS,) standard deviation of the mean of 1, 2, 4 ... differences (h, w) in a row, robust to true steps."""
    h, w = lines.shape
    out, values = np.zeros(RUNS), np.empty(RUN_SAMPLES)
    for run in range(RUNS):
        length = 1 << run
        n, seen, stride = 0, 0, h * w // (length * RUN_SAMPLES) + 1
        for r in range(h):
            total, known = 0.0, 0
            for c in range(w):
                is_known = np.isfinite(lines[r, c])
                total, known = (total + lines[r, c], known + 1) if is_known else (0.0, 0)
                if known == length:
                    if seen % stride == 0:
                        values[n] = abs(total / length)
                        n += 1
                    seen, total, known = seen + 1, 0.0, 0
        before = out[run - 1] if run > 0 else np.inf
        out[run] = min(before, np.median(values[:n]) / 0.6745) if n >= LEAST_RUNS or run == 0 else before
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def _basins(own, right, down):  # type: ignore[no-untyped-def]  # numba types it
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
def _seams(basin, count, own, right, down):  # type: ignore[no-untyped-def]  # numba types it
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
def _moments(basin, e, limits, count):  # type: ignore[no-untyped-def]  # numba types it
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
def _joined(pairs, seams, moments, usual, least):  # type: ignore[no-untyped-def]  # numba types it
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
        owner[k] = _root(owner, k)
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
        a, b = _root(owner, a), _root(owner, b)
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
        a, b = _root(owner, pairs[k, 0]), _root(owner, pairs[k, 1])
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


@njit(cache=True, error_model="numpy", nogil=True)
def _parts(basin, owner, own, e, count, least):  # type: ignore[no-untyped-def]  # numba types it
    """`step_parts` of joined basins: parts that something hides from each other, and that lie equally far back, are one."""
    h, w = basin.shape
    n = owner.shape[0]
    size, surface, mean = np.zeros(n, np.int64), np.zeros(n, np.int32), np.zeros(n)
    island = np.arange(n)  # of parts that touch
    for r in range(h):
        for c in range(w):
            if basin[r, c] == 0:
                continue
            k = owner[basin[r, c]]
            size[k], surface[k], mean[k] = size[k] + 1, own[r, c], mean[k] + e[r, c]
            for i, j in ((r, c + 1), (r + 1, c)):
                if i < h and j < w and own[i, j] == own[r, c]:
                    p, q = _root(island, k), _root(island, owner[basin[i, j]])
                    island[max(p, q)] = min(p, q)
    order = np.argsort(-size, kind="mergesort")
    head = np.arange(n)
    owners, names = [np.int32(0)], np.zeros(n, np.int32)
    for s in range(1, count):
        mine = order[(surface[order] == s) & (size[order] > 0)]
        for at in range(mine.shape[0]):
            k = mine[at]
            _find_head(mine, at, island, mean, size, head)
            if at > 0 and head[k] == k and size[k] >= least:
                names[k] = len(owners)
                owners.append(np.int32(s))
            names[k] = names[head[k]]
    out = np.zeros((h, w), np.int32)
    for r in range(h):
        for c in range(w):
            out[r, c] = names[owner[basin[r, c]]] if basin[r, c] > 0 else 0
    return out, np.array(owners)


@njit(cache=True, error_model="numpy")
def _find_head(mine, at, island, mean, size, head):  # type: ignore[no-untyped-def]  # numba types it
    """Set the part that the one at `at` continues: the nearest in depth of those that it does not touch, or itself.

    One whose island was not cut was no face of its own before, and continues one however far.
    """
    k = mine[at]
    mean_k, island_k = mean[k] / size[k], _root(island, k)
    is_whole = True
    for m in mine:
        is_whole &= m == k or _root(island, m) != island_k
    least = np.inf if is_whole else SAME_SIGMAS
    for g in mine[:at]:
        if head[g] != g:
            continue
        is_free = True
        for m in mine[:at]:
            is_free &= head[m] != g or _root(island, m) != island_k
        gap = abs(mean[g] / size[g] - mean_k)
        if is_free and gap < least:
            head[k], least = g, gap


@njit(cache=True, error_model="numpy")
def _root(parent, k):  # type: ignore[no-untyped-def]  # numba types it
    while parent[k] != k:
        k = parent[k]
    return k
