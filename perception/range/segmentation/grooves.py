"""Faces in one plane with a groove between them are two: cushions side by side, boxes pushed together, drawers.

A groove that is narrower and shallower than the noise still shows along its whole length in what tangent planes leave
over. A plane is cut where blocks that do so, and lie behind it, make most of a seam between two large parts of it.
Things in front, and pixels without a reading, part nothing: the plane may go on behind them.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from hal.arrays import Array
from perception.range.components import label_components
from perception.range.fitting.surfaces import LEAN, PLANE, depth_on
from perception.range.segmentation.beside import WORD, column_range, flagged, new_columns
from perception.range.segmentation.compete import Candidates
from perception.range.segmentation.faces import labels_of_blocks
from perception.range.segmentation.grid import Grid, sigma_at
from perception.range.segmentation.segment import Task

Flags = NDArray[np.bool_]
Labels = NDArray[np.int32]

ROUGHER = 1.35  # than its plane is in the median: a block that may hold a piece of a groove
RMS_BINS, BINS_A_SIGMA = 64, 16.0
LEAST_SHARE = 0.08  # of the plane's blocks, that a part must have
LEAST_BLOCKS = 60
SEAM_SHARE = 0.7  # of the blocks between two parts, that must be rough
BEHIND_SIGMAS = 0.3  # of a block, that they lie behind in the median
DEEP_SIGMAS = 3.5  # of a pixel, that makes a block rough by itself: a gap narrower than blocks
IN_FRONT_SIGMAS = 3.0
NO_PLANE = np.int32(2**31 - 1)
AROUND = np.ones((3, 3), np.uint8)


def cut_at_grooves(task: Task, law: Array, grid: Grid, labels: Labels, found: Candidates) -> Labels:
    """Labels (H, W) after planes with a groove across were cut; extends `found` by a copy of the plane for each part."""
    size = grid.size_px
    kinds, table = found.arrays()
    planes, sizes = planes_of_blocks(labels_of_blocks(labels, grid), kinds)
    rough = rough_blocks(planes, grid.rms, labels, task.depth_m, task.packed, law, size, table)
    out = labels
    for k in _suspects(planes, rough, sizes):
        parts = _parts(grid, planes == k, rough, table[k])
        if parts is None:
            continue
        out = labels.copy() if out is labels else out
        fine = np.repeat(np.repeat(parts, size, 0), size, 1)[: out.shape[0], : out.shape[1]]
        for part in range(2, int(parts.max()) + 1):
            out[(labels == k) & (fine == part)] = found.add(PLANE, table[k].copy(), found.slack[k - 1])
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def planes_of_blocks(blocks, kinds):  # type: ignore[no-untyped-def]  # numba types it
    """(h, w) `blocks` with 0 for all but planes, and how many blocks each plane has."""
    planes, sizes = np.zeros_like(blocks), np.zeros(kinds.shape[0], np.int32)
    flat, out = blocks.ravel(), planes.ravel()
    for i in range(flat.shape[0]):
        k = flat[i]
        if k > 0 and kinds[k] == PLANE:
            out[i] = k
            sizes[k] += 1
    return planes, sizes


@njit(cache=True, error_model="numpy", nogil=True)
def rough_blocks(planes, rms, labels, depth, sen, noise, size, table):  # type: ignore[no-untyped-def]  # numba types it
    """(h, w) of the blocks of planes: 2 where a pixel lies deep behind, 1 where the tangent plane leaves much over, else 0."""
    h, w = planes.shape
    H, W = labels.shape
    perspective = sen[0] > 0
    limit = ROUGHER * _usual_rms(planes, rms, table.shape[0])
    out = np.zeros((h, w), np.uint8)
    own, words, columns = np.zeros(W, np.int32), np.zeros(W // WORD + 1, np.uint64), np.empty(W + 1, np.int32)
    for r in range(h):
        for c in range(w):
            k = planes[r, c]
            out[r, c] = k > 0 and not rms[r, c] < limit[k]
            for u in range(c * size, min(c * size + size, W)):
                own[u] = k
        for v in range(r * size, min(r * size + size, H)):
            _flag_others(labels[v], own, words.view(np.bool_))
            for i in range(flagged(words, columns)):
                u = columns[i]
                zm = depth_on(PLANE, table[own[u]], (u - sen[3]) / sen[1], (v - sen[4]) / sen[2], perspective)
                if depth[v, u] - zm > DEEP_SIGMAS * sigma_at(noise, zm):
                    out[r, u // size] = 2
    return out


@njit(cache=True, error_model="numpy")
def _usual_rms(planes, rms, count):  # type: ignore[no-untyped-def]  # numba types it
    """(count,) the median of what tangent planes leave over, of the blocks of each plane."""
    counts, usual = np.zeros((count, RMS_BINS), np.int32), np.zeros(count)
    for r in range(planes.shape[0]):
        for c in range(planes.shape[1]):
            if rms[r, c] < np.inf:
                counts[planes[r, c], int(min(rms[r, c] * BINS_A_SIGMA, RMS_BINS - 1.0))] += 1
    for k in range(1, count):
        middle, level, below = counts[k].sum() // 2, 0, counts[k, 0]
        while below < middle:
            level += 1
            below += counts[k, level]
        usual[k] = (level + 0.5) / BINS_A_SIGMA
    return usual


@njit(cache=True, error_model="numpy", **LEAN)
def _flag_others(labels, own, flags):  # type: ignore[no-untyped-def]  # numba types it
    """Where a pixel of a plane's block is not the plane's."""
    for u in range(labels.shape[0]):
        flags[u] = (own[u] > 0) & (labels[u] != own[u])


def _suspects(planes: Labels, rough: NDArray[np.uint8], sizes: Labels) -> list[int]:
    """Planes of whose inside two or more large parts remain when rough blocks are taken away."""
    core = inside(planes, rough)
    marks, areas = label_components(core, core, core)
    if areas.size < 3:
        return []
    owners = _planes_of_parts(marks, planes, areas.size)
    least = np.maximum(LEAST_BLOCKS, LEAST_SHARE * sizes)
    large = np.bincount(owners[(areas >= least[owners]) & (owners > 0)], minlength=sizes.size)
    suspects: list[int] = np.flatnonzero(large > 1).tolist()
    return suspects


@njit(cache=True, nogil=True)
def inside(planes, rough):  # type: ignore[no-untyped-def]  # numba types it
    """(h, w) where a block and all of its neighbours belong to one plane and are not rough."""
    h, w = planes.shape
    out, own = np.zeros((h, w), np.bool_), np.zeros((h, w), np.int32)
    for r in range(h):
        _fill_smooth(planes[r], rough[r], own[r])
    least, most = new_columns(w)
    for r in range(1, h - 1):
        column_range(own, r, least, most)
        _fill_inside(own[r], least, most, out[r])
    return out


@njit(cache=True, error_model="numpy", **LEAN)
def _fill_smooth(planes, rough, own):  # type: ignore[no-untyped-def]  # numba types it
    """The planes of one row of blocks, `NO_PLANE` for a block that is rough or of none."""
    for c in range(own.shape[0]):
        own[c] = planes[c] if (planes[c] > 0) & (rough[c] == 0) else NO_PLANE


@njit(cache=True, error_model="numpy", **LEAN)
def _fill_inside(own, least, most, out):  # type: ignore[no-untyped-def]  # numba types it
    """From `column_range` of `own`: where it and all around are one plane."""
    for c in range(1, own.shape[0] - 1):
        low, high = min(least[c], least[c + 1], least[c + 2]), max(most[c], most[c + 1], most[c + 2])
        out[c] = (own[c] != NO_PLANE) & (high == own[c]) & (low == np.uint32(own[c] - np.int32(1)))


@njit(cache=True, nogil=True)
def _planes_of_parts(marks, planes, count):  # type: ignore[no-untyped-def]  # numba types it
    """(count,) the plane that each mark lies in; 0 for mark 0."""
    owners = np.zeros(count, np.int32)
    for r in range(marks.shape[0]):
        for c in range(marks.shape[1]):
            if marks[r, c] > 0:
                owners[marks[r, c]] = planes[r, c]
    return owners


def _parts(grid: Grid, mine: Flags, rough: NDArray[np.uint8], th: Array) -> Labels | None:
    """(h, w) parts 1, 2 ... of a plane's blocks, the largest first, None where it is one."""
    rows, columns = np.flatnonzero(mine.any(1)), np.flatnonzero(mine.any(0))
    box = np.s_[max(rows[0] - 1, 0) : rows[-1] + 2, max(columns[0] - 1, 0) : columns[-1] + 2]
    mine, rough = mine[box], rough[box]
    x, y, z, sigma = (a[box] for a in (grid.x, grid.y, grid.z, grid.sigma))
    behind = _behind(th, x, y, z, sigma, grid.perspective)
    is_passable = (mine & (rough == 0)) | ~np.isfinite(z) | (~mine & (behind < -IN_FRONT_SIGMAS))
    behind[mine & (rough == 2)] = DEEP_SIGMAS
    inner = cv2.erode(is_passable.view(np.uint8), AROUND, borderValue=0)
    count, marks = cv2.connectedComponents(inner, connectivity=4)
    large = np.bincount(marks[mine], minlength=count)
    large[0] = 0
    keep = np.flatnonzero(large >= max(LEAST_BLOCKS, LEAST_SHARE * mine.sum()))
    if keep.size < 2:
        return None
    names = np.zeros(count, np.int32)
    names[keep] = np.arange(1, keep.size + 1)
    basins = names[marks]
    _flood(basins, is_passable)
    _flood(basins, is_passable | mine)
    owner = _joined(_seams(basins, mine, rough > 0, behind), keep.size)
    sizes = np.bincount(owner[basins[mine]], minlength=keep.size + 1)
    sizes[0] = 0
    order = [k for k in np.argsort(-sizes, kind="stable") if sizes[k] > 0]
    if len(order) < 2:
        return None
    renamed = np.zeros(keep.size + 1, np.int32)
    renamed[order] = np.arange(1, len(order) + 1)
    out = np.zeros(grid.z.shape, np.int32)
    out[box] = np.where(mine, np.maximum(renamed[owner[basins]], 1), 0)
    return out


