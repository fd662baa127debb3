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

from hal.arrays import Array
from perception.range.fitting.surfaces import PLANE, depth_on
from perception.range.segmentation.basins import (
    LEAST_FIT,
    RUNS,
    basins_of,
    joined_basins,
    moments_of,
    root_of,
    seams_of,
)
from perception.range.segmentation.compete import Candidates, fit_best
from perception.range.segmentation.faces import labels_of_blocks
from perception.range.segmentation.grid import Grid, sigma_at
from perception.range.segmentation.segment import Task

Labels = NDArray[np.int32]

COARSE_SHARE = 0.004  # of the depth: where three sigmas are less, single pixels tell faces apart
ACROSS = 3  # blocks on either side of an edge, 2 at least
ALONG = 2  # blocks to either side along it, for basins
MOST_SIGMAS = 4.0  # of a pixel: beyond are gross errors
RUN_SAMPLES, LEAST_RUNS = 4000, 24
LEAST_SIGMAS, LEAST_DEPTH = 1.35, 0.0025  # of a pixel, and of the depth, that it must be too
LEAST_TIMES = 1.5  # the smallest surface
SAME_SIGMAS = 0.7  # of parts on both sides of what hides them: they are one face


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
    basin, count = basins_of(own, _along(right, own), _along(down, own.T.copy()).T.copy())
    pairs, seams = seams_of(basin, count, own, right, down.T.copy())
    owner = joined_basins(pairs, seams, moments_of(basin, e, limits, count), usual, least)
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
                    p, q = root_of(island, k), root_of(island, owner[basin[i, j]])
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
    mean_k, island_k = mean[k] / size[k], root_of(island, k)
    is_whole = True
    for m in mine:
        is_whole &= m == k or root_of(island, m) != island_k
    least = np.inf if is_whole else SAME_SIGMAS
    for g in mine[:at]:
        if head[g] != g:
            continue
        is_free = True
        for m in mine[:at]:
            is_free &= head[m] != g or root_of(island, m) != island_k
        gap = abs(mean[g] / size[g] - mean_k)
        if is_free and gap < least:
            head[k], least = g, gap
