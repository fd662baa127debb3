"""Tests of the whole chain: images of known surfaces, bad input, and reproducible results."""

from __future__ import annotations

import numpy as np
import pytest

from hal.errors import CellError, InvalidRequest, NotFound
from perception.range import Cylinder, Sphere, SurfaceType, analyse
from perception.range.segmentation.finish import without_crumbs
from tests.perception.range.scenes import PARALLEL, PINHOLE, ball_on_table, noisy, plane_depth


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
@pytest.mark.parametrize("sigma_m", [0.0, 0.0003, 0.0006])
def test_table_ball_and_pipe_are_found_and_named(sensor, sigma_m):
    truth = ball_on_table(sensor)
    scene = analyse(noisy(truth.depth_m, sigma_m, seed=1, gross=0.01), sensor)
    # Small remains of the steep rims may be separate regions, but nothing large.
    large = [s for s in scene.surfaces if s.pixels > 100]
    assert sorted(s.type for s in large) == [SurfaceType.CYLINDER, SurfaceType.PLANE, SurfaceType.SPHERE]
    ball = scene.of_type(SurfaceType.SPHERE)[0].primitive
    pipe = scene.of_type(SurfaceType.CYLINDER)[0].primitive
    assert isinstance(ball, Sphere) and isinstance(pipe, Cylinder)
    assert ball.radius_m == pytest.approx(0.04, rel=0.01)
    assert pipe.radius_m == pytest.approx(0.025, rel=0.02)
    np.testing.assert_allclose(ball.centre_m, [-0.07, 0.0, 0.58], atol=0.0005)


def test_labels_overlap_the_truth():
    truth = ball_on_table()
    scene = analyse(noisy(truth.depth_m, 0.0005, seed=2), PINHOLE)
    for label in (1, 2, 3):
        mine = truth.labels == label
        values, counts = np.unique(scene.labels[mine], return_counts=True)
        best = values[np.argmax(counts)]
        assert counts.max() > 0.9 * mine.sum()
        assert (scene.labels == best).sum() < 1.1 * mine.sum()


def test_the_same_image_gives_the_same_labels_and_parameters():
    depth = noisy(ball_on_table().depth_m, 0.0005, seed=3)
    first, second = analyse(depth, PINHOLE), analyse(depth, PINHOLE)
    np.testing.assert_array_equal(first.labels, second.labels)
    for a, b in zip(first.surfaces, second.surfaces, strict=True):
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_holes_stay_holes():
    depth = noisy(ball_on_table().depth_m, 0.0005, seed=4)
    depth[40:60, 70:90] = np.nan
    assert not analyse(depth, PINHOLE).labels[40:60, 70:90].any()


def test_the_largest_plane_is_the_table():
    plane = analyse(noisy(ball_on_table().depth_m, 0.0005, seed=5), PINHOLE).largest_plane()
    normal = np.array([0.0, -0.5, -0.85]) / np.hypot(0.5, 0.85)
    assert plane.primitive.normal @ normal == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("depth", "error"),
    [
        (np.full((120, 160), np.nan), NotFound),
        (np.zeros((120, 160)), NotFound),
        (np.full((10, 160), 0.5), InvalidRequest),
        (np.full((120, 160, 3), 0.5), InvalidRequest),
        (np.full((120, 160), 600.0), InvalidRequest),
        (np.full((120, 160), 1e-5), InvalidRequest),
        (np.empty((0, 0)), InvalidRequest),
        (np.array([["a"]]), InvalidRequest),
    ],
    ids=["all NaN", "all zero", "other size", "colour", "millimetres", "tiny", "empty", "text"],
)
def test_bad_input_is_refused_with_a_hint(depth, error):
    with pytest.raises(error) as caught:
        analyse(depth, PINHOLE)
    assert isinstance(caught.value, CellError) and caught.value.hint


def test_a_flat_noise_free_wall_is_one_plane():
    scene = analyse(np.full((120, 160), 0.5), PINHOLE)
    assert [s.type for s in scene.surfaces] == [SurfaceType.PLANE]
    assert scene.surfaces[0].pixels == 120 * 160


def test_one_finite_pixel_is_too_little():
    depth = np.full((120, 160), np.nan)
    depth[3, 4] = 0.5
    with pytest.raises(NotFound):
        analyse(depth, PINHOLE)


def test_random_depth_holds_no_surface_but_does_not_fail():
    depth = np.random.default_rng(0).uniform(0.3, 3.0, (120, 160))
    assert sum(s.pixels for s in analyse(depth, PINHOLE).surfaces) < 0.3 * depth.size


def test_infinite_and_negative_depth_count_as_missing():
    depth = plane_depth(PINHOLE, np.array([0.1, 0.0, -1.0]), np.array([0.0, 0.0, 0.5]))
    depth[:10] = np.inf
    depth[10:20] = -1.0
    scene = analyse(depth, PINHOLE)
    assert not scene.labels[:20].any()
    assert scene.labels[30:].all()


def test_surfaces_that_keep_next_to_no_pixels_are_dropped_and_the_rest_numbered_anew():
    scene = analyse(noisy(ball_on_table(PARALLEL).depth_m, 0.0003, seed=6), PARALLEL)
    labels = np.where(scene.labels == 1, 0, scene.labels).astype(np.int32)
    labels[0, :7] = 1
    after, kept = without_crumbs(labels, list(scene.surfaces), 8)
    assert [s.label for s in kept] == list(range(1, len(scene.surfaces)))
    assert [s.primitive for s in kept] == [s.primitive for s in scene.surfaces[1:]]
    np.testing.assert_array_equal(after, np.where(labels > 1, labels - 1, 0))