def _seams(basins: Labels, mine: Flags, rough: Flags, behind: Array) -> dict[tuple[int, int], bool]:
    """Of each pair of basins that meet: whether their seam is a groove, rough and behind the plane in the median."""
    near = cv2.dilate(rough.view(np.uint8), AROUND) > 0
    own = np.where(mine, basins, 0)
    count = int(own.max()) + 1
    parts = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        met = (own[a] != own[b]) & (own[a] > 0) & (own[b] > 0)
        p, q = own[a][met], own[b][met]
        pair = np.minimum(p, q) * count + np.maximum(p, q)
        parts.append((pair, near[a][met] & near[b][met], 0.5 * (behind[a][met] + behind[b][met])))
    pairs, is_rough, depth = (np.concatenate(p) for p in zip(*parts, strict=True))
    out = {}
    for pair in np.unique(pairs).tolist():
        seam = pairs == pair
        known = depth[seam & np.isfinite(depth)]
        is_groove = np.count_nonzero(is_rough[seam]) >= SEAM_SHARE * np.count_nonzero(seam) and known.size > 0
        out[divmod(pair, count)] = bool(is_groove and np.median(known) > BEHIND_SIGMAS)
    return out


def _joined(seams: dict[tuple[int, int], bool], count: int) -> Labels:
    """(count + 1,) the basin that each belongs to, after those that meet without a groove were joined."""
    owner = np.arange(count + 1, dtype=np.int32)
    for (p, q), is_groove in seams.items():
        if not is_groove:
            owner[owner == owner[q]] = owner[p]
    return owner


