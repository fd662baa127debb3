"""A simulated counter on a small panel: its drums, and that the camera's picture of it is read as the judge knows it."""

from __future__ import annotations

import pytest

from simbackend.bodies.counter import drum_places

SMALL = """
schema = 1
name = "small"
width_m = 0.4
height_m = 0.3
lights = [
  { name = "a", position_m = [-0.18, 0.13, 0.0] },
  { name = "b", position_m = [0.18, 0.13, 0.0] },
  { name = "c", position_m = [0.18, -0.13, 0.0] },
  { name = "d", position_m = [-0.18, -0.13, 0.0] },
]
objects = [
  { kind = "counter", name = "hours", label = "HOURS", position_m = [0.0, 0.0], width_m = 0.065, height_m = 0.018, unit = "h" },
]
"""


@pytest.mark.parametrize(
    ("steps", "places"),
    [(42.0, [0, 0, 4, 2]), (42.5, [0, 0, 4, 2.5]), (49.5, [0, 0, 4.5, 9.5]), (1999.25, [1.25, 9.25, 9.25, 9.25])],
)
def test_a_drum_turns_with_the_one_that_passes_nine(steps: float, places: list[float]) -> None:
    assert drum_places(steps, 4) == places
