"""The filter pass, which is the unit of time, finds the curvature and normals of a ball and a plane."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.range_filter_pass import geometry_of
from tests.perception.range.scenes import PARALLEL, PINHOLE, plane_depth, sphere_depth


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
def test_a_ball_has_its_curvature_and_normals(sensor):
    centre, radius = np.array([0.0, 0.0, 0.55]), 0.08
    depth = sphere_depth(sensor, centre, radius)
    depth[~np.isfinite(depth)] = np.nan
    found = geometry_of(depth, sensor)
    points = sensor.points(depth)
    middle = np.s_[50:70, 70:90]
    assert np.nanmedian(found.mean_curvature_per_m[middle]) == pytest.approx(1 / radius, rel=0.01)
    assert np.nanmedian(found.gaussian_curvature_per_m2[middle]) == pytest.approx(1 / radius**2, rel=0.02)
    radial = (points[middle] - centre) / radius
    assert np.einsum("...i,...i", found.normal[middle], radial).min() > 0.9999


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
def test_a_plane_has_none(sensor):
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    found = geometry_of(plane_depth(sensor, normal, np.array([0, 0, 0.6])), sensor)
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(found.mean_curvature_per_m[inner]).max() < 0.05
    np.testing.assert_allclose(found.normal[inner], np.broadcast_to(normal, found.normal[inner].shape), atol=1e-4)


def test_holes_spread_by_a_pixel():
    depth = sphere_depth(PARALLEL, np.array([0.0, 0.0, 0.55]), 0.3)
    depth[20, 30] = np.nan
    unknown = np.isnan(geometry_of(depth, PARALLEL).mean_curvature_per_m)
    assert unknown[19:22, 29:32].all() and unknown[0].all() and unknown[:, -1].all()
    assert not unknown[40:80, 60:100].any()
