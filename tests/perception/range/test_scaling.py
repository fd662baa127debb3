"""The discrete-event simulation of batches obeys the bounds that hold for any schedule."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.range_scaling import Cluster, simulate


@settings(max_examples=50, deadline=None)
@given(lengths=st.lists(st.floats(0.01, 2.0), min_size=1, max_size=60), workers=st.integers(1, 40))
def test_a_makespan_lies_between_its_bounds(lengths, workers):
    """Graham's bounds: at least the mean load and the longest task, at most their sum, apart from hand-overs."""
    work = np.array(lengths)
    makespan = simulate(work, Cluster(workers=workers, handover_s=0.0))
    assert makespan >= max(work.sum() / workers, work.max()) - 1e-9
    assert makespan <= work.sum() / workers + work.max() + 1e-9


def test_one_worker_pays_every_hand_over():
    assert simulate(np.full(10, 0.5), Cluster(workers=1, handover_s=0.1)) == pytest.approx(6.0)


def test_hand_over_bounds_how_many_workers_can_be_fed():
    work = np.full(1000, 0.04)
    makespan = simulate(work, Cluster(workers=1024, handover_s=0.01))
    assert makespan == pytest.approx(1000 * 0.01 + 0.04)


def test_stragglers_and_a_lost_worker_cost_time_but_no_task():
    work = np.full(200, 0.1)
    plain = simulate(work, Cluster(workers=4, handover_s=0.001))
    slow = simulate(work, Cluster(workers=4, handover_s=0.001, straggle_share=0.1))
    lost = simulate(work, Cluster(workers=4, handover_s=0.001, lost_at_s=plain / 2))
    assert plain < slow < 1.5 * plain
    assert plain < lost <= plain / 2 + (plain / 2) * 4 / 3 + 2.0 + 0.2
