"""Tests of the truth that the judge receives, with mechanisms at known positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from hal.panel import Gauge, Lamp, Lever, Scale, State, Toggle
from simbackend.bodies.body import Start, body_of
from simbackend.bodies.parts import nearest_state

STATES = (State(name="open", angle_rad=0.0), State(name="closed", angle_rad=1.57))


@dataclass
class At:
    """Mechanism that rests where it was put."""

    where: float
    body: int = 0

    def lock(self) -> None:
        """Do nothing, because there is nothing to hold."""

    def drive(self) -> None:
        """Do nothing, because there is nothing to drive."""

    def place(self) -> float:
        return self.where


def truth(panel_object: Any, place: float, *, lamp: bool = False) -> Any:
    return body_of(panel_object.kind).truth(panel_object, Start(), At(place), is_lit=lamp)


@pytest.mark.parametrize(("angle", "state"), [(0.1, "open"), (1.5, "closed"), (0.8, None), (-0.5, None)])
def test_a_lever_has_a_state_only_near_a_resting_place(angle: float, state: str | None) -> None:
    assert nearest_state(STATES, angle) == state
    shown = truth(Lever(name="l", position_m=(0.0, 0.0), states=STATES), angle)
    assert (shown.state, shown.value) == (state, angle)


def test_a_gauge_shows_the_value_of_its_needles_angle() -> None:
    scale = Scale(minimum=0.0, maximum=10.0, unit="bar", at_min=-2.0, at_max=2.0)
    assert truth(Gauge(name="g", position_m=(0.0, 0.0), radius_m=0.03, scale=scale), 1.0).value == pytest.approx(7.5)


def test_a_toggle_is_on_when_its_bat_points_up() -> None:
    toggle = Toggle(name="t", position_m=(0.0, 0.0))
    assert (truth(toggle, 0.4).state, truth(toggle, -0.4).state) == ("on", "off")


def test_a_lamp_is_what_the_panel_says() -> None:
    lamp = Lamp(name="x", position_m=(0.0, 0.0), radius_m=0.01)
    assert (truth(lamp, 0.0, lamp=True).state, truth(lamp, 0.0).state) == ("on", "off")
