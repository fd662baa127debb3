"""The loops over many rays agree with the functions of `surfaces` for each ray, and their sums agree with numpy."""

from __future__ import annotations

import numpy as np
import pytest

from perception.range.fitting import equations, rays
from perception.range.fitting.surfaces import (
    CONE,
    CYLINDER,
    FREEDOM,
    GRAZING_COSINE,
    PLANE,
    QUADRIC,
    SIZE,
    SPHERE,
    frame_of,
)
from tests.perception.range.reference import depth_and_jacobian

CENTRE = np.array([0.01, 0.02, 0.6])
KINDS = [PLANE, SPHERE, CYLINDER, CONE, QUADRIC]
GRAZING_RAD = 1e-3  # closer to the outline the result is determined by rounding errors


def random_surface(kind: int, rng: np.random.Generator) -> np.ndarray:
    """Return parameters of a surface half a metre away that most rays of `random_rays` meet."""
    th = np.zeros(SIZE)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    side = rng.choice([-1.0, 1.0])
    if kind == PLANE:
        normal = np.array([*rng.uniform(-0.5, 0.5, 2), -1.0])
        th[:3] = normal / np.linalg.norm(normal)
        th[3] = th[:3] @ CENTRE
    elif kind == SPHERE:
        th[:5] = [*CENTRE, 0.1, side]
    elif kind == CYLINDER:
        th[:8] = [*CENTRE, *direction, 0.1, side]
    elif kind == CONE:
        th[:8] = [*CENTRE, *direction, 0.4, side]
    else:
        th[:4] = [*CENTRE, 0.1]
        th[4:7], th[7:13], th[13] = [1.0, 0.8, 1.2], 0.1 * rng.normal(size=6), -1.0
    return th


