"""Simplification of surfaces that sensor errors have bent: a wall may appear as a part of a very large sphere.

Triangulating sensors have errors of one or two per cent of the depth that vary slowly over the image. A surface whose
normals turn by less than such errors can cause is reported as a plane.

Samples are (4, N) here and in `merge` and `join`: ray coordinates x and y, depth z and its standard deviation.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import as_numpy_scalar, compiled
from perception.range.fitting.equations import MISS_SIGMAS, residuals
from perception.range.fitting.fit import fit_robust, points_of
from perception.range.fitting.initialisation import start_plane
from perception.range.fitting.surfaces import CONE, CYLINDER, FREEDOM, PLANE, SIZE, normals_on
from perception.range.segmentation.grid import slow_share_at

BEND_TURN_RAD = 0.3  # walls, floors, screens and table tops of the real development frames turn by 0.07 to 0.27
ENDS = 0.02  # share of the samples whose normals may turn farther
NEAR_SIGMAS = 5.0  # largest residual of a sample that counts as near the simpler surface
NEAR_SHARE = 0.8
CUT_SIGMAS = 3.0
SCRAP_AREA_PX = 600.0  # area over which the slowest noise, bands and waves of 30 pixels, keeps its sign
LEAST_PRICE = 2.0  # cost per parameter (Akaike), because Schwarz's is zero for a single value
SLENDER_RAD = 0.15  # half-angle of a cone that may be a cylinder
ROUNDS = as_numpy_scalar(2)  # of robust weights


@compiled
def simplest(kind: int, th: Array, samples: Array, perspective: bool, patches: float) -> tuple[int, Array]:
    """Refine a surface on its samples, and replace it by a simpler one of lower cost (Schwarz's criterion).

    `patches`: number of independent noise values among the samples. Returns kind and parameters.
    """
    if kind == PLANE or samples.shape[1] == 0:
        return kind, th
    best, mean_square = _refined(kind, th, samples, perspective)
    best_kind, least = kind, mean_square * patches + schwarz_price(kind, patches)
    for simple in (PLANE, CYLINDER):
        start, exists = _simpler(simple, kind, best, samples, perspective)
        if not exists:
            continue
        other, mean_square = _refined(simple, start, samples, perspective)
        cost = mean_square * patches + schwarz_price(simple, patches)
        if cost < least and _is_near(simple, other, samples, perspective):
            best_kind, best, least = simple, other, cost
    return best_kind, best


@compiled
def straightened(kind: int, th: Array, samples: Array, noise: Array, perspective: bool) -> tuple[int, Array]:
    """Replace a surface by the plane, or a slender cone by the cylinder, that slow errors may have bent into it.

    `noise` as `NoiseModel.packed`. Returns kind and parameters, unchanged if its curvature is real.
    """
    if kind == PLANE or samples.shape[1] == 0:
        return kind, th
    limit = BEND_TURN_RAD * np.sqrt(slow_share_at(noise, np.median(samples[2])))
    for simple in (PLANE, CYLINDER):
        bend = 2.0 * th[6] if simple == CYLINDER else turn_of(surface_normals(kind, th, samples, perspective))
        if bend >= limit:
            continue
        start, exists = _simpler(simple, kind, th, samples, perspective)
        if not exists:
            continue
        other, _ = _refined(simple, start, samples, perspective)
        if _is_near(simple, other, samples, perspective):
            return simple, other
    return kind, th


@compiled
def schwarz_price(kind: int, patches: float) -> float:
    """Return the penalty p ln n for the p parameters of a surface in Schwarz's criterion."""
    return float(FREEDOM[kind] * np.log(max(patches, 2.0)))


@compiled
def scrap_gain(
    kind: int, th: Array, own_kind: int, own: Array, samples: Array, pixels: float, noise: Array, perspective: bool,
) -> float:  # fmt: skip
    """Return how much lower the cost of a small piece is as part of a large surface; it stays separate if <= 0.

    A small piece of a face has only one or a few independent values of the slow noise, which may tilt it anyhow.
    Therefore its direction and kind are ignored. `samples` are those of the small piece, which has `pixels` pixels.
    """
    e = residual_sizes(kind, th, samples, perspective)
    if not np.mean(e < NEAR_SIGMAS) >= NEAR_SHARE:
        return -np.inf
    slow = slow_share_at(noise, np.median(samples[2]))
    values = max(pixels / (1.0 + slow * (SCRAP_AREA_PX - 1.0)), 1.0)
    price = FREEDOM[own_kind] * max(np.log(values), LEAST_PRICE)
    own_e = residual_sizes(own_kind, own, samples, perspective)
    return float(price + values * (cut_mean_square(own_e, CUT_SIGMAS) - cut_mean_square(e, CUT_SIGMAS)))


@compiled
def cut_mean_square(e: Array, limit: float) -> float:
    """Return the mean of the squares of e (N,), each capped at the square of `limit`."""
    total = 0.0
    for i in range(e.shape[0]):
        cut = min(e[i], limit)
        total += cut * cut
    return float(total / e.shape[0])


@compiled
def _is_near(kind: int, th: Array, samples: Array, perspective: bool) -> bool:
    """Return whether most samples lie within `NEAR_SIGMAS` of the surface."""
    return bool(np.mean(residual_sizes(kind, th, samples, perspective) < NEAR_SIGMAS) > NEAR_SHARE)


@compiled
def _refined(kind: int, th: Array, samples: Array, perspective: bool) -> tuple[Array, float]:
    """Return the parameters of a robust fit and the mean squared residual, each capped at the trim."""
    th, cost = fit_robust(kind, th, samples, perspective, ROUNDS)
    return th, cost / samples.shape[1]


@compiled
def _simpler(simple: int, kind: int, th: Array, samples: Array, perspective: bool) -> tuple[Array, bool]:
    """Return initial parameters of a plane, or of a cylinder in place of a slender cone, and whether they exist."""
    points = points_of(samples, perspective)
    if simple == PLANE:
        return start_plane(points), True
    cylinder = np.zeros(SIZE)
    if kind != CONE or th[6] >= SLENDER_RAD:
        return cylinder, False
    height = 0.0
    for a in range(3):
        height += (np.mean(points[:, a]) - th[a]) * th[3 + a]
    for a in range(3):
        cylinder[a], cylinder[3 + a] = th[a] + height * th[3 + a], th[3 + a]
    cylinder[6], cylinder[7] = abs(height) * np.tan(th[6]), th[7]
    return cylinder, True


@compiled
def turn_of(normals: Array) -> float:
    """Return the angle in radians over which all but the share `ENDS` of the unit normals (N, 3) spread."""
    n = normals.shape[0]
    mx, my, mz = np.mean(normals[:, 0]), np.mean(normals[:, 1]), np.mean(normals[:, 2])
    length = max(np.sqrt(mx * mx + my * my + mz * mz), 1e-12)
    cosines = np.empty(n)
    for i in range(n):
        cosines[i] = (normals[i, 0] * mx + normals[i, 1] * my + normals[i, 2] * mz) / length
    cosines.sort()
    return float(2.0 * np.arccos(min(1.0, max(-1.0, cosines[int(ENDS * (n - 1) + 0.5)]))))


@compiled
def surface_normals(kind: int, th: Array, samples: Array, perspective: bool) -> Array:
    """Return the unit normals (N, 3) of the surface at the samples, turned towards the sensor."""
    normals = np.empty((samples.shape[1], 3))
    normals_on(kind, th, samples[0], samples[1], samples[2], perspective, normals)
    return normals


@compiled
def residual_sizes(kind: int, th: Array, samples: Array, perspective: bool) -> Array:
    """Return the absolute residuals (N,) along the rays, in sigmas; `MISS_SIGMAS` for a ray that misses."""
    e = residuals(kind, th, samples, perspective)
    for i in range(e.shape[0]):
        e[i] = abs(e[i]) if np.isfinite(e[i]) else MISS_SIGMAS
    return e
