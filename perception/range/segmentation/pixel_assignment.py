"""Assignment of pixels: each gets the label of the neighbouring surface that explains its depth best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Indices, Labels
from hal.jit import REORDERED, compiled
from perception.range.fitting.surfaces import PLANE, depth_on, normal_on
from perception.range.segmentation.boundary_pixels import WORD, column_range, flag_free, flagged, new_columns
from perception.range.segmentation.grid import sigma_at

ASSIGNMENT_SIGMAS = 3.5  # largest residual of a pixel from the surface to which it is assigned
PLAIN_SIGMAS = 1.0  # a pixel with a smaller residual from the surface of its own block is not compared with others
MAX_CANDIDATES = 8  # surfaces among which a pixel is assigned
SEVERAL = np.int32(-1)  # marks blocks and pixels for which several surfaces must be compared
EASED = 0.4  # smallest factor by which a residual is reduced at a grazing ray


@compiled
def assign_pixels(
    depth: Array, sen: Array, noise: Array, blocks: Labels, size: int, kinds: Indices, ths: Array, out: Labels,
    top: int, bottom: int,
) -> None:  # fmt: skip
    """Label each pixel of `depth` (H, W) with the best surface among those of the 3x3 blocks around it.

    `blocks` (h, w) are the labels of blocks of `size` pixels; labels index `kinds` and `ths` from 1. Writes the pixels of
    the rows of blocks [top, bottom) into `out` (H, W) int32: a label, or 0 if no residual is below `ASSIGNMENT_SIGMAS`.
    """
    w = blocks.shape[1]
    perspective = sen[0] > 0
    least, most = new_columns(w)
    only, near = np.empty(w, np.int32), np.empty(MAX_CANDIDATES, np.int32)
    for r in range(top, bottom):
        column_range(blocks, r, least, most)
        _only_labels(least, most, only)
        _assign_first(depth, sen, noise, blocks[r], only, size, r, kinds, ths, out)
        for c in range(w):
            if only[c] == SEVERAL:
                n = _labels_around(blocks, r, c, near)
                _assign_rest(depth, sen, noise, size, r, c, near, n, kinds, ths, perspective, out)


@compiled
def _only_labels(least: NDArray[np.uint32], most: Labels, only: Labels) -> None:
    """Write the only label of the 3x3 blocks around each block into `only`: 0 if none, SEVERAL if more than one.

    `least` and `most` are those of `column_range`.
    """
    one = np.int32(1)
    for c in range(only.shape[0]):
        low, high = min(least[c], least[c + 1], least[c + 2]), max(most[c], most[c + 1], most[c + 2])
        only[c] = high if (high == 0) | (low == np.uint32(high - one)) else SEVERAL


@compiled
def _assign_first(
    depth: Array, sen: Array, noise: Array, own: Labels, only: Labels, size: int, r: int, kinds: Indices, ths: Array,
    out: Labels,
) -> None:  # fmt: skip
    """Compare the pixels of the r-th row of blocks with the only surface around, or else with that of their `own` block.

    `only` is that of `_only_labels`. Where several surfaces are around, a pixel that the surface of its own block does not
    explain within `PLAIN_SIGMAS` gets the mark `SEVERAL`.
    """
    H, W = depth.shape
    w = own.shape[0]
    perspective = sen[0] > 0
    c = 0
    while c < w:
        start, label, mine = c, only[c], own[c]
        while c < w and only[c] == label and (label != SEVERAL or own[c] == mine):
            c += 1
        first, end = start * size, min(c * size, W)
        k, limit, otherwise = (mine, PLAIN_SIGMAS, SEVERAL) if label == SEVERAL else (label, ASSIGNMENT_SIGMAS, 0)
        for v in range(r * size, min(r * size + size, H)):
            if k == 0:
                out[v, first:end] = otherwise
            elif kinds[k] == PLANE:
                _assign_run(
                    depth[v, first:end],
                    ths[k],
                    k,
                    first,
                    v,
                    sen,
                    noise,
                    perspective,
                    limit,
                    otherwise,
                    out[v, first:end],
                )
            else:
                y = (v - sen[4]) / sen[2]
                for u in range(first, end):
                    z, x = depth[v, u], (u - sen[3]) / sen[1]
                    e = misfit_of(k, kinds, ths, x, y, z, sigma_at(noise, z), perspective)
                    out[v, u] = k if e < limit else otherwise


@compiled(fastmath=REORDERED)
def _assign_run(
    depth: Array, th: Array, label: int, first: int, v: int, sen: Array, noise: Array, perspective: bool, limit: float,
    otherwise: int | np.int32, out: Labels,
) -> None:  # fmt: skip
    """Label the pixels of row v from column `first` that a plane explains within `limit` sigmas; others get `otherwise`.

    The loop has neither a branch nor a square root.
    """
    p = 1.0 if perspective else 0.0
    y = (v - sen[4]) / sen[2]
    per_x = 1.0 / sen[1]
    dy = p * y
    at = th[3] - th[1] * (y - dy)
    along = th[1] * dy + th[2]
    square = limit * limit
    mine, other = np.int32(label), np.int32(otherwise)
    for i in range(out.shape[0]):
        x = (first + i - sen[3]) * per_x
        dx = p * x
        z = depth[i]
        facing = th[0] * dx + along
        e = z * facing - (at - th[0] * (x - dx))  # residual times `facing`, which avoids a division
        z2 = z * z
        white, slow, step = noise[0] + noise[1] * z2, noise[2] + noise[3] * z2, noise[4] + noise[5] * z2
        variance = max(white * white, step * step * (1.0 / 12.0)) + slow * slow
        out[i] = mine if e * e < square * variance * (facing * facing) else other


@compiled
def _assign_rest(
    depth: Array, sen: Array, noise: Array, size: int, r: int, c: int, near: Labels, n: int, kinds: Indices, ths: Array,
    perspective: bool, out: Labels,
) -> None:  # fmt: skip
    """Assign the pixels of one block that are still `SEVERAL` to the best of the surfaces near[:n]."""
    H, W = depth.shape
    for v in range(r * size, min(r * size + size, H)):
        for u in range(c * size, min(c * size + size, W)):
            if out[v, u] == SEVERAL:
                x, y = (u - sen[3]) / sen[1], (v - sen[4]) / sen[2]
                out[v, u] = _best_of(depth[v, u], x, y, noise, near, n, kinds, ths, perspective)


@compiled
def _best_of(
    z: float, x: float, y: float, noise: Array, near: Labels, n: int, kinds: Indices, ths: Array, perspective: bool,
) -> int:  # fmt: skip
    """Return the label of near[:n] whose surface explains the depth best; 0 if none does within `ASSIGNMENT_SIGMAS`."""
    best, label = ASSIGNMENT_SIGMAS, 0
    if not np.isfinite(z):
        return label
    sigma = sigma_at(noise, z)
    for m in range(n):
        e = misfit_of(near[m], kinds, ths, x, y, z, sigma, perspective)
        if e < best:
            best, label = e, near[m]
    return label


@compiled
def reassign_pixels(
    depth: Array, sen: Array, noise: Array, labels: Labels, kinds: Indices, ths: Array, rows: Labels, columns: Labels,
    out: Labels, first: int, last: int,
) -> None:  # fmt: skip
    """Find the best surface around each of the pixels at `rows`, `columns` (N,); writes its label into out[first:last].

    Only the pixels beside new surfaces need this, because `assign_pixels` has compared the earlier ones.
    """
    perspective = sen[0] > 0
    near = np.empty(9, np.int32)
    for k in range(first, last):
        v, u = 0 + rows[k], 0 + columns[k]
        x, y = (u - sen[3]) / sen[1], (v - sen[4]) / sen[2]
        n = _labels_around(labels, v, u, near)
        out[k] = _best_of(depth[v, u], x, y, noise, near, n, kinds, ths, perspective)


@compiled
def _labels_around(labels: Labels, v: int, u: int, near: Labels) -> int:
    """Write the distinct labels of a 3x3 neighbourhood into `near`, in raster order; returns their number."""
    h, w = labels.shape
    n = 0
    for i in range(max(0, v - 1), min(h, v + 2)):
        for j in range(max(0, u - 1), min(w, u + 2)):
            k = labels[i, j]
            new = k > 0
            for m in range(n):
                if near[m] == k:
                    new = False
            if new and n < near.shape[0]:
                near[n] = k
                n += 1
    return n


@compiled
def misfit_of(
    k: np.int32, kinds: Indices, ths: Array, x: float, y: float, z: float, sigma: float, perspective: bool,
) -> float:  # fmt: skip
    """Return the `misfit` of surface k of a table, with a short cut for planes, which are most frequent."""
    if kinds[k] != PLANE:
        return misfit(kinds[k], ths[k], x, y, z, sigma, perspective)
    p = 1.0 if perspective else 0.0
    facing = p * (ths[k, 0] * x + ths[k, 1] * y) + ths[k, 2]
    if not abs(facing) >= 1e-9:
        return np.inf
    return float(abs(z - (ths[k, 3] - (1.0 - p) * (ths[k, 0] * x + ths[k, 1] * y)) / facing) / sigma)


@compiled
def misfit(kind: int, th: Array, x: float, y: float, z: float, sigma: float, perspective: bool) -> float:
    """Return the absolute residual of depth z at the ray (x, y) in sigmas; infinite if the ray misses the surface.

    Large residuals from curved surfaces are reduced at grazing rays, because half a pixel changes the depth much there.
    """
    zm = depth_on(kind, th, x, y, perspective)
    if not np.isfinite(zm):
        return np.inf
    e = abs(z - zm) / sigma
    if e < ASSIGNMENT_SIGMAS or kind == PLANE or e * EASED >= ASSIGNMENT_SIGMAS:
        return e
    px, py = (x * zm, y * zm) if perspective else (x, y)
    nx, ny, nz = normal_on(kind, th, px, py, zm)
    facing = abs(nx * x + ny * y + nz) / np.sqrt(x * x + y * y + 1.0) if perspective else abs(nz)
    return e * max(EASED, min(1.0, 2.0 * facing))


@compiled
def fill_small_gaps(label: Labels, depth: Array, sweeps: int) -> None:
    """Give each unlabelled valid pixel the label that at least 5 of its 8 neighbours have; `sweeps` times."""
    H, W = label.shape
    words, columns = np.zeros(W // WORD + 1, np.uint64), np.empty(W + 1, np.int32)
    for _ in range(sweeps):
        before = label.copy()
        for v in range(1, H - 1):
            flag_free(before[v], words.view(np.bool_))
            for k in range(flagged(words, columns)):
                if 0 < columns[k] < W - 1 and np.isfinite(depth[v, columns[k]]):
                    label[v, columns[k]] = _agreed(before, v, columns[k])


@compiled
def _agreed(label: Labels, v: int, u: int) -> int:
    """Return the label that at least 5 of the 8 neighbours have; 0 if there is none."""
    for i in range(4):  # a label of five neighbours is among any four
        k = label[v - 1 + i // 3, u - 1 + i % 3]
        if k == 0:
            continue
        n = 0
        for j in range(9):
            n += label[v - 1 + j // 3, u - 1 + j % 3] == k
        if n >= 5:
            return int(k)
    return 0
