"""Viewpoints show the point in the image centre, the whole plate, and every object, as they promise."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.calibration import load_calibration
from hal.camera_model import project
from hal.geometry import transform_rpy
from hal.panel import load_panel
from perception.vision.viewpoints import (
    CLOSE_UP_M,
    SIDES,
    close_up_groups,
    facing,
    hidden_share,
    overview_distance_m,
    overview_poses,
    poses_from,
    reading_distance_m,
    sides_by_sight,
)

ROOT = Path(__file__).parents[3]
PANEL = load_panel(ROOT / "panels/bench.toml")
RECORD = load_calibration(ROOT / "cells/calibrations/wrist_camera.toml").intrinsics
assert RECORD is not None
LENS = RECORD.intrinsics()
BASE_FROM_PANEL = transform_rpy((0.95, 0.03, 0.55), (1.5, 0.1, -1.6))


@given(
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.2, 0.2)),
    st.floats(0.2, 1.0),
    st.floats(-3.0, 3.0),
    st.floats(-0.4, 0.4),
)
@settings(max_examples=40)
def test_a_facing_camera_sees_its_point_in_the_middle(
    point: tuple[float, float], distance_m: float, roll_rad: float, tilt_rad: float
) -> None:
    camera = facing(BASE_FROM_PANEL, (*point, 0.0), distance_m, roll_rad=roll_rad, tilt_rad=(tilt_rad, -tilt_rad))
    seen = (camera.inv() * BASE_FROM_PANEL).apply([*point, 0.0])
    np.testing.assert_allclose(seen, [0.0, 0.0, distance_m], atol=1e-9)


def test_an_upright_view_shows_the_panel_upright() -> None:
    camera_from_panel = facing(BASE_FROM_PANEL, (0.0, 0.0, 0.0), 0.5).inv() * BASE_FROM_PANEL
    right, up = project(camera_from_panel.apply(np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])), LENS)
    assert right[0] > LENS.cx_px
    assert up[1] < LENS.cy_px


@pytest.mark.parametrize(
    ("side", "axis", "sign"), [("the right", 0, 1), ("the left", 0, -1), ("above", 1, 1), ("below", 1, -1)]
)
def test_a_look_from_a_side_stands_on_that_side(side: str, axis: int, sign: int) -> None:
    for camera in poses_from(BASE_FROM_PANEL, (0.1, 0.05, 0.0), side):
        stands = (BASE_FROM_PANEL.inv() * camera).translation - (0.1, 0.05, 0.0)
        assert sign * stands[axis] > 0.08
        assert abs(stands[1 - axis]) < 1e-9


@pytest.mark.parametrize("slack_m", [0.0, 0.06])
def test_the_overview_holds_the_whole_plate_wherever_it_is(slack_m: float) -> None:
    camera = next(overview_poses(BASE_FROM_PANEL, PANEL, LENS, slack_m))
    x, y = PANEL.width_m / 2 + slack_m, PANEL.height_m / 2 + slack_m
    corners = np.array([[sx * x, sy * y, 0.0] for sx, sy in itertools.product((-1, 1), (-1, 1))])
    pixels = project((camera.inv() * BASE_FROM_PANEL).apply(corners), LENS)
    assert np.all(pixels >= 0) and np.all(pixels <= [LENS.width_px - 1, LENS.height_px - 1])
    assert overview_distance_m(PANEL, LENS, slack_m) < 0.8


def test_one_image_of_a_camera_with_twice_the_pixels_shows_the_whole_panel() -> None:
    sizes = {name: 2 * getattr(LENS, name) for name in ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")}
    finer = replace(LENS, **sizes)
    assert reading_distance_m(LENS) == CLOSE_UP_M
    assert reading_distance_m(finer) == pytest.approx(2 * CLOSE_UP_M, rel=0.02)
    assert len(close_up_groups(PANEL.objects, finer, reading_distance_m(finer))) == 1


def test_close_ups_show_every_object_once_and_whole() -> None:
    groups = close_up_groups(PANEL.objects, LENS)
    names = [name for _, group in groups for name in group]
    assert sorted(names) == sorted(panel_object.name for panel_object in PANEL.objects)
    assert len(groups) <= 5
    for centre_m, group in groups:
        camera_from_panel = facing(BASE_FROM_PANEL, tuple(centre_m), 0.30).inv() * BASE_FROM_PANEL
        for name in group:
            pixel = project(camera_from_panel.apply(np.array([PANEL.object(name).point_m])), LENS)[0]
            assert 20 < pixel[0] < LENS.width_px - 20 and 20 < pixel[1] < LENS.height_px - 20


@given(st.integers(0, 10**6))
@settings(max_examples=60)
def test_a_box_hides_the_points_whose_line_of_sight_passes_through_it(seed: int) -> None:
    """Compared with points along each line, which are in the box or not."""
    random = np.random.default_rng(seed)
    box = transform_rpy(tuple(random.uniform(-0.1, 0.1, 3)), tuple(random.uniform(-3, 3, 3)))
    half_m = (0.03, 0.05, 0.02)
    eye, points = random.uniform(-0.3, 0.3, 3), random.uniform(-0.3, 0.3, (40, 3))
    along = np.linspace(0.0, 1.0, 4001)[:, None, None]
    inside = np.abs(box.inv().apply((eye + along * (points - eye)).reshape(-1, 3))) <= half_m
    expected = inside.all(axis=1).reshape(len(along), -1).any(axis=0).mean()
    assert hidden_share(eye, points, [(box, half_m)]) == pytest.approx(expected, abs=0.026)


def test_a_thing_beside_the_line_of_sight_or_behind_the_eye_hides_nothing() -> None:
    points = np.array([[0.0, 0.0, 0.0]])
    beside, behind = (transform_rpy(place, (0.0, 0.0, 0.0)) for place in ((0.1, 0.0, 0.2), (0.0, 0.0, 0.5)))
    thing = (0.01, 0.01, 0.01)
    assert hidden_share(np.array([0.0, 0.0, 0.4]), points, [(beside, thing), (behind, thing)]) == 0.0
    assert hidden_share(np.array([0.0, 0.0, 0.4]), points, []) == 0.0


@pytest.mark.parametrize(("offset_m", "first"), [(-0.02, "the right"), (0.02, "the left")])
def test_the_first_look_is_from_the_side_that_an_upright_cable_hides_least(offset_m: float, first: str) -> None:
    """A cable left of the middle of a display hides none of it from the right, where it appears farther left."""
    display = np.column_stack(
        [*(a.ravel() for a in np.meshgrid(np.linspace(-0.03, 0.03, 9), [-0.01, 0.0, 0.01])), np.zeros(27)]
    )
    cable = (transform_rpy((offset_m, 0.0, 0.04), (0.0, 0.0, 0.0)), (0.004, 0.2, 0.004))
    sides = sides_by_sight(display, [cable])
    assert sides[0] == first and sorted(sides) == sorted(SIDES)
    assert sides_by_sight(display, []) == list(SIDES)
