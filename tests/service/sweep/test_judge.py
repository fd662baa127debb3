"""A deed is judged by what truly happened; saying so counts only when it is so."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hal.panel import Panel
from hal.simulated import ObjectTruth, TrueContact, Truth
from hal.strict import validate
from service.sweep.deeds import Deed, deeds_of
from service.sweep.draw import draw_panel
from service.sweep.judge import JudgedDeed, Verdict, judge

PANEL = validate(draw_panel(3).built, Panel, source="a random panel")  # its lever takes 18 N at the tip
START = {
    "main_valve": ObjectTruth(name="main_valve", state="closed", value=1.5708),
    "bypass": ObjectTruth(name="bypass", value=1.0),
    "setpoint": ObjectTruth(name="setpoint", value=20.0),
    "mode": ObjectTruth(name="mode", state="off", value=-0.7854),
    "pump": ObjectTruth(name="pump", state="on", value=0.4),
    "emergency": ObjectTruth(name="emergency", state="released", value=0.0),
    "start": ObjectTruth(name="start", state="released", value=0.0),
    "hold": ObjectTruth(name="hold", state="pressed", value=0.0),
    "run_lamp": ObjectTruth(name="run_lamp", state="off"),
}
DEEDS = {deed.object: deed for deed in deeds_of(3, PANEL, START)}


def judged(deed: Deed, outcome: str, *, contact: TrueContact | None = None, **now: ObjectTruth) -> JudgedDeed:
    answer: dict[str, Any] = {
        "outcome": outcome, "cause": "", "confirmed": outcome == "done", "attempts": 1, "peak_force_n": 9.0, "cell_s": 1.0,
    }  # fmt: skip
    truth = Truth(
        base_from_panel_matrix=np.eye(4),
        objects=tuple({**START, **now}.values()),
        peak_force_n=9.0,
        sim_time_s=5.0,
        initial=tuple(START.values()),
        contact=contact or TrueContact(peak_n=9.0),
    )
    return judge(3, deed, PANEL, answer, truth)


def slider_at(value: float) -> ObjectTruth:
    return ObjectTruth(name="setpoint", value=value)


@pytest.mark.parametrize(
    ("outcome", "off", "verdict"),
    [
        ("done", 0.019, Verdict.RIGHT),
        ("done", 0.021, Verdict.FALSE),
        ("slipped", 0.021, Verdict.FAILED),
        ("unverified", 0.0, Verdict.UNSAID),
    ],
)
def test_a_slider_is_right_within_two_percent_of_its_scale(outcome: str, off: float, verdict: Verdict) -> None:
    deed = DEEDS["setpoint"]
    goal, span = deed.goal, 60.0  # Hz
    assert isinstance(goal, float)
    assert judged(deed, outcome, setpoint=slider_at(goal + off * span)).verdict is verdict


@pytest.mark.parametrize(
    ("torque_nm", "row", "stiff_is"),
    [(1.0, "lever 90", Verdict.FAILED), (4.5, "lever 90", Verdict.RIGHT), (5.5, "lever too stiff", Verdict.RIGHT)],
)
def test_a_stiff_lever_must_be_named_so_and_a_light_one_turned(torque_nm: float, row: str, stiff_is: Verdict) -> None:
    lever = PANEL.objects[0].model_copy(update={"torque_nm": torque_nm})
    panel = PANEL.model_copy(update={"objects": (lever, *PANEL.objects[1:])})
    deed = next(deed for deed in deeds_of(3, panel, START) if deed.object == "main_valve")
    assert deed.row == row
    assert judged(deed, "stiff").verdict is stiff_is
    turned = ObjectTruth(name="main_valve", state="open", value=3.14)
    assert judged(deed, "done", main_valve=turned).verdict is Verdict.RIGHT


def test_a_button_is_judged_by_its_lamp() -> None:
    deed = DEEDS["start"]
    assert deed.goal == "on"
    assert judged(deed, "done").verdict is Verdict.FALSE
    assert judged(deed, "done", run_lamp=ObjectTruth(name="run_lamp", state="on")).verdict is Verdict.RIGHT


def test_what_was_not_named_may_neither_move_nor_be_pressed() -> None:
    deed = DEEDS["pump"]
    touched = TrueContact(peak_n=30.0, peaks_n={"pump": 30.0, "hold": 10.5, "mode": 9.5, "_plate": 20.0})
    off = ObjectTruth(name="pump", state="off", value=-0.4)
    told = judged(deed, "done", contact=touched, pump=off, setpoint=slider_at(22.0))
    assert told.verdict is Verdict.RIGHT and told.is_untrue
    assert told.moved_unasked == ("setpoint",)
    assert told.touched_unasked == ("hold",)


def test_a_cause_is_true_when_the_truth_agrees_with_its_type() -> None:
    lever, slider = DEEDS["main_valve"], DEEDS["setpoint"]
    assert judged(lever, "stiff").cause_is_true is False
    assert judged(slider, "missed").cause_is_true is True
    assert judged(slider, "missed", setpoint=slider_at(24.0)).cause_is_true is False
    assert judged(slider, "stalled", setpoint=slider_at(24.0)).cause_is_true is True
    assert judged(slider, "unreachable", contact=TrueContact()).cause_is_true is True
