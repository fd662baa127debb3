"""Invalid input is refused with index and reason; what cannot be determined is reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fusion_simulation import CODES, Problem, problem
from fusion import Measurement, SensingClass, fuse
from fusion.errors import Contradiction
from fusion.features import line, plane
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose, difference
from tests.fusion.mixtures import mixture

NAN = float("nan")


def made(seed: int = 0, count: int = 12) -> Problem:
    rng = np.random.default_rng(seed)
    return problem([CODES[k] for k in rng.integers(len(CODES), size=count)], rng)


def first_sensed_line(p: Problem) -> int:
    return next(i for i, m in enumerate(p.measurements) if m.cls >= 4)


BAD: dict[str, tuple[Callable[[Measurement], Measurement], str]] = {
    "non-SPD C": (lambda m: replace(m, C_m2=np.diag([1e-6, -1e-6, 1e-6])), "positive definite"),
    "flat C": (lambda m: replace(m, C_m2=np.diag([1e-6, 0.0, 1e-6])), "positive definite"),
    "asymmetric C": (lambda m: replace(m, C_m2=1e-6 * np.array([[1, 0.5, 0], [0, 1, 0], [0, 0, 1]])), "symmetric"),
    "indefinite M": (lambda m: replace(m, M=np.diag([1e4, 1e4, -1e4])), "indefinite"),
    "M without null": (lambda m: replace(m, M=1e4 * np.eye(3)), "null direction"),
    "no M": (lambda m: replace(m, M=np.zeros((3, 3))), "needs M"),
    "NaN place": (lambda m: replace(m, mu_m=np.array([0.0, NAN, 0.0])), "not finite"),
    "infinite C": (lambda m: replace(m, C_m2=np.diag([np.inf, 1.0, 1.0])), "not finite"),
    "zero direction": (lambda m: replace(m, cls=SensingClass.LINE_LINE, u=np.zeros(3)), "direction is zero"),
    "millimetres": (lambda m: replace(m, mu_m=1000.0 * m.mu_m), "beyond"),
    "covariance in mm^2": (lambda m: replace(m, C_m2=1e6 * np.eye(3)), "standard deviation"),
    "wrong shape": (lambda m: replace(m, mu_m=np.zeros(2)), "shape"),
}


@pytest.mark.parametrize("what", BAD)
def test_nonsense_is_refused_with_index_and_reason(what: str) -> None:
    spoil, reason = BAD[what]
    p = made()
    i = first_sensed_line(p)
    given = list(p.measurements)
    given[i] = spoil(given[i])
    with pytest.raises(InvalidRequest) as caught:
        fuse(given)
    assert caught.value.details["index"] == i
    assert reason in caught.value.details["reason"]
    assert caught.value.hint


def test_nothing_to_fuse_is_refused() -> None:
    with pytest.raises(InvalidRequest, match="no measurement"):
        fuse([])


@pytest.mark.parametrize("build", [line, plane])
def test_a_feature_needs_a_direction(build: Callable[..., object]) -> None:
    with pytest.raises(InvalidRequest, match="zero"):
        build((0, 0, 0), (0, 0, 0))


def test_too_few_constraints_are_answered_with_what_stays_free() -> None:
    rng = np.random.default_rng(4)
    one = problem(["1t"], rng)
    answer = fuse(one.measurements)
    assert len(answer.unobservable) == 3
    assert all("turn about" in free.words for free in answer.unobservable)
    assert np.sqrt(np.linalg.eigvalsh(answer.covariance)[-1]) > 1.0


def test_a_free_shift_is_named_with_its_direction() -> None:
    rng = np.random.default_rng(5)
    p = problem(["9t"], rng)
    answer = fuse(p.measurements)
    shifts = [free for free in answer.unobservable if free.words.startswith("shift")]
    assert len(shifts) == 2
    normal = answer.pose.rotation.apply(p.measurements[0].u)
    assert all(abs(free.twist[:3] @ normal) < 1e-6 for free in shifts)


def test_all_bad_is_a_contradiction_and_no_pose() -> None:
    rng = np.random.default_rng(6)
    p = problem([CODES[k] for k in rng.integers(len(CODES), size=12)], rng, bad=12)
    with pytest.raises(Contradiction) as caught:
        fuse(p.measurements)
    assert caught.value.details["total"] == 12


@pytest.mark.parametrize("count", [3, 5, 7])
def test_where_nothing_agrees_each_measurement_is_named(count: int) -> None:
    given = [mixture(count, 31 + k).measurements[k] for k in range(count)]  # each of another pose
    with pytest.raises(Contradiction) as caught:
        fuse(given)
    named = [one["index"] for one in caught.value.details["outside"]]
    assert len(named) == count - caught.value.details["agreeing"]
    assert set(named) <= set(range(count)) and named


def test_duplicates_count_once_and_are_named() -> None:
    p = made(7)
    once, twice = fuse(p.measurements), fuse([*p.measurements, p.measurements[3]])
    assert twice.covariance == pytest.approx(once.covariance)
    (repeat,) = [r for r in twice.rejected if r.index == len(p.measurements)]
    assert repeat.reason == "duplicate of measurement 3"
    assert len(twice.values) == len(p.measurements) + 1


def test_ten_thousand_measurements_are_fused() -> None:
    rng = np.random.default_rng(8)
    p = problem(["3t"] * 400 + ["1v"] * 100, rng, bad=100)
    copies = [
        replace(m, mu_m=m.mu_m + rng.normal(0, 1e-5, 3), C_m2=m.C_m2 + 1e-10 * np.eye(3))
        for _ in range(20)
        for m in p.measurements
    ]
    answer = fuse(copies)
    delta = difference(p.base_from_object, answer.pose)
    assert np.linalg.norm(delta[:3]) < 0.001
    assert len(answer.values) == 10_000


def test_a_prior_must_be_a_covariance() -> None:
    p = made(9)
    covariance = np.diag([1e-4, 1e-4, 1e-4, 1e-4, 1e-4, -1e-4])
    with pytest.raises(InvalidRequest, match="indefinite"):
        fuse(p.measurements, prior=UncertainPose(parent_from_child=p.base_from_object, covariance=covariance))
