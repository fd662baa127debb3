"""Joining pieces of one surface that are separated by an object in front of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.arrays import Array, Indices, Labels, Mask
from hal.jit import as_numpy_scalar, compiled
from perception.range.fitting.equations import TRIM_SIGMAS
from perception.range.fitting.fit import fit_robust
from perception.range.fitting.surfaces import PLANE, depth_on
from perception.range.segmentation import bend
from perception.range.segmentation.grid import slow_share_at
from perception.range.segmentation.regions import Regions
from perception.range.segmentation.seams import crosses_groove, is_grooved_at

PAIR_SAMPLES = 150
ROUGH_ROUNDS, ROUNDS = as_numpy_scalar(1), as_numpy_scalar(3)  # of robust weights
JOINED_SHARE = 0.85  # least share of each piece's samples that lie near the joint surface
JOINED_MEAN_SQUARE = 1.6  # squared sigmas; largest mean square of each piece about the joint surface
ROUGH_STRIDE = 5  # the first fit uses every fifth sample
ROUGH_SHARE = 0.7  # least share of the samples near the first fit; with less, no fit to all samples is made
NEAR_SAMPLES = 16  # samples, or all of a smaller piece, that decide whether a surface passes near a piece
LEAST_NEAR = 4  # samples needed for that decision
NEAR_SIGMAS = 20.0
SCRAP_SHARE = 0.1  # largest size of a fragment, relative to the surface that it belongs to
SCRAP_SIGMAS = 6.0
LARGEST_TURN_RAD = 0.2  # between the planes of two pieces of one plane
SIGHT_LINES = 5  # shortest lines between two pieces along which a gap is looked for
GAP_SIGMAS = 6.0
TOUCHING_PX = 8  # pieces that are closer than this count as touching
GROOVE_PX = 2  # a single pixel may be a gross error
BEHIND_SHARE = 0.15  # if a larger share of the line is measured behind the surface, there is a gap and no occluder
APART, SCRAP, JOINED = 0, 1, 2  # results of `related`


class Piece(NamedTuple):
    """A piece of a surface: kind and parameters (16,), (4, N) samples, and number of pixels."""

    kind: int
    th: Array
    samples: Array
    pixels: int


def join_pieces(regions: Regions, kinds: list[int], parameters: list[Array]) -> list[int]:
    """Join pieces of one surface; returns a list whose entry k - 1 is the label to which label k belongs afterwards.

    A surface that is not joined keeps its label. Updates the `parameters` of the labels that remain.
    """
    if len(kinds) < 2:
        return list(range(1, len(kinds) + 1))
    pixels = np.array(regions.pixels)
    order = np.argsort(-pixels, kind="stable")[: np.count_nonzero(pixels)]
    thin = regions.few(PAIR_SAMPLES)
    starts = np.cumsum([0] + [few.shape[1] for few in thin])
    ths = np.stack(parameters)
    image = (regions.depth_m, regions.packed, regions.law, regions.labels)
    owner = _joined(np.array(kinds), ths, np.concatenate(thin, axis=1), starts, pixels, order, *image)
    parameters[:] = list(ths)
    joined: list[int] = owner.tolist()
    return joined


@compiled
def _joined(
    kinds: Indices, ths: Array, samples: Array, starts: Indices, pixels: Indices, order: Indices, depth: Array,
    sen: Array, noise: Array, labels: Labels,
) -> Indices:  # fmt: skip
    """Compute `join_pieces`; returns the owner of each label and updates `ths`.

    Piece k has `pixels[k]` pixels and the samples[:, starts[k] : starts[k + 1]]. `order`: pieces, largest first.
    """
    perspective, owner = sen[0] > 0, np.arange(1, kinds.shape[0] + 1)
    pieces = [
        Piece(kinds[k], ths[k].copy(), np.ascontiguousarray(samples[:, starts[k] : starts[k + 1]]), pixels[k])
        for k in range(kinds.shape[0])
    ]
    for position in range(order.shape[0]):
        big = order[position]
        if owner[big] != big + 1:
            continue
        before = pieces[big]
        for small in order[position + 1 :]:
            large, other = pieces[big], pieces[small]
            if owner[small] != small + 1 or not _passes_near(before.kind, before.th, other.samples, perspective):
                continue
            verdict, joint = related(large, other, noise, perspective)
            if verdict == APART:
                continue
            if verdict == JOINED:
                own = np.zeros(owner.shape[0] + 1, np.bool_)
                own[1:] = (owner == big + 1) | (owner == small + 1)
                if gap_between(depth, sen, noise, labels, own, large.kind, joint, large.samples, other.samples):
                    continue
                ths[big] = joint
                both = np.concatenate((large.samples, other.samples), 1)
                few = np.ascontiguousarray(both[:, :: (both.shape[1] - 1) // PAIR_SAMPLES + 1])
                pieces[big] = Piece(large.kind, joint, few, large.pixels)
            owner[small] = big + 1
    return owner


@compiled
def related(large: Piece, small: Piece, noise: Array, perspective: bool) -> tuple[int, Array]:
    """Classify the relation of a smaller piece to a larger one: APART, SCRAP (a fragment of it) or JOINED (one surface).

    Also returns the parameters of the joint surface (JOINED) or of the larger piece.
    """
    kind, th = large.kind, large.th
    if small.pixels <= SCRAP_SHARE * large.pixels and _is_scrap(large, small, noise, perspective):
        return SCRAP, th
    if kind == PLANE and small.kind == PLANE and _are_turned(large, small):
        return APART, th
    both = np.concatenate((large.samples, small.samples), 1)
    rough, _ = fit_robust(kind, th, np.ascontiguousarray(both[:, ::ROUGH_STRIDE]), perspective, ROUGH_ROUNDS)
    for piece in (small, large):  # the smaller piece first, because it fails more often
        if _trimmed(kind, rough, piece.samples, perspective)[0] < ROUGH_SHARE:
            return APART, th
    joint, _ = fit_robust(kind, th, both, perspective, ROUNDS)
    # Slow noise distorts a piece, and the joint surface cannot follow the distortion: the limit grows accordingly.
    own = 0.0
    for piece in (small, large):
        own = max(own, _trimmed(piece.kind, piece.th, piece.samples, perspective)[1])
    limit = JOINED_MEAN_SQUARE * (1.0 + slow_share_at(noise, np.median(both[2])) * max(own - 1.0, 0.0))
    for piece in (small, large):
        share, mean_square = _trimmed(kind, joint, piece.samples, perspective)
        if share < JOINED_SHARE or not mean_square <= limit:
            return APART, th
    return JOINED, joint


@compiled
def _are_turned(large: Piece, small: Piece) -> bool:
    """Return whether the planes of two pieces differ in direction by more than `LARGEST_TURN_RAD`."""
    return bool(
        large.th[0] * small.th[0] + large.th[1] * small.th[1] + large.th[2] * small.th[2] < np.cos(LARGEST_TURN_RAD)
    )


@compiled
def _is_scrap(large: Piece, small: Piece, noise: Array, perspective: bool) -> bool:
    """Return whether a small piece is so close to a large surface that it is only a dent in it or a part of its rim."""
    kind, th, samples = large.kind, large.th, small.samples
    if bend.scrap_gain(kind, th, small.kind, small.th, samples, float(small.pixels), noise, perspective) > 0.0:
        return True
    if kind == PLANE and (small.kind != PLANE or _are_turned(large, small)):
        return False
    hit, near = 0, 0
    for i in range(samples.shape[1]):
        z = depth_on(kind, th, samples[0, i], samples[1, i], perspective)
        if np.isfinite(z):
            hit += 1
            near += abs(samples[2, i] - z) < SCRAP_SIGMAS * samples[3, i]
    # Rays just outside the outline miss the surface, so only the rays that hit count; they must be the majority.
    return 2 * hit > samples.shape[1] and near > JOINED_SHARE * hit


@compiled
def _trimmed(kind: int, th: Array, samples: Array, perspective: bool) -> tuple[float, float]:
    """Return the share of the samples with residuals below `TRIM_SIGMAS`, and their mean square in squared sigmas."""
    e = bend.residual_sizes(kind, th, samples, perspective)
    kept = e[e < TRIM_SIGMAS]
    return float(kept.shape[0] / max(e.shape[0], 1)), float(np.mean(kept * kept)) if kept.shape[0] else np.inf


@compiled
def _passes_near(kind: int, th: Array, samples: Array, perspective: bool) -> bool:
    """Return whether the surface, extended beyond its pixels, passes near most of a piece; a cheap test before joint fits."""
    n, step = samples.shape[1], max(1, samples.shape[1] // NEAR_SAMPLES)
    count, far = (n + step - 1) // step, 0
    for k in range(0, n, step):
        z = depth_on(kind, th, samples[0, k], samples[1, k], perspective)
        far += not abs(samples[2, k] - z) < NEAR_SIGMAS * samples[3, k]
        if 2 * far >= count:
            return False  # decided early, because most pairs fail
    return bool(count >= LEAST_NEAR)


@compiled
def gap_between(
    depth: Array, sen: Array, noise: Array, labels: Labels, own: Mask, kind: int, th: Array, a: Array, b: Array,
) -> bool:  # fmt: skip
    """Return whether there is a gap in the surface on most of the shortest lines between two pieces.

    `a`, `b` (4, N) are samples of the pieces. `own` tells for each label whether it belongs to them; pixels of other
    labels between them may belong to a narrow groove.
    """
    distance, nearest = np.full(a.shape[1], np.inf), np.zeros(a.shape[1], np.int64)
    for m in range(a.shape[1]):
        for n in range(b.shape[1]):
            square = (a[0, m] - b[0, n]) ** 2 + (a[1, m] - b[1, n]) ** 2
            if square < distance[m]:
                distance[m], nearest[m] = square, n
    slack = GAP_SIGMAS * np.median(a[3])
    lines = np.argsort(distance)[:SIGHT_LINES]
    gaps = 0
    for m in lines:
        n = nearest[m]
        gaps += _is_gap(depth, sen, noise, labels, own, kind, th, a[0, m], a[1, m], b[0, n], b[1, n], slack)
    return bool(2 * gaps > lines.shape[0])


@compiled
def _is_gap(
    depth: Array, sen: Array, noise: Array, labels: Labels, own: Mask, kind: int, th: Array, ax: float, ay: float,
    bx: float, by: float, slack: float,
) -> bool:  # fmt: skip
    """Return whether the depth on the line from ray a to ray b shows a gap in the surface.

    There is a gap if much of the line lies behind the surface, if `GROOVE_PX` successive pixels that belong to neither
    piece do, or if a groove crosses the line. `slack` (m): how far behind the surface noise may move a pixel.
    """
    H, W = depth.shape
    perspective = sen[0] > 0
    du, dv = (bx - ax) * sen[1], (by - ay) * sen[2]
    count = max(int(max(abs(du), abs(dv))), 1)
    behind, run = 0, 0
    for k in range(1, count):
        u = min(max(int(np.rint(ax * sen[1] + sen[3] + du * k / count)), 0), W - 1)
        v = min(max(int(np.rint(ay * sen[2] + sen[4] + dv * k / count)), 0), H - 1)
        seen = depth[v, u]
        past = seen - depth_on(kind, th, (u - sen[3]) / sen[1], (v - sen[4]) / sen[2], perspective)
        step = 3.0 / sen[1] * (abs(seen) if perspective else 1.0)
        behind += past > max(slack, step)
        run = run + 1 if past > slack and not own[labels[v, u]] else 0
        if run == GROOVE_PX:
            return True
    if behind > BEHIND_SHARE * (count - 1):
        return True
    if kind != PLANE:
        return False
    u, v = ax * sen[1] + sen[3], ay * sen[2] + sen[4]
    if crosses_groove(depth, sen, noise, labels, own, th, u, v, du / count, dv / count, count):
        return True
    # If the pieces touch, the line between them may run along the groove that separates them.
    is_touching = count <= TOUCHING_PX
    return is_touching and is_grooved_at(depth, sen, noise, labels, own, th, u + 0.5 * du, v + 0.5 * dv)
