"""Tests of comparing mushroom and wheel, found by their surfaces, with layout and vision."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.errors import NotFound
from hal.geometry import UncertainPose
from hal.panel import Handwheel, Mushroom
from perception.range import Sighting
from perception.range.matching.match import Match
from perception.vision.reading import ObjectReading
from service.operations.range_detection import CLOSER, OVERVIEW, SurfaceCheck, after_both, compared, need_its_place

BASE_FROM_PANEL = RigidTransform.from_components([0.9, 0.1, 0.5], Rotation.from_euler("xyz", [1.5, 0.1, -1.6]))
MUSHROOM = Mushroom(name="stop", position_m=(0.19, 0.0))
WHEEL = Handwheel(name="bypass", position_m=(-0.06, 0.02))
SIGMA_M = 0.001


def pose(parent_from_child: RigidTransform, sigma_m: float) -> UncertainPose:
    """Return a pose with a precise orientation and `sigma_m` in position."""
    return UncertainPose(parent_from_child=parent_from_child, covariance=np.diag([sigma_m**2] * 3 + [1e-10] * 3))


def sighting(
    panel_object: Mushroom | Handwheel, *, off_m: tuple[float, float] = (0.0, 0.0), state: float = 0.0
) -> Sighting:
    """Return an object found `off_m` (x, y on the panel) from its place in the file."""
    at = RigidTransform.from_translation(
        [panel_object.position_m[0] + off_m[0], panel_object.position_m[1] + off_m[1], 0.0]
    )
    found = pose(BASE_FROM_PANEL * at, SIGMA_M)
    match = Match(
        model=panel_object.name,
        sensor_from_object=found,
        labels={},
        state=state,
        state_sigma=0.01,
        free=(),
        score=100.0,
        seen=0.6,
    )
    return Sighting(
        panel_object=panel_object, match=match, base_from_object=found, off_m=float(np.hypot(*off_m)), state=state
    )


def reading(
    panel_object: Mushroom | Handwheel, *, state: str | None = None, value: float | None = None
) -> ObjectReading:
    """Return a reading by vision, with the object at its place in the file."""
    return ObjectReading(
        name=panel_object.name,
        kind=panel_object.kind,
        present=True,
        centre_px=np.zeros(2),
        outline_px=np.zeros((4, 2)),
        centre_m=np.array([*panel_object.position_m, 0.0]),
        state=state,
        value=value,
        uncertainty=0.01 if value is not None else None,
    )


def check(seen: Sighting, shown: ObjectReading | None = None, place: str = OVERVIEW) -> SurfaceCheck:
    """Return the judgement with a panel pose that is known to 0.1 mm."""
    return compared(seen, pose(BASE_FROM_PANEL, 1e-4), 0.0002, shown, place)


def test_the_distance_is_told_with_its_deviation_and_that_from_vision():
    row = check(sighting(MUSHROOM, off_m=(0.0012, -0.0005)), reading(MUSHROOM, state="released"))
    assert row.agrees and not row.stands_elsewhere
    assert row.off_m == pytest.approx(0.0013) and row.off_vision_m == pytest.approx(0.0013)
    assert row.sigma_m == pytest.approx(np.sqrt(SIGMA_M**2 + 1e-8 + 4e-8), rel=0.01)
    assert row.chi_square == pytest.approx((row.off_m / row.sigma_m) ** 2, rel=0.01)
    assert "1.3 mm from its place" in row.finding


@pytest.mark.parametrize(("sigmas", "stands_elsewhere"), [(3.6, False), (3.8, True)])
def test_one_of_a_thousand_that_stand_in_their_place_is_taken_to_stand_elsewhere(sigmas, stands_elsewhere):
    # With two degrees of freedom a deviation r has p = exp(-r^2 / 2), which is 0.001 at 3.717.
    off_m = sigmas * np.sqrt(SIGMA_M**2 + 1e-8 + 4e-8)
    row = check(sighting(WHEEL, off_m=(0.6 * off_m, 0.8 * off_m)))
    assert row.stands_elsewhere is stands_elsewhere


def test_what_stands_elsewhere_is_not_worked_and_others_are():
    row = check(sighting(WHEEL, off_m=(0.006, 0.0)))
    assert row.found and row.agrees is False and row.stands_elsewhere
    need_its_place([row], "stop")
    with pytest.raises(NotFound, match=r"bypass is not operated.*6\.0 mm"):
        need_its_place([row], "bypass")


@pytest.mark.parametrize(
    ("seen", "shown", "is_alike"),
    [
        (sighting(MUSHROOM, state=-0.006), reading(MUSHROOM, state="pressed"), True),
        (sighting(MUSHROOM, state=-0.006), reading(MUSHROOM, state="released"), False),
        (sighting(MUSHROOM, state=-0.0002), reading(MUSHROOM, state="released"), True),
        (sighting(WHEEL, state=0.2), reading(WHEEL, value=0.22), True),
        (sighting(WHEEL, state=0.2), reading(WHEEL, value=0.22 - 4 * np.pi / 3), True),
        (sighting(WHEEL, state=0.02), reading(WHEEL, value=-0.02), True),
        (sighting(WHEEL, state=0.2), reading(WHEEL, value=0.6), False),
        (sighting(WHEEL, state=0.2), None, True),
    ],
)
def test_the_state_is_compared_too_a_wheel_up_to_its_spokes(seen, shown, is_alike):
    row = check(seen, shown)
    assert row.agrees is is_alike and not row.stands_elsewhere
    assert ("by vision" in row.finding) is not is_alike


def test_what_was_not_found_says_why_and_forbids_nothing():
    row = check(Sighting(panel_object=WHEEL, why="not in the scanner's view"))
    assert (row.found, row.agrees, row.off_m) == (False, None, None)
    assert "not in the scanner's view" in row.finding
    need_its_place([row], "bypass")


def test_the_closer_look_counts_and_both_are_told():
    far, near = check(sighting(WHEEL, off_m=(0.006, 0.0))), check(sighting(WHEEL, off_m=(0.0005, 0.0)), place=CLOSER)
    both = after_both(far, near)
    assert both.agrees and both.seen_from == CLOSER
    assert "6.0 mm" in both.finding and "0.5 mm" in both.finding
    lost = check(Sighting(panel_object=WHEEL, why="no surfaces like its own near its place"), place=CLOSER)
    assert after_both(far, lost).stands_elsewhere and "no surfaces" in after_both(far, lost).finding