def random_rays(perspective: bool, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    reach = 0.25 if perspective else 0.15
    return tuple(rng.uniform(-reach, reach, (2, count)))


def plain_rows(kind, th, x, y, perspective):
    """Return depth, cosine (N,) and derivatives (N, p), computed ray by ray by the reference."""
    frame = np.zeros(6)
    frame_of(kind, th, frame)
    z, cosine, J = np.empty(x.size), np.empty(x.size), np.zeros((x.size, 9))
    for i in range(x.size):
        z[i], cosine[i] = depth_and_jacobian(kind, th, frame, x[i], y[i], perspective, J[i])
    return z, cosine, J[:, : FREEDOM[kind]], frame


@pytest.mark.parametrize("perspective", [True, False], ids=["pinhole", "orthographic"])
@pytest.mark.parametrize("kind", KINDS)
def test_each_ray_is_as_the_plain_function_has_it(kind, perspective):
    rng = np.random.default_rng(kind)
    for _ in range(20):
        th = random_surface(kind, rng)
        x, y = random_rays(perspective, 100, rng)
        z, cosine, J, frame = plain_rows(kind, th, x, y, perspective)
        work = np.zeros(rays.SCRATCH)
        rays.load_rows(np.stack([x, y, x, y]), work)
        rays.fill_rows(kind, th, frame, 100, perspective, work)
        depth, cosine_row = work[rays.DEPTH :][:100], work[rays.COSINE :][:100]
        np.testing.assert_array_equal(np.isnan(depth), np.isnan(z))
        seen = cosine > GRAZING_RAD
        np.testing.assert_allclose(depth[seen], z[seen], rtol=1e-9)
        np.testing.assert_allclose(cosine_row[seen], cosine[seen], rtol=1e-6)
        for column in range(FREEDOM[kind]):
            derivative = work[rays.D0 + column * rays.CHUNK :][:100]
            np.testing.assert_allclose(derivative[seen], J[seen, column], rtol=1e-6, atol=1e-9)


def system_of(kind, th, frame, samples, perspective, scale, *, step_follows=True, work=None):
    """Return cost, number of samples used, matrix and gradient of the compiled sums."""
    n, work = samples.shape[1], np.empty(rays.SCRATCH) if work is None else work
    H, g = np.zeros((9, 9)), np.zeros(9)
    rays.load_rows(samples, work)
    rays.fill_rows(kind, th, frame, n, perspective, work)
    cost, used = equations.add_equations(kind, n, scale, work, H, g, step_follows)
    return cost, used, H, g


@pytest.mark.parametrize("perspective", [True, False], ids=["pinhole", "orthographic"])
@pytest.mark.parametrize("scale", [0.0, 1.5])
@pytest.mark.parametrize("kind", KINDS)
def test_sums_are_those_of_numpy(kind, scale, perspective):
    """Some of the samples have gross errors, and some rays miss."""
    rng = np.random.default_rng(10 + kind)
    th = random_surface(kind, rng)
    x, y = random_rays(perspective, 300, rng)
    truth, cosine, J, frame = plain_rows(kind, th, x, y, perspective)
    sigma = rng.uniform(0.5e-3, 2e-3, 300)
    z = np.nan_to_num(truth, nan=0.6) + sigma * rng.normal(size=300)
    z[::17] += 0.05
    given = (kind, th, frame, np.stack([x, y, z, sigma]), perspective, scale)
    cost, used, H, g = system_of(*given)
    *figures, untouched, _ = system_of(*given, step_follows=False)
    assert figures == [cost, used] and not untouched.any()

    hit = np.isfinite(truth)
    w = np.where(hit, np.minimum(1.0, cosine / GRAZING_COSINE) / sigma, 0.0)
    e = np.where(hit, (z - np.nan_to_num(truth)) * w, equations.MISS_SIGMAS)
    if scale:
        c2 = (scale * equations.CAUCHY_WIDTH) ** 2
        weight, wanted_cost = hit / (1.0 + e**2 / c2), c2 * np.log1p(e**2 / c2).sum()
    else:
        weight = hit & (np.abs(e) <= 3.0)
        wanted_cost = np.minimum(e**2, 9.0).sum()
    Jw = np.where(hit[:, None], J, 0.0) * w[:, None]
    p = FREEDOM[kind]
    wanted = np.tril((Jw * weight[:, None]).T @ Jw)
    assert cost == pytest.approx(wanted_cost, rel=1e-9)
    assert used == np.count_nonzero(weight)
    np.testing.assert_allclose(H[:p, :p], wanted, rtol=1e-6, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(g[:p], (Jw * weight[:, None]).T @ e, rtol=1e-6, atol=1e-7 * np.abs(Jw).max())
    assert not H[p:].any() and not g[p:].any()


def test_residuals_are_in_sigmas_and_nan_where_a_ray_misses():
    th = np.zeros(SIZE)
    th[:5] = [0.0, 0.0, 0.6, 0.1, 1.0]
    samples = np.stack([[0.0, 0.0, 0.5], np.zeros(3), [0.5, 0.502, 0.6], np.full(3, 1e-3)])
    np.testing.assert_allclose(equations.residuals(SPHERE, th, samples, True), [0.0, 2.0, np.nan], atol=1e-9)


def test_sums_do_not_depend_on_where_the_samples_lie_in_memory():
    """The result must be identical wherever the samples are in memory, also right before or after the scratch array."""
    rng = np.random.default_rng(9)
    th = random_surface(SPHERE, rng)
    frame, count = np.zeros(6), 300
    frame_of(SPHERE, th, frame)
    x, y = random_rays(False, count, rng)
    samples = np.stack([x, y, 0.6 + 0.05 * rng.normal(size=count), np.full(count, 0.03)])
    seen = set()
    for first, apart in ((0, 0), (0, 3), (rays.SCRATCH, 0), (rays.SCRATCH + 1, 0)):
        pool = np.zeros(4 * count + rays.SCRATCH + 3)
        held = pool[first : first + 4 * count].reshape(4, count)
        held[:] = samples
        at = 4 * count + apart if first == 0 else 0
        cost, _, H, g = system_of(SPHERE, th, frame, held, False, 0.0, work=pool[at : at + rays.SCRATCH])
        seen.add((cost, H.tobytes(), g.tobytes()))
    assert len(seen) == 1
