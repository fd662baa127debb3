"""Tests of how a reading is passed to the skills, and of when it is doubted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hal.errors import DeviceFault
from hal.panel import Slider, load_panel
from manipulation import Outcome, SkillReport
from perception.vision.reading import ObjectReading
from service.operations import manipulate
from service.operations.locate import PanelShift
from service.operations.manipulate import object_state
from service.world_model import WorldModel

PANEL = Path(__file__).parents[3] / "panels" / "bench.toml"


def reading(uncertainty: float | None) -> ObjectReading:
    return ObjectReading(
        name="setpoint", kind="slider", present=True, centre_px=np.zeros(2), outline_px=np.zeros((4, 2)), value=71.1,
        unit="%", uncertainty=uncertainty,
    )  # fmt: skip


def test_the_skill_learns_how_sure_the_look_is() -> None:
    panel_object = load_panel(PANEL).object("setpoint")
    assert isinstance(panel_object, Slider)
    assert object_state(reading(0.3), panel_object).sigma == 0.3
    assert object_state(reading(None), panel_object).sigma == 0.0
    assert object_state(reading(0.3), panel_object).value == 71.1


@dataclass(frozen=True)
class Context:
    """As much of a skill's context as is set for a deed."""

    is_in_place: Callable[[], bool] = lambda: True


def test_a_control_is_not_known_any_more_once_a_stroke_began_that_a_fault_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The way to park would otherwise lead through the place to which a lever was half turned."""

    def fail(*_: Any, **__: Any) -> SkillReport:
        raise DeviceFault("wrist_ft silent", hint="none", device="wrist_ft")

    slider: Any = load_panel(PANEL).object("setpoint")
    session: Any = SimpleNamespace(panel=load_panel(PANEL), world=WorldModel())
    session.world.note_readings([reading(0.3)])
    monkeypatch.setattr(manipulate, "skill_context", lambda _: Context())
    monkeypatch.setattr(manipulate, "operate", fail)
    with pytest.raises(DeviceFault):
        manipulate._operate(session, manipulate._Eye(session, slider, True), slider, 70.0, reading(0.3))
    assert "setpoint" not in session.world.readings


@pytest.mark.parametrize(
    ("value", "has_moved", "outcome"),
    [(70.4, True, "done"), (85.5, True, "unverified"), (None, True, "unverified"), (85.5, False, "done")],
)
def test_what_was_seen_of_a_panel_that_has_moved_is_looked_at_again(
    value: float | None, has_moved: bool, outcome: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drill 210: the panel jumped by 15 mm along a track, so the look said 70 % of a slider at 85.5 %."""
    slider: Any = load_panel(PANEL).object("setpoint")
    shift = PanelShift(moved_m=0.015, turned_rad=0.0) if has_moved else None
    monkeypatch.setattr(manipulate, "look_again", lambda *_: shift)
    seen = None if value is None else replace(reading(0.3), value=value)
    eye: Any = SimpleNamespace(last=reading(0.3), witness=slider, before=lambda is_fresh: seen)
    done = SkillReport(
        skill="slider", object="setpoint", target="70 %", outcome=Outcome.DONE, cause="", reached=70.0, seen=None,
        attempts=3, started_s=0.0, ended_s=1.0, peak_force_n=0.0, motions=(), was_missed=True,
    )  # fmt: skip
    session: Any = SimpleNamespace()
    told, findings = manipulate._after_doubt(session, eye, slider, 70.0, done)
    assert (told.outcome, len(findings)) == (outcome, int(has_moved))
