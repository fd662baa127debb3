"""Assignment of rounded edges (fillets) to the faces that they join, as in manual segmentations.

An accurate sensor resolves a rounded edge as a separate surface, but people do not outline it as one. It is a strip much
narrower than its neighbours, which it continues without a step or a crease, and it lies close to them: a quarter circle
of radius r deviates from two faces by at most 0.41 r and is 1.57 r wide. Each of its pixels goes to the nearer face.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Indices, Mask
from hal.jit import compiled
from perception.range.fitting.surfaces import PLANE, depth_on, normal_on
from perception.range.segmentation.borders import step_and_turn, touching
from perception.range.segmentation.boundary_pixels import WORD, flagged
from perception.range.segmentation.grid import sigma_at
from perception.range.segmentation.regions import regions_of
from perception.range.segmentation.run_length import pixels_of
from perception.range.segmentation.seams import is_seam_grooved

Labels = NDArray[np.int32]

NARROWER = 0.6  # largest ratio of a strip's width to that of the face beside it
LONG = 22.0  # least elongation as `_shapes` measures it; about three times as long as wide
STEP_SIGMAS = 3.0  # largest step between a strip and a face that it continues
TURN_RAD = 1.0  # a surface fitted to several rounded edges may meet its faces at any angle below a right angle
FLAT_TURN_RAD = 0.5  # a flat strip at a larger angle to its face is a bevel
# Half width, as a ratio of the image's shorter side, below which a strip's own shape is unknown; the step then accepted.
NARROW, NARROW_SIGMAS = 0.004, 4.0
GENTLE_RAD = 0.7  # a strip that touches only one face must meet it at a smaller angle
NEAR_SHARE = 0.5  # largest distance of a strip's pixels from a face, as a ratio of the strip's width
LEAST_SHARE = 0.4  # least share of a strip's pixels that are so near; low, because connected edges may hold thin faces
WHOLE_SHARE = 0.7  # the same for a strip beside only one face
LEAST_BORDER_PX = 6
ALONG_SHARE = 0.15  # least share of a strip's rim that borders a face; with less, only its end touches the face
REACH = 0.025  # of the image's shorter side: how far unlabelled pixels beside a face may curve away from it
LEAST_ROWS = 192  # in smaller images the pixels beside a face are mixed pixels of an outline, which matching needs
SLOPE = 0.5  # largest slope of that curve
SIGMAS = 3.0  # allowance for noise in the distance of a pixel from a face


def without_fillets(
    depth_m: Array, packed: Array, law: Array, labels: Labels, kinds: NDArray[np.int64], table: Array
) -> Labels:
    """Assign rounded edges to their faces; returns `labels` (H, W), changed in place.

    Labels index `kinds` and `table` from 1.
    """
    half_width, length = _shapes(labels, kinds.shape[0])
    beside = _strips(depth_m, packed, law, labels, kinds, table, half_width, length)
    if beside:
        regions = regions_of(depth_m, packed, law, labels, kinds.shape[0] - 1)
        for strip, faces in beside.items():
            mine = regions.places(strip)
            owner = _nearer(depth_m, packed, mine, half_width[strip], np.array(faces), kinds, table)
            share = np.mean(owner > 0)
            if share >= (LEAST_SHARE if len(faces) > 1 else WHOLE_SHARE):
                # If most of a strip is assigned, the rest is no surface; otherwise it is a thin face among the edges.
                labels.ravel()[mine] = np.where(owner > 0, owner, 0 if share >= WHOLE_SHARE else strip)
    if min(labels.shape) >= LEAST_ROWS:
        spread_outwards(depth_m, packed, law, labels, kinds, table, round(REACH * min(labels.shape)))
    return labels


def _strips(
    depth_m: Array,
    packed: Array,
    law: Array,
    labels: Labels,
    kinds: NDArray[np.int64],
    table: Array,
    half_width: Array,
    length: Array,
) -> dict[int, list[int]]:
    """Return the faces that each strip continues: two or more, or one with a gentle transition at an outline."""
    if not np.any((length >= LONG) & (half_width <= NARROWER * half_width.max())):
        return {}
    pairs, lengths, x, y = touching(labels, packed)
    goes_on, is_gentle = _continuations(
        depth_m, packed, law, labels, kinds, table, half_width, length, pairs, lengths, x, y
    )
    beside: dict[int, list[int]] = {}
    for p in np.lexsort((pairs[:, 1], pairs[:, 0])).tolist():
        if goes_on[p]:
            a, b = pairs[p].tolist()
            strip, face = (a, b) if half_width[a] < half_width[b] else (b, a)
            beside.setdefault(strip, []).append(face)
    return {strip: faces for strip, faces in beside.items() if len(faces) > 1 or is_gentle[strip]}


@compiled
def _continuations(
    depth: Array, sen: Array, noise: Array, labels: Labels, kinds: Indices, table: Array, half_width: Array,
    length: Array, pairs: Labels, lengths: Indices, x: Array, y: Array,
) -> tuple[Mask, Mask]:  # fmt: skip
    """Return for each touching pair whether the narrower label is a strip that continues the wider one.

    Also returns which labels are gentle strips: they meet a face at less than `GENTLE_RAD`.
    """
    narrow_px = NARROW * min(labels.shape[0], labels.shape[1])
    out, is_gentle = np.zeros(pairs.shape[0], np.bool_), np.zeros(kinds.shape[0], np.bool_)
    for p in range(pairs.shape[0]):
        a, b = pairs[p]
        strip, face = (a, b) if half_width[a] < half_width[b] else (b, a)
        is_strip = length[strip] >= LONG and half_width[strip] <= NARROWER * half_width[face]
        if not is_strip or lengths[p] < max(LEAST_BORDER_PX, ALONG_SHARE * length[strip] * half_width[strip]):
            continue
        count = min(lengths[p], x.shape[1])
        step, turn = step_and_turn(
            kinds[a], table[a], kinds[b], table[b], x[p, :count], y[p, :count], noise, sen[0] > 0
        )
        if not _goes_on(step, turn, kinds[strip] == PLANE, half_width[strip] < narrow_px):
            continue
        if kinds[face] == PLANE:
            both = np.zeros(kinds.shape[0], np.bool_)
            both[strip] = both[face] = True
            if is_seam_grooved(depth, sen, noise, labels, both, table[face], x[p, :count], y[p, :count]):
                continue
        out[p] = True
        is_gentle[strip] |= turn <= GENTLE_RAD
    return out, is_gentle


@compiled
def _goes_on(step: float, turn: float, is_flat: bool, is_narrow: bool) -> bool:
    """Return whether a strip continues a face; `step` between them in sigmas, `turn` in radians."""
    if is_narrow:
        return step <= NARROW_SIGMAS and turn <= TURN_RAD
    return step <= STEP_SIGMAS and turn <= (FLAT_TURN_RAD if is_flat else TURN_RAD)


@compiled
def _shapes(labels: Labels, count: int) -> Array:
    """Return half width and elongation (2, count) of each label.

    The half width of a strip is its number of pixels divided by the number of pixels on its rim. The elongation is the
    rim divided by the half width: 12.6 for a disc, 16 for a square, and four times length / width for a long strip. A
    hole of one pixel (a gross error) does not count as rim.
    """
    H, W = labels.shape
    pixels, rim = pixels_of(labels, count - 1), np.zeros(count)
    words, columns = np.zeros(W // WORD + 1, np.uint64), np.empty(W + 1, np.int32)
    for v in range(H):
        above, below = labels[max(v - 1, 0)], labels[min(v + 1, H - 1)]
        _flag_rims(labels[max(v - 2, 0)], above, labels[v], below, labels[min(v + 2, H - 1)], words.view(np.bool_))
        _flag_sides(labels[v], words.view(np.bool_))
        for i in range(flagged(words, columns)):
            rim[labels[v, columns[i]]] += 1.0
    out = np.zeros((2, count))
    for k in range(1, count):
        if pixels[k] > 0:
            out[0, k] = pixels[k] / rim[k]
            out[1, k] = rim[k] / out[0, k]
    return out


@compiled
def _flag_rims(above_2: Labels, above: Labels, own: Labels, below: Labels, below_2: Labels, flags: Mask) -> None:
    """Flag labelled pixels with two successive pixels of another label above or below."""
    for u in range(own.shape[0]):
        k = own[u]
        is_top, is_bottom = (above[u] != k) & (above_2[u] != k), (below[u] != k) & (below_2[u] != k)
        flags[u] = (k > 0) & (is_top | is_bottom)


@compiled
def _flag_sides(own: Labels, flags: Mask) -> None:
    """Flag also the labelled pixels with two successive pixels of another label to the left or right.

    Beyond either end of the row its last pixel counts as repeated.
    """
    last = own.shape[0] - 1
    for u in range(last - 3):
        k = own[u + 2]
        is_left, is_right = (own[u + 1] != k) & (own[u] != k), (own[u + 3] != k) & (own[u + 4] != k)
        flags[u + 2] |= (k > 0) & (is_left | is_right)
    for u in (0, 1, last - 1, last):
        k = own[u]
        is_left = (own[max(u - 1, 0)] != k) & (own[max(u - 2, 0)] != k)
        is_right = (own[min(u + 1, last)] != k) & (own[min(u + 2, last)] != k)
        flags[u] |= (k > 0) & (is_left | is_right)


@compiled
def _off(kind: int, th: Array, x: float, y: float, z: float, perspective: bool) -> float:
    """Return the distance in metres of a pixel from a surface, along the normal; infinite if its ray misses."""
    zm = depth_on(kind, th, x, y, perspective)
    if not np.isfinite(zm):
        return np.inf
    nx, ny, nz = normal_on(kind, th, x * zm if perspective else x, y * zm if perspective else y, zm)
    return abs(z - zm) * (abs(nx * x + ny * y + nz) if perspective else abs(nz))


@compiled
def _nearer(
    depth: Array, sen: Array, indices: Labels, half_width: float, faces: Indices, kinds: Indices, table: Array,
) -> Labels:  # fmt: skip
    """Return the label of the nearest face for each pixel of a strip; 0 if even that is farther than `NEAR_SHARE` allows.

    `indices` (N,): the strip's flat pixel indices. `half_width` is in pixels; `faces` are labels.
    """
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


@compiled
def spread_outwards(
    depth: Array, sen: Array, noise: Array, labels: Labels, kinds: Indices, table: Array, reach: int,
) -> None:  # fmt: skip
    """Assign unlabelled pixels beside a surface that curve slowly away from it, ring by ring up to `reach`; in place."""
    flat, fd, W = labels.ravel(), depth.ravel(), depth.shape[1]
    ring = _first_ring(labels, depth)
    for sweep in range(1, reach + 1):
        chosen = np.zeros(ring.shape[0], np.int32)
        for k in range(ring.shape[0]):
            chosen[k] = _slowest_left(ring[k], W, fd, sen, noise, flat, kinds, table, SLOPE * sweep / sen[1])
        for k in range(ring.shape[0]):
            # A rejected pixel is marked, because the limit grows with the distance and would accept it later.
            flat[ring[k]] = chosen[k] if chosen[k] else -1
        ring = _next_ring(ring[chosen > 0], depth.shape, fd, flat)
    for i in range(flat.shape[0]):
        flat[i] = max(flat[i], 0)


@compiled
def _first_ring(labels: Labels, depth: Array) -> Labels:
    """Return the flat indices of the unlabelled pixels with a reading beside labelled ones."""
    H, W = labels.shape
    words, columns = np.zeros(W // WORD + 1, np.uint64), np.empty(W + 1, np.int32)
    ring, count = np.empty(4 * W, np.int32), 0
    for v in range(1, H - 1):
        if count + W > ring.shape[0]:
            ring = np.concatenate((ring, ring))
        _flag_outlines(labels[v - 1], labels[v], labels[v + 1], words.view(np.bool_))
        for i in range(flagged(words, columns)):
            if np.isfinite(depth[v, columns[i]]):
                ring[count] = v * W + columns[i]
                count += 1
    return ring[:count].copy()


@compiled
def _flag_outlines(above: Labels, own: Labels, below: Labels, flags: Mask) -> None:
    """Flag unlabelled pixels beside labelled ones, except at the ends of the row."""
    for u in range(1, own.shape[0] - 1):
        flags[u] = (own[u] == 0) & ((own[u - 1] | own[u + 1] | above[u] | below[u]) != 0)


@compiled
def _next_ring(ring: Labels, shape: tuple[int, int], fd: Array, flat: Labels) -> Labels:
    """Return the unlabelled pixels with a reading beside those of a ring; marks them -1 in `flat`, so that none occurs twice."""
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


@compiled
def _slowest_left(
    i: int, W: int, fd: Array, sen: Array, noise: Array, flat: Labels, kinds: Indices, table: Array, slope: float,
) -> int:  # fmt: skip
    """Return the nearest of the surfaces that own a pixel beside pixel i; 0 if all are farther than noise and `slope` allow.

    `slope`: distance allowed in addition to noise, metres (per metre of depth, if perspective).
    """
    perspective = sen[0] > 0
    x, y, z = (i % W - sen[3]) / sen[1], (i // W - sen[4]) / sen[2], fd[i]
    best, label = SIGMAS * sigma_at(noise, z) + slope * (z if perspective else 1.0), 0
    last = 0
    for step in (-1, 1, -W, W):
        f = flat[i + step]
        if f <= 0 or f == label or f == last:  # noqa: PLR1714, SIM109 - numba knows no `in` of mixed integers
            continue
        last = f
        off = _off(kinds[f], table[f], x, y, z, perspective)
        if off < best:
            best, label = off, f
    return label
