"""Tests of what an answer reports about other poses, repeated measurements, and agreement by chance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusion import fuse
from fusion.batch import duplicates, pack
from fusion.features import Kind, point
from fusion.measurement import Measurement, measurement
from fusion.robust.evidence import log_evidence
from fusion.solve import local_solution
from hal.geometry import matrix_of, transform
from tests.fusion.mixtures import mixture


def leaning(*sigmas_m: float) -> list[Measurement]:
    """Return two marks and a third of which only a plane is known, so the pose flipped about the first two also fits;
    then rough positions of the third, which favour one of the two poses.
    """
    pose = transform(np.eye(3), (0.5, 0.1, 0.3))
    C = 0.0005**2 * np.eye(3)
    marks = [point((0, 0, 0)), point((0.4, 0, 0))]
    third, M = point((0.1, 0.2, 0.1)), 1e6 * (np.eye(3) - np.diag([0.0, 1.0, 0.0]))
    given = [measurement(mark, Kind.POINT, mu_m=pose.apply(mark.point_m), C_m2=C) for mark in marks]
    given.append(measurement(third, Kind.PLANE, mu_m=pose.apply(third.point_m), C_m2=C, M=M))
    rough = [measurement(third, Kind.POINT, mu_m=pose.apply(third.point_m), C_m2=s**2 * np.eye(3)) for s in sigmas_m]
    return [*given, *rough]


@pytest.mark.parametrize("sigmas_m", [(), (0.3,), (0.2,), (0.1,), (0.1, 0.3)])
def test_the_odds_of_another_pose_are_those_of_its_error_and_its_room(sigmas_m: tuple[float, ...]) -> None:
    answer = fuse(leaning(*sigmas_m))
    own = answer.chi_square + sum(r.limit for r in answer.rejected)
    assert answer.alternatives
    for other in answer.alternatives:
        room = np.linalg.det(other.covariance) / np.linalg.det(answer.covariance)
        assert other.odds == pytest.approx(min(1.0, math.exp(0.5 * (own - other.cost)) * math.sqrt(room)), rel=1e-4)
    odds = [other.odds for other in answer.alternatives]
    assert odds == sorted(odds, reverse=True)
    assert answer.is_ambiguous and odds[0] > 0.05


def test_a_measurement_repeats_another_only_in_every_number() -> None:
    given = mixture(6, 3).measurements
    lines = next(m for m in given if m.cls >= 4)
    sharper = replace(lines, M=2.0 * lines.M)
    assert duplicates([*given, sharper]) == {}
    assert duplicates([*given, lines]) == {len(given): given.index(lines)}


def test_evidence_falls_by_half_of_the_misfit_and_by_the_choice_of_a_set() -> None:
    p, stray = mixture(12, 8), mixture(12, 9).measurements[0]
    R, t = matrix_of(p.base_from_object), np.array(p.base_from_object.translation)
    b, used = pack(p.measurements), np.ones(12, bool)
    local = local_solution(b, used.astype(float), R, t)
    alone = log_evidence(b, used, local)
    worse = replace(local, values=local.values + 0.5)
    assert log_evidence(b, used, worse) == pytest.approx(alone - 0.5 * 12 * 0.5)
    with_stray = pack([*p.measurements, stray])
    among = replace(local, values=np.append(local.values, 1e6))
    assert log_evidence(with_stray, np.append(used, False), among) == pytest.approx(alone - math.log(13))
