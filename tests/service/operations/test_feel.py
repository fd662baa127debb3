"""Tests of touching the plate: the most informative place is first, unreachable ones are replaced, a stop ends it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fusion import PoseTolerance, TouchPlan
from fusion.shared_errors import ErrorBudget
from hal.errors import NotFound, Stopped, Unreachable
from hal.panel import load_panel
from service.operations import sense
from tests.fusion.test_shared_errors import BASE_FROM_PANEL

PANEL = load_panel(Path(__file__).parents[3] / "panels" / "bench.toml")
SPOTS_M = np.array([(0.25, 0.16), (-0.25, -0.16), (0.12, -0.2), (-0.12, 0.2), (0.0, 0.0), (0.25, -0.1)])


def touch_at(spot_m: Any) -> ErrorBudget:
    """Return the information of a touch with 0.2 mm; in these tests the base frame equals the panel frame."""
    row = np.array([0.0, 0.0, 1.0, spot_m[1], -spot_m[0], 0.0]) / 2e-4
    return ErrorBudget(information=np.outer(row, row), own=np.outer(row, row), shared={})


def plan(**changes: Any) -> TouchPlan:
    """Return a pose known to 1 mm and 3 mrad where touches are informative, and ten times better otherwise."""
    A = np.diag(np.array([1e-4, 1e-4, 1e-3, 3e-3, 3e-3, 3e-4]) ** -2.0)
    made = TouchPlan(
        base_from_panel=BASE_FROM_PANEL,
        budget=ErrorBudget(information=A, own=A, shared={}),
        tolerance=PoseTolerance(position_m=1e-4, angle_rad=3e-4),
        spots_m=SPOTS_M,
        offers=tuple(touch_at(spot) for spot in SPOTS_M),
        places=4,
        tip_m=np.zeros(2),
        speed_m_per_s=0.25,
    )
    return replace(made, **changes)


class Toucher:
    """Replaces the arm: the first touches raise the given errors; the others return their place."""

    def __init__(self, *errors: Exception) -> None:
        self.errors = list(errors)
        self.tried = 0

    def __call__(self, session: Any, spot: Any, monitor: Any) -> list[Any]:
        self.tried += 1
        if self.errors:
            raise self.errors.pop(0)
        return [np.asarray(spot)]


def follow(monkeypatch: pytest.MonkeyPatch, toucher: Toucher, made: TouchPlan, most: int = 4) -> sense.Felt:
    monkeypatch.setattr(sense, "_feel_at", toucher)
    monkeypatch.setattr(sense, "mounts_of", lambda *_: {})
    monkeypatch.setattr(sense, "error_budget", lambda spots, *_: touch_at(spots[0]))
    session: Any = SimpleNamespace(panel=PANEL, progress=lambda *_: None)
    return sense.touch_by_plan(session, made, most)


def test_each_touch_brings_what_it_was_expected_to(monkeypatch: pytest.MonkeyPatch) -> None:
    felt = follow(monkeypatch, Toucher(), plan())
    assert len(felt.account.touches) == len(felt.observations) == 4
    assert felt.account.ended == "the requested number of places was touched"
    for touch in felt.account.touches:
        assert touch.error_after == pytest.approx(touch.error_expected)
        assert touch.error_after < touch.error_before
        assert "expected to lower" in touch.words
    assert all(
        a.error_after == pytest.approx(b.error_before)
        for a, b in zip(felt.account.touches, felt.account.touches[1:], strict=False)
    )


def test_three_touches_far_apart_come_first(monkeypatch: pytest.MonkeyPatch) -> None:
    first = np.array([touch.spot_m for touch in follow(monkeypatch, Toucher(), plan(), most=3).account.touches])
    edges = first[1:] - first[0]
    assert abs(np.linalg.det(edges)) > 0.04, "square metres of twice their triangle: a plane is known by three corners"


def test_touching_ends_when_the_pose_is_good_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    toucher = Toucher()
    felt = follow(monkeypatch, toucher, plan(tolerance=PoseTolerance(position_m=0.1, angle_rad=0.1)))
    assert (felt.account.touches, toucher.tried) == ([], 0)
    assert felt.account.ended == "the pose is as good as wanted"


def test_touching_ends_when_a_further_touch_brings_little(monkeypatch: pytest.MonkeyPatch) -> None:
    useless = tuple(ErrorBudget(information=1e-6 * o.information, own=1e-6 * o.own, shared={}) for o in plan().offers)
    felt = follow(monkeypatch, Toucher(), plan(offers=useless))
    assert felt.account.touches == []
    assert "no further touch" in felt.account.ended


def test_a_place_out_of_reach_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    felt = follow(monkeypatch, Toucher(Unreachable("no way to it", hint="another place")), plan())
    assert len(felt.account.touches) == len(felt.observations) == 4
    assert "no way to it" in felt.account.skipped[0]
    assert list(SPOTS_M[4]) in [touch.spot_m for touch in felt.account.touches], "the first spare place stands in"


def test_too_few_places_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NotFound, match=r"only 2 of 4 places .* no way to it"):
        follow(monkeypatch, Toucher(*[Unreachable("no way to it", hint="another place")] * 4), plan())


def test_a_stop_ends_it_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    toucher = Toucher(*[Stopped("the stop latch is set", hint="reset it")] * 6)
    with pytest.raises(Stopped, match="latch"):
        follow(monkeypatch, toucher, plan())
    assert toucher.tried == 1
