"""Touching regions that are one surface: agglomeration on the graph of neighbours, cheapest description first.

Slow noise and bent calibration break one face into several, and planes that grow first leave a narrow cylinder as
facets. Two regions that meet without a step are joined when one surface describes both more cheaply than two do
(Schwarz's criterion over independent patches of noise), or when they meet without a crease either: then what parts them
is the error of the sensor, whatever the models say. `pairs` judges; the graph is kept here, compiled too, for an image
has a hundred pairs.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hal.arrays import Array
from perception.range.fitting.surfaces import PLANE, SIZE
from perception.range.segmentation.borders import touching
from perception.range.segmentation.pairs import FIGURES, PIXELS, described, judged, united
from perception.range.segmentation.regions import Regions
from perception.range.segmentation.seams import is_seam_grooved

PART_SAMPLES = 80
LEAST_BORDER_PX = 6
TIP_SHARE = 0.35  # of the side of a square of the smaller region: two that touch by less may have anything between them


def merge_touching(regions: Regions, kinds: list[int], parameters: list[Array]) -> list[int]:
    """For each label (k at k - 1) the label it belongs to afterwards; updates kinds and parameters of the survivors."""
    if not kinds:
        return []
    names, ths = np.array(kinds), np.stack(parameters)
    samples = regions.samples(PART_SAMPLES)
    pairs, lengths, x, y = touching(regions.labels, regions.packed)
    image = (regions.depth_m, regions.packed, regions.law, regions.labels)
    owner: list[int] = _agglomerated(names, ths, samples, regions.sizes, pairs, lengths, x, y, *image).tolist()
    kinds[:], parameters[:] = names.tolist(), list(ths)
    return owner[1:]


@njit(cache=True, error_model="numpy", nogil=True)
def _agglomerated(  # type: ignore[no-untyped-def]  # numba types it
    kinds, ths, samples, pixels, pairs, lengths, x, y, depth, sen, noise, labels
):
    """Joins pairs of labels, the most gainful first, until none gains; the owner (count + 1,) of each label then.

    `kinds` and `ths` of the labels that remain are updated. Samples (count, 4, n) as `Regions.samples`; `pairs` (P, 2),
    `lengths` (P,) and places x, y (P, n) as `touching`.
    """
    perspective, pitch = sen[0] > 0, 1.0 / sen[1]
    few, normals, figures = _described_parts(kinds, ths, samples, pixels, pitch, noise, perspective)
    parts = (kinds, ths, few, normals, figures)
    xs = [x[p, : min(lengths[p], x.shape[1])] for p in range(pairs.shape[0])]
    ys = [y[p, : min(lengths[p], x.shape[1])] for p in range(pairs.shape[0])]
    owner = np.arange(kinds.shape[0] + 1)
    joint_kinds, joint_ths = np.zeros(pairs.shape[0], np.int64), np.zeros((pairs.shape[0], SIZE))
    gains, is_old = np.zeros(pairs.shape[0]), np.zeros(pairs.shape[0], np.bool_)
    while True:
        for p in np.flatnonzero(~is_old):
            gains[p], joint_kinds[p], joint_ths[p] = _gain_of(
                pairs[p], parts, xs[p], ys[p], lengths[p], owner, depth, sen, noise, labels
            )
            is_old[p] = True
        best = _most_gainful(gains, pairs)
        if best < 0:
            return owner
        a, b = pairs[best]
        kept, lost = (a, b) if figures[a, PIXELS] >= figures[b, PIXELS] else (b, a)
        kind, th = joint_kinds[best], joint_ths[best].copy()
        is_same = kind == kinds[kept - 1] and np.array_equal(th, ths[kept - 1])
        kinds[kept - 1], ths[kept - 1] = kind, th
        few[kept], normals[kept], figures[kept] = united(
            kind, th, few[kept], normals[kept], figures[kept], few[lost], normals[lost], figures[lost], PART_SAMPLES,
            pitch, perspective,
        )  # fmt: skip
        owner[owner == lost] = kept
        _rewire(kept, lost, pairs, gains, lengths, xs, ys, is_old)
        # A part that took in a scrap, and is the surface it was, is what it was to neighbours that the scrap did not touch.
        if not is_same:
            is_old &= (pairs[:, 0] != kept) & (pairs[:, 1] != kept)


@njit(cache=True, error_model="numpy")
def _described_parts(kinds, ths, samples, pixels, pitch, noise, perspective):  # type: ignore[no-untyped-def]  # numba types it
    """Samples (4, n) and normals (n, 3) of each label, its figures (count + 1, FIGURES), entry 0 unused.

    Updates `kinds` and `ths`.
    """
    few, normals = [np.empty((4, 0))], [np.empty((0, 3))]
    figures = np.zeros((kinds.shape[0] + 1, FIGURES))
    for k in range(1, kinds.shape[0] + 1):
        few.append(np.ascontiguousarray(samples[k - 1, :, : min(pixels[k], samples.shape[2])]))
        normals.append(np.empty((0, 3)))
        if pixels[k] > 0:
            kinds[k - 1], ths[k - 1], normals[k], figures[k] = described(
                kinds[k - 1], ths[k - 1], few[k], float(pixels[k]), pitch, noise, perspective
            )
    return few, normals, figures


@njit(cache=True, error_model="numpy")
def _gain_of(pair, parts, x, y, length_px, owner, depth, sen, noise, labels):  # type: ignore[no-untyped-def]  # numba types it
    """How much cheaper a pair is as one surface (0 or less: it stays two), that surface's kind and its parameters."""
    kinds, ths, few, normals, figures = parts
    a, b = pair
    least_px = max(LEAST_BORDER_PX, TIP_SHARE * np.sqrt(min(figures[a, PIXELS], figures[b, PIXELS])))
    if length_px < least_px:
        return 0.0, PLANE, ths[a - 1]
    gain, kind, th = judged(
        kinds[a - 1], ths[a - 1], few[a], normals[a], figures[a], kinds[b - 1], ths[b - 1], few[b], normals[b], figures[b],
        x, y, length_px, noise, sen[0] > 0,
    )  # fmt: skip
    if gain > 0.0 and kind == PLANE:
        own = (owner == a) | (owner == b)
        if is_seam_grooved(depth, sen, noise, labels, own, th, x, y):
            return 0.0, kind, th
    return gain, kind, th


