"""Tests of how a reading is passed to the skills."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hal.panel import Slider, load_panel
from perception.vision.reading import ObjectReading
from service.operations.manipulate import object_state

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
