"""Compares the compiled search for edges with plain numpy, and tests it on an edge at a known place."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from hal.arrays import Array
from perception.vision.registration.edge_search import STEP_PX, strongest_edges


def in_numpy(smooth: np.ndarray, points: Array, normals: Array, window_px: float) -> tuple[Array, Array, np.ndarray]:
    """Return the result of `strongest_edges`, computed with whole arrays."""
    t = np.arange(-window_px - STEP_PX, window_px + 1.5 * STEP_PX, STEP_PX)
    u, v = points[:, :1] + normals[:, :1] * t, points[:, 1:] + normals[:, 1:] * t
    height, width = smooth.shape
    visible = np.isfinite(u).all(axis=1) & (np.minimum(u, v) >= 1).all(axis=1)
    visible &= (u < width - 2).all(axis=1) & (v < height - 2).all(axis=1)
    places = [np.where(visible[:, None], v, 0.0), np.where(visible[:, None], u, 0.0)]
    values = map_coordinates(smooth.astype(float), places, order=1)
    slope = np.abs(values[:, 2:] - values[:, :-2]) / (2 * STEP_PX)
    inner = t[1:-1]
    best = np.clip((slope * np.exp(-0.5 * (inner / window_px) ** 2)).argmax(axis=1), 1, len(inner) - 2)
    rows = np.arange(len(best))
    before, peak, after = slope[rows, best - 1], slope[rows, best], slope[rows, best + 1]
    bend = before - 2 * peak + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
    return inner[best] + STEP_PX * np.clip(shift, -1, 1), peak, visible


@pytest.mark.parametrize("window_px", [2.0, 2.5, 5.0, 8.0])
def test_it_finds_what_numpy_finds(window_px: float) -> None:
    random = np.random.default_rng(int(10 * window_px))
    smooth = cv2.GaussianBlur(random.uniform(0, 255, (90, 120)).astype(np.float32), (0, 0), 1.5)
    points = random.uniform([-5, -5], [125, 95], (400, 2))
    points[::50] = np.nan
    angles = random.uniform(0, 2 * np.pi, 400)
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    offset, peak, visible = strongest_edges(smooth, points, normals, window_px)
    wanted_offset, wanted_peak, wanted_visible = in_numpy(smooth, points, normals, window_px)
    assert (visible == wanted_visible).all() and 0.5 < visible.mean() < 1.0
    assert offset[visible] == pytest.approx(wanted_offset[visible], abs=1e-3)
    assert peak[visible] == pytest.approx(wanted_peak[visible], rel=1e-4)
    assert not peak[~visible].any() and not offset[~visible].any()


@pytest.mark.parametrize("place_px", [47.0, 50.3, 52.75])
def test_an_edge_is_found_where_it_is(place_px: float) -> None:
    u = np.arange(100.0)
    smooth = np.tile(100.0 + 80.0 * np.tanh((u - place_px) / 1.5), (60, 1)).astype(np.float32)
    points, normals = np.array([[50.0, 30.0], [50.0, 30.0]]), np.array([[1.0, 0.0], [-1.0, 0.0]])
    offset, peak, visible = strongest_edges(smooth, points, normals, 5.0)
    assert visible.all() and offset == pytest.approx([place_px - 50.0, 50.0 - place_px], abs=0.3)  # half a step
    assert peak == pytest.approx(80.0 / 1.5, rel=0.15)
