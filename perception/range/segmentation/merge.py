"""Merging touching regions that belong to one surface: agglomeration on the graph of neighbours, largest gain first.

Slow noise and calibration errors split one face into several regions, and growing planes first splits a narrow cylinder
into facets. Two regions that meet without a step are merged if one surface describes both at a lower cost than two
(Schwarz's criterion over independent patches of noise). They are also merged if they meet without a crease, because
only sensor errors then separate them. `merge_criterion` decides (compiled); the graph is kept here in plain Python,
because an image has at most some hundred pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array, Indices, Labels, Mask
from perception.range.fitting.surfaces import PLANE, SIZE
from perception.range.segmentation.borders import touching
from perception.range.segmentation.merge_criterion import FIGURES, PIXELS, described, judged, united
from perception.range.segmentation.regions import Regions
from perception.range.segmentation.seams import is_seam_grooved

PART_SAMPLES = 80  # samples by which a region is represented
LEAST_BORDER_PX = 6
TIP_SHARE = 0.35  # least length of a border, relative to the square root of the smaller region's area


def merge_touching(regions: Regions, kinds: list[int], parameters: list[Array]) -> list[int]:
    """Merge touching regions; returns a list whose entry k - 1 is the label to which label k belongs afterwards.

    Updates the `kinds` and `parameters` of the labels that remain.
    """
    if not kinds:
        return []
    names, ths = np.array(kinds), np.stack(parameters)
    owner: list[int] = _agglomerated(regions, _described_graph(regions, names, ths)).tolist()
    kinds[:], parameters[:] = names.tolist(), list(ths)
    return owner[1:]


@dataclass(slots=True, kw_only=True, eq=False)
class _Graph:
    """Regions and the borders between them.

    Label k is at index k - 1 of `kinds` and `ths`, and at index k of the other attributes of regions.

    Attributes:
        kinds, ths: kinds (count,) and parameters (count, 16).
        few, normals: samples (4, n) and normals (n, 3) of each region.
        figures: (count + 1, FIGURES) of each region, as in `merge_criterion`; entry 0 is unused.
        owner: (count + 1,) the label to which each label now belongs.
        pairs: (P, 2) labels a < b that touch; both are 0 for a pair that no longer exists.
        lengths, x, y: number of pixels of each border, and the rays (n,) of some of them.
        gains, is_old: (P,) gain of merging each pair, and whether it is up to date.
    """

    kinds: Indices
    ths: Array
    few: list[Array]
    normals: list[Array]
    figures: Array
    owner: Indices
    pairs: Labels
    lengths: Indices
    x: list[Array]
    y: list[Array]
    gains: Array
    is_old: Mask


def _agglomerated(regions: Regions, graph: _Graph) -> Indices:
    """Merge pairs of labels, the largest gain first, until no gain is positive; returns the owner (count + 1,)."""
    perspective, pitch = bool(regions.packed[0] > 0), 1.0 / float(regions.packed[1])
    joint_kinds, joint_ths = np.zeros(len(graph.pairs), np.int64), np.zeros((len(graph.pairs), SIZE))
    few, normals, figures = graph.few, graph.normals, graph.figures
    while True:
        for p in np.flatnonzero(~graph.is_old):
            graph.gains[p], joint_kinds[p], joint_ths[p] = _gain_of(int(p), graph, regions)
            graph.is_old[p] = True
        best = _most_gainful(graph.gains, graph.pairs)
        if best is None:
            return graph.owner
        a, b = graph.pairs[best].tolist()
        kept, lost = (a, b) if figures[a, PIXELS] >= figures[b, PIXELS] else (b, a)
        kind, th = joint_kinds[best], joint_ths[best].copy()
        is_same = kind == graph.kinds[kept - 1] and np.array_equal(th, graph.ths[kept - 1])
        graph.kinds[kept - 1], graph.ths[kept - 1] = kind, th
        few[kept], normals[kept], figures[kept] = united(
            int(kind), th, few[kept], normals[kept], figures[kept], few[lost], normals[lost], figures[lost],
            PART_SAMPLES, pitch, perspective,
        )  # fmt: skip
        graph.owner[graph.owner == lost] = kept
        _rewire(kept, lost, graph)
        # If the surface has not changed, the gains with neighbours that the merged region did not touch stay valid.
        if not is_same:
            graph.is_old &= (graph.pairs != kept).all(axis=1)


def _described_graph(regions: Regions, kinds: Indices, ths: Array) -> _Graph:
    """Build the graph of the regions; replaces `kinds` and `ths` by the simplest surface that describes each region."""
    perspective, pitch = bool(regions.packed[0] > 0), 1.0 / float(regions.packed[1])
    samples = regions.samples(PART_SAMPLES)
    few, normals = [np.empty((4, 0))], [np.empty((0, 3))]
    figures = np.zeros((len(kinds) + 1, FIGURES))
    for k, pixels in enumerate(regions.pixels, 1):
        few.append(np.ascontiguousarray(samples[k - 1, :, : min(pixels, samples.shape[2])]))
        normals.append(np.empty((0, 3)))
        if pixels > 0:
            kinds[k - 1], ths[k - 1], normals[k], figures[k] = described(
                int(kinds[k - 1]), ths[k - 1], few[k], float(pixels), pitch, regions.law, perspective
            )
    pairs, lengths, x, y = touching(regions.labels, regions.packed)
    known = np.minimum(lengths, x.shape[1]).tolist()
    return _Graph(
        kinds=kinds, ths=ths, few=few, normals=normals, figures=figures, owner=np.arange(len(kinds) + 1),
        pairs=pairs, lengths=lengths, x=[row[:n] for row, n in zip(x, known, strict=True)],
        y=[row[:n] for row, n in zip(y, known, strict=True)],
        gains=np.zeros(len(pairs)), is_old=np.zeros(len(pairs), np.bool_),
    )  # fmt: skip


def _gain_of(p: int, graph: _Graph, regions: Regions) -> tuple[float, int, Array]:
    """Return the gain of merging pair p (0 or less: not merged), and the kind and parameters of the joint surface."""
    kinds, ths, few, normals, figures = graph.kinds, graph.ths, graph.few, graph.normals, graph.figures
    a, b = graph.pairs[p].tolist()
    length_px = int(graph.lengths[p])
    least_px = max(LEAST_BORDER_PX, TIP_SHARE * np.sqrt(min(figures[a, PIXELS], figures[b, PIXELS])))
    if length_px < least_px:
        return 0.0, PLANE, ths[a - 1]
    gain, kind, th = judged(
        int(kinds[a - 1]), ths[a - 1], few[a], normals[a], figures[a],
        int(kinds[b - 1]), ths[b - 1], few[b], normals[b], figures[b],
        graph.x[p], graph.y[p], length_px, regions.law, bool(regions.packed[0] > 0),
    )  # fmt: skip
    if gain > 0.0 and kind == PLANE:
        own = (graph.owner == a) | (graph.owner == b)
        image = (regions.depth_m, regions.packed, regions.law)
        if is_seam_grooved(*image, regions.labels, own, th, graph.x[p], graph.y[p]):
            return 0.0, kind, th
    return gain, kind, th


def _most_gainful(gains: Array, pairs: Labels) -> int | None:
    """Return the index of the pair with the largest gain, or None if no gain is positive.

    Of several equal gains the last in label order wins, so that results are repeatable.
    """
    most = gains.max(initial=0.0)
    if not most > 0.0:
        return None
    best = np.flatnonzero(gains == most)
    return int(best[np.lexsort((pairs[best, 1], pairs[best, 0]))[-1]])


def _rewire(kept: int, lost: int, graph: _Graph) -> None:
    """Transfer the borders of label `lost` to label `kept`; pairs whose border changed are marked for a new evaluation.

    A pair that no longer exists gets label 0 twice and gain 0.
    """
    pairs, x, y = graph.pairs, graph.x, graph.y
    for p in np.flatnonzero((pairs == lost).any(axis=1)).tolist():
        other = int(pairs[p, 0] if pairs[p, 1] == lost else pairs[p, 1])
        pairs[p], graph.gains[p] = 0, 0.0
        if other == kept:
            continue
        a, b = min(kept, other), max(kept, other)
        same = np.flatnonzero((pairs[:, 0] == a) & (pairs[:, 1] == b))
        to = int(same[-1]) if same.size else p
        if to != p:
            x[to], y[to] = np.concatenate((x[to], x[p])), np.concatenate((y[to], y[p]))
            graph.lengths[to] += graph.lengths[p]
        pairs[to] = a, b
        graph.is_old[to] = False
