"""Tests of which proximity sensors are trusted over a plate that was touched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.devices import ProximityCapabilities
from hal.errors import DeviceFault
from hal.geometry import transform_rpy
from hal.panel import load_panel
from manipulation.planning.touch_points import touch_points
from manipulation.plausibility import ProximityMonitor
from manipulation.plausibility.proximity import BARE_M

PANEL = load_panel(Path(__file__).parents[3] / "panels" / "bench.toml")
SPOTS = touch_points(PANEL, 4)
OF = ProximityCapabilities(min_range_m=0.02, max_range_m=0.6, sigma_m=0.0008, rate_hz=100.0)
BASE_FROM_PANEL = transform_rpy((0.75, 0.1, 0.6), (np.pi / 2, 0.05, -np.pi / 2))
BULGE_M = 0.002  # the plate is this far in front of its place by the panel's pose


def over(spot: Sequence[float], height_m: float) -> RigidTransform:
    """Return `base_from_sensor` that faces a point of the plate at a right angle from a given distance."""
    down = Rotation.from_euler("x", np.pi)
    return BASE_FROM_PANEL * RigidTransform.from_components([spot[0], spot[1], BULGE_M + height_m], down)


def visit(
    watch: ProximityMonitor, spot: Sequence[float], *said_m: float, heights_m: Sequence[float] = (0.12, 0.1)
) -> None:
    finding = watch.note(
        "left",
        OF,
        [(over(spot, height), said) for height, said in zip(heights_m, said_m, strict=True)],
        base_from_panel=BASE_FROM_PANEL,
        touched_m=np.asarray(BASE_FROM_PANEL.apply([spot[0] + 0.05, spot[1], BULGE_M])),
    )
    if finding is not None:
        raise finding.error()


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ((0.15, 0.13), (0.15, 0.13), "says 1[35]0 mm where .* is 1[02]0 mm"),  # off by 30 mm
        ((0.12, 0.12), (0.12, 0.12), "says 120 mm where .* is 100 mm"),  # frozen over the plate
        ((0.40, 0.40), (0.40, 0.40), "says 400 mm where .* is 100 mm"),  # frozen before it reached the plate
        ((math.nan, math.nan), (math.nan, math.nan), "sees nothing where .* is 120 mm"),
    ],
)
def test_a_sensor_that_is_off_by_the_same_at_two_places_is_named(
    first: Sequence[float], second: Sequence[float], words: str
) -> None:
    watch = ProximityMonitor(PANEL)
    visit(watch, SPOTS[0], *first)
    with pytest.raises(DeviceFault, match=f"left {words}") as caught:
        visit(watch, SPOTS[1], *second)
    assert caught.value.details["device"] == "left" and "window" in caught.value.hint


def test_noise_and_what_hangs_before_the_plate_at_one_place_is_no_fault() -> None:
    watch = ProximityMonitor(PANEL)
    for spot, said in zip([*SPOTS, *SPOTS], [(0.123, 0.097), (0.06, 0.04), (0.12, 0.1), (0.06, 0.04)] * 2, strict=True):
        visit(watch, spot, *said)
    watch = ProximityMonitor(PANEL)
    for spot, nearer in zip(SPOTS, (0.03, 0.06, 0.02, 0.07), strict=True):  # cables at different heights
        visit(watch, spot, 0.12 - nearer, 0.1 - nearer)


def test_beams_that_may_meet_something_else_say_nothing() -> None:
    edge = PANEL.width_m / 2
    panel_object = PANEL.objects[0].position_m
    for foot in ((edge - 0.5 * BARE_M, 0.0), (edge + 0.05, 0.0), panel_object):
        watch = ProximityMonitor(PANEL)
        for _ in range(3):
            visit(watch, foot, 0.3, 0.3)
    watch = ProximityMonitor(PANEL)
    for spot in SPOTS:
        visit(watch, spot, math.nan, math.nan, heights_m=(0.01, 0.62))  # out of its range
