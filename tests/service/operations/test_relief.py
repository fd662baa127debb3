"""The mushroom and the valve wheel of a panel file found by their surfaces in a drawn range image."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.devices import RangeScannerCapabilities
from hal.errors import Unsupported
from hal.geometry import UncertainPose
from hal.panel import Button, Handwheel, Light, Mushroom, Panel
from perception.range.solids import boxes_of, render, solid_of
from service.operations.eyes import Scan
from service.operations.relief import find_by_surfaces, models_of, surfaces_in

SIDE = 160
FOCAL_PX = 220.0
TILTED = Rotation.from_euler("x", np.pi - 0.15)
SCANNER_FROM_PANEL = RigidTransform.from_components([0.0, 0.0, 0.45], TILTED)
MUSHROOM = Mushroom(name="stop", position_m=(0.06, 0.03))
WHEEL = Handwheel(name="bypass", position_m=(-0.05, -0.02))


def panel() -> Panel:
    """A plate with the two, and a button that is not looked for."""
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
    """A pose without errors."""
    return UncertainPose(parent_from_child=pose, covariance=np.zeros((6, 6)))


def image(*, with_objects: bool, projection: str = "pinhole") -> Scan:
    """The range image of the panel, 0.3 mm of noise."""
    rng = np.random.default_rng(3)
    sen = np.array([1.0, FOCAL_PX, FOCAL_PX, (SIDE - 1) / 2, (SIDE - 1) / 2])
    R, p = SCANNER_FROM_PANEL.rotation.as_matrix(), SCANNER_FROM_PANEL.translation
    v, u = np.mgrid[:SIDE, :SIDE]
    rays = np.stack([(u - sen[3]) / FOCAL_PX, (v - sen[4]) / FOCAL_PX, np.ones_like(u)], axis=-1)
    depth = (R[:, 2] @ p) / (rays @ R[:, 2])
    for model, thing in zip(models_of(panel()), (MUSHROOM, WHEEL), strict=True):
        m, k = np.empty((SIDE, SIDE)), np.empty((SIDE, SIDE), np.int64)
        at, window = p + R @ [*thing.position_m, 0.0], np.array([0, 0, SIDE, SIDE])
        n = len(model.surfaces)
        render(solid_of(model), boxes_of(model), np.zeros(n), np.zeros(3), R, at, sen, window, 1, m, k)
        depth = np.minimum(depth, m) if with_objects else depth
    c = RangeScannerCapabilities(
        projection=projection,  # type: ignore[arg-type]  # any text is tried
        width=SIDE,
        height=SIDE,
        fx=FOCAL_PX,
        fy=FOCAL_PX,
        cx=sen[3],
        cy=sen[4],
        min_range_m=0.1,
        max_range_m=1.5,
        sigma_m=0.0003,
        rate_hz=5.0,
    )
    return Scan(
        depth_m=(depth + rng.normal(0.0, 0.0003, depth.shape)).astype(np.float32),
        stamp_s=0.0,
        scanner="range_scanner",
        capabilities=c,
        base_from_scanner=certain(RigidTransform.identity()),
    )


def test_both_are_found_where_they_stand():
    scan = image(with_objects=True)
    scene = surfaces_in(scan)
    rows = find_by_surfaces(scene, scan, panel(), certain(SCANNER_FROM_PANEL), scene.largest_plane())
    assert [(r["name"], r["found"]) for r in rows] == [("stop", True), ("bypass", True)]
    assert all(r["off_panel_file_m"] < 0.002 for r in rows)
    assert abs(rows[0]["state"]) < 0.001
    assert "cap" in rows[0]["surfaces"]


def test_a_bare_plate_shows_neither():
    scan = image(with_objects=False)
    scene = surfaces_in(scan)
    rows = find_by_surfaces(scene, scan, panel(), certain(SCANNER_FROM_PANEL), scene.largest_plane())
    assert [r["found"] for r in rows] == [False, False]


def test_a_thing_far_from_its_place_in_the_file_is_another_one():
    scan = image(with_objects=True)
    scene = surfaces_in(scan)
    moved = RigidTransform.from_components(SCANNER_FROM_PANEL.translation + np.array([0.05, 0.0, 0.0]), TILTED)
    rows = find_by_surfaces(scene, scan, panel(), certain(moved), scene.largest_plane())
    assert not any(r["found"] for r in rows)


def test_a_line_scanner_is_refused():
    with pytest.raises(Unsupported):
        surfaces_in(image(with_objects=True, projection="polar"))
