"""Assignment of rounded edges (fillets) to the faces that they join, as in manual segmentations.

An accurate sensor resolves a rounded edge as a separate surface, but people do not outline it as one. It is a strip much
narrower than its neighbours, which it continues without a step or a crease, and it lies close to them: a quarter circle
of radius r deviates from two faces by at most 0.41 r and is 1.57 r wide. Each of its pixels goes to the nearer face.
"""

from __future__ import annotations

import cv2
import numpy as np

from hal.arrays import Array, Indices, Labels, Mask
from hal.jit import compiled
from perception.range.fitting.surfaces import PLANE, depth_on, normal_on
from perception.range.segmentation.borders import step_and_turn, touching
from perception.range.segmentation.boundary_pixels import WORD, flagged
from perception.range.segmentation.grid import sigma_at
from perception.range.segmentation.regions import Regions, regions_of
from perception.range.segmentation.seams import is_seam_grooved

NARROWER = 0.6  # largest ratio of a strip's width to that of the face beside it
LONG = 22.0  # least elongation as `_shapes` measures it; about three times as long as wide
STEP_SIGMAS = 3.0  # largest step between a strip and a face that it continues
TURN_RAD = 1.0  # a surface fitted to several rounded edges may meet its faces at any angle below a right angle
FLAT_TURN_RAD = 0.5  # a flat strip at a larger angle to its face is a bevel
# Half width, as a ratio of the image's shorter side, below which a strip's own shape is unknown; the step then accepted.
NARROW, NARROW_SIGMAS = 0.004, 4.0
NEAR_SHARE = 0.5  # largest distance of a strip's pixels from a face, as a ratio of the strip's width
LEAST_SHARE = 0.4  # least share of a strip's pixels that are so near; low, because connected edges may hold thin faces
WHOLE_SHARE = 0.7  # the same for a strip beside only one face
LEAST_BORDER_PX = 6
ALONG_SHARE = 0.15  # least share of a strip's rim that borders a face; with less, only its end touches the face
REACH = 0.025  # of the image's shorter side: how far unlabelled pixels beside a face may curve away from it
LEAST_ROWS = 192  # in smaller images the pixels beside a face are mixed pixels of an outline, which matching needs
SLOPE = 0.5  # largest slope of that curve
SIGMAS = 3.0  # allowance for noise in the distance of a pixel from a face
CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


def without_fillets(depth_m: Array, packed: Array, law: Array, labels: Labels, kinds: Indices, table: Array) -> Labels:
    """Assign rounded edges to their faces; returns `labels` (H, W), changed in place.

    Labels index `kinds` and `table` from 1.
    """
    regions = regions_of(depth_m, packed, law, labels, kinds.shape[0] - 1)
    half_width, length = _shapes(labels, regions.sizes)
    for strip, faces in _strips(regions, kinds, table, half_width, length).items():
        mine = regions.places(strip)
        owner = _nearer(depth_m, packed, mine, half_width[strip], np.array(faces), kinds, table)
        share = np.mean(owner > 0)
        if share >= (LEAST_SHARE if len(faces) > 1 else WHOLE_SHARE):
            # If most of a strip is assigned, the rest is no surface; otherwise it is a thin face among the edges.
            labels.ravel()[mine] = np.where(owner > 0, owner, 0 if share >= WHOLE_SHARE else strip)
    if min(labels.shape) >= LEAST_ROWS:
        spread_outwards(depth_m, packed, law, labels, kinds, table, round(REACH * min(labels.shape)))
    return labels


def _strips(regions: Regions, kinds: Indices, table: Array, half_width: Array, length: Array) -> dict[int, list[int]]:
    """Return the faces that each strip continues."""
    if not np.any((length >= LONG) & (half_width <= NARROWER * half_width.max())):
        return {}
    image = (regions.depth_m, regions.packed, regions.law, regions.labels)
    perspective, narrow_px = bool(regions.packed[0] > 0), NARROW * min(regions.labels.shape)
    beside: dict[int, list[int]] = {}
    for pair, border_px, px, py in zip(*touching(regions.labels, regions.packed), strict=True):
        a, b = pair.tolist()
        strip, face = (a, b) if half_width[a] < half_width[b] else (b, a)
        is_strip = length[strip] >= LONG and half_width[strip] <= NARROWER * half_width[face]
        if not is_strip or border_px < max(LEAST_BORDER_PX, ALONG_SHARE * length[strip] * half_width[strip]):
            continue
        x, y = px[:border_px], py[:border_px]
        step, turn = step_and_turn(kinds[a], table[a], kinds[b], table[b], x, y, regions.law, perspective)
        if not _goes_on(step, turn, is_flat=kinds[strip] == PLANE, is_narrow=half_width[strip] < narrow_px):
            continue
        both = np.isin(np.arange(kinds.shape[0]), pair)
        if kinds[face] == PLANE and is_seam_grooved(*image, both, table[face], x, y):
            continue
        beside.setdefault(strip, []).append(face)
    return beside


