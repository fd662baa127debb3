"""Joining pieces of one surface that are separated by an object in front of it."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Indices, Labels, Mask
from hal.jit import as_numpy_scalar, compiled
from perception.range.fitting import fit
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
    perspective = sen[0] > 0
    owner, before = np.arange(1, kinds.shape[0] + 1), ths.copy()
    thin = [np.ascontiguousarray(samples[:, starts[k] : starts[k + 1]]) for k in range(kinds.shape[0])]
    for position in range(order.shape[0]):
        big = order[position]
        if owner[big] != big + 1:
            continue
        for small in order[position + 1 :]:
            if owner[small] != small + 1 or not _passes_near(kinds[big], before[big], thin[small], perspective):
                continue
            verdict, joint = related(
                kinds[big], ths[big], thin[big], pixels[big],
                kinds[small], ths[small], thin[small], pixels[small], noise, perspective,
            )  # fmt: skip
            if verdict == APART:
                continue
            if verdict == JOINED:
                own = np.zeros(owner.shape[0] + 1, np.bool_)
                own[1:] = (owner == big + 1) | (owner == small + 1)
                if gap_between(depth, sen, noise, labels, own, kinds[big], joint, thin[big], thin[small]):
                    continue
                ths[big] = joint
                thin[big] = np.concatenate((thin[big], thin[small]), 1)
            owner[small] = big + 1
    return owner


@compiled
def related(
    kind: int, th: Array, samples: Array, pixels: int, other_kind: int, other: Array, others: Array, other_pixels: int,
    noise: Array, perspective: bool,
) -> tuple[int, Array]:  # fmt: skip
    """Classify the relation of a smaller piece to a larger one: APART, SCRAP (a fragment of it) or JOINED (one surface).

    The larger piece has kind, parameters and `samples` (4, N, as in `bend`); `other_kind`, `other` and `others` are those
    of the smaller one. Also returns the parameters of the joint surface (JOINED) or of the larger piece.
    """
    if other_pixels <= SCRAP_SHARE * pixels and _is_scrap(
        kind, th, other_kind, other, others, other_pixels, noise, perspective
    ):
        return SCRAP, th
    if kind == PLANE and other_kind == PLANE:
        turn = th[0] * other[0] + th[1] * other[1] + th[2] * other[2]
        if turn < np.cos(LARGEST_TURN_RAD):
            return APART, th
    both = np.concatenate((samples, others), 1)
    rough = _fitted(kind, th, np.ascontiguousarray(both[:, ::ROUGH_STRIDE]), perspective, ROUGH_ROUNDS)
    for s in (others, samples):  # the smaller piece first, because it fails more often
        if _trimmed(kind, rough, s, perspective)[0] < ROUGH_SHARE:
            return APART, th
    joint = _fitted(kind, th, both, perspective, ROUNDS)
    # Slow noise distorts a piece, and the joint surface cannot follow the distortion: the limit grows accordingly.
    own = max(_trimmed(kind, th, samples, perspective)[1], _trimmed(other_kind, other, others, perspective)[1])
    limit = JOINED_MEAN_SQUARE * (1.0 + slow_share_at(noise, np.median(both[2])) * max(own - 1.0, 0.0))
    for s in (samples, others):
        share, mean_square = _trimmed(kind, joint, s, perspective)
        if share < JOINED_SHARE or not mean_square <= limit:
            return APART, th
    return JOINED, joint


@compiled
def _is_scrap(
    kind: int, th: Array, own_kind: int, own: Array, samples: Array, pixels: int, noise: Array, perspective: bool,
) -> bool:  # fmt: skip
    """Return whether a small piece is so close to a large surface that it is only a dent in it or a part of its rim."""
    if bend.scrap_gain(kind, th, own_kind, own, samples, float(pixels), noise, perspective) > 0.0:
        return True
    if kind == PLANE and own_kind != PLANE:
        return False
    if kind == PLANE and th[0] * own[0] + th[1] * own[1] + th[2] * own[2] < np.cos(LARGEST_TURN_RAD):
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
def _fitted(kind: int, th: Array, s: Array, perspective: bool, rounds: int) -> Array:
    """Return the parameters of a robust fit to samples (4, N) that starts at `th`."""
    free = np.zeros(9, np.bool_)
    th, _ = fit.fit_robust(kind, th, s[0], s[1], s[2], s[3], perspective, free, rounds)
    return th


@compiled
def _trimmed(kind: int, th: Array, s: Array, perspective: bool) -> tuple[float, float]:
    """Return the share of the samples with residuals below `TRIM_SIGMAS`, and their mean square in squared sigmas."""
    e = bend.residual_sizes(kind, th, s, perspective)
    kept, total = 0, 0.0
    for i in range(e.shape[0]):
        if e[i] < fit.TRIM_SIGMAS:
            kept += 1
            total += e[i] * e[i]
    return kept / max(e.shape[0], 1), total / kept if kept else np.inf


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
    distance = np.full(a.shape[1], np.inf)
    for n in range(b.shape[1]):
        _lessen(a[0], a[1], b[0, n], b[1, n], distance)
    slack = GAP_SIGMAS * np.median(a[3])
    lines = np.argsort(distance)[:SIGHT_LINES]
    gaps = 0
    for m in lines:
        n = _first_at(distance[m], b[0], b[1], a[0, m], a[1, m])
        gaps += _is_gap(depth, sen, noise, labels, own, kind, th, a[0, m], a[1, m], b[0, n], b[1, n], slack)
    return bool(2 * gaps > lines.shape[0])


@compiled
def _lessen(x: Array, y: Array, x0: float, y0: float, distance: Array) -> None:
    """Lower the squared `distance` of each ray (x, y) from its nearest ray in another set if the ray (x0, y0) is nearer."""
    for m in range(x.shape[0]):
        dx, dy = x[m] - x0, y[m] - y0
        d2 = dx * dx + dy * dy
        distance[m] = d2 if d2 < distance[m] else distance[m]


@compiled
def _first_at(distance: float, x: Array, y: Array, x0: float, y0: float) -> int:
    """Return the index of the first ray (x, y) whose squared distance from (x0, y0) is at most `distance`."""
    for n in range(x.shape[0]):
        dx, dy = x0 - x[n], y0 - y[n]
        if dx * dx + dy * dy <= distance:
            return n
    return 0


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
