"""Compares the compiled loops for blocks, tangent planes and the order of seeds with their definitions in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import label

from perception.range.noise import NoiseModel
from perception.range.segmentation import grow_planes as grow
from perception.range.segmentation.blocks import BLOCK_SAMPLES, JUMP_SLOPE
from perception.range.segmentation.flat_fit import plane_from_coefficients
from perception.range.segmentation.grid import build_grid, seen_from
from perception.range.segmentation.seeds import LONE_BEND, seed_order
from perception.range.segmentation.tangents import JUMP_SIGMAS
from perception.range.sensor import OrthographicSensor, PinholeSensor

NOISE = NoiseModel(white=(0.0004, 0.0002), correlated=(0.0, 0.0001), step=(0.0008, 0.0))
SHAPE = (46, 301)  # not a multiple of a block or of a run of blocks
SENSORS = [
    PinholeSensor(width_px=SHAPE[1], height_px=SHAPE[0], fx_px=300.0, fy_px=310.0, cx_px=150.0, cy_px=22.0),
    OrthographicSensor(width_px=SHAPE[1], height_px=SHAPE[0], pixel_pitch_m=0.002),
]


def depth_with_a_jump_and_holes() -> np.ndarray:
    rng = np.random.default_rng(3)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = 0.7 + 0.0005 * v + 0.0003 * u - 0.1 * ((u // 37) % 2) + 0.0004 * rng.normal(size=SHAPE)
    depth[rng.random(SHAPE) < 0.1] = np.nan
    depth[10:16, 200:260] = np.nan
    return depth


def grids():
    return pytest.mark.parametrize(
        ("sensor", "size"), [(s, b) for s in SENSORS for b in (1, 2, 3, 5)], ids=lambda x: str(x).split("(")[0]
    )


@grids()
def test_a_block_is_the_mean_of_what_lies_near_the_median_of_its_corners(sensor, size):
    depth = depth_with_a_jump_and_holes()
    grid, packed = build_grid(depth, sensor, NOISE, size), seen_from(sensor, (0, 0))
    hop = -(-size // BLOCK_SAMPLES)
    places = range(0, size, hop)
    least, corners = len(places) ** 2 / 2, np.array([0, places[-1]])
    wide = np.pad(depth, ((0, size), (0, size)), constant_values=np.nan)
    h, w = grid.z.shape
    rng = np.random.default_rng(0)
    some = zip(rng.integers(0, h, 250).tolist(), rng.integers(0, w, 250).tolist(), strict=True)
    for r, c in [*some, (h - 1, w - 1), (h - 1, 0), (0, w - 1)]:
        rows, columns = (at[(at < n)] for at, n in zip(
            (r * size + np.array(places), c * size + np.array(places)), SHAPE, strict=True
        ))  # fmt: skip
        part = wide[np.ix_(r * size + corners, c * size + corners)]
        known = np.sort(part[np.isfinite(part)])
        if known.size < 2:
            assert np.isnan(grid.z[r, c]) and np.isnan(grid.sigma[r, c])
            continue
        median, sigma = known[(known.size - 1) // 2], float(NOISE.sigma_m(known[(known.size - 1) // 2]))
        pitch = (median if grid.perspective else 1.0) / packed[1]
        v, u = (at.ravel() for at in np.meshgrid(rows, columns, indexing="ij"))
        near = np.abs(depth[v, u] - median) <= 0.7 * JUMP_SLOPE * pitch * size + 3.0 * sigma
        np.testing.assert_allclose(grid.x[r, c], (u[near].mean() - packed[3]) / packed[1], atol=1e-12)
        np.testing.assert_allclose(grid.y[r, c], (v[near].mean() - packed[4]) / packed[2], atol=1e-12)
        if near.sum() < least:
            assert np.isnan(grid.z[r, c])
            continue
        of = depth[v, u][near]
        mean = 1.0 / np.mean(1.0 / of) if grid.perspective else of.mean()
        np.testing.assert_allclose(grid.z[r, c], mean, atol=1e-7)  # the series for 1 / z is cut after the third power


@grids()
def test_a_tangent_plane_is_the_least_squares_plane_of_the_blocks_around(sensor, size):
    grid = build_grid(depth_with_a_jump_and_holes(), sensor, NOISE, size)
    packed, k = seen_from(sensor, (0, 0)), grid.radius
    slope, least = JUMP_SLOPE / packed[1] * size, max(5.0, np.floor((2 * k + 1) ** 2 * 0.4))
    h, w = grid.z.shape
    rng, met = np.random.default_rng(1), 0
    for r, c in zip(rng.integers(0, h, 150), rng.integers(0, w, 150), strict=True):
        i, j = (at.ravel() for at in np.mgrid[max(r - k, 0) : min(r + k + 1, h), max(c - k, 0) : min(c + k + 1, w)])
        away = np.maximum(np.abs(i - r), np.abs(j - c))
        z0 = grid.z[r, c]
        reach = slope * away * (z0 if grid.perspective else 1.0)
        near = np.abs(grid.z[i, j] - z0) <= JUMP_SIGMAS * grid.sigma[r, c] + reach
        if near.sum() < least:
            assert np.isnan(grid.rms[r, c])
            continue
        x, y, z = grid.x[i, j][near], grid.y[i, j][near], grid.z[i, j][near]
        A = np.stack([x, y, np.ones_like(x)], axis=1)
        if size == 1:  # the weight of a larger block is its number of pixels, which the grid does not contain
            a, b, g0 = np.linalg.lstsq(A, 1.0 / z if grid.perspective else z, rcond=None)[0]
            normal = np.array([a, b, g0] if grid.perspective else [-a, -b, 1.0])
            towards = -np.sign(normal @ ([grid.x[r, c], grid.y[r, c], 1.0] if grid.perspective else [0.0, 0.0, 1.0]))
            np.testing.assert_allclose(grid.normal[r, c], towards * normal / np.linalg.norm(normal), atol=1e-6)
        assert np.linalg.norm(grid.normal[r, c]) == pytest.approx(1.0) and grid.rms[r, c] >= 0.0
        met += 1
    assert met > 30


def test_seeds_come_flattest_first_and_in_raster_order_where_equally_flat():
    grid = build_grid(depth_with_a_jump_and_holes(), SENSORS[0], NOISE, 2)
    free, reach = np.isfinite(grid.z), 2
    free[:, 40:60] = False
    framed = np.pad(np.where((free & np.isfinite(grid.rms))[..., None], grid.normal, np.nan), ((reach,) * 2,) * 2 + ((0, 0),),
                    constant_values=np.nan)  # fmt: skip
    h, w = grid.z.shape
    bend = np.zeros((h, w))
    for r, c in ((2 * reach, reach), (0, reach), (reach, 2 * reach), (reach, 0)):
        turn = 1.0 - np.einsum("ijk,ijk->ij", framed[reach:-reach, reach:-reach], framed[r : r + h, c : c + w])
        bend += np.where(np.isnan(turn), LONE_BEND, turn)
    level = np.minimum(63, 12.0 * np.sqrt(25.0 * np.maximum(bend, 0.0)) + 4.0 * np.maximum(grid.rms - 1.0, 0.0))
    seeds = np.flatnonzero(np.isfinite(framed[reach:-reach, reach:-reach, 0]))
    expected = seeds[np.argsort(level.ravel()[seeds].astype(int), kind="stable")]
    assert expected.size > 100
    np.testing.assert_array_equal(seed_order(grid, free, reach), expected)


def test_a_fixed_plane_grows_over_the_connected_blocks_that_it_explains():
    grid = build_grid(depth_with_a_jump_and_holes(), SENSORS[1], NOISE, 1)
    h, w = grid.z.shape
    free = np.isfinite(grid.z)
    table, mark, place = grow._padded(grid, free)
    rows = table[place].reshape(h, w, 8)
    a, b, c = np.linalg.lstsq(np.stack([*rows[:, :30, :2][free[:, :30]].T, np.ones(free[:, :30].sum())], 1),
                              rows[:, :30, 2][free[:, :30]], rcond=None)[0]  # fmt: skip
    e = (rows[..., 2] - a * rows[..., 0] - b * rows[..., 1] - c) * np.sqrt(rows[..., 3])
    th, m, cos_limit = np.zeros(16), np.array([a, b, c]), 0.9
    plane_from_coefficients(m, grid.perspective, th)
    length = np.linalg.norm(rows[..., 4:7], axis=-1)
    explained = free & (np.abs(e) <= grow.GROW_SIGMAS) & ((rows[..., 4:7] @ th[:3] >= cos_limit) | (length**2 <= 0.5))
    parts, _ = label(explained)
    seed = int(np.flatnonzero(parts.ravel() == np.argmax(np.bincount(parts[explained])))[0])
    queue, S = np.empty(h * w, np.int32), np.zeros(9)
    count = grow._grown(table, mark, w + 2, place[seed], 2, True, m, th, grid.perspective, cos_limit, queue, S)
    expected = np.flatnonzero(parts.ravel() == parts.ravel()[seed])
    assert count > 200
    np.testing.assert_array_equal(np.sort(queue[:count]), np.sort(place[expected]))
    x, _, g, weight = rows.reshape(-1, 8)[expected, :4].T
    np.testing.assert_allclose(S[[0, 1, 6]], [weight.sum(), weight @ x, weight @ g], rtol=1e-9)
