"""Flat faces that the sensor has bent: slow errors and calibration turn a wall into a piece of a huge ball.

Triangulating sensors are off by one or two hundredths of the depth, slowly over the image. A surface that turns by less
than such errors can is called what it most likely is, a plane.

Samples are (4, N) here and in `merge` and `join`: ray coordinates x and y, depth z and its standard deviation.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import as_numpy_scalar, compiled
from perception.range.fitting import rays
from perception.range.fitting.fit import fit_robust
from perception.range.fitting.initialisation import start_plane
from perception.range.fitting.surfaces import CONE, CYLINDER, FREEDOM, PLANE, SIZE, normals_on
from perception.range.segmentation.grid import slow_share_at

BEND_TURN_RAD = 0.3  # walls, floors, screens and table tops of the real development frames turn by 0.07 to 0.27
ENDS = 0.02  # share of the samples whose normals may turn farther
NEAR_SIGMAS = 5.0  # the bend that a plane leaves over
NEAR_SHARE = 0.8
CUT_SIGMAS = 3.0
SCRAP_AREA_PX = 600.0  # over which the slowest part of the noise, bands and waves of 30 pixels, keeps its sign
LEAST_PRICE = 2.0  # of a parameter, Akaike's: Schwarz's is none where there is one value
SLENDER_RAD = 0.15  # half-angle of a cone that may be a cylinder
ROUNDS = as_numpy_scalar(2)  # of robust weights


@compiled
def simplest(kind: int, th: Array, samples: Array, perspective: bool, patches: float) -> tuple[int, Array]:
    """The surface refined on its samples, or the simpler one that describes them more cheaply (Schwarz's criterion).

    `patches`: independent values of the noise among the samples. Returns kind and parameters.
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
    """The plane, or the cylinder for a slender cone, that slow errors have bent into this surface, else itself.

    `noise` as `NoiseModel.packed`. Returns kind and parameters.
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
    """What Schwarz's criterion asks for the parameters of a surface: p ln n."""
    return float(FREEDOM[kind] * np.log(max(patches, 2.0)))


@compiled
def scrap_gain(
    kind: int, th: Array, own_kind: int, own: Array, samples: Array, pixels: float, noise: Array, perspective: bool,
) -> float:  # fmt: skip
    """How much cheaper a small piece is as part of a large surface than as a surface of its own; <= 0: it stays.

    Slow noise gives a scrap of a face one value or few, and any direction; so its direction and kind count for nothing.
    `samples`: of the small piece, which has so many `pixels`.
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
    """Mean of the squares of e (N,), each at most that of `limit`."""
    total = 0.0
    for i in range(e.shape[0]):
        cut = min(e[i], limit)
        total += cut * cut
    return float(total / e.shape[0])


@compiled
def _is_near(kind: int, th: Array, samples: Array, perspective: bool) -> bool:
    return bool(np.mean(residual_sizes(kind, th, samples, perspective) < NEAR_SIGMAS) > NEAR_SHARE)


@compiled
def _refined(kind: int, th: Array, s: Array, perspective: bool) -> tuple[Array, float]:
    """Parameters after a robust fit, and the mean of the squared residuals, each at most the trim's."""
    free = np.zeros(9, np.bool_)
    th, cost = fit_robust(kind, th, s[0], s[1], s[2], s[3], perspective, free, ROUNDS)
    return th, cost / s.shape[1]


@compiled
def _simpler(simple: int, kind: int, th: Array, samples: Array, perspective: bool) -> tuple[Array, bool]:
    """Where the fit of a plane, or of a cylinder in place of a slender cone, starts; and whether there is one."""
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
    """Angle in radians over which all but `ENDS` of the unit normals (N, 3) spread."""
    n = normals.shape[0]
    mx, my, mz = np.mean(normals[:, 0]), np.mean(normals[:, 1]), np.mean(normals[:, 2])
    length = max(np.sqrt(mx * mx + my * my + mz * mz), 1e-12)
    cosines = np.empty(n)
    for i in range(n):
        cosines[i] = (normals[i, 0] * mx + normals[i, 1] * my + normals[i, 2] * mz) / length
    cosines.sort()
    return float(2.0 * np.arccos(min(1.0, max(-1.0, cosines[int(ENDS * (n - 1) + 0.5)]))))


@compiled
def points_of(samples: Array, perspective: bool) -> Array:
    """(N, 3) positions of the samples, metres."""
    out = np.empty((samples.shape[1], 3))
    for i in range(samples.shape[1]):
        scale = samples[2, i] if perspective else 1.0
        out[i, 0], out[i, 1], out[i, 2] = samples[0, i] * scale, samples[1, i] * scale, samples[2, i]
    return out


@compiled
def surface_normals(kind: int, th: Array, samples: Array, perspective: bool) -> Array:
    """(N, 3) unit normals of the surface towards the sensor, at the samples."""
    normals = np.empty((samples.shape[1], 3))
    normals_on(kind, th, samples[0], samples[1], samples[2], perspective, normals)
    return normals


@compiled
def residual_sizes(kind: int, th: Array, samples: Array, perspective: bool) -> Array:
    """(N,) size of the residuals along the rays, in sigmas; a ray that misses counts as far off."""
    e = np.empty(samples.shape[1])
    rays.residuals(kind, th, samples[0], samples[1], samples[2], samples[3], perspective, e)
    for i in range(e.shape[0]):
        e[i] = abs(e[i]) if np.isfinite(e[i]) else rays.MISS_SIGMAS
    return e
