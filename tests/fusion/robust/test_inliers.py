"""Compares branch and bound over the sets of inliers with the search of all sets."""

from __future__ import annotations

from itertools import count, product

import numpy as np
import pytest

from benchmarks.fusion_simulation import CODES, problem
from fusion import fuse
from fusion.batch import Batch, pack
from fusion.certify.dual import minimiser
from fusion.certify.proof import quadratic_forms
from fusion.robust.inliers import best_set
from fusion.robust.minima import minima
from fusion.solve import LocalSolution
from fusion.solve.local import middle_and_size
from hal.arrays import Array
from hal.errors import InvalidRequest

pytest.importorskip("clarabel", reason="branch and bound is an extra")


def packed(codes: list[str], seed: int, bad: int) -> tuple[Batch, np.ndarray, LocalSolution]:
    p = problem(codes, np.random.default_rng(seed), bad=bad)
    b = pack(p.measurements)
    best, _ = minima(b, np.random.default_rng(0))
    return b, best.used, best.local


def least_of_all_sets(b: Batch, used: np.ndarray, local: LocalSolution) -> float:
    """Return the minimum over all 2^N sets and all poses, each from several starts; slow, but without bounds."""
    lever, size = middle_and_size(b, used, local.rotation)
    about, middle = local.rotation.T @ lever, local.translation_m + lever
    forms = quadratic_forms(b, local.rotation, local.translation_m, about, middle, size)
    turns: list[Array] = [np.eye(3), *(2 * np.outer(a, a) - np.eye(3) for a in np.eye(3))]
    t = (local.translation_m + local.rotation @ about - middle) / size
    costs = []
    for chosen in product((False, True), repeat=len(b.cls)):
        inside = np.array(chosen)
        left_out = float(b.gate[~inside].sum())
        if not inside.any():
            costs.append(left_out)
            continue
        found = [minimiser(forms[inside].sum(axis=0), local.rotation @ turn, t, prove=False).value for turn in turns]
        costs.append(left_out + min(found))
    return min(costs)


@pytest.mark.parametrize(("seed", "bad"), [(0, 0), (1, 1), (2, 2)])
def test_no_set_is_better_than_the_proven_one(seed: int, bad: int) -> None:
    b, used, local = packed(["1v", "2t", "9t", "5v", "3p", "1t"], seed, bad)
    found = best_set(b, used, local, np.arange(len(b.cls)), deadline_s=60.0)
    assert found.proven
    assert found.gap < 1e-3 * (1 + found.cost)
    assert found.cost == pytest.approx(least_of_all_sets(b, used, local), rel=2e-3)


def test_the_answer_with_mismatches_is_proven() -> None:
    rng = np.random.default_rng(11)
    p = problem([CODES[k] for k in rng.integers(len(CODES), size=12)], rng, bad=2)
    answer = fuse(p.measurements, prove_set_within_s=60.0)
    proof = answer.proven_set
    assert proof is not None
    assert proof.proven
    assert proof.agrees
    assert set(range(12)) - set(proof.believed) == {r.index for r in answer.rejected}


def test_a_better_set_than_the_answers_is_found() -> None:
    b, used, local = packed(["1v", "2t", "9t", "5v", "3p", "1t", "6t"], 3, 1)
    best = best_set(b, used, local, np.arange(7), deadline_s=60.0)
    worse = used.copy()
    worse[int(np.flatnonzero(used)[0])] = False
    found = best_set(b, worse, local, np.arange(7), deadline_s=60.0)
    assert not found.agrees
    assert found.believed == best.believed


def test_at_the_deadline_the_gap_is_stated() -> None:
    b, used, local = packed(["1v", "2t", "9t", "5v", "3p", "1t", "8v"], 4, 2)
    ticks = count()
    found = best_set(b, used, local, np.arange(7), deadline_s=3.0, clock=lambda: float(next(ticks)))
    assert not found.proven
    assert found.gap == pytest.approx(found.cost - found.lower_bound)
    assert 0.0 < found.gap <= found.cost
    whole = best_set(b, used, local, np.arange(7), deadline_s=60.0)
    assert found.lower_bound <= whole.cost + 1e-6
    assert whole.gap < found.gap


def test_more_than_sixteen_are_refused() -> None:
    rng = np.random.default_rng(5)
    p = problem([CODES[k] for k in rng.integers(len(CODES), size=17)], rng)
    with pytest.raises(InvalidRequest, match="at most 16"):
        fuse(p.measurements, prove_set_within_s=1.0)
