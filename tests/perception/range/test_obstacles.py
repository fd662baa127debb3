"""What stands before a panel is enclosed by boxes, and what belongs to the panel is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal.arrays import Array
from hal.config import load_cell
from hal.errors import NotFound
from perception.range.obstacles import Obstacle, find_obstacles, shows_plate

PANEL = load_cell(Path(__file__).parents[3] / "cells/bench.toml").panel
PITCH_M, SIGMA_M = 0.006, 0.0006


def found(points_m: Array) -> tuple[Obstacle, ...]:
    return find_obstacles(points_m, PANEL, pitch_m=PITCH_M, sigma_m=SIGMA_M)


def plate(rng: np.random.Generator) -> Array:
    x, y = np.meshgrid(np.arange(-0.35, 0.35, PITCH_M), np.arange(-0.25, 0.25, PITCH_M))
    return np.column_stack([x.ravel(), y.ravel(), rng.normal(0.0, 0.003, x.size)])


def bow(height_m: float) -> Array:
    """Return the axis of a cable that hangs in a bow above everything on the panel."""
    t = np.linspace(-1.0, 1.0, 80)
    return np.column_stack([0.25 * t, 0.2 * t**2 - 0.1, np.full(t.size, height_m)])


def held_by(box: Obstacle, points_m: Array) -> Array:
    inside: Array = (abs(box.panel_from_box.inv().apply(points_m)) <= np.array(box.half_m) + 1e-9).all(axis=1)
    return inside


def test_a_cable_is_enclosed_and_the_space_in_its_bow_stays_free() -> None:
    rng = np.random.default_rng(4)
    cable = bow(0.12) + rng.normal(0.0, 0.001, (80, 3))
    boxes = found(np.vstack([plate(rng), cable]))
    assert np.any([held_by(box, cable) for box in boxes], axis=0).all()
    beside = np.array([[0.0, 0.05, 0.12], [0.1, 0.1, 0.12], [0.0, -0.1, 0.06], [0.2, -0.05, 0.12]])
    assert not np.any([held_by(box, beside) for box in boxes])
    assert 2 <= len(boxes) <= 16


def test_objects_with_the_blurred_pixels_at_their_edges_are_no_obstacle() -> None:
    rng = np.random.default_rng(5)
    tops = [
        np.array([*(one.position_m + rng.uniform(-1.0, 1.0, 2) * np.array(room.half_m)), share * room.height_m])
        for one in PANEL.objects
        for room in (one.envelope(),)
        if room.turn_rad == 0.0
        for share in rng.uniform(0.0, 1.1, 40)
    ]
    assert found(np.vstack([plate(rng), tops])) == ()


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_few_stray_points_are_no_obstacle(count: int) -> None:
    rng = np.random.default_rng(7)
    assert found(np.vstack([plate(rng), bow(0.2)[:count]])) == ()


def test_a_wide_flat_thing_is_one_box() -> None:
    y, z = np.meshgrid(np.arange(-0.2, 0.2, PITCH_M), np.arange(0.09, 0.3, PITCH_M))
    door = np.column_stack([np.full(y.size, 0.33), y.ravel(), z.ravel()])
    (box,) = found(np.vstack([plate(np.random.default_rng(8)), door]))
    assert held_by(box, door).all() and min(box.half_m) < PITCH_M


def test_a_plate_that_stands_elsewhere_is_told_from_one_with_a_cable_before_it() -> None:
    rng = np.random.default_rng(6)
    seen = np.vstack([plate(rng), bow(0.05)])
    assert shows_plate(seen, PANEL)
    for off_m in (-0.008, 0.008, 0.018):
        assert not shows_plate(seen + np.array([0.0, 0.0, off_m]), PANEL)
    assert not shows_plate(seen[:0], PANEL)
    with pytest.raises(NotFound, match="no plate"):
        found(bow(0.05))
