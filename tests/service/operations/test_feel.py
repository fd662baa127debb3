"""Touching the plate: a place that cannot be touched is replaced by another, a stop is no fault of a place."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hal.errors import NotFound, Stopped, Unreachable
from hal.panel import load_panel
from service.operations import sense
from service.operations.spots import bare_spots

PANEL = Path(__file__).parents[3] / "panels" / "bench.toml"


class Toucher:
    """Stands for the arm: the first touches fail with the errors given."""

    def __init__(self, *errors: Exception) -> None:
        self.errors = list(errors)
        self.tried = 0

    def __call__(self, session: Any, spot: Any, doubted: Any) -> list[Any]:
        self.tried += 1
        if self.errors:
            raise self.errors.pop(0)
        return [np.asarray(spot)]


def feel(monkeypatch: pytest.MonkeyPatch, toucher: Toucher, over_m: tuple[float, float] = (0.0, 0.0)) -> sense.Felt:
    monkeypatch.setattr(sense, "_feel_at", toucher)
    monkeypatch.setattr(sense, "_fingers_over_panel", lambda _: np.array(over_m))
    session: Any = SimpleNamespace(panel=load_panel(PANEL), progress=lambda *_: None)
    return sense.feel(session, 4)


def test_a_place_out_of_reach_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    felt = feel(monkeypatch, Toucher(Unreachable("no way to it", hint="another place")))
    assert len(felt.spots) == len(felt.observations) == 4
    assert "no way to it" in felt.skipped[0]


def test_too_few_places_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NotFound, match=r"only 2 of 4 places .* no way to it"):
        feel(monkeypatch, Toucher(*[Unreachable("no way to it", hint="another place")] * 4))


def test_a_stop_ends_it_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    toucher = Toucher(*[Stopped("the stop latch is set", hint="reset it")] * 6)
    with pytest.raises(Stopped, match="latch"):
        feel(monkeypatch, toucher)
    assert toucher.tried == 1


@pytest.mark.parametrize("over_m", [(0.2, -0.1), (-0.2, -0.1), (-0.1, 0.2)])
def test_places_are_touched_on_a_short_way_from_where_the_fingers_are(
    monkeypatch: pytest.MonkeyPatch, over_m: tuple[float, float]
) -> None:
    way = np.array([over_m, *feel(monkeypatch, Toucher(), over_m).spots])
    wanted = bare_spots(load_panel(PANEL), 4)
    assert {tuple(spot) for spot in way[1:]} == {tuple(spot) for spot in wanted}
    assert length_m(way) < 0.8 * length_m(np.array([over_m, *wanted])), "from corner to opposite corner before"


def length_m(way: Any) -> float:
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
