"""The guard that detects an end stop does not trip when a load is taken up again, and is not late for a stop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hal.motion import Guard, Quantity
from manipulation.control.guards import GuardSet, Measured

DT_S = 0.002
POSE = np.eye(4)


def trips_at_s(force_n: Callable[[float], float], *, rise_n: float, until_s: float = 2.0) -> float | None:
    """Return when a guard on a force rise trips for a force along x; None if it does not."""
    guards = GuardSet((Guard(name="stop", quantity=Quantity.FORCE_RISE, limit=rise_n, axis=(1.0, 0.0, 0.0)),), POSE)
    for tick in range(round(until_s / DT_S)):
        elapsed_s = tick * DT_S
        wrench = np.array([force_n(elapsed_s), 0, 0, 0, 0, 0.0])
        now = Measured(
            elapsed_s=elapsed_s,
            wrench=wrench,
            base_from_tool=POSE,
            commanded_tip_m=np.zeros(3),
            contacts=(),
            proximity_m=(),
        )
        if guards.tripped(now) is not None:
            return elapsed_s
    return None


def test_taking_up_the_load_of_the_motion_before_is_no_end_stop() -> None:
    """Half of a friction of 40 N is lost while the arm stands; an arm on a link starts to move 50 ms late."""

    def taken_up(late_s: float) -> Callable[[float], float]:
        return lambda t: 20.0 + 20.0 * min(max(t - late_s, 0.0) / 0.08, 1.0)

    for late_s in (0.0, 0.05):
        assert trips_at_s(taken_up(late_s), rise_n=8.0) is None


def test_a_stop_is_found_within_its_rise() -> None:
    slope_n_per_s = 90.0  # 5 kN/m at 18 mm/s
    found_s = trips_at_s(lambda t: 40.0 + slope_n_per_s * max(t - 1.0, 0.0), rise_n=8.0)
    assert found_s is not None
    assert 1.0 + 8.0 / slope_n_per_s <= found_s <= 1.0 + 8.0 / slope_n_per_s + 0.02


def test_a_stop_soon_after_the_start_is_found_as_fast() -> None:
    slope_n_per_s = 90.0
    found_s = trips_at_s(lambda t: 40.0 + slope_n_per_s * max(t - 0.25, 0.0), rise_n=8.0)
    assert found_s is not None
    assert found_s <= 0.25 + 8.0 / slope_n_per_s + 0.02


def test_friction_that_grows_over_a_second_is_no_end_stop() -> None:
    assert trips_at_s(lambda t: 40.0 + 30.0 * t, rise_n=8.0) is None
