"""Touching regions that are one surface: agglomeration on the graph of neighbours, cheapest description first.

Slow noise and bent calibration break one face into several, and planes that grow first leave a narrow cylinder as
facets. Two regions that meet without a step are joined when one surface describes both more cheaply than two do
(Schwarz's criterion over independent patches of noise), or when they meet without a crease either: then what parts them
is the error of the sensor, whatever the models say. `pairs` judges, compiled; the graph is kept here.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.range.fitting.surfaces import PLANE
from perception.range.segmentation.borders import Border, borders_of
from perception.range.segmentation.pairs import PIXELS, described, judged, united
from perception.range.segmentation.regions import Regions
from perception.range.segmentation.seams import is_seam_grooved

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

PART_SAMPLES = 80
LEAST_BORDER_PX = 6
TIP_SHARE = 0.35  # of the side of a square of the smaller region: two that touch by less may have anything between them


class Part(NamedTuple):
    """A region while it is being joined: its surface, (4, N) samples, their (N, 3) normals, and figures (`pairs`)."""

    kind: int
    parameters: Array
    samples: Array
    normals: Array
    figures: Array

    @property
    def pixels(self) -> float:
        """How many pixels the region has."""
        return float(self.figures[PIXELS])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Merger:
    """One joint description of a pair; `gain` > 0 says how much cheaper it is than two."""

    pair: tuple[int, int]
    kind: int
    parameters: Array
    gain: float


class Agglomeration:
    """The graph of regions; joins the pair with the largest gain until none gains."""

    def __init__(
        self,
        kinds: list[int],
        parameters: list[Array],
        samples: list[Array],
        pixels: list[int],
        *,
        borders: dict[tuple[int, int], Border],
        image: tuple[Array, Array, Array, Ints],
    ) -> None:
        self.image = image
        _, packed, self.law, _ = image
        self.pitch = pitch = 1.0 / float(packed[1])
        self.perspective = perspective = bool(packed[0] > 0)
        self.parts: dict[int, Part] = {}
        for k, few in enumerate(samples, 1):
            if few.size:
                surface = (kinds[k - 1], parameters[k - 1])
                kind, th, normals, figures = described(
                    *surface, few, float(pixels[k - 1]), pitch, self.law, perspective
                )
                self.parts[k] = Part(kind=kind, parameters=th, samples=few, normals=normals, figures=figures)
        self.borders = dict(borders)
        self.owner = {k: k for k in range(1, len(kinds) + 1)}

    def run(self) -> None:
        """Join pairs, the most gainful first."""
        gainful = self._gainful(set(self.borders))
        while gainful:
            lost, changed = self._join(max(gainful.values(), key=lambda m: (m.gain, m.pair)))
            gainful = {pair: merger for pair, merger in gainful.items() if lost not in pair and pair not in changed}
            gainful |= self._gainful(changed)

    def _gainful(self, pairs: set[tuple[int, int]]) -> dict[tuple[int, int], Merger]:
        judged = {pair: self._judged(pair) for pair in pairs}
        return {pair: merger for pair, merger in judged.items() if merger is not None}

    def _judged(self, pair: tuple[int, int]) -> Merger | None:
        """The joint description of a pair if it gains, else None."""
        a, b = (self.parts.get(k) for k in pair)
        border = self.borders[pair]
        if a is None or b is None or border.length_px < LEAST_BORDER_PX:
            return None
        if border.length_px < TIP_SHARE * sqrt(min(a.pixels, b.pixels)):
            return None
        gain, kind, th = judged(*a, *b, border.x, border.y, border.length_px, self.law, self.perspective)
        if not gain > 0.0:
            return None
        if kind == PLANE and is_seam_grooved(*self.image, self._members(pair), th, border.x, border.y):
            return None
        return Merger(pair=pair, kind=kind, parameters=th, gain=gain)

    def _members(self, pair: tuple[int, int]) -> NDArray[np.bool_]:
        """Of each label, and of none (0), whether it belongs to a part of the pair."""
        return np.array([False, *(owner in pair for owner in self.owner.values())])

    def _join(self, merger: Merger) -> tuple[int, set[tuple[int, int]]]:
        """Replace the two parts by one; returns the label that is lost and the pairs that are to be judged again.

        A part that took in a scrap, and is the surface it was, is what it was to neighbours that the scrap did not touch.
        """
        a, b = merger.pair
        kept, lost = (a, b) if self.parts[a].pixels >= self.parts[b].pixels else (b, a)
        p, q = self.parts[kept], self.parts.pop(lost)
        pieces = (p.samples, p.normals, p.figures, q.samples, q.normals, q.figures)
        surface = (merger.kind, merger.parameters)
        samples, normals, figures = united(*surface, *pieces, PART_SAMPLES, self.pitch, self.perspective)
        self.parts[kept] = Part(
            kind=merger.kind, parameters=merger.parameters, samples=samples, normals=normals, figures=figures
        )
        for label, owner in self.owner.items():
            if owner == lost:
                self.owner[label] = kept
        rewired = self._rewire(kept, lost)
        is_same = merger.kind == p.kind and np.array_equal(merger.parameters, p.parameters)
        return lost, rewired if is_same else {pair for pair in self.borders if kept in pair}

    def _rewire(self, kept: int, lost: int) -> set[tuple[int, int]]:
        """The borders of the part that is lost go to the one that is kept; returns the pairs that have got more."""
        rewired = set()
        for pair in [p for p in self.borders if lost in p]:
            border = self.borders.pop(pair)
            other = pair[0] if pair[1] == lost else pair[1]
            if other == kept:
                continue
            new = (min(kept, other), max(kept, other))
            self.borders[new] = self.borders[new].with_more(border) if new in self.borders else border
            rewired.add(new)
        return rewired


def merge_touching(regions: Regions, kinds: list[int], parameters: list[Array]) -> list[int]:
    """For each label (k at k - 1) the label it belongs to afterwards; updates kinds and parameters of the survivors."""
    graph = Agglomeration(
        kinds,
        parameters,
        regions.few(PART_SAMPLES),
        regions.pixels,
        borders=borders_of(regions.labels, regions.packed),
        image=(regions.depth_m, regions.packed, regions.law, regions.labels),
    )
    graph.run()
    for label, part in graph.parts.items():
        kinds[label - 1], parameters[label - 1] = part.kind, part.parameters
    return [graph.owner[k] for k in range(1, len(kinds) + 1)]
