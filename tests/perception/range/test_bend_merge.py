"""Correlated sensor errors bend a flat face and split it; both are corrected, and creases and steps are kept."""

from __future__ import annotations

import numpy as np
import pytest

from perception.range.fitting.surfaces import CONE, CYLINDER, PLANE, SIZE, SPHERE
from perception.range.noise import NoiseModel
from perception.range.segmentation.bend import scrap_gain, simplest, straightened, turn_of
from perception.range.segmentation.join import join_pieces
from perception.range.segmentation.merge import merge_touching
from perception.range.segmentation.regions import regions_of
from tests.perception.range.reference import depths_on

WHITE = NoiseModel(white=(0.002, 0.0), correlated=(0.0, 0.0), step=(0.0, 0.0))
SLOW = NoiseModel(white=(0.001, 0.0), correlated=(0.004, 0.0), step=(0.0, 0.0))
FOCAL_PX = 120.0
SHAPE = (120, 160)
PACKED = np.array([1.0, FOCAL_PX, FOCAL_PX, 79.5, 59.5])


def surface(kind, *values):
    th = np.zeros(SIZE)
    th[: len(values)] = values
    return kind, th


def plane(normal, d):
    n = np.asarray(normal, float)
    return surface(PLANE, *(n / np.linalg.norm(n)), d)


def rays(mask):
    v, u = np.nonzero(mask)
    return (u - PACKED[3]) / FOCAL_PX, (v - PACKED[4]) / FOCAL_PX


def sampled(kind, th, mask, noise, *, seed=0, sigma=1.0):
    """Return the (4, N) samples of the pixels in `mask`, with white noise of `sigma` times the model's."""
    x, y = rays(mask)
    z = depths_on(kind, th, x, y, True)
    assert np.isfinite(z).all()
    scatter = noise.sigma_m(z)
    z = z + sigma * scatter * np.random.default_rng(seed).normal(size=z.size)
    return np.stack([x, y, z, scatter])


