"""Filters keep holes and edges; derivatives, normals and curvature match closed forms and plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from perception.range.filters import gaussian, median, remove_gross_errors
from perception.range.geometry import curvature_class, geometry_of, graph_curvature, local_geometry
from perception.range.noise import NoiseModel, estimate_noise
from perception.range.sensor import OrthographicSensor
from tests.perception.range.scenes import PARALLEL, PINHOLE, noisy, plane_depth, sphere_depth

NOISE = NoiseModel(white=(0.0005, 0.0), correlated=(0.0, 0.0), step=(0.0, 0.0))


def wall_with_a_step() -> np.ndarray:
    depth = plane_depth(PINHOLE, np.array([0.2, 0.1, -1.0]), np.array([0.0, 0.0, 0.6]))
    depth[:, 80:] += 0.05
    return depth


def test_gross_errors_go_and_everything_else_stays():
    truth = wall_with_a_step()
    rng = np.random.default_rng(0)
    depth = truth + rng.normal(0, 0.0005, truth.shape)
    bad = rng.random(truth.shape) < 0.01
    depth[bad] = 0.9
    out = remove_gross_errors(depth, PINHOLE, NOISE)
    assert np.abs(out - truth)[bad & (np.abs(np.arange(160) - 80) > 3)].max() < 0.01
    assert (out == depth)[~bad].mean() > 0.999


def test_a_thin_bar_survives_the_filter_but_not_a_plain_median():
    depth = np.full((120, 160), 0.6)
    depth[:, 70:72] = 0.5
    assert (remove_gross_errors(depth, PINHOLE, NOISE)[:, 70:72] == 0.5).all()
    assert median(depth)[10:-10, 70:72] == pytest.approx(0.6)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_the_gaussian_lowers_noise_and_keeps_edges_and_planes(scale):
    truth = wall_with_a_step()
    depth = truth + np.random.default_rng(1).normal(0, 0.0005, truth.shape)
    out = gaussian(depth, PINHOLE, NOISE, sigma_px=scale)
    inner = np.s_[5:-5, 5:-5]
    assert np.std((out - truth)[inner]) < 0.0005 / (1.5 * scale)
    assert np.abs(out - truth)[:, 78:82].max() < 0.003


def test_holes_stay_holes():
    depth = wall_with_a_step()
    depth[30:40, 30:40] = np.nan
    smooth, clean = gaussian(depth, PINHOLE, NOISE, sigma_px=1.5), remove_gross_errors(depth, PINHOLE, NOISE)
    for out in (median(depth), smooth, clean):
        np.testing.assert_array_equal(np.isnan(out), np.isnan(depth))


def test_an_image_of_holes_passes():
    empty = np.full((8, 8), np.nan)
    assert np.isnan(median(empty)).all()


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
def test_a_ball_has_its_curvature_and_normals(sensor):
    centre, radius = np.array([0.0, 0.0, 0.55]), 0.08
    depth = sphere_depth(sensor, centre, radius)
    depth[~np.isfinite(depth)] = np.nan
    found = geometry_of(depth, sensor, scale_px=0.0)
    points = sensor.points(depth)
    middle = np.s_[50:70, 70:90]
    assert np.nanmedian(found.mean_curvature_per_m[middle]) == pytest.approx(1 / radius, rel=0.01)
    assert np.nanmedian(found.gaussian_curvature_per_m2[middle]) == pytest.approx(1 / radius**2, rel=0.02)
    radial = (points[middle] - centre) / radius
    assert np.einsum("...i,...i", found.normal[middle], radial).min() > 0.9999


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
def test_a_plane_has_none(sensor):
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    found = geometry_of(plane_depth(sensor, normal, np.array([0, 0, 0.6])), sensor, scale_px=0.0)
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(found.mean_curvature_per_m[inner]).max() < 1e-6
    # Central differences of 1 / (a x + b y + c) err in third order, 1e-6 at this pixel pitch.
    np.testing.assert_allclose(found.normal[inner], np.broadcast_to(normal, found.normal[inner].shape), atol=2e-6)


def test_the_papers_formula_agrees_with_the_fundamental_forms():
    """For parallel rays of unit pitch both are the same; the graph bulges away where H is positive there."""
    rng = np.random.default_rng(2)
    v, u = np.mgrid[:40, :50] / 10.0
    g = 3 + np.sin(u) * np.cos(v) + 0.1 * u * v + rng.normal(0, 1e-3, u.shape)
    H, K = graph_curvature(g)
    found = geometry_of(g, OrthographicSensor(width_px=50, height_px=40, pixel_pitch_m=1.0), scale_px=0.0)
    np.testing.assert_allclose(found.mean_curvature_per_m[1:-1, 1:-1], H, atol=1e-12)
    np.testing.assert_allclose(found.gaussian_curvature_per_m2[1:-1, 1:-1], K, atol=1e-12)


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
def test_single_precision_tells_the_same_and_holes_spread_by_a_pixel(sensor):
    depth = noisy(sphere_depth(sensor, np.array([0.0, 0.0, 0.55]), 0.3), 0.0001, seed=4)
    depth[20, 30] = np.nan
    exact = geometry_of(depth, sensor, scale_px=0.0)
    single = geometry_of(depth.astype(np.float32), sensor, scale_px=0.0)
    unknown = np.isnan(exact.mean_curvature_per_m)
    assert (
        unknown[19:22, 29:32].all() and unknown[0].all() and unknown[:, -1].all() and not unknown[40:80, 60:100].any()
    )
    for name, tolerance in (("gu", 1e-7), ("normal", 1e-4), ("mean_curvature_per_m", 0.5)):
        mine = getattr(single, name)
        assert mine.dtype == np.float32
        np.testing.assert_array_equal(np.isnan(mine), np.isnan(getattr(exact, name)))
        assert np.nanmax(np.abs(mine - getattr(exact, name))) < tolerance


def test_the_orientation_is_the_papers_angle_of_the_two_slopes():
    v, u = np.mgrid[:20, :30]
    for slope_u, slope_v in ((0.3, 0.4), (-0.3, 0.4), (0.3, -0.4)):
        found = geometry_of(3.0 + slope_u * u + slope_v * v, PARALLEL, scale_px=0.0)
        np.testing.assert_allclose(found.orientation_rad[1:-1, 1:-1], np.arctan2(slope_u, slope_v), atol=1e-12)


def test_curvature_classes_tell_plane_from_ball():
    depth = np.minimum(sphere_depth(PARALLEL, np.array([0.0, 0.0, 0.55]), 0.07), 0.6)
    found = local_geometry(noisy(depth, 0.0002, seed=0), PARALLEL)
    classes = curvature_class(found, flat_per_m=5.0)
    assert (classes[55:65, 75:85] == 4).mean() > 0.8
    assert (classes[3:15, 3:15] == 0).mean() > 0.9


def test_noisier_images_get_a_larger_scale():
    flat = plane_depth(PARALLEL, np.array([0.1, 0.0, -1.0]), np.array([0, 0, 0.6]))
    quiet = local_geometry(noisy(flat, 0.00005, seed=1), PARALLEL)
    loud = local_geometry(noisy(flat, 0.001, seed=1), PARALLEL)
    assert loud.scale_px > quiet.scale_px


@pytest.mark.parametrize("sigma_m", [0.0005, 0.001, 0.003])
@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
def test_white_noise_is_measured(sigma_m, sensor):
    wall = plane_depth(sensor, np.array([0.2, 0.3, -1.0]), np.array([0, 0, 0.6]))
    depth = noisy(wall, sigma_m, seed=3, gross=0.01)
    measured = float(estimate_noise(depth, sensor).sigma_m(0.6))
    assert measured == pytest.approx(sigma_m, rel=0.15)


def test_steps_and_slow_noise_are_told_apart():
    import cv2

    wall = plane_depth(PINHOLE, np.array([0.2, 0.3, -1.0]), np.array([0, 0, 0.6]))
    stepped = np.round(wall / 0.004) * 0.004
    law = estimate_noise(stepped, PINHOLE)
    assert law.step[0] + law.step[1] * 0.36 == pytest.approx(0.004, rel=0.1)
    large = OrthographicSensor(width_px=400, height_px=400, pixel_pitch_m=0.001)
    slow = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, (400, 400)), (0, 0), 3.0)
    law = estimate_noise(0.6 + slow * 0.002 / slow.std(), large)
    assert law.slow_share(0.6) > 0.5
