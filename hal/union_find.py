"""Union-find over array indices for compiled loops; the root of a set is its smallest index."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.jit import inlined


@inlined
def find(parent: NDArray[np.signedinteger[Any]], i: int) -> int:
    """Return the root of index i; halves the path to it in place."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@inlined
def unite(parent: NDArray[np.signedinteger[Any]], i: int, j: int) -> None:
    """Join the sets of two indices; the smaller root remains the root, so it is the first pixel in raster order."""
    a, b = find(parent, i), find(parent, j)
    if a < b:
        parent[b] = a
    elif b < a:
        parent[a] = b
