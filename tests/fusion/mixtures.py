"""Fusion problems of mixed measurements with a known answer."""

from __future__ import annotations

import numpy as np

from benchmarks.fusion_simulation import CODES, Problem, problem


def mixture(count: int, seed: int, bad: int = 0) -> Problem:
    """Return a problem of `count` measurements of random classes, `bad` of which are of another feature."""
    rng = np.random.default_rng(seed)
    return problem([CODES[k] for k in rng.integers(len(CODES), size=count)], rng, bad=bad)
