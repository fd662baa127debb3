"""Merging touching regions that belong to one surface: agglomeration on the graph of neighbours, largest gain first.

Slow noise and calibration errors split one face into several regions, and growing planes first splits a narrow cylinder
into facets. Two regions that meet without a step are merged if one surface describes both at a lower cost than two
(Schwarz's criterion over independent patches of noise). They are also merged if they meet without a crease, because
only sensor errors then separate them. `merge_criterion` decides (compiled); the graph is kept here in plain Python,
because an image has at most some hundred pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.arrays import Array, Indices
from perception.range.fitting.surfaces import PLANE
from perception.range.segmentation.borders import touching
from perception.range.segmentation.merge_criterion import Part, described, judged, united
from perception.range.segmentation.regions import Regions
from perception.range.segmentation.seams import is_seam_grooved

PART_SAMPLES = 80  # samples by which a region is represented
LEAST_BORDER_PX = 6
TIP_SHARE = 0.35  # least length of a border, relative to the square root of the smaller region's area

Pair = tuple[int, int]
"""Labels a < b of two regions that touch."""


class Border(NamedTuple):
    """Border of two regions: its length in pixels, and the rays x, y (n,) of some of them."""

    length_px: int
    x: Array
    y: Array


def merge_touching(regions: Regions, kinds: list[int], parameters: list[Array]) -> list[int]:
    """Merge touching regions, those with the largest gain first, until no gain is positive.

    Returns a list whose entry k - 1 is the label to which label k belongs afterwards. Updates the `kinds` and
    `parameters` of the labels that remain.
    """
    perspective, pitch = bool(regions.packed[0] > 0), 1.0 / float(regions.packed[1])
    owner = np.arange(len(kinds) + 1)
    parts = {
        k: described(int(kinds[k - 1]), parameters[k - 1], few, float(few_of), pitch, regions.law, perspective)
        for k, (few, few_of) in enumerate(zip(regions.few(PART_SAMPLES), regions.pixels, strict=True), 1)
        if few_of > 0
    }
    borders = {
        (int(a), int(b)): Border(int(n), x[:n], y[:n])
        for (a, b), n, x, y in zip(*touching(regions.labels, regions.packed), strict=True)
    }
    merged: dict[Pair, tuple[float, int, Array]] = {}
    while borders:
        merged |= {p: _merged(p, border, parts, owner, regions) for p, border in borders.items() if p not in merged}
        # Of several equal gains the last in label order wins, so that results are repeatable.
        best = max(borders, key=lambda p: (merged[p][0], p))
        gain, kind, th = merged[best]
        if not gain > 0.0:
            break
        kept, lost = best if parts[best[0]].pixels >= parts[best[1]].pixels else best[::-1]
        is_same = kind == parts[kept].kind and np.array_equal(th, parts[kept].th)
        parts[kept] = united(int(kind), th, parts[kept], parts[lost], PART_SAMPLES, pitch, perspective)
        owner[owner == lost] = kept
        changed = _rewire(kept, lost, borders)
        # If the surface has not changed, the gains with neighbours that the merged region did not touch stay valid.
        merged = {p: m for p, m in merged.items() if p not in changed and (is_same or kept not in p)}
    for k, part in parts.items():
        kinds[k - 1], parameters[k - 1] = part.kind, part.th
    joined: list[int] = owner[1:].tolist()
    return joined


def _merged(
    pair: Pair, border: Border, parts: dict[int, Part], owner: Indices, regions: Regions
) -> tuple[float, int, Array]:
    """Return the gain of merging two regions (0 or less: not merged), and the kind and parameters of their joint surface."""
    a, b = (parts[k] for k in pair)
    if border.length_px < max(LEAST_BORDER_PX, TIP_SHARE * np.sqrt(min(a.pixels, b.pixels))):
        return 0.0, PLANE, a.th
    gain, kind, th = judged(a, b, border.x, border.y, regions.law, bool(regions.packed[0] > 0))
    if gain > 0.0 and kind == PLANE:
        image = (regions.depth_m, regions.packed, regions.law, regions.labels)
        if is_seam_grooved(*image, np.isin(owner, pair), th, border.x, border.y):
            return 0.0, kind, th
    return gain, kind, th


def _rewire(kept: int, lost: int, borders: dict[Pair, Border]) -> set[Pair]:
    """Transfer the borders of label `lost` to label `kept`; returns the pairs that are new or changed."""
    changed = set()
    for pair in [p for p in borders if lost in p]:
        border, other = borders.pop(pair), pair[0] if pair[1] == lost else pair[1]
        if other == kept:
            continue
        to = (min(kept, other), max(kept, other))
        if to in borders:
            length_px, x, y = borders[to]
            border = Border(length_px + border.length_px, np.concatenate((x, border.x)), np.concatenate((y, border.y)))
        borders[to] = border
        changed.add(to)
    return changed