@njit(cache=True, error_model="numpy")
def _most_gainful(gains, pairs):  # type: ignore[no-untyped-def]  # numba types it
    """The pair with the largest gain, of equal ones the last in the order of labels; -1 when none gains."""
    best = -1
    for p in range(gains.shape[0]):
        if not gains[p] > 0.0:
            continue
        if best < 0 or gains[p] > gains[best]:
            best = p
        elif gains[p] == gains[best]:
            later = pairs[p, 0] - pairs[best, 0] if pairs[p, 0] != pairs[best, 0] else pairs[p, 1] - pairs[best, 1]
            best = p if later > 0 else best
    return best


@njit(cache=True, error_model="numpy")
def _rewire(kept, lost, pairs, gains, lengths, xs, ys, is_old):  # type: ignore[no-untyped-def]  # numba types it
    """The borders of the part that is lost go to the one that is kept; pairs that have got more are to be judged again.

    A pair that is no more has label 0 twice, and gains nothing.
    """
    for p in range(pairs.shape[0]):
        if pairs[p, 0] != lost and pairs[p, 1] != lost:
            continue
        other = pairs[p, 0] if pairs[p, 1] == lost else pairs[p, 1]
        pairs[p], gains[p] = 0, 0.0
        if other == kept:
            continue
        a, b = min(kept, other), max(kept, other)
        to = p
        for q in range(pairs.shape[0]):
            if pairs[q, 0] == a and pairs[q, 1] == b:
                to = q
        if to != p:
            xs[to], ys[to] = np.concatenate((xs[to], xs[p])), np.concatenate((ys[to], ys[p]))
            lengths[to] += lengths[p]
        pairs[to, 0], pairs[to, 1] = a, b
        is_old[to] = False
