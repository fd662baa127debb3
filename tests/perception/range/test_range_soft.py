"""The soft boxes of the range benchmark are closed, rounded, and bulge by the requested amount."""

from __future__ import annotations

import numpy as np

from benchmarks.range_soft import SoftBox, soft_box


def plain(radius: float, cushion: bool = False) -> SoftBox:
    return SoftBox(
        name="box",
        centre=np.array([1.0, 2.0, 3.0]),
        turn=np.eye(3),
        half=np.array([10.0, 20.0, 30.0]),
        radius=radius,
        bulge=np.zeros((6, 4)),
        is_cushion=cushion,
    )


def test_distances_of_a_rounded_box():
    box = plain(4.0)
    points = np.array([[13.0, 0, 0], [0, -25.0, 0], [0, 0, 30.0], [9.0, 0, 0], [6 + 3.0 + 4.0, 16 + 4.0 + 4.0, 0]])
    np.testing.assert_allclose(box.distance(points), [3.0, 5.0, 0.0, -1.0, np.hypot(7.0, 8.0) - 4.0])
    np.testing.assert_array_equal(box.faces(points[:4]), [0, 3, 4, 0])


def test_a_bulge_is_as_high_as_asked_and_none_at_the_outline():
    box = soft_box(np.random.default_rng(1), "b", np.zeros(3), np.array([100.0, 200, 300]), np.eye(3), 0.0, 0.02)
    middle = box.half * np.array([1.0, 0, 0])
    assert box.distance(middle[None])[0] == -box.bulge[0, 0]
    assert 0.5 * 0.02 * 200 <= abs(box.bulge[0, 0]) <= 0.02 * 200
    outline = box.half * np.array([[1.0, 1.0, 0.3], [1.0, -0.2, -1.0]])
    np.testing.assert_allclose(box.distance(outline), 0.0, atol=1e-12)


def test_a_moved_box_and_a_cushion():
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = plain(0.0).moved(turn, np.array([5.0, 0, 0]))
    np.testing.assert_allclose(moved.centre, [3.0, 1.0, 3.0])
    np.testing.assert_allclose(moved.turn, turn)
    cushion = plain(0.0, cushion=True)
    on = np.array([[10.0, 0, 0], [0, 20.0, 0], [0, 0, -30.0]])
    np.testing.assert_allclose(cushion.distance(on), 0.0, atol=1e-12)
    assert (cushion.distance(1.2 * on) > 0).all()
    assert not cushion.faces(on).any()
