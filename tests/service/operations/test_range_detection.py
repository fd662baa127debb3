"""Tests of finding the mushroom and the valve wheel of a panel file by their surfaces in a drawn range image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.devices import RangeScannerCapabilities
from hal.errors import Unsupported
from hal.geometry import UncertainPose
from hal.panel import Button, Handwheel, Light, Mushroom, Panel
from perception.range import Sighting
from perception.range.matching.panel_objects import models_of
from perception.range.matching.solids import boxes_of, render, solid_of
from service.operations.acquisition import Scan
from service.operations.range_detection import find_by_surfaces, mark_of, surfaces_in
from service.operations.recognise import _sighting_result
from service.report.surfaces import FOUND, LOST, surfaces_picture

SIDE = 128
FOCAL_PX = 123.0  # the rim of the wheel is 2.3 pixels wide from 0.54 m, as in the mission
JUMP_M = 0.008
TILTED = Rotation.from_euler("x", np.pi - 0.15)
SCANNER_FROM_PANEL = RigidTransform.from_components([0.0, 0.0, 0.54], TILTED)
MUSHROOM = Mushroom(name="stop", position_m=(0.09, 0.03))
WHEEL = Handwheel(name="bypass", position_m=(-0.06, -0.02))


def panel() -> Panel:
    """Return a plate with both objects, and a button that is not searched for."""
    lights = tuple(
        Light(name=f"l{k}", position_m=(x, y, 0.0005))
        for k, (x, y) in enumerate([(-0.28, 0.2), (0.28, 0.2), (0.28, -0.2), (-0.28, -0.2)])
    )
    return Panel.model_validate(
        {
            "schema": 1,
            "name": "small",
            "width_m": 0.62,
            "height_m": 0.46,
            "thickness_m": 0.01,
            "lights": lights,
            "objects": (MUSHROOM, WHEEL, Button(name="start", position_m=(0.2, -0.1), radius_m=0.013)),
        }
    )


def certain(pose: RigidTransform) -> UncertainPose:
    """Return a pose without errors."""
    return UncertainPose(parent_from_child=pose, covariance=np.zeros((6, 6)))


def drawn(panel_from_thing: RigidTransform, panel_object: Mushroom | Handwheel) -> np.ndarray:
    """Return the depth of one object by itself."""
    model = models_of(panel())[panel_object.name]
    sen = np.array([1.0, FOCAL_PX, FOCAL_PX, (SIDE - 1) / 2, (SIDE - 1) / 2])
    pose = SCANNER_FROM_PANEL * panel_from_thing
    m, k = np.empty((SIDE, SIDE)), np.empty((SIDE, SIDE), np.int64)
    n, window = len(model.surfaces), np.array([0, 0, SIDE, SIDE])
    R, p = pose.rotation.as_matrix(), pose.translation
    render(solid_of(model), boxes_of(model), np.zeros(n), np.zeros(3), R, p, sen, window, 1, m, k)
    return m


def plate_depth(height_m: float = 0.0) -> np.ndarray:
    """Return the depth of a plane at a height above the plate."""
    v, u = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    rays = np.stack([u / FOCAL_PX, v / FOCAL_PX, np.ones((SIDE, SIDE))], axis=-1)
    R, p = SCANNER_FROM_PANEL.rotation.as_matrix(), SCANNER_FROM_PANEL.apply([0.0, 0.0, height_m])
    return np.asarray((R[:, 2] @ p) / (rays @ R[:, 2]))


def standing(panel_object: Mushroom | Handwheel, turn_rad: float = 0.0) -> RigidTransform:
    """Return the pose of an object at its place in the panel file, rotated counter-clockwise."""
    return RigidTransform.from_components([*panel_object.position_m, 0.0], Rotation.from_euler("z", turn_rad))


def scan_of(depth: np.ndarray, *, seed: int = 3, projection: str = "pinhole") -> Scan:
    """Return a scan with 0.6 mm noise; half of the beams at a jump report a random depth between its two sides."""
    rng = np.random.default_rng(seed)
    near, far = (change(depth, np.ones((3, 3))) for change in (cv2.erode, cv2.dilate))
    is_mixed = (far - near > JUMP_M) & (rng.random(depth.shape) < 0.5)
    depth = np.where(is_mixed, near + rng.random(depth.shape) * (far - near), depth)
    c = RangeScannerCapabilities(
        projection=projection,  # tests use any text
        width=SIDE,
        height=SIDE,
        fx=FOCAL_PX,
        fy=FOCAL_PX,
        cx=(SIDE - 1) / 2,
        cy=(SIDE - 1) / 2,
        min_range_m=0.1,
        max_range_m=1.5,
        sigma_m=0.0006,
        rate_hz=5.0,
    )
    return Scan(
        depth_m=(depth + rng.normal(0.0, 0.0006, depth.shape)).astype(np.float32),
        stamp_s=0.0,
        scanner="range_scanner",
        capabilities=c,
        base_from_scanner=certain(RigidTransform.identity()),
        position_rad=np.zeros(6),
    )


def sightings(
    scan: Scan, believed: RigidTransform = SCANNER_FROM_PANEL, *, sigma_m: float = 0.0
) -> dict[str, Sighting]:
    """Return what is found in a scan, by name."""
    scene = surfaces_in(scan)
    pose = UncertainPose(parent_from_child=believed, covariance=np.diag([sigma_m**2] * 3 + [0.0] * 3))
    found = find_by_surfaces(scene, scan, panel(), pose, scene.largest_plane())
    return {s.panel_object.name: s for s in found}


@pytest.mark.parametrize("seed", [3, 4])
def test_both_are_found_where_they_stand_though_the_rim_is_two_pixels_wide(seed):
    turn = 0.4
    depth = np.minimum(plate_depth(), drawn(standing(MUSHROOM), MUSHROOM))
    seen = sightings(scan_of(np.minimum(depth, drawn(standing(WHEEL, turn), WHEEL)), seed=seed))
    rows = [_sighting_result(s) for s in seen.values()]
    assert [(r.name, r.found) for r in rows] == [("stop", True), ("bypass", True)]
    assert all(r.off_panel_file_m < 0.0015 for r in rows)
    assert abs(rows[0].state) < 0.001 and "cap" in rows[0].surfaces
    off_rad = abs(rows[1].state - (2 * np.pi / 3 - turn))
    assert off_rad < 0.06 and off_rad < 4.0 * rows[1].state_sigma and rows[1].state_sigma < 0.03


def test_a_bare_plate_shows_neither():
    seen = sightings(scan_of(plate_depth()))
    assert [_sighting_result(s).found for s in seen.values()] == [False, False]
    assert all("no surfaces" in s.why for s in seen.values())


@pytest.mark.parametrize("what", ["lid", "mushroom"])
def test_what_stands_in_the_place_of_the_wheel_is_not_taken_for_it(what):
    v, u = np.mgrid[:SIDE, :SIDE]
    middle = SCANNER_FROM_PANEL.apply([*WHEEL.position_m, 0.03])
    off_px = np.hypot(*(FOCAL_PX * middle[k] / middle[2] + (SIDE - 1) / 2 - uv for k, uv in enumerate((u, v))))
    lid = np.where(off_px < FOCAL_PX * 0.04 / middle[2], plate_depth(0.03), np.inf)
    panel_object = lid if what == "lid" else drawn(standing(WHEEL), MUSHROOM)
    assert sightings(scan_of(np.minimum(plate_depth(), panel_object)))["bypass"].match is None


def test_a_thing_far_from_its_place_in_the_file_is_another_one_unless_the_panel_may_stand_there():
    depth = np.minimum(plate_depth(), drawn(standing(MUSHROOM), MUSHROOM))
    moved = RigidTransform.from_components(SCANNER_FROM_PANEL.translation + np.array([0.05, 0.0, 0.0]), TILTED)
    assert all(s.match is None for s in sightings(scan_of(depth), moved).values())
    vaguely = sightings(scan_of(depth), moved, sigma_m=0.02)
    assert vaguely["stop"].off_m == pytest.approx(0.05, abs=0.002) and vaguely["bypass"].match is None


def test_what_the_scanner_does_not_see_is_said_to_be_out_of_view():
    beside = RigidTransform.from_components(SCANNER_FROM_PANEL.translation + np.array([0.5, 0.0, 0.0]), TILTED)
    assert {s.why for s in sightings(scan_of(plate_depth()), beside).values()} == {"not in the scanner's view"}


def test_the_picture_rings_what_was_found_in_green_and_what_was_not_in_red():
    scan = scan_of(np.minimum(plate_depth(), drawn(standing(MUSHROOM), MUSHROOM)))
    scene = surfaces_in(scan)
    found = find_by_surfaces(scene, scan, panel(), certain(SCANNER_FROM_PANEL), scene.largest_plane())
    marks = [mark_of(s, scan, certain(SCANNER_FROM_PANEL)) for s in found]
    image = surfaces_picture(scene, marks)
    for mark, colour, panel_object in zip(marks, (FOUND, LOST), (MUSHROOM, WHEEL), strict=True):
        at = SCANNER_FROM_PANEL.apply([panel_object.position_m[0], panel_object.position_m[1], panel_object.height_m])
        assert mark.outline_px.mean(axis=0) == pytest.approx(FOCAL_PX * at[:2] / at[2] + (SIDE - 1) / 2, abs=0.6)
        scale = image.shape[0] / SIDE
        u, v = np.round(scale * (mark.outline_px[5] + 0.5) - 0.5).astype(int)
        assert (image[v, u] == colour).all()


def test_a_line_scanner_is_refused():
    with pytest.raises(Unsupported):
        surfaces_in(scan_of(plate_depth(), projection="polar"))
