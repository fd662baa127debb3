"""Components are the same for any number of tiles; quadrics agree across three ways of fitting them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from hal.errors import NotObservable
from perception.range import analyse
from perception.range.components import label_components, merge_rounds, tile_rows
from perception.range.primitives import SurfaceType
from perception.range.quadric import classify, fit_qr, moments
from tests.perception.range.scenes import PINHOLE, ball_on_table, noisy


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), density=st.floats(0.2, 0.9))
def test_labels_match_scipy_and_do_not_depend_on_tiles(seed, density):
    mask = np.random.default_rng(seed).random((37, 23)) < density
    linked = np.ones_like(mask)
    labels, sizes = label_components(mask, linked, linked)
    expected, count = ndimage.label(mask)
    assert sizes.size == count + 1
    np.testing.assert_array_equal(labels, expected)
    for tiles in (2, 3, 8, 32, 100):
        np.testing.assert_array_equal(label_components(mask, linked, linked, tiles=tiles)[0], labels)


def test_links_cut_components():
    mask = np.ones((4, 6), bool)
    right = np.ones_like(mask)
    right[:, 2] = False
    labels, sizes = label_components(mask, right, np.ones_like(mask), tiles=2)
    assert labels.max() == 2 and list(sizes[1:]) == [12, 12]


def test_seams_merge_in_log_rounds():
    seams = [top for top, _ in tile_rows(320, 32)][1:]
    rounds = merge_rounds(seams)
    assert len(rounds) == 5
    assert sorted(s for r in rounds for s in r) == seams


def test_the_whole_chain_is_the_same_for_1_to_32_tiles():
    depth = noisy(ball_on_table().depth_m, 0.0005, seed=7, gross=0.01)
    one = analyse(depth, PINHOLE)
    with ThreadPoolExecutor(2) as pool:
        for tiles in (2, 5, 32):
            other = analyse(depth, PINHOLE, tiles=tiles, pool=pool)
            np.testing.assert_array_equal(one.labels, other.labels)
            for a, b in zip(one.surfaces, other.surfaces, strict=True):
                np.testing.assert_array_equal(a.covariance, b.covariance)


def on_ellipsoid(radii, count=400, seed=0):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True) * radii + [0.1, -0.2, 0.7]


def same_up_to_sign(a, b):
    return min(np.abs(a - b).max(), np.abs(a + b).max())


@pytest.mark.parametrize("leaves", [1, 2, 7, 16])
def test_the_givens_tree_equals_one_svd(leaves):
    points = on_ellipsoid([0.05, 0.03, 0.02]) + np.random.default_rng(1).normal(0, 1e-4, (400, 3))
    one, tree = fit_qr(points), fit_qr(points, leaves=leaves)
    assert same_up_to_sign(one.coefficients, tree.coefficients) < 1e-10
    with ThreadPoolExecutor(2) as pool:
        assert same_up_to_sign(one.coefficients, fit_qr(points, leaves=leaves, pool=pool).coefficients) < 1e-10


def test_moments_add_and_agree_with_qr():
    points = on_ellipsoid([0.05, 0.03, 0.02])
    qr = fit_qr(points)
    parts = [moments(p, centre_m=qr.centre_m, scale_m=qr.scale_m) for p in np.array_split(points, 3)]
    assert same_up_to_sign((parts[0] + parts[1] + parts[2]).fit().coefficients, qr.coefficients) < 1e-6
    with pytest.raises(ValueError):
        _ = parts[0] + moments(points, centre_m=np.zeros(3), scale_m=1.0)


def test_quadrics_are_named():
    rng = np.random.default_rng(0)
    t, h = rng.uniform(0, 2 * np.pi, 400), rng.uniform(0.02, 0.1, 400)
    tube = np.stack([0.03 * np.cos(t), 0.03 * np.sin(t), h], 1)
    cone = np.stack([0.5 * h * np.cos(t), 0.5 * h * np.sin(t), h], 1)
    saddle = np.stack([0.1 * np.cos(t), 0.1 * np.sin(t), 0.1 * np.cos(2 * t)], 1) + 0.02 * rng.normal(size=(400, 1))
    saddle[:, 2] = 10 * (saddle[:, 0] ** 2 - saddle[:, 1] ** 2)
    assert classify(fit_qr(on_ellipsoid([0.04, 0.04, 0.04]))) == SurfaceType.SPHERE
    assert classify(fit_qr(on_ellipsoid([0.05, 0.03, 0.02]))) == SurfaceType.ELLIPSOID
    assert classify(fit_qr(tube)) == SurfaceType.CYLINDER
    assert classify(fit_qr(cone)) == SurfaceType.CONE
    assert classify(fit_qr(saddle)) is None


def test_points_that_fix_no_quadric_are_refused():
    flat = np.random.default_rng(0).normal(size=(50, 3)) * [1, 1, 0]
    with pytest.raises(NotObservable):
        fit_qr(flat)
    with pytest.raises(NotObservable):
        fit_qr(flat[:5])
