"""Rounded edges belong to the faces that they join, as people outline them.

A rounded edge is a surface of its own to a sensor that is fine enough, but nobody calls it one. It is a strip much
narrower than its neighbours, which it continues without a step and without a crease, and it lies close to them: a
quarter circle of radius r leaves two faces by 0.41 r and is 1.57 r wide. Each of its pixels goes to the nearer face.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.range.borders import borders_of, step_and_turn
from perception.range.grid import sigma_at
from perception.range.regions import regions_of
from perception.range.surfaces import PLANE, depth_on, normal_on

Array = NDArray[np.float64]
Labels = NDArray[np.int32]

NARROWER = 0.6  # than the faces beside it
LONG = 22.0  # as `_shapes` says it: three times as long as wide
STEP_SIGMAS = 3.0
TURN_RAD = 1.0  # a surface through a net of rounded edges meets its faces at any angle below a right one
FLAT_TURN_RAD = 0.5
GENTLE_RAD = 0.7
NEAR_SHARE = 0.5  # of the strip's width, that it may lie off its faces
LEAST_SHARE = 0.4  # of the pixels of a strip between faces that do so: nets of edges take thin faces along
WHOLE_SHARE = 0.7  # of those of a strip beside one face
LEAST_BORDER_PX = 6
REACH = 0.025  # of the image's shorter side, over which unlabelled pixels beside a face may curve away from it
LEAST_ROWS = 192  # in smaller images what is beside a face is mixed pixels of an outline, which models are matched by
SLOPE = 0.5  # at which they may do so
SIGMAS = 3.0


def without_fillets(
    depth_m: Array, packed: Array, law: Array, labels: Labels, kinds: NDArray[np.int64], table: Array
) -> Labels:
    """(H, W) labels after rounded edges went to their faces; labels index `kinds` and `table` from 1."""
    half_width, length = _shapes(labels, kinds.shape[0])
    out = labels.copy()
    beside = _strips(packed, law, labels, kinds, table, half_width, length)
    if beside:
        regions = regions_of(depth_m, packed, law, labels, kinds.shape[0] - 1)
        for strip, faces in beside.items():
            mine = regions.indices[regions.starts[strip] : regions.starts[strip + 1]]
            owner = _nearer(depth_m, packed, mine, half_width[strip], np.array(faces), kinds, table)
            if np.mean(owner > 0) >= (LEAST_SHARE if len(faces) > 1 else WHOLE_SHARE):
                out.ravel()[mine] = np.where(owner > 0, owner, strip)
    if min(labels.shape) >= LEAST_ROWS:
        spread_outwards(depth_m, packed, law, out, kinds, table, round(REACH * min(labels.shape)))
    return out


def _strips(
    packed: Array, law: Array, labels: Labels, kinds: NDArray[np.int64], table: Array, half_width: Array, length: Array
) -> dict[int, list[int]]:
    """The faces beside each strip that continues them: two or more, or one that it leaves gently towards an outline."""
    perspective = bool(packed[0] > 0)
    beside: dict[int, list[int]] = {}
    gentle: set[int] = set()
    for (a, b), border in borders_of(labels, packed).items():
        strip, face = (a, b) if half_width[a] < half_width[b] else (b, a)
        is_strip = length[strip] >= LONG and half_width[strip] <= NARROWER * half_width[face]
        if border.length_px < LEAST_BORDER_PX or not is_strip:
            continue
        surfaces = (int(kinds[a]), table[a], int(kinds[b]), table[b])
        step, turn = step_and_turn(*surfaces, border.x, border.y, law, perspective)
        if step <= STEP_SIGMAS and turn <= (FLAT_TURN_RAD if kinds[strip] == PLANE else TURN_RAD):
            beside.setdefault(strip, []).append(face)
            gentle |= {strip} if turn <= GENTLE_RAD else set()
    return {strip: faces for strip, faces in beside.items() if len(faces) > 1 or strip in gentle}


@njit(cache=True, error_model="numpy", nogil=True)
def _shapes(labels, count):  # type: ignore[no-untyped-def]  # numba types it
    """(2, count) of each label: pixels over those at its rim, half the width of a strip; and its rim over that.

    A hole of one pixel, a gross error, has no rim. The latter is 12.6 for a disc, 16 for a square and four times the
    length over the width for a long strip.
    """
    H, W = labels.shape
    pixels, rim = np.zeros(count), np.zeros(count)
    for v in range(H):
        v1, v2, v3, v4 = max(v - 1, 0), max(v - 2, 0), min(v + 1, H - 1), min(v + 2, H - 1)
        for u in range(W):
            k = labels[v, u]
            if k == 0:
                continue
            pixels[k] += 1.0
            if 0 < u < W - 1 and labels[v, u - 1] == labels[v, u + 1] == labels[v1, u] == labels[v3, u] == k:
                continue  # the inside of a region: nearly every pixel
            u1, u2, u3, u4 = max(u - 1, 0), max(u - 2, 0), min(u + 1, W - 1), min(u + 2, W - 1)
            is_rim = (labels[v, u1] != k and labels[v, u2] != k) or (labels[v, u3] != k and labels[v, u4] != k)
            is_rim |= (labels[v1, u] != k and labels[v2, u] != k) or (labels[v3, u] != k and labels[v4, u] != k)
            rim[k] += is_rim
    out = np.zeros((2, count))
    for k in range(count):
        if pixels[k] > 0:
            out[0, k] = pixels[k] / rim[k]
            out[1, k] = rim[k] / out[0, k]
    return out


@njit(cache=True, error_model="numpy")
def _off(kind, th, x, y, z, perspective):  # type: ignore[no-untyped-def]  # numba types it
    """How far a pixel lies off a surface, across the surface, metres; infinite where its ray misses."""
    zm = depth_on(kind, th, x, y, perspective)
    if not np.isfinite(zm):
        return np.inf
    nx, ny, nz = normal_on(kind, th, x * zm if perspective else x, y * zm if perspective else y, zm)
    return abs(z - zm) * (abs(nx * x + ny * y + nz) if perspective else abs(nz))


@njit(cache=True, error_model="numpy", nogil=True)
def _nearer(depth, sen, indices, half_width, faces, kinds, table):  # type: ignore[no-untyped-def]  # numba types it
    """Of each pixel the face that it lies nearest to, 0 where it is farther than the strip allows."""
    W = depth.shape[1]
    perspective = sen[0] > 0
    owner = np.zeros(indices.shape[0], np.int32)
    flat = depth.ravel()
    for k in range(indices.shape[0]):
        i = indices[k]
        x, y, z = (i % W - sen[3]) / sen[1], (i // W - sen[4]) / sen[2], flat[i]
        limit = NEAR_SHARE * 2.0 * half_width / sen[1] * (z if perspective else 1.0)
        for f in faces:
            off = _off(kinds[f], table[f], x, y, z, perspective)
            if off < limit:
                owner[k], limit = f, off
    return owner


@njit(cache=True, error_model="numpy", nogil=True)
def spread_outwards(depth, sen, noise, labels, kinds, table, reach):  # type: ignore[no-untyped-def]  # numba types it
    """Give unlabelled pixels, ring by ring up to `reach`, to the surface beside them that they leave slowly; in place."""
    flat, fd, W = labels.ravel(), depth.ravel(), depth.shape[1]
    ring = _first_ring(labels, fd)
    for sweep in range(1, reach + 1):
        chosen = np.zeros(ring.shape[0], np.int32)
        for k in range(ring.shape[0]):
            chosen[k] = _slowest_left(ring[k], W, fd, sen, noise, flat, kinds, table, SLOPE * sweep / sen[1])
        for k in range(ring.shape[0]):
            # What is refused is not asked again: farther out more would be allowed.
            flat[ring[k]] = chosen[k] if chosen[k] else -1
        ring = _next_ring(ring[chosen > 0], depth.shape, fd, flat)
    for i in range(flat.shape[0]):
        flat[i] = max(flat[i], 0)


@njit(cache=True, nogil=True)
def _first_ring(labels, fd):  # type: ignore[no-untyped-def]  # numba types it
    """Flat indices of the unlabelled pixels with a reading beside labelled ones."""
    H, W = labels.shape
    flat = labels.ravel()
    ring, count = np.empty(1024, np.int32), 0
    for v in range(1, H - 1):
        for i in range(v * W + 1, v * W + W - 1):
            if flat[i] or not np.isfinite(fd[i]) or not flat[i - 1] | flat[i + 1] | flat[i - W] | flat[i + W]:
                continue
            if count == ring.shape[0]:
                ring = np.concatenate((ring, np.empty_like(ring)))
            ring[count] = i
            count += 1
    return ring[:count].copy()


@njit(cache=True, nogil=True)
def _next_ring(ring, shape, fd, flat):  # type: ignore[no-untyped-def]  # numba types it
    """The free pixels with a reading beside those of a ring, marked -1 in `flat` so that each comes once."""
    H, W = shape
    new, count = np.empty(4 * ring.shape[0], np.int32), 0
    for i in ring:
        for step in (-1, 1, -W, W):
            j = i + step
            v, u = j // W, j % W
            if flat[j] == 0 and 0 < v < H - 1 and 0 < u < W - 1 and np.isfinite(fd[j]):
                flat[j] = -1
                new[count] = j
                count += 1
    return new[:count].copy()


@njit(cache=True, error_model="numpy", nogil=True)
def _slowest_left(i, W, fd, sen, noise, flat, kinds, table, slope):  # type: ignore[no-untyped-def]  # numba types it
    """The label beside pixel i whose surface it lies nearest to, 0 where all are farther than noise and `slope` allow."""
    perspective = sen[0] > 0
    x, y, z = (i % W - sen[3]) / sen[1], (i // W - sen[4]) / sen[2], fd[i]
    best, label = SIGMAS * sigma_at(noise, z) + slope * (z if perspective else 1.0), 0
    for step in (-1, 1, -W, W):
        f = flat[i + step]
        if f <= 0 or f == label:
            continue
        off = _off(kinds[f], table[f], x, y, z, perspective)
        if off < best:
            best, label = off, f
    return label