@njit(cache=True, error_model="numpy")
def _behind(th, x, y, z, sigma, perspective):  # type: ignore[no-untyped-def]  # numba types it
    """(h, w) how far each block lies behind the plane, in sigmas."""
    out = np.empty(z.shape)
    for r in range(z.shape[0]):
        for c in range(z.shape[1]):
            out[r, c] = (z[r, c] - depth_on(PLANE, th, x[r, c], y[r, c], perspective)) / sigma[r, c]
    return out


@njit(cache=True, nogil=True)
def _flood(basins, allowed):  # type: ignore[no-untyped-def]  # numba types it
    """Spread the basins, breadth first, over the allowed blocks."""
    h, w = basins.shape
    queue = np.empty(h * w, np.int32)
    count, head = 0, 0
    for r in range(h):
        for c in range(w):
            if basins[r, c]:
                queue[count] = r * w + c
                count += 1
    while head < count:
        r = queue[head] // w
        c = queue[head] - r * w
        head += 1
        for s in range(4):
            i, j = r + (s == 0) - (s == 1), c + (s == 2) - (s == 3)
            if 0 <= i < h and 0 <= j < w and basins[i, j] == 0 and allowed[i, j]:
                basins[i, j] = basins[r, c]
                queue[count] = i * w + j
                count += 1
