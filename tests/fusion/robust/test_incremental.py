"""One measurement more or less gives what fusing at once would have given."""

from __future__ import annotations

import numpy as np
import pytest

from fusion import fuse
from fusion.robust import incremental
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose, difference
from tests.fusion.mixtures import mixture
from tests.fusion.robust.test_answer import leaning


def test_adding_and_removing_agree_with_fusing_at_once() -> None:
    p = mixture(17, 5, bad=2)
    grown = incremental.add(incremental.start(p.measurements[:16]), p.measurements[16])
    assert np.abs(difference(fuse(p.measurements).pose, grown.answer.pose)).max() < 1e-6
    shrunk = incremental.remove(grown, 4)
    left = [m for i, m in enumerate(p.measurements) if i != 4]
    assert np.abs(difference(fuse(left).pose, shrunk.answer.pose)).max() < 1e-6


def test_a_bad_one_added_is_named_and_moves_nothing() -> None:
    good, other = mixture(12, 6), mixture(12, 7)
    before = incremental.start(good.measurements)
    after = incremental.add(before, other.measurements[0])
    assert 12 in {r.index for r in after.answer.rejected}
    assert np.abs(difference(before.answer.pose, after.answer.pose)).max() < 1e-6


def test_a_repeated_measurement_is_refused() -> None:
    p = mixture(8, 8)
    with pytest.raises(InvalidRequest) as caught:
        incremental.add(incremental.start(p.measurements), p.measurements[2])
    assert caught.value.details["index"] == 8


def test_removing_what_is_not_there_is_refused() -> None:
    with pytest.raises(InvalidRequest):
        incremental.remove(incremental.start(mixture(8, 9).measurements), 8)


def test_a_prior_stays_what_it_is_when_measurements_come_and_go() -> None:
    p = mixture(14, 21)
    prior = UncertainPose(parent_from_child=p.base_from_object, covariance=np.diag([4e-6] * 3 + [1e-5] * 3))
    grown = incremental.add(incremental.start(p.measurements[:13], prior=prior), p.measurements[13])
    whole = fuse(p.measurements, prior=prior)
    assert np.abs(difference(whole.pose, grown.answer.pose)).max() < 1e-6
    assert grown.answer.covariance == pytest.approx(whole.covariance, rel=1e-3, abs=1e-12)
    assert [r.index for r in grown.answer.rejected] == [r.index for r in whole.rejected]
    shrunk = incremental.remove(grown, 13).answer
    assert np.abs(difference(fuse(p.measurements[:13], prior=prior).pose, shrunk.pose)).max() < 1e-6


def test_another_pose_that_fits_stays_listed_as_measurements_come_and_go() -> None:
    given = leaning(0.3, 0.2)
    grown = incremental.add(incremental.start(given[:-1]), given[-1])
    shrunk = incremental.remove(grown, len(given) - 1)
    for step, whole in ((grown, fuse(given)), (shrunk, fuse(given[:-1]))):
        assert len(step.answer.alternatives) == len(whole.alternatives) > 0
        assert step.answer.alternatives[0].odds == pytest.approx(whole.alternatives[0].odds, rel=1e-3)
        found = [step.answer.pose, *(other.pose for other in step.answer.alternatives)]
        for pose in (whole.pose, *(other.pose for other in whole.alternatives)):
            assert min(np.abs(difference(pose, one)).max() for one in found) < 1e-4
