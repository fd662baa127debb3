"""Compares the compiled passes over pixels and their algebra with plain numpy."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perception.range.fitting.equations import MISS_SIGMAS, TRIM_SIGMAS
from perception.range.fitting.fit import PER_MEDIAN, SCALE_PRECISION, middle_scale
from perception.range.fitting.initialisation import ellipsoid, principal_axes
from perception.range.fitting.last_step import last_step
from perception.range.fitting.surfaces import (
    CYLINDER,
    FREEDOM,
    GRAZING_COSINE,
    PLANE,
    QUADRIC,
    SIZE,
    SPHERE,
    frame_of,
    step_into,
)
from perception.range.noise import NoiseModel
from perception.range.primitives import named_covariance
from perception.range.segmentation import boundary_pixels, finish, pixel_assignment
from perception.range.segmentation.regions import regions_of
from perception.range.sensor import OrthographicSensor
from tests.perception.range.reference import depth_and_jacobian, depths_on
from tests.perception.range.scenes import PARALLEL, PINHOLE

NOISE = NoiseModel(white=(0.0005, 0.0002), correlated=(0.0, 0.0003), step=(0.0004, 0.0))
KINDS = np.array([0, PLANE, SPHERE, PLANE, CYLINDER])


def competing_surfaces() -> np.ndarray:
    """Return (5, 16) parameters of two planes, a ball and a pipe at about 0.6 m; entry 0 is unused."""
    table = np.zeros((5, SIZE))
    table[1, :4] = [0.0, 0.0, -1.0, -0.62]
    table[2, :5] = [-0.05, 0.0, 0.62, 0.05, 1.0]
    table[3, :4] = [0.6, 0.0, -0.8, -0.48]
    table[4, :8] = [0.1, 0.0, 0.62, 0.0, 1.0, 0.0, 0.03, 1.0]
    return table


def random_case(sensor, seed, size=2):
    """Return depth near the surfaces, with holes, and a block map of random patches."""
    rng = np.random.default_rng(seed)
    depth = 0.6 + 0.02 * rng.normal(size=(sensor.height_px, sensor.width_px)) * (rng.random((120, 160)) < 0.5)
    depth[rng.random(depth.shape) < 0.02] = np.nan
    h, w = -(-depth.shape[0] // size), -(-depth.shape[1] // size)
    coarse = rng.integers(0, 5, (h // 6 + 1, w // 6 + 1))
    blocks = np.kron(coarse, np.ones((6, 6), int))[:h, :w].astype(np.int32)
    return depth, np.ascontiguousarray(blocks)


def best_label(sensor, depth, v, u, near, table, own=0):
    """Return the first label of smallest residual among `near`, by definition; `own` is kept if it fits well."""
    packed, z = sensor.packed(), depth[v, u]
    best, label = pixel_assignment.ASSIGNMENT_SIGMAS, 0
    for k in near:
        e = pixel_assignment.misfit(
            KINDS[k],
            table[k],
            (u - packed[3]) / packed[1],
            (v - packed[4]) / packed[2],
            z,
            float(NOISE.sigma_m(z)),
            bool(packed[0] > 0),
        )
        if k == own and e < pixel_assignment.PLAIN_SIGMAS:
            return k
        if e < best:
            best, label = e, k
    return label


def around(labels, v, u):
    """Return the labels of the 3x3 neighbourhood, in raster order of their first pixel."""
    patch = labels[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].ravel()
    return list(dict.fromkeys(int(k) for k in patch if k > 0))


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
@pytest.mark.parametrize("tiles", [1, 5])
def test_pixels_go_to_the_best_surface_of_the_blocks_around(sensor, tiles):
    depth, blocks = random_case(sensor, 1)
    table, out = competing_surfaces(), np.full(depth.shape, -1, np.int32)
    cuts = np.linspace(0, blocks.shape[0], tiles + 1).astype(int).tolist()
    for top, bottom in pairwise(cuts):
        pixel_assignment.assign_pixels(
            depth, sensor.packed(), NOISE.packed(), blocks, 2, KINDS, table, out, top, bottom
        )
    assert (out >= 0).all() and len(np.unique(out)) == 5
    rng = np.random.default_rng(0)
    for v, u in zip(rng.integers(0, 120, 3000), rng.integers(0, 160, 3000), strict=True):
        own = int(blocks[v // 2, u // 2])
        near = sorted(around(blocks, v // 2, u // 2), key=lambda k: k != own)
        assert out[v, u] == best_label(sensor, depth, v, u, near, table, own)


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
def test_only_pixels_beside_a_new_surface_are_judged_again(sensor):
    depth, blocks = random_case(sensor, 2, size=1)
    table, out, newest = competing_surfaces(), blocks.copy(), 3
    rows, columns = boundary_pixels.contested_pixels(blocks, newest, 0, 120)
    names = np.full_like(rows, -1)
    for ends in ((0, 50), (50, rows.size)):
        pixel_assignment.reassign_pixels(
            depth, sensor.packed(), NOISE.packed(), blocks, KINDS, table, rows, columns, names, *ends
        )
    boundary_pixels.renamed_pixels(out, rows, columns, names)
    for v in range(120):
        for u in range(160):
            near = around(blocks, v, u)
            if not set(near) - {int(blocks[v, u])} or max(near) < newest:
                assert out[v, u] == blocks[v, u]
            elif (v + u) % 7 == 0:  # only every seventh pixel, because the plain search is slow
                assert out[v, u] == best_label(sensor, depth, v, u, near, table)


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
def test_samples_of_each_label_come_in_raster_order(sensor):
    depth, labels = random_case(sensor, 3, size=1)
    labels[np.isnan(depth)] = 0
    packed = sensor.packed()
    regions = regions_of(depth, packed, NOISE.packed(), labels, 4)
    for k, few in enumerate(regions.few(100), 1):
        v, u = np.nonzero(labels == k)
        np.testing.assert_array_equal(regions.places(k), v * depth.shape[1] + u)
        assert regions.pixels[k - 1] == v.size and few.shape == (4, 100)
        spread = np.rint(np.linspace(0, v.size - 1, 100)).astype(int)
        v, u = v[spread], u[spread]
        expected = [(u - packed[3]) / packed[1], (v - packed[4]) / packed[2], depth[v, u], NOISE.sigma_m(depth[v, u])]
        np.testing.assert_allclose(few, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
@pytest.mark.parametrize("kind", [PLANE, SPHERE])
def test_the_last_step_over_runs_is_that_of_the_normal_equations_of_all_pixels(sensor, kind):
    th, rng = competing_surfaces()[kind + 1], np.random.default_rng(5)
    packed, (v, u) = sensor.packed(), np.mgrid[:120, :160]
    x, y = (u - packed[3]) / packed[1], (v - packed[4]) / packed[2]
    depth = depths_on(kind, th, x.ravel(), y.ravel(), bool(packed[0] > 0)).reshape(u.shape)
    labels = (np.isfinite(depth) & (rng.random(depth.shape) < 0.9)).astype(np.int32)
    depth += 1.4 * NOISE.sigma_m(0.6) * rng.normal(size=depth.shape)
    inside = labels == 1
    x, y, z = x[inside], y[inside], depth[inside]
    p, J, e = int(FREEDOM[kind]), [], []
    frame, row = np.zeros(6), np.zeros(9)
    frame_of(kind, th, frame)
    for k, sigma in enumerate(NOISE.sigma_m(z)):
        zm, cosine = depth_and_jacobian(kind, th, frame, x[k], y[k], bool(packed[0] > 0), row)
        weight = min(1.0, cosine / GRAZING_COSINE) / sigma
        if abs((z[k] - zm) * weight) <= TRIM_SIGMAS:
            J.append(row[:p] * weight)
            e.append((z[k] - zm) * weight)
    regions = regions_of(depth, packed, NOISE.packed(), labels, 1)
    moved, H, kept, used = last_step(kind, th, depth, packed, NOISE.packed(), regions.runs_of(1))
    J, e = np.array(J), np.array(e)
    step, left, *_ = np.linalg.lstsq(J, e, rcond=None)
    expected = np.zeros(SIZE)
    step_into(kind, th, frame, step, expected)
    assert used == len(e) > 500
    np.testing.assert_allclose(H[:p, :p], J.T @ J, rtol=1e-6, atol=1e-6 * np.trace(J.T @ J))
    np.testing.assert_allclose(moved, expected, atol=1e-7)
    assert kept == pytest.approx(float(left[0]), rel=1e-6)


def test_regions_given_to_others_are_those_of_the_new_labels():
    depth, labels = random_case(PINHOLE, 4, size=1)
    labels[np.isnan(depth)] = 0
    given = regions_of(depth, PINHOLE.packed(), NOISE.packed(), labels, 4).given_to([1, 1, 3, 3])
    assert given.pixels == [int(np.isin(labels, k).sum()) for k in ([1, 2], [], [3, 4], [])]
    assert np.array_equal(given.labels, np.array([0, 1, 1, 3, 3])[labels])


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), rank=st.integers(1, 3), size=st.floats(1e-8, 1e8))
def test_principal_axes_are_those_of_lapack(seed, rank, size):
    rows = np.random.default_rng(seed).normal(size=(rank, 3)) * np.array([1.0, 0.1, 3.0])
    S = size * rows.T @ rows
    values, vectors = principal_axes(S)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(S), atol=1e-13 * np.trace(S))
    np.testing.assert_allclose(vectors @ vectors.T, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(S @ vectors, vectors * values, atol=1e-13 * np.trace(S))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.integers(1, 40), wide=st.sampled_from([0.3, 1.0, 4.0]))
def test_the_middle_scale_is_that_of_numpys_median(seed, size, wide):
    rng = np.random.default_rng(seed)
    e = np.round(wide * rng.normal(size=size), 1)
    e[rng.random(size) < 0.1] = np.nan
    median = np.sort(np.abs(np.nan_to_num(e, nan=MISS_SIGMAS)))[size // 2]
    assert middle_scale(e) == pytest.approx(max(1.0, PER_MEDIAN * median), rel=SCALE_PRECISION)


def test_an_ellipsoids_shape_and_its_covariance_are_those_of_plain_differences():
    th = np.zeros(SIZE)
    th[:14] = [0.1, -0.05, 0.6, 0.08, 1.0, 0.7, 1.3, 0.1, -0.05, 0.2, 0.02, -0.03, 0.01, -0.9]

    def shape(q):
        """Return centre and radii by LAPACK: Y0 = -A^-1 b and radii s sqrt((b' A^-1 b - c) / lambda_i)."""
        t = th.copy()
        t[4:7] += [q[0], q[1], -q[0] - q[1]]
        t[7:14] += q[2:]
        A = np.array([[2 * t[4], t[7], t[8]], [t[7], 2 * t[5], t[9]], [t[8], t[9], 2 * t[6]]]) / 2
        b = 0.5 * t[10:13]
        y = -np.linalg.solve(A, b)
        return np.concatenate([t[:3] + t[3] * y, t[3] * np.sqrt((-b @ y - t[13]) / np.linalg.eigvalsh(A))])

    centre, radii, axes = ellipsoid(th)
    np.testing.assert_allclose([*centre, *radii], shape(np.zeros(9)), rtol=1e-12)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    J = np.stack([(shape(1e-5 * q) - shape(-1e-5 * q)) / 2e-5 for q in np.eye(9)], axis=1)
    root = np.random.default_rng(4).normal(size=(9, 9)) * 1e-3
    np.testing.assert_allclose(
        named_covariance(QUADRIC, th, root @ root.T), J @ root @ root.T @ J.T, rtol=1e-3, atol=1e-12
    )


def test_a_sphere_is_refined_to_its_bound_and_its_covariance_is_the_inverse_information():
    """In 20 noisy images of a ball, errors over sigma are standard normal."""
    rng = np.random.default_rng(5)
    sensor = OrthographicSensor(width_px=60, height_px=60, pixel_pitch_m=0.2 / 59)
    noise = NoiseModel(white=(1e-3, 0.0), correlated=(0.0, 0.0), step=(0.0, 0.0))
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 60), np.linspace(-0.1, 0.1, 60))
    labels = (np.hypot(x, y) < 0.09).astype(np.int32)
    truth = np.array([0.0, 0.0, 0.6, 0.1])
    surface = 0.6 - np.sqrt(np.maximum(0.01 - x**2 - y**2, 0.0))
    scores = []
    for _ in range(20):
        start = np.zeros(SIZE)
        start[:5] = [0.002, -0.001, 0.601, 0.1, 1.0]
        z = surface + 1e-3 * rng.normal(size=x.shape)
        own = regions_of(z, sensor.packed(), noise.packed(), labels, 1)
        image = (z, own.packed, own.law, own.runs_of(1), own.pixels[0])
        th, H, covariance, middles, kept, used = finish.refined(SPHERE, start, *image)
        np.testing.assert_allclose(covariance @ H[:4, :4], np.eye(4), atol=1e-8)
        assert kept / used == pytest.approx(0.97, abs=0.1)
        np.testing.assert_allclose(middles[:2], 0.0, atol=0.02)
        scores.append((th[:4] - truth) / np.sqrt(np.diag(covariance)))
    assert 0.6 < np.std(scores) < 1.5


def test_an_undetermined_direction_has_no_inverse():
    H = np.zeros((9, 9))
    H[0, 0] = H[1, 1] = 4.0
    assert np.isnan(finish._inverse(H, 3)).all()