def few_of(*given, **more):
    """Return at most 300 of the samples of `sampled`, as many as a fit takes."""
    samples = sampled(*given, **more)
    return np.ascontiguousarray(samples[:, :: samples.shape[1] // 300 + 1])


def box(top, bottom, left, right):
    mask = np.zeros(SHAPE, bool)
    mask[top:bottom, left:right] = True
    return mask


WALL = box(20, 100, 30, 130)
BENT_WALL = surface(SPHERE, 0.0, 0.0, 14.0, 12.0, 1.0)  # 12 m radius, 2 m away: its normal turns by 0.1 rad
BALL = surface(SPHERE, 0.0, 0.0, 2.3, 0.3, 1.0)


def test_a_wall_bent_by_slow_errors_is_named_a_plane():
    kind, th = straightened(*BENT_WALL, few_of(*BENT_WALL, WALL, SLOW), SLOW.packed(), True)
    assert kind == PLANE
    assert abs(th[2]) == pytest.approx(1.0, abs=1e-3)


def test_without_slow_errors_the_same_surface_stays_a_piece_of_a_ball():
    kind, th = straightened(*BENT_WALL, few_of(*BENT_WALL, WALL, WHITE), WHITE.packed(), True)
    assert (kind, th[3]) == (SPHERE, 12.0)


def test_a_ball_is_no_bent_plane():
    samples = few_of(*BALL, box(52, 68, 70, 90), SLOW)
    assert straightened(*BALL, samples, SLOW.packed(), True)[0] == SPHERE


def test_a_slender_cone_under_slow_errors_is_named_a_cylinder():
    cone = surface(CONE, 0.0, -3.0, 1.5, 0.0, 1.0, 0.0, 0.03, 1.0)
    samples = few_of(*cone, box(40, 80, 76, 84), SLOW, sigma=0.2)
    kind, th = straightened(*cone, samples, SLOW.packed(), True)
    assert kind == CYLINDER
    assert th[6] == pytest.approx(3.0 * np.tan(0.03), rel=0.1)


def test_a_steeper_cone_stays_one():
    cone = surface(CONE, 0.0, -1.0, 1.5, 0.0, 1.0, 0.0, 0.2, 1.0)
    assert straightened(*cone, few_of(*cone, box(40, 80, 74, 86), SLOW, sigma=0.2), SLOW.packed(), True)[0] == CONE


def test_turn_is_the_angle_over_which_normals_spread():
    a = np.linspace(-0.2, 0.2, 401)
    normals = np.stack([np.sin(a), np.zeros_like(a), -np.cos(a)], axis=1)
    assert turn_of(normals) == pytest.approx(0.4, rel=0.05)


def test_a_flat_patch_that_was_fitted_as_a_ball_is_cheaper_as_a_plane():
    flat = plane([0.0, 0.3, -1.0], -2.0)
    samples = few_of(*flat, box(50, 70, 70, 90), WHITE)
    kind, th = simplest(*surface(SPHERE, 0.0, 0.0, 6.0, 4.0, 1.0), samples, True, 400.0)
    assert kind == PLANE
    assert abs(th[:3] @ flat[1][:3]) == pytest.approx(1.0, abs=1e-3)


def test_a_ball_stays_a_ball_when_its_bulge_is_worth_its_price():
    samples = few_of(*BALL, box(52, 68, 70, 90), WHITE)
    kind, th = simplest(*BALL, samples, True, 320.0)
    assert kind == SPHERE
    assert th[3] == pytest.approx(0.3, rel=0.15)


WALL_2M = plane([0.0, 0.0, -1.0], -2.0)
LEFT, RIGHT = box(20, 100, 20, 80), box(20, 100, 80, 140)


def image_of(parts, noise, background_m=np.nan):
    """Return the regions of an image of `parts`, each a surface and its mask; later parts hide earlier ones."""
    depth, labels = np.full(SHAPE, background_m), np.zeros(SHAPE, np.int32)
    for k, (shape, mask) in enumerate(parts, 1):
        depth[mask], labels[mask] = sampled(*shape, mask, noise, seed=k)[2], k
    return regions_of(depth, PACKED, noise.packed(), labels, len(parts))


def merged(left, right, noise):
    """Return the owners of labels 1 and 2, two planes that touch along a column."""
    regions = image_of([(left, LEFT), (right, RIGHT)], noise)
    return merge_touching(regions, [left[0], right[0]], [left[1], right[1]])


@pytest.mark.parametrize("noise", [WHITE, SLOW], ids=["white", "slow"])
@pytest.mark.parametrize(("turn_rad", "is_one"), [(0.0, True), (0.02, True), (0.8, False), (1.5, False)])
def test_pieces_of_one_face_are_joined_and_faces_at_an_edge_are_not(noise, turn_rad, is_one):
    half = 0.5 * turn_rad
    left = plane([np.sin(half), 0.0, -np.cos(half)], -2.0 * np.cos(half))
    right = plane([-np.sin(half), 0.0, -np.cos(half)], -2.0 * np.cos(half))
    assert (len(set(merged(left, right, noise))) == 1) == is_one


FINE = NoiseModel(white=(0.0004, 0.0), correlated=(0.0, 0.0), step=(0.0, 0.0))


@pytest.mark.parametrize(("turn_rad", "is_one"), [(0.05, True), (0.15, False)])
def test_facets_of_upholstery_are_one_face_and_faces_of_a_blunt_body_are_not(turn_rad, is_one):
    # Halves 1 m wide deviate from their common plane by up to 0.25 m * turn; 2 % of their size is 23 mm.
    left = plane([np.sin(turn_rad), 0.0, -np.cos(turn_rad)], -2.0 * np.cos(turn_rad))
    assert (len(set(merged(left, plane([0.0, 0.0, -1.0], -2.0), FINE))) == 1) == is_one


def test_a_step_between_parallel_faces_stays():
    assert merged(plane([0, 0, -1], -2.0), plane([0, 0, -1], -2.1), SLOW) == [1, 2]


def test_pieces_of_a_bent_table_are_joined_behind_what_parts_them():
    left, right = plane([0.008, 0.3, -1.0], -2.0), plane([-0.008, 0.3, -1.0], -2.0)
    apart = [(left, box(20, 100, 10, 60)), (right, box(20, 100, 90, 150))]
    regions = image_of(apart, SLOW, background_m=1.5)  # a nearer surface is between them
    owners = join_pieces(regions, [PLANE, PLANE], [left[1], right[1]])
    assert len(set(owners)) == 1


def test_a_gap_that_shows_something_behind_keeps_pieces_apart():
    flat = plane([0.0, 0.0, -1.0], -2.0)
    regions = image_of([(flat, box(20, 100, 10, 60)), (flat, box(20, 100, 90, 150))], SLOW, background_m=4.0)
    assert join_pieces(regions, [PLANE, PLANE], [flat[1], flat[1]]) == [1, 2]


@pytest.mark.parametrize(("depth_m", "is_one"), [(0.03, False), (0.004, True), (-0.03, True)])
def test_a_groove_keeps_coplanar_pieces_apart_and_a_ridge_or_a_scratch_does_not(depth_m, is_one):
    flat = plane([0.0, 0.0, -1.0], -2.0)
    pieces = [(flat, box(20, 100, 10, 70)), (flat, box(20, 100, 75, 150))]
    regions = image_of(pieces, WHITE, background_m=2.0 + depth_m)
    owner = join_pieces(regions, [PLANE, PLANE], [flat[1], flat[1]])
    assert (len(set(owner)) == 1) == is_one


SPOT = box(55, 65, 75, 85)


def spot_gain(offset_m, noise):
    """Return the gain of joining a spot, tilted by 0.4 rad and shifted by an offset, with the wall around it."""
    spot = plane([0.4, 0.0, -1.0], -(2.0 + offset_m) / np.hypot(0.4, 1.0))
    samples = few_of(*plane([0, 0, -1], -(2.0 + offset_m)), SPOT, noise)
    return scrap_gain(*WALL_2M, *spot, samples, float(SPOT.sum()), noise.packed(), True)


def test_a_spot_within_slow_noise_belongs_to_the_wall_whatever_its_direction():
    assert spot_gain(0.005, SLOW) > 0.0


def test_under_white_noise_the_same_offset_is_a_thing_of_its_own():
    flush = plane([0.0, 0.0, -1.0], -2.005)
    samples = few_of(*flush, SPOT, WHITE)
    assert scrap_gain(*WALL_2M, *flush, samples, float(SPOT.sum()), WHITE.packed(), True) < 0.0


def test_a_spot_that_stands_out_of_slow_noise_stays():
    assert spot_gain(0.06, SLOW) < 0.0


@pytest.mark.parametrize(("offset_m", "owners"), [(0.003, [1, 1]), (0.08, [1, 2])])
def test_a_scrap_inside_a_wall_is_swallowed_only_when_noise_explains_it(offset_m, owners):
    odd = plane([0.5, 0.0, -1.0], -(2.0 + offset_m) / np.hypot(0.5, 1.0))
    spot = plane([0, 0, -1], -(2.0 + offset_m))
    regions = image_of([(WALL_2M, WALL), (spot, SPOT)], SLOW)
    assert merge_touching(regions, [PLANE, PLANE], [WALL_2M[1], odd[1]]) == owners
