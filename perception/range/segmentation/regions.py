"""The pixels of each region of a label image, and samples of them for fits.

Samples are (4, N): ray coordinates x and y, depth z and its standard deviation, metres. Only the positions of pixels
are stored, as runs in rows; samples are computed on demand, because most steps need only a few per region.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array, Indices, Labels
from hal.jit import compiled
from perception.range.fitting.last_step import fill_variances
from perception.range.segmentation.run_length import painted, places_of, runs_of

CENTRED = 0.5  # shift of samples, so that positions are rounded to the nearest pixel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regions:
    """The regions with labels 1 to `count` of a depth image (H, W) in metres.

    `packed` and `law` are the packed sensor and noise models. Label k owns `runs[starts[k] : starts[k + 1]]` and
    `sizes[k]` pixels, as `runs_of` returns them.
    """

    depth_m: Array
    packed: Array
    law: Array
    labels: Labels
    starts: Indices
    runs: Labels
    sizes: Indices

    @property
    def pixels(self) -> list[int]:
        """Number of pixels of each label; entry 0 is label 1."""
        sizes: list[int] = self.sizes[1:].tolist()
        return sizes

    def few(self, most: int) -> list[Array]:
        """Return the samples of all labels; entry 0 is label 1."""
        return [self.sampled(label, most) for label in range(1, self.sizes.shape[0])]

    def sampled(self, label: int, most: int) -> Array:
        """Return at most `most` samples (4, N) of a label, spread evenly and deterministically over its pixels."""
        few = np.empty((4, min(int(self.sizes[label]), most)))
        spread(self.depth_m, self.packed, self.law, self.runs_of(label), int(self.sizes[label]), CENTRED, few)
        return few

    def runs_of(self, label: int) -> Labels:
        """Return the runs (R, 3) of a label in raster order: row, first column, and the column after the last."""
        return self.runs[self.starts[label] : self.starts[label + 1]]

    def places(self, label: int) -> Labels:
        """Return the flat pixel indices (N,) of a label, in raster order."""
        return np.asarray(places_of(self.runs_of(label), self.labels.shape[1]))

    def renamed(self, names: Labels) -> Labels:
        """Return the labels (H, W) with each label k replaced by `names[k]`."""
        labels = np.zeros_like(self.labels)
        painted(self.starts, self.runs, names, labels)
        return labels

    def given_to(self, owner: list[int]) -> Regions:
        """Return the regions with each label k merged into `owner[k - 1]`."""
        if owner == list(range(1, len(owner) + 1)):
            return self
        labels = self.renamed(np.array([0, *owner], np.int32))
        return regions_of(self.depth_m, self.packed, self.law, labels, len(owner))


def regions_of(depth_m: Array, packed: Array, law: Array, labels: Labels, count: int) -> Regions:
    """Build the regions of labels 1 to `count`."""
    starts, runs, sizes = runs_of(labels, count)
    return Regions(depth_m=depth_m, packed=packed, law=law, labels=labels, starts=starts, runs=runs, sizes=sizes)


@compiled
def spread(depth: Array, sen: Array, noise: Array, runs: Labels, pixels: int, shift: float, out: Array) -> None:
    """Fill `out` (4, n) with samples evenly spread over the `pixels` of runs (R, 3), offset by `shift` (0 to 1)."""
    n = min(out.shape[1], pixels)
    step = (pixels - 1) / max(n - 1, 1)
    run, passed = 0, 0
    for j in range(n):
        at = int(j * step + shift)
        while at - passed >= runs[run, 2] - runs[run, 1]:
            passed += runs[run, 2] - runs[run, 1]
            run += 1
        v, u = runs[run, 0], runs[run, 1] + at - passed
        out[0, j], out[1, j], out[2, j] = (u - sen[3]) / sen[1], (v - sen[4]) / sen[2], depth[v, u]
    fill_variances(out[2, :n], noise, out[3, :n])
    out[3, :n] = np.sqrt(out[3, :n])