def _goes_on(step: float, turn: float, *, is_flat: bool, is_narrow: bool) -> bool:
    """Return whether a strip continues a face; `step` between them in sigmas, `turn` in radians."""
    if is_narrow:
        return step <= NARROW_SIGMAS and turn <= TURN_RAD
    return step <= STEP_SIGMAS and turn <= (FLAT_TURN_RAD if is_flat else TURN_RAD)


def _shapes(labels: Labels, pixels: Indices) -> tuple[Array, Array]:
    """Return half width and elongation (N,) of each label; `pixels` (N,) are their numbers of pixels.

    The half width of a strip is its number of pixels divided by the number of pixels on its rim. The elongation is the
    rim divided by the half width: 12.6 for a disc, 16 for a square, and four times length / width for a long strip. A
    hole of one pixel (a gross error) does not count as rim.
    """
    wide = np.asarray(cv2.copyMakeBorder(labels, 2, 2, 2, 2, cv2.BORDER_REPLICATE), np.int32)
    rim = np.maximum(_rims(wide, pixels.shape[0]), 1)
    half_width = np.where(pixels > 0, pixels / rim, 0.0)
    return half_width, np.where(pixels > 0, rim / np.maximum(half_width, 1e-9), 0.0)


@compiled
def _rims(wide: Labels, count: int) -> Indices:
    """Count the pixels on the rim of each label (count,); `wide` are the labels with a margin of two pixels."""
    rim, W = np.zeros(count, np.int64), wide.shape[1] - 4
    words, columns = np.zeros(W // WORD + 1, np.uint64), np.empty(W + 1, np.int32)
    for v in range(2, wide.shape[0] - 2):
        _flag_rim(wide[v - 2], wide[v - 1], wide[v], wide[v + 1], wide[v + 2], words.view(np.bool_))
        for i in range(flagged(words, columns)):
            rim[wide[v, columns[i] + 2]] += 1
    return rim


@compiled
def _flag_rim(above_2: Labels, above: Labels, own: Labels, below: Labels, below_2: Labels, flags: Mask) -> None:
    """Flag labelled pixels with two successive pixels of another label on one of four sides."""
    for u in range(own.shape[0] - 4):
        k = own[u + 2]
        is_top, is_bottom = (above[u + 2] != k) & (above_2[u + 2] != k), (below[u + 2] != k) & (below_2[u + 2] != k)
        is_left, is_right = (own[u + 1] != k) & (own[u] != k), (own[u + 3] != k) & (own[u + 4] != k)
        flags[u] = (k > 0) & (is_top | is_bottom | is_left | is_right)


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


def spread_outwards(
    depth: Array, sen: Array, noise: Array, labels: Labels, kinds: Indices, table: Array, reach: int
) -> None:
    """Assign unlabelled pixels beside a surface that curve slowly away from it, ring by ring up to `reach`; in place."""
    known = (labels > 0).view(np.uint8)
    beside = cv2.dilate(known, CROSS) > known
    beside[[0, -1]] = beside[:, [0, -1]] = False
    first = np.flatnonzero(beside).astype(np.int32)
    first = first[np.isfinite(depth.ravel()[first])]
    _spread(depth, sen, noise, labels, kinds, table, reach, first)


@compiled
def _spread(
    depth: Array, sen: Array, noise: Array, labels: Labels, kinds: Indices, table: Array, reach: int, ring: Labels,
) -> None:  # fmt: skip
    """Compute `spread_outwards` from the flat indices of the first ring."""
    flat, fd, W = labels.ravel(), depth.ravel(), depth.shape[1]
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
