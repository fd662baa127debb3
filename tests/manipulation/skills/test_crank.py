"""Tests of where the fingers stand behind the spokes of a wheel, against polygons cut out of its plane."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hal.arrays import Array
from hal.panel import Handwheel
from manipulation.planning.hand import Hand
from manipulation.skills.crank import HUB_MARGIN_M, RIM_MARGINS_M, SpokeHold, spoke_holds

HAND = Hand()
WHEELS = [
    (wheel, angle, sign)
    for radius, spokes in itertools.product((0.030, 0.035, 0.048), (2, 3, 4, 5))
    for angle, sign in ((0.3, 1.0), (-2.0, -1.0))
    if spoke_holds(
        wheel := Handwheel(name="w", position_m=(0.1, 0.0), radius_m=radius, spokes=spokes), HAND, angle, sign
    )
]


def boundary(wheel: Handwheel, hold: SpokeHold, turned_rad: float) -> tuple[Array, Array]:
    """Return points (2, N, 2) on the outlines of both fingers in the wheel's plane, from the hub."""
    pose = hold.grip(wheel, turned_rad, 0.0, flip=False)
    t, w = HAND.finger_thickness_m, HAND.finger_width_m
    u = np.linspace(-0.5, 0.5, 41)
    box = np.concatenate(
        [[[a * t, b * w] for b in u] for a in (-0.5, 0.5)] + [[[a * t, b * w] for a in u] for b in (-0.5, 0.5)]
    )
    fingers = []
    for side in (-1.0, 1.0):
        points = np.column_stack([box[:, 0] + side * hold.half_m, box[:, 1], np.zeros(len(box))])
        fingers.append((pose.apply(points))[:, :2] - np.array(wheel.position_m))
    return fingers[0], fingers[1]


def to_spokes(wheel: Handwheel, angle_rad: float, points: Array) -> Array:
    """Return the distances (N,) of points to the nearest spoke's surface."""
    gaps = []
    for k in range(wheel.spokes):
        a = angle_rad + 2.0 * np.pi * k / wheel.spokes
        along = points @ [np.sin(a), np.cos(a)]
        across = np.abs(points @ [np.cos(a), -np.sin(a)])
        gaps.append(np.where(along > 0.0, across, np.hypot(along, across)) - wheel.spoke_m)
    return np.min(gaps, axis=0)


@pytest.mark.parametrize(("wheel", "angle_rad", "sign"), WHEELS)
def test_fingers_come_down_free_and_meet_both_spokes_at_once(wheel: Handwheel, angle_rad: float, sign: float) -> None:
    furthest, wide = (spoke_holds(wheel, HAND, angle_rad, sign, least_arm_m=least_m) for least_m in (np.inf, 0.0))
    assert all(one.arm_m <= other.arm_m for one, other in zip(wide, furthest, strict=True))
    for hold in (*furthest, *wide):
        for points in boundary(wheel, hold, 0.0):
            far = np.linalg.norm(points, axis=1)
            assert far.max() <= wheel.radius_m - wheel.rim_m - min(RIM_MARGINS_M) + 1e-6
            assert far.min() >= wheel.hub_m + HUB_MARGIN_M - 1e-4
            assert to_spokes(wheel, angle_rad, points).min() > 0.001
        arms = []
        for points in boundary(wheel, hold, sign * hold.behind_rad):
            gaps = to_spokes(wheel, angle_rad, points)
            assert gaps.min() == pytest.approx(0.0, abs=1e-3)  # of five spokes one is met 0.9 mm before the other
            arms.append(np.linalg.norm(points[np.argmin(gaps)]))
        assert np.mean(arms) == pytest.approx(hold.arm_m, abs=1e-3)


def test_a_wheel_that_is_too_small_for_the_fingers_has_no_hold() -> None:
    assert spoke_holds(Handwheel(name="w", position_m=(0.0, 0.0), radius_m=0.024), HAND, 0.0, 1.0) == ()
