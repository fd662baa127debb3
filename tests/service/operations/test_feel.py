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

PANEL = Path(__file__).parents[3] / "panels" / "bench.toml"


class Toucher:
    """Stands for the arm: the first touches fail with the errors given."""

    def __init__(self, *errors: Exception) -> None:
        self.errors = list(errors)
        self.tried = 0

    def __call__(self, session: Any, spot: Any) -> list[Any]:
        self.tried += 1
        if self.errors:
            raise self.errors.pop(0)
        return [np.asarray(spot)]


def feel(monkeypatch: pytest.MonkeyPatch, toucher: Toucher) -> sense.Felt:
    monkeypatch.setattr(sense, "_feel_at", toucher)
    session: Any = SimpleNamespace(panel=load_panel(PANEL), progress=lambda *_: None)
    return sense.feel(session, 4)


def test_a_place_out_of_reach_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    felt = feel(monkeypatch, Toucher(Unreachable("no way to it", hint="another place")))
    assert len(felt.spots) == len(felt.evidence) == 4
    assert "no way to it" in felt.skipped[0]


def test_too_few_places_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NotFound, match=r"only 2 of 4 places .* no way to it"):
        feel(monkeypatch, Toucher(*[Unreachable("no way to it", hint="another place")] * 4))


def test_a_stop_ends_it_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    toucher = Toucher(*[Stopped("the stop latch is set", hint="reset it")] * 6)
    with pytest.raises(Stopped, match="latch"):
        feel(monkeypatch, toucher)
    assert toucher.tried == 1
