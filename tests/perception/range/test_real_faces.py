"""Tests with faces of real things: bulging, with rounded edges, side by side with a groove between them."""

from __future__ import annotations

import numpy as np
import pytest

from perception.range import analyse
from perception.range.fitting.surfaces import CONE, CYLINDER, PLANE, SIZE
from perception.range.segmentation import fillets
from tests.perception.range.scenes import PARALLEL, PINHOLE, noisy

LAW = np.array([2e-4, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_a_post_before_a_plane_does_not_part_it():
    plate = np.full((120, 160), 0.8)
    plate[:, 79:82] -= 0.1
    plate[:10], plate[-10:] = 1.2, 1.2
    labels = analyse(noisy(plate, 2e-3, 4), PINHOLE).labels
    left, right = labels[20:100, 5:70], labels[20:100, 90:155]
    assert np.median(left) == np.median(right)
    assert np.mean(left == np.median(left)) > 0.9
    assert np.mean(right == np.median(right)) > 0.9


def roof(radius_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return two planes at a right angle with a rounded edge: depth, labels, kinds and their parameters."""
    pitch = PARALLEL.pixel_pitch_m
    x = np.broadcast_to((np.arange(160) - 79.5) * pitch, (120, 160))
    axis_z = 0.5 + radius_m * np.sqrt(2.0)
    round_half = radius_m / np.sqrt(2.0)
    arc = axis_z - np.sqrt(np.maximum(radius_m**2 - x**2, 0.0))
    depth = np.where(abs(x) < round_half, arc, 0.5 + abs(x))
    labels = np.where(abs(x) < round_half, 3, np.where(x < 0, 1, 2)).astype(np.int32)
    table = np.zeros((4, SIZE))
    for k, side in ((1, -1.0), (2, 1.0)):
        normal = np.array([side, 0.0, -1.0]) / np.sqrt(2.0)
        table[k, :3], table[k, 3] = normal, normal @ [0.0, 0.0, 0.5]
    table[3, :8] = 0.0, 0.0, axis_z, 0.0, 1.0, 0.0, radius_m, 1.0
    return depth, labels, np.array([0, PLANE, PLANE, CYLINDER]), table


def test_a_rounded_edge_is_shared_by_its_faces():
    depth, labels, kinds, table = roof(0.012)
    assert (labels == 3).sum() > 900
    after = fillets.without_fillets(depth, PARALLEL.packed(), LAW, labels, kinds, table)
    assert set(np.unique(after)) == {1, 2}
    np.testing.assert_array_equal(after[:, :80], 1)
    np.testing.assert_array_equal(after[:, 80:], 2)


@pytest.mark.parametrize(("share", "left"), [(0.2, 0), (0.5, 3)])
def test_what_is_left_of_a_rounded_edge_that_has_gone_is_no_surface(share, left):
    depth, labels, kinds, table = roof(0.012)
    edge = labels == 3
    off = edge & (np.arange(120) < share * 120)[:, None]
    after = fillets.without_fillets(np.where(off, depth - 0.05, depth), PARALLEL.packed(), LAW, labels, kinds, table)
    np.testing.assert_array_equal(after[off], left)  # a strip that mostly remains is a net of edges or a thin face
    assert np.isin(after[edge & ~off], (1, 2)).all()


@pytest.mark.parametrize(
    ("step", "turn", "is_flat", "is_narrow", "goes_on"),
    [
        (2.9, 0.4, True, False, True),
        (2.9, 0.7, True, False, False),  # a bevel
        (2.9, 0.7, False, False, True),
        (3.5, 0.4, True, False, False),
        (3.5, 0.9, True, True, True),  # too narrow for its bend to be visible
        (4.5, 0.4, True, True, False),
        (2.9, 1.2, True, True, False),
    ],
)
def test_a_strip_goes_on_by_its_step_and_turn_as_far_as_its_width_lets_them_show(
    step, turn, is_flat, is_narrow, goes_on
):
    assert fillets._goes_on(step, turn, is_flat=is_flat, is_narrow=is_narrow) == goes_on


def test_a_tube_before_a_wall_stays_a_tube():
    depth, labels, kinds, table = roof(0.012)
    tube = labels == 3
    depth = np.where(tube, depth - 0.05, 0.56)
    table[1, :4] = 0.0, 0.0, -1.0, -0.56
    table[3, 2] -= 0.05
    labels = np.where(tube, 3, 1).astype(np.int32)
    after = fillets.without_fillets(depth, PARALLEL.packed(), LAW, labels.copy(), kinds, table)
    np.testing.assert_array_equal(after, labels)


def test_what_curves_away_slowly_is_the_faces_as_far_as_the_reach():
    _, labels, kinds, table = roof(0.0)
    labels[:] = np.where(np.arange(160) < 70, 1, 0)
    slope = np.maximum(np.arange(160) - 69, 0) * PARALLEL.pixel_pitch_m
    off = np.where(np.arange(120) < 60, 0.3, 1.5)[:, None] * slope  # in depth; at 45 degrees 0.7 of it is normal
    fillets.spread_outwards(plane_of(table[1]) + off, PARALLEL.packed(), LAW, labels, kinds, table, 5)
    inner = slice(3, 57)
    np.testing.assert_array_equal(labels[inner, :75], 1)
    np.testing.assert_array_equal(labels[inner, 75:], 0)
    assert not labels[65:115, 72:].any()


def plane_of(th: np.ndarray) -> np.ndarray:
    """Return the depth of a plane n . X = d seen by parallel rays."""
    v, u = np.mgrid[:120, :160]
    x, y = (u - 79.5) * PARALLEL.pixel_pitch_m, (v - 59.5) * PARALLEL.pixel_pitch_m
    return np.asarray((th[3] - th[0] * x - th[1] * y) / th[2])


def test_strips_are_told_from_discs():
    labels = np.zeros((90, 120), np.int32)
    labels[5:85, 10:16] = 1
    v, u = np.mgrid[:90, :120]
    labels[np.hypot(u - 70, v - 45) < 35] = 2
    labels[45:75:5, 60:80:4] = 0
    half_width, length = fillets._shapes(labels, np.bincount(labels.ravel(), minlength=4))
    assert half_width[1] == pytest.approx(480 / (2 * 80 + 2 * 4))
    assert half_width[2] == pytest.approx(17.5, rel=0.15)
    assert length[1] > 2 * fillets.LONG
    assert length[2] < 0.7 * fillets.LONG
    assert half_width[3] == length[3] == 0.0


def test_a_cone_on_a_table_is_no_rounded_edge():
    v, u = np.mgrid[:120, :160]
    off = np.hypot((u - 79.5) * PARALLEL.pixel_pitch_m, (v - 59.5) * PARALLEL.pixel_pitch_m)
    depth = np.minimum(0.5, 0.45 + 1.4 * off)
    labels = np.where(depth < 0.5, 2, 1).astype(np.int32)
    table = np.zeros((3, SIZE))
    table[1, :4] = 0.0, 0.0, -1.0, -0.5
    table[2, :7] = 0.0, 0.0, 0.45, 0.0, 0.0, 1.0, np.arctan(1 / 1.4)
    kinds = np.array([0, PLANE, CONE])
    after = fillets.without_fillets(depth, PARALLEL.packed(), LAW, labels.copy(), kinds, table)
    np.testing.assert_array_equal(after, labels)
