"""Tests of finding a panel by tags, outline and looks: drawn images with known truth, and every refusal."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.panel_ways import WAYS, views, with_tags
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.config import load_cell
from hal.errors import Ambiguous, NotFound
from hal.geometry import difference, matrix_of, perturbed, transform
from hal.panel import Panel, Tag
from perception.vision import PanelPrior, compare, estimate, find_by_outline, find_by_tags
from perception.vision.panel_ways.points import pose_from_points
from perception.vision.panel_ways.sighting import WrongMark
from simbackend import textures
from tests.simbackend.rig import BENCH

CAMERA = CameraIntrinsics(width_px=640, height_px=480, fx_px=700.0, fy_px=700.0, cx_px=319.5, cy_px=239.5)
TURN = Rotation.from_euler("xyz", [8.0, -12.0, 4.0], degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
POSE = transform(TURN, (0.01, -0.005, 0.62))
PRIOR = PanelPrior(camera_from_panel=POSE)
PLACES = ((-0.15, 0.10), (0.15, 0.10), (0.15, -0.10), (-0.15, -0.10))
PX_PER_M, FINER = 4000.0, 4


def panel(*places: tuple[float, float], **changes: float) -> Panel:
    tags = tuple(Tag(id=k, size_m=0.04, position_m=(*place, 0.0), angle_rad=0.3 * k) for k, place in enumerate(places))
    return Panel.model_validate({"name": "plain", "width_m": 0.40, "height_m": 0.28, "tags": tags, **changes})


def picture(drawn: Panel, pose: RigidTransform = POSE, *, plate: int = 190, seed: int = 1) -> NDArray[np.uint8]:
    """Return an image of a plate with printed tags, drawn finer and then reduced."""
    sheet = np.full((round(drawn.height_m * PX_PER_M), round(drawn.width_m * PX_PER_M)), plate, np.uint8)
    scene = np.full((480 * FINER, 640 * FINER), 50, np.uint8)
    layers = [(sheet, plate_from_sheet(sheet.shape, PX_PER_M, (0.0, 0.0), 0.0))]
    for tag in drawn.tags:
        pixels, side_m = textures.tag(tag)
        scale = pixels.shape[0] / side_m
        layers.append((pixels[:, :, 0], plate_from_sheet(pixels.shape, scale, tag.position_m[:2], tag.angle_rad)))
    R, t = matrix_of(pose), pose.translation
    K = np.array([[FINER * 700.0, 0, FINER * 320.0 - 0.5], [0, FINER * 700.0, FINER * 240.0 - 0.5], [0, 0, 1.0]])
    image_from_plate = K @ np.column_stack([R[:, 0], R[:, 1], t])
    for pixels, onto in layers:
        H = image_from_plate @ onto
        size = (scene.shape[1], scene.shape[0])
        inside = cv2.warpPerspective(np.full(pixels.shape, 255, np.uint8), H, size, flags=cv2.INTER_NEAREST) > 0
        scene[inside] = cv2.warpPerspective(pixels, H, size, flags=cv2.INTER_LINEAR)[inside]
    reduced = cv2.GaussianBlur(cv2.resize(scene, (640, 480), interpolation=cv2.INTER_AREA).astype(float), (0, 0), 0.6)
    noisy = reduced + np.random.default_rng(seed).normal(scale=1.5, size=reduced.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def plate_from_sheet(shape: tuple[int, ...], px_per_m: float, middle_m: tuple[float, float], angle_rad: float) -> Array:
    """Return the map (3, 3) from a sheet's pixels to plate metres; `angle_rad` is clockwise for the viewer."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    centred = np.array([[1, 0, -(shape[1] - 1) / 2], [0, -1, (shape[0] - 1) / 2], [0, 0, px_per_m]]) / px_per_m
    return np.array([[c, s, middle_m[0]], [-s, c, middle_m[1]], [0, 0, 1]]) @ centred


def errors(found: RigidTransform) -> tuple[float, float]:
    off = difference(POSE, found)
    return float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))


def test_four_tags_give_the_pose() -> None:
    seen = find_by_tags(picture(panel(*PLACES)), panel(*PLACES), CAMERA, prior=PRIOR)
    position_m, angle_rad = errors(seen.camera_from_panel.parent_from_child)
    assert position_m < 0.0008 and angle_rad < 0.002
    assert len(seen.names) == 16 and seen.names[0] == "tag_36h11_0_corner_0"
    np.testing.assert_allclose(seen.points_px, project(POSE.apply(seen.points_m), CAMERA), atol=0.25)


def test_one_tag_is_enough_and_its_pose_is_less_certain() -> None:
    image = picture(panel(*PLACES))
    one = find_by_tags(image, panel(PLACES[0]), CAMERA, prior=PRIOR).camera_from_panel
    four = find_by_tags(image, panel(*PLACES), CAMERA, prior=PRIOR).camera_from_panel
    assert errors(one.parent_from_child)[0] < 0.02
    assert np.trace(one.covariance) > 10 * np.trace(four.covariance)


