"""Two photographs of lift panels: after five clicks the other buttons are found, and before nothing is surely named."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.vision_lifts import CLICKS, LIFTS, PRECISION, REAL, RECALL, Lift, found, surely_named, taught

pytestmark = pytest.mark.skipif(not REAL.exists(), reason="no photographs beside the repository")


@pytest.mark.parametrize("lift", LIFTS, ids=lambda lift: lift.name)
def test_five_clicks_find_the_other_buttons(lift: Lift) -> None:
    random = np.random.default_rng(8)
    clicks = [random.choice(lift.middles_px(), CLICKS, replace=False) for _ in range(4)]
    hits, there, others = np.sum([found(lift, 1.0, taught(lift, 1.0, one)) for one in clicks], axis=0)
    assert hits >= RECALL * there
    assert hits >= PRECISION * (hits + others)


@pytest.mark.parametrize("lift", LIFTS, ids=lambda lift: lift.name)
def test_nothing_is_surely_named_before_it_is_taught(lift: Lift) -> None:
    assert surely_named(lift, 1.0) == surely_named(lift, 1.5) == []
