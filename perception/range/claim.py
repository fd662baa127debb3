"""From blocks back to pixels: every pixel goes to the neighbouring surface that explains its depth best."""

# ruff: noqa: PLR0912 - compiled loops take plain arrays, and long
# bodies and plain comparisons are what compiles fast.
from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.grid import sigma_at
from perception.range.surfaces import depth_on, normal_on

CLAIM_SIGMAS = 3.5
MAX_CANDIDATES = 8


@njit(cache=True, nogil=True)
def claim_pixels(depth, sen, noise, blocks, size, kinds, ths, out, top, bottom):  # type: ignore[no-untyped-def]
    """Label each pixel of `depth` (H, W) with the best surface among those of the 3x3 blocks around it.

    Writes the rows of blocks [top, bottom) of `out` (H, W) int32: label, or 0 beyond `CLAIM_SIGMAS`. Labels index
    `kinds` and `ths` from 1.
    """
    H, W = depth.shape
    h, w = blocks.shape
    perspective = sen[0] > 0
    near = np.empty(MAX_CANDIDATES, np.int32)
    for r in range(top, bottom):
        for c in range(w):
            n = 0
            for i in range(max(0, r - 1), min(h, r + 2)):
                for j in range(max(0, c - 1), min(w, c + 2)):
                    k = blocks[i, j]
                    if k == 0:
                        continue
                    new = True
                    for m in range(n):
                        if near[m] == k:
                            new = False
                    if new and n < MAX_CANDIDATES:
                        near[n] = k
                        n += 1
            for v in range(r * size, min(r * size + size, H)):
                y = (v - sen[4]) / sen[2]
                for u in range(c * size, min(c * size + size, W)):
                    out[v, u] = 0
                    z = depth[v, u]
                    if n == 0 or not np.isfinite(z):
                        continue
                    x = (u - sen[3]) / sen[1]
                    best, label = CLAIM_SIGMAS, 0
                    sigma = sigma_at(noise, z)
                    for m in range(n):
                        e = misfit(kinds[near[m]], ths[near[m]], x, y, z, sigma, perspective)
                        if e < best:
                            best, label = e, near[m]
                    out[v, u] = label


@njit(cache=True, nogil=True)
def claim_borders(depth, sen, noise, labels, kinds, ths, out, top, bottom):  # type: ignore[no-untyped-def]
    """Judge again each pixel whose 3x3 neighbourhood holds another label; regions gain or lose at most one pixel.

    Reads `labels` (H, W), writes rows [top, bottom) of `out` (H, W). The outermost pixels keep their labels.
    """
    H, W = depth.shape
    perspective = sen[0] > 0
    near = np.empty(9, np.int32)
    out[top:bottom] = labels[top:bottom]
    for v in range(max(1, top), min(H - 1, bottom)):
        y = (v - sen[4]) / sen[2]
        for u in range(1, W - 1):
            own = labels[v, u]
            if (
                labels[v, u - 1] == own
                and labels[v, u + 1] == own
                and labels[v - 1, u] == own
                and labels[v + 1, u] == own
                and labels[v - 1, u - 1] == own
                and labels[v - 1, u + 1] == own
                and labels[v + 1, u - 1] == own
                and labels[v + 1, u + 1] == own
            ):
                continue
            z = depth[v, u]
            if not np.isfinite(z):
                continue
            n = 0
            for i in range(9):
                k = labels[v - 1 + i // 3, u - 1 + i % 3]
                new = k > 0
                for m in range(n):
                    if near[m] == k:
                        new = False
                if new:
                    near[n] = k
                    n += 1
            x = (u - sen[3]) / sen[1]
            best, label = CLAIM_SIGMAS, 0
            sigma = sigma_at(noise, z)
            for m in range(n):
                e = misfit(kinds[near[m]], ths[near[m]], x, y, z, sigma, perspective)
                if e < best:
                    best, label = e, near[m]
            out[v, u] = label


@njit(cache=True)
def misfit(kind, th, x, y, z, sigma, perspective):  # type: ignore[no-untyped-def]
    """|z - surface| in sigmas, eased at grazing rays where half a pixel moves the depth far; infinite on a miss."""
    zm = depth_on(kind, th, x, y, perspective)
    if not np.isfinite(zm):
        return np.inf
    e = abs(z - zm) / sigma
    if e < CLAIM_SIGMAS or kind == 0:
        return e
    px, py = (x * zm, y * zm) if perspective else (x, y)
    nx, ny, nz = normal_on(kind, th, px, py, zm)
    facing = abs(nx * x + ny * y + nz) / np.sqrt(x * x + y * y + 1.0) if perspective else abs(nz)
    return e * min(1.0, max(facing, 0.2) / 0.5)


@njit(cache=True)
def fill_small_gaps(label, depth, sweeps):  # type: ignore[no-untyped-def]
    """Give each unlabelled valid pixel the label that at least 5 of its 8 neighbours agree on; `sweeps` times."""
    H, W = label.shape
    for _ in range(sweeps):
        before = label.copy()
        for v in range(1, H - 1):
            for u in range(1, W - 1):
                if before[v, u] or not np.isfinite(depth[v, u]):
                    continue
                for i in range(9):
                    k = before[v - 1 + i // 3, u - 1 + i % 3]
                    if k == 0:
                        continue
                    n = 0
                    for j in range(9):
                        if before[v - 1 + j // 3, u - 1 + j % 3] == k:
                            n += 1
                    if n >= 5:
                        label[v, u] = k
                        break


@njit(cache=True)
def bucket(label, count):  # type: ignore[no-untyped-def]
    """Flat pixel indices grouped by label: label k owns indices[starts[k] : starts[k + 1]]; starts is (count + 2,)."""
    flat = label.ravel()
    starts = np.zeros(count + 2, np.int64)
    for i in range(flat.shape[0]):
        starts[flat[i] + 1] += 1
    for k in range(count + 1):
        starts[k + 1] += starts[k]
    place = starts.copy()
    indices = np.empty(flat.shape[0], np.int32)
    for i in range(flat.shape[0]):
        k = flat[i]
        indices[place[k]] = i
        place[k] += 1
    return starts, indices


@njit(cache=True)
def gather(depth, sen, noise, indices, x, y, z, sigma):  # type: ignore[no-untyped-def]
    """Fill ray coordinates, depth and sigma of the pixels `indices` (flat) into the given (N,) arrays."""
    W = depth.shape[1]
    flat = depth.ravel()
    for k in range(indices.shape[0]):
        i = indices[k]
        x[k] = (i % W - sen[3]) / sen[1]
        y[k] = (i // W - sen[4]) / sen[2]
        z[k] = flat[i]
        sigma[k] = sigma_at(noise, flat[i])