def test_a_tag_in_another_place_than_the_file_has_it_is_named() -> None:
    moved = panel(*PLACES[:3], (-0.15, -0.085))
    with pytest.raises(WrongMark, match="without tag_36h11_3 the others fit best"):
        find_by_tags(picture(panel(*PLACES)), moved, CAMERA, prior=PRIOR)


def test_a_tag_that_is_visible_twice_is_ambiguous() -> None:
    double = panel(*PLACES)
    double = double.model_copy(update={"tags": tuple(tag.model_copy(update={"id": 0}) for tag in double.tags)})
    with pytest.raises(Ambiguous, match="tag 36h11 id 0 is in view 4 times"):
        find_by_tags(picture(double), panel(PLACES[0]), CAMERA, prior=PRIOR)


def test_without_a_tag_in_view_the_error_names_those_of_the_file() -> None:
    with pytest.raises(NotFound, match="36h11 id 0"):
        find_by_tags(picture(panel()), panel(PLACES[0]), CAMERA, prior=PRIOR)


def test_the_outline_gives_the_pose() -> None:
    seen = find_by_outline(picture(panel()), panel(), CAMERA, prior=PRIOR)
    position_m, angle_rad = errors(seen.camera_from_panel.parent_from_child)
    assert position_m < 0.001 and angle_rad < 0.003
    np.testing.assert_allclose(seen.points_px, project(POSE.apply(seen.points_m), CAMERA), atol=0.25)


def test_a_plate_of_another_size_is_refused() -> None:
    with pytest.raises((WrongMark, NotFound)):
        find_by_outline(picture(panel()), panel(width_m=0.44), CAMERA, prior=PRIOR)


def test_a_plate_like_its_background_is_refused_with_a_remedy() -> None:
    with pytest.raises(NotFound) as refused:
        find_by_outline(picture(panel(), plate=51), panel(), CAMERA, prior=PRIOR)
    assert refused.value.hint


def test_a_pose_that_the_cell_file_does_not_expect_is_refused() -> None:
    elsewhere = perturbed(POSE, np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    prior = PanelPrior(
        camera_from_panel=elsewhere, camera_from_expected=elsewhere, position_tolerance_m=0.1, angle_tolerance_rad=0.3
    )
    with pytest.raises(NotFound, match=r"the tags put the panel 0\.300 m"):
        find_by_tags(picture(panel(*PLACES)), panel(*PLACES), CAMERA, prior=prior)


def test_two_ways_agree_unless_the_file_is_wrong_about_one() -> None:
    image = picture(panel(*PLACES))
    outline = find_by_outline(image, panel(*PLACES), CAMERA, prior=PRIOR)
    assert not compare(find_by_tags(image, panel(*PLACES), CAMERA, prior=PRIOR), outline).contradicts
    shifted = panel(*((x + 0.006, y) for x, y in PLACES))
    compared = compare(find_by_tags(image, shifted, CAMERA, prior=PRIOR), outline)
    assert compared.contradicts and compared.position_m == pytest.approx(0.006, abs=0.0015)


def test_the_pose_of_points_is_that_of_four_lights_and_its_covariance_that_of_repeated_noise() -> None:
    points_m = np.array([[-0.2, 0.12, 0.0], [0.2, 0.12, 0.0], [0.2, -0.12, 0.0], [-0.2, -0.12, 0.0], [0.0, 0.05, 0.03]])
    exact = project(POSE.apply(points_m), CAMERA)
    four = pose_from_points(points_m[:4], exact[:4], 0.04 * np.eye(8), CAMERA)
    lights = estimate(points_m[:4], exact[:4], 0.04, CAMERA)
    np.testing.assert_allclose(difference(four.poses[0].parent_from_child, lights.camera_from_object), 0.0, atol=1e-6)
    np.testing.assert_allclose(four.poses[0].covariance, lights.covariance, rtol=1e-3, atol=1e-9)
    shared = 0.04 * np.eye(10) + 0.09 * np.kron(np.ones((5, 5)), np.eye(2))  # an error that all points share
    rng = np.random.default_rng(3)
    off = np.array([
        difference(POSE, pose_from_points(points_m, exact + noise.reshape(5, 2), shared, CAMERA).poses[0].parent_from_child)
        for noise in rng.multivariate_normal(np.zeros(10), shared, 200)
    ])  # fmt: skip
    stated = pose_from_points(points_m, exact, shared, CAMERA).poses[0].covariance
    nees = np.einsum("ni,ij,nj->n", off, np.linalg.inv(stated), off) / 6.0
    assert 0.85 < nees.mean() < 1.15


@pytest.mark.parametrize("way", ["four tags", "outline", "looks"])
def test_each_way_finds_the_simulated_panel(way: str) -> None:
    bench = load_cell(BENCH, seed=21)
    for view in views(bench.model_copy(update={"panel": with_tags(bench.panel)})):
        off = difference(view.camera_from_panel, WAYS[way](view).parent_from_child)
        assert np.linalg.norm(off[:3]) < 0.008 and np.linalg.norm(off[3:]) < 0.08
