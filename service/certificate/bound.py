"""The bound on the share of wrong readings that judged cases support."""

from __future__ import annotations

from collections.abc import Iterable

from scipy.special import betaincinv

ASSURANCE = 0.95


def wrong_at_most(wrong: int, cases: int, *, assurance: float = ASSURANCE) -> float:
    """Return the share of wrong readings that is not exceeded with this assurance, given independent judged cases.

    Source: Clopper and Pearson, Biometrika 26 (1934), the one-sided exact bound.
    """
    return 1.0 if wrong >= cases else float(betaincinv(wrong + 1, cases - wrong, assurance))


def by_cluster(cases: Iterable[tuple[str, bool]]) -> tuple[int, int]:
    """Return how many clusters there are and in how many a case is wrong; cases are (cluster, is wrong).

    Cases of the same dial in the same hour are not independent, so that they count as one, and as wrong if any is.
    """
    clusters: dict[str, bool] = {}
    for cluster, is_wrong in cases:
        clusters[cluster] = clusters.get(cluster, False) or is_wrong
    return len(clusters), sum(clusters.values())
