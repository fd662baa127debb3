"""The pixels of each region of a label image, as fits read them.

Samples are (4, N): ray coordinates x and y, depth z and its standard deviation, metres. Only the places of pixels are
kept; samples are made where they are wanted, for most steps need a few of a region.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.range.claim import bucket
from perception.range.rays import LOOSE

Array = NDArray[np.float64]
Labels = NDArray[np.int32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regions:
    """Labels 1 to `count` of a depth image (H, W) in metres; `packed` and `law` of its sensor and its noise.

    Label k owns the flat pixel indices `indices[starts[k] : starts[k + 1]]`, in raster order.
    """

    depth_m: Array
    packed: Array
    law: Array
    labels: Labels
    starts: NDArray[np.int64]
    indices: NDArray[np.int32]

    @property
    def pixels(self) -> list[int]:
        """How many pixels each label has; entry 0 is label 1."""
        sizes: list[int] = np.diff(self.starts[1:]).tolist()
        return sizes

    def few(self, most: int) -> list[Array]:
        """At most `most` samples of each label, evenly spread over its pixels; the same choice every time."""
        out, sizes = _spread_samples(self.depth_m, self.packed, self.law, self.starts, self.indices, most)
        return [np.ascontiguousarray(s[:, :n]) for s, n in zip(out, sizes.tolist(), strict=True)]

    def samples(self, label: int) -> Array:
        """Samples of all pixels of a label."""
        mine = self.indices[self.starts[label] : self.starts[label + 1]]
        return np.asarray(_samples_at(self.depth_m, self.packed, self.law, mine))

    def given_to(self, owner: list[int]) -> Regions:
        """The regions after label k has gone to `owner[k - 1]`."""
        if owner == list(range(1, len(owner) + 1)):
            return self
        labels = renamed(self.labels, np.array([0, *owner], np.int32))
        return regions_of(self.depth_m, self.packed, self.law, labels, len(owner))


def regions_of(depth_m: Array, packed: Array, law: Array, labels: Labels, count: int) -> Regions:
    """The pixels of labels 1 to `count`."""
    starts, indices = bucket(labels, count)
    return Regions(depth_m=depth_m, packed=packed, law=law, labels=labels, starts=starts, indices=indices)


@njit(cache=True, nogil=True)
def renamed(labels, names):  # type: ignore[no-untyped-def]  # numba types it
    """(H, W) labels after k is called `names[k]`."""
    out = np.empty_like(labels)
    flat, new = labels.ravel(), out.ravel()
    for i in range(flat.shape[0]):
        new[i] = names[flat[i]]
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def _spread_samples(depth, sen, noise, starts, indices, most):  # type: ignore[no-untyped-def]  # numba types it
    """(count, 4, most) samples and how many of them each label has."""
    count = starts.shape[0] - 2
    out, sizes = np.empty((count, 4, most)), np.empty(count, np.int64)
    W = depth.shape[1]
    for k in range(count):
        first, n = starts[k + 1], starts[k + 2] - starts[k + 1]
        sizes[k] = min(n, most)
        step = (n - 1) / max(sizes[k] - 1, 1)
        for j in range(sizes[k]):
            i = indices[first + int(j * step + 0.5)]
            out[k, 0, j], out[k, 1, j] = (i % W - sen[3]) / sen[1], (i // W - sen[4]) / sen[2]
            out[k, 2, j] = depth[i // W, i % W]
        _fill_sigmas(out[k, 2, : sizes[k]], noise, out[k, 3, : sizes[k]])
    return out, sizes


@njit(cache=True, error_model="numpy", nogil=True)
def _samples_at(depth, sen, noise, indices):  # type: ignore[no-untyped-def]  # numba types it
    """(4, N) samples of the pixels at flat `indices` (N,) in raster order."""
    n, W = indices.shape[0], depth.shape[1]
    flat = depth.ravel()
    out = np.empty((4, n))
    per_x, row, start, y = 1.0 / sen[1], -1, 0, 0.0
    for k in range(n):
        i = indices[k]
        if i - start >= W or row < 0:
            row = i // W
            start, y = row * W, (row - sen[4]) / sen[2]
        out[0, k], out[1, k], out[2, k] = (i - start - sen[3]) * per_x, y, flat[i]
    _fill_sigmas(out[2], noise, out[3])
    return out


@njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _fill_sigmas(z, noise, out):  # type: ignore[no-untyped-def]  # numba types it
    """`sigma_at` of many depths, without a branch."""
    a, b, c, d, e, f = noise[0], noise[1], noise[2], noise[3], noise[4], noise[5]
    for i in range(z.shape[0]):
        z2 = z[i] * z[i]
        white, slow, step = a + b * z2, c + d * z2, e + f * z2
        out[i] = np.sqrt(max(white * white, step * step / 12.0) + slow * slow)
