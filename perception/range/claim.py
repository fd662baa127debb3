"""From blocks back to pixels: every pixel goes to the neighbouring surface that explains its depth best."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.grid import sigma_at
from perception.range.rays import LOOSE
from perception.range.surfaces import LEAN, PLANE, depth_on, normal_on

CLAIM_SIGMAS = 3.5
PLAIN_SIGMAS = 1.0  # a pixel that its own block's surface explains so well is not offered to the others
MAX_CANDIDATES = 8
NO_LABEL = np.int32(2**31 - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def claim_pixels(depth, sen, noise, blocks, size, kinds, ths, out, top, bottom):  # type: ignore[no-untyped-def]  # numba types it
    """Label each pixel of `depth` (H, W) with the best surface among those of the 3x3 blocks around it.

    Writes the rows of blocks [top, bottom) of `out` (H, W) int32: label, or 0 beyond `CLAIM_SIGMAS`. Labels index
    `kinds` and `ths` from 1.
    """
    H, W = depth.shape
    w = blocks.shape[1]
    perspective = sen[0] > 0
    only = np.empty(w, np.int32)
    for r in range(top, bottom):
        _only_labels(blocks, r, only)
        last = min(r * size + size, H)
        c = 0
        while c < w:
            k, start = only[c], c
            c += 1
            if k < 0:
                _claim_block(depth, sen, noise, blocks, size, kinds, ths, out, r, start)
                continue
            while c < w and only[c] == k:
                c += 1
            first, end = start * size, min(c * size, W)
            for v in range(r * size, last):
                if k == 0:
                    out[v, first:end] = 0
                elif kinds[k] == PLANE:
                    _claim_run(depth[v, first:end], ths[k], k, first, v, sen, noise, perspective, out[v, first:end])
                else:
                    y = (v - sen[4]) / sen[2]
                    for u in range(first, end):
                        z = depth[v, u]
                        x = (u - sen[3]) / sen[1]
                        mine = misfit_of(k, kinds, ths, x, y, z, sigma_at(noise, z), perspective) < CLAIM_SIGMAS
                        out[v, u] = k if mine else 0


@njit(cache=True, error_model="numpy", **LEAN)
def _only_labels(blocks, r, only):  # type: ignore[no-untyped-def]  # numba types it
    """The one label that the 3x3 blocks around each block of row r hold, 0 where they hold none, -1 where several."""
    h, w = blocks.shape
    above, here, below = blocks[max(r - 1, 0)], blocks[r], blocks[min(r + 1, h - 1)]
    for c in range(w):
        left, right = max(c - 1, 0), min(c + 1, w - 1)
        most = max(above[left], above[c], above[right], here[left], here[c], here[right])
        most = max(most, below[left], below[c], below[right])
        same = True
        for j in (left, c, right):
            same &= above[j] == most or above[j] == 0
            same &= here[j] == most or here[j] == 0
            same &= below[j] == most or below[j] == 0
        only[c] = most if same else -1


@njit(cache=True, error_model="numpy", fastmath=LOOSE, **LEAN)
def _claim_run(depth, th, label, first, v, sen, noise, perspective, out):  # type: ignore[no-untyped-def]  # numba types it
    """Pixels first, first + 1, ... of row v that a plane explains: their squared misfit, without branch or root."""
    p = 1.0 if perspective else 0.0
    y = (v - sen[4]) / sen[2]
    per_x = 1.0 / sen[1]
    dy = p * y
    at = th[3] - th[1] * (y - dy)
    along = th[1] * dy + th[2]
    limit = CLAIM_SIGMAS * CLAIM_SIGMAS
    for i in range(out.shape[0]):
        x = (first + i - sen[3]) * per_x
        dx = p * x
        z = depth[i]
        e = z - (at - th[0] * (x - dx)) / (th[0] * dx + along)
        z2 = z * z
        white, slow, step = noise[0] + noise[1] * z2, noise[2] + noise[3] * z2, noise[4] + noise[5] * z2
        variance = max(white * white, step * step * (1.0 / 12.0)) + slow * slow
        out[i] = label if e * e < limit * variance else 0


@njit(cache=True, error_model="numpy")
def _claim_block(depth, sen, noise, blocks, size, kinds, ths, out, r, c):  # type: ignore[no-untyped-def]  # numba types it
    """The pixels of one block among whose neighbours several surfaces compete."""
    H, W = depth.shape
    h, w = blocks.shape
    perspective = sen[0] > 0
    near = np.empty(MAX_CANDIDATES, np.int32)
    n = 0
    for i in range(max(0, r - 1), min(h, r + 2)):
        for j in range(max(0, c - 1), min(w, c + 2)):
            k = blocks[i, j]
            new = k > 0
            for m in range(n):
                if near[m] == k:
                    new = False
            if new and n < MAX_CANDIDATES:
                near[n] = k
                n += 1
    for v in range(r * size, min(r * size + size, H)):
        y = (v - sen[4]) / sen[2]
        for u in range(c * size, min(c * size + size, W)):
            x = (u - sen[3]) / sen[1]
            out[v, u] = _best_of(depth[v, u], x, y, noise, blocks[r, c], near, n, kinds, ths, perspective)


@njit(cache=True, error_model="numpy", **LEAN)
def _best_of(z, x, y, noise, own, near, n, kinds, ths, perspective):  # type: ignore[no-untyped-def]  # numba types it
    """The label among near[:n] whose surface explains the depth best, 0 when none does within `CLAIM_SIGMAS`.

    `own` > 0 is taken without a look at the others when it explains the depth within `PLAIN_SIGMAS`.
    """
    best, label = CLAIM_SIGMAS, 0
    if not np.isfinite(z):
        return label
    sigma = sigma_at(noise, z)
    if own > 0:
        best = min(best, misfit_of(own, kinds, ths, x, y, z, sigma, perspective))
        if best < CLAIM_SIGMAS:
            label = own
        if best < PLAIN_SIGMAS:
            return label
    for m in range(n):
        if near[m] == own:
            continue
        e = misfit_of(near[m], kinds, ths, x, y, z, sigma, perspective)
        if e < best:
            best, label = e, near[m]
    return label


@njit(cache=True, error_model="numpy", **LEAN)
def add_row(labels, least, most):  # type: ignore[no-untyped-def]  # numba types it
    """One more row of a neighbourhood: the least label that is none of 0, and the largest, of each column."""
    for u in range(labels.shape[0]):
        k = labels[u]
        least[u] = min(least[u], k if k > 0 else NO_LABEL)
        most[u] = max(most[u], k)


@njit(cache=True, error_model="numpy", **LEAN)
def contested(own, least, most, out):  # type: ignore[no-untyped-def]  # numba types it
    """Where the three columns around hold another surface than the pixel's own.

    `least` and `most` are (W + 2,), with a column of no surface before the first and after the last.
    """
    for u in range(own.shape[0]):
        low = min(least[u], least[u + 1], least[u + 2])
        high = max(most[u], most[u + 1], most[u + 2])
        out[u] = (high != own[u]) | ((own[u] > 0) & (low != own[u]))


@njit(cache=True, nogil=True, error_model="numpy")
def claim_borders(depth, sen, noise, labels, newest, kinds, ths, out, top, bottom):  # type: ignore[no-untyped-def]  # numba types it
    """Judge again each pixel whose 3x3 neighbourhood holds another surface, and one of label `newest` or later.

    Reads `labels` (H, W), writes rows [top, bottom) of `out` (H, W). Where earlier surfaces meet they have competed for
    every pixel already (`claim_pixels`).
    """
    H, W = depth.shape
    perspective = sen[0] > 0
    near, judged = np.empty(9, np.int32), np.empty(W, np.bool_)
    least, most = np.empty(W + 2, np.int32), np.empty(W + 2, np.int32)
    out[top:bottom] = labels[top:bottom]
    for v in range(top, bottom):
        first, last = max(v - 1, 0), min(v + 2, H)
        least[:], most[:] = NO_LABEL, 0
        for i in range(first, last):
            add_row(labels[i], least[1:-1], most[1:-1])
        if most.max() < newest:
            continue
        contested(labels[v], least, most, judged)
        y = (v - sen[4]) / sen[2]
        for u in range(W):
            if not judged[u] or max(most[u], most[u + 1], most[u + 2]) < newest:
                continue
            n = 0
            for i in range(first, last):
                for j in range(max(u - 1, 0), min(u + 2, W)):
                    k = labels[i, j]
                    new = k > 0
                    for m in range(n):
                        if near[m] == k:
                            new = False
                    if new:
                        near[n] = k
                        n += 1
            out[v, u] = _best_of(depth[v, u], (u - sen[3]) / sen[1], y, noise, 0, near, n, kinds, ths, perspective)


@njit(cache=True, error_model="numpy", **LEAN)
def misfit_of(k, kinds, ths, x, y, z, sigma, perspective):  # type: ignore[no-untyped-def]  # numba types it
    """`misfit` of surface k of a table: planes, which most are, in a line."""
    if kinds[k] != PLANE:
        return misfit(kinds[k], ths[k], x, y, z, sigma, perspective)
    p = 1.0 if perspective else 0.0
    facing = p * (ths[k, 0] * x + ths[k, 1] * y) + ths[k, 2]
    if not abs(facing) >= 1e-9:
        return np.inf
    return abs(z - (ths[k, 3] - (1.0 - p) * (ths[k, 0] * x + ths[k, 1] * y)) / facing) / sigma


@njit(cache=True, error_model="numpy", **LEAN)
def misfit(kind, th, x, y, z, sigma, perspective):  # type: ignore[no-untyped-def]  # numba types it
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


@njit(cache=True, error_model="numpy")
def fill_small_gaps(label, depth, sweeps):  # type: ignore[no-untyped-def]  # numba types it
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
def pixels_of(label, count):  # type: ignore[no-untyped-def]  # numba types it
    """How many pixels each of the labels 1 to `count` has, (count,)."""
    flat = label.ravel()
    sizes = np.zeros(count + 1, np.int64)
    for i in range(flat.shape[0]):
        sizes[flat[i]] += 1
    return sizes[1:]


@njit(cache=True)
def bucket(label, count):  # type: ignore[no-untyped-def]  # numba types it
    """Flat pixel indices grouped by label: label k owns indices[starts[k] : starts[k + 1]]; starts is (count + 2,).

    Label 0 owns nothing: unlabelled pixels are left out.
    """
    flat = label.ravel()
    n = flat.shape[0]
    starts = np.zeros(count + 2, np.int64)
    # Neighbours mostly share their label: sums wait until it changes.
    own, first = np.int64(0), 0
    for i in range(n):
        if flat[i] != own:
            starts[own + 1] += i - first
            own, first = np.int64(flat[i]), i
    starts[own + 1] += n - first
    starts[1] = 0
    for k in range(count + 1):
        starts[k + 1] += starts[k]
    place = starts.copy()
    indices = np.empty(starts[count + 1], np.int32)
    own, at = np.int64(0), 0
    for i in range(n):
        if flat[i] != own:
            place[own] = at
            own = np.int64(flat[i])
            at = place[own]
        if own > 0:
            indices[at] = i
            at += 1
    return starts, indices
