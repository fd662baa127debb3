"""Union-find over array indices: the smallest index of a set is its root."""

from __future__ import annotations

from hal.arrays import Indices
from hal.jit import compiled


@compiled
def find(parent: Indices, i: int) -> int:
    """The root of index i; shortens the way there in place."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def unite(parent: Indices, i: int, j: int) -> None:
    """Join the sets of two indices; the smaller root stays one, so roots are first pixels in raster order."""
    a, b = find(parent, i), find(parent, j)
    if a < b:
        parent[b] = a
    elif b < a:
        parent[a] = b
