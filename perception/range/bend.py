"""Flat faces that the sensor has bent: slow errors and calibration turn a wall into a piece of a huge ball.

Triangulating sensors are off by one or two hundredths of the depth, slowly over the image. A surface that turns by less
than such errors can is called what it most likely is, a plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception.range import fit, rays
from perception.range.finish import FREE, Samples
from perception.range.noise import NoiseModel
from perception.range.starts import start_plane
from perception.range.surfaces import CONE, CYLINDER, FREEDOM, PLANE, SIZE, normals_on

Array = NDArray[np.float64]

BEND_TURN_RAD = 0.2  # walls and table tops of the real development frames turn by 0.07 to 0.15
ENDS = 0.02  # share of the samples whose normals may turn farther
NEAR_SIGMAS = 5.0  # the bend that a plane leaves over
NEAR_SHARE = 0.8
CUT_SIGMAS = 3.0
SCRAP_AREA_PX = 600.0  # over which the slowest part of the noise, bands and waves of 30 pixels, keeps its sign
LEAST_PRICE = 2.0  # of a parameter, Akaike's: Schwarz's is none where there is one value
SLENDER_RAD = 0.15  # half-angle of a cone that may be a cylinder


def simplest(kind: int, th: Array, samples: Samples, perspective: bool, *, patches: float) -> tuple[int, Array]:
    """The surface refined on its samples, or the simpler one that describes them more cheaply (Schwarz's criterion).

    `patches`: independent values of the noise among the samples.
    """
    if kind == PLANE or samples.x.size == 0:
        return kind, th
    th, mean_square = _refined(kind, th, samples, perspective)
    best, least = (kind, th), mean_square * patches + schwarz_price(kind, patches)
    for simple, start in _simpler(kind, th, samples, perspective):
        other, mean_square = _refined(simple, start, samples, perspective)
        cost = mean_square * patches + schwarz_price(simple, patches)
        if cost < least and _is_near(simple, other, samples, perspective):
            best, least = (simple, other), cost
    return best


def straightened(kind: int, th: Array, samples: Samples, noise: NoiseModel, perspective: bool) -> tuple[int, Array]:
    """The plane, or the cylinder for a slender cone, that slow errors have bent into this surface, else itself."""
    if kind == PLANE or samples.x.size == 0:
        return kind, th
    limit = BEND_TURN_RAD * np.sqrt(noise.slow_share(float(np.median(samples.z))))
    for simple, start in _simpler(kind, th, samples, perspective):
        bend = turn_of(surface_normals(kind, th, samples, perspective)) if simple == PLANE else 2.0 * th[6]
        if bend >= limit:
            continue
        other, _ = _refined(simple, start, samples, perspective)
        if _is_near(simple, other, samples, perspective):
            return simple, other
    return kind, th


def schwarz_price(kind: int, patches: float) -> float:
    """What Schwarz's criterion asks for the parameters of a surface: p ln n."""
    return float(FREEDOM[kind]) * float(np.log(max(patches, 2.0)))


def scrap_gain(
    big: tuple[int, Array],
    small: tuple[int, Array],
    samples: Samples,
    pixels: int,
    noise: NoiseModel,
    perspective: bool,
) -> float:
    """How much cheaper a small piece is as part of a large surface than as a surface of its own; <= 0: it stays.

    Slow noise gives a scrap of a face one value or few, and any direction; so its direction and kind count for nothing.
    `samples`: of the small piece, which has so many `pixels`.
    """
    if np.mean(residuals_of(*big, samples, perspective) < NEAR_SIGMAS) < NEAR_SHARE:
        return -np.inf
    slow = noise.slow_share(float(np.median(samples.z)))
    values = max(pixels / (1.0 + slow * (SCRAP_AREA_PX - 1.0)), 1.0)
    price = float(FREEDOM[small[0]]) * max(float(np.log(values)), LEAST_PRICE)
    saved = [float(np.mean(np.minimum(residuals_of(*s, samples, perspective), CUT_SIGMAS) ** 2)) for s in (small, big)]
    return price + values * (saved[0] - saved[1])


def _is_near(kind: int, th: Array, samples: Samples, perspective: bool) -> bool:
    return bool(np.mean(residuals_of(kind, th, samples, perspective) < NEAR_SIGMAS) > NEAR_SHARE)


def _refined(kind: int, th: Array, s: Samples, perspective: bool) -> tuple[Array, float]:
    """Parameters after a robust fit, and the mean of the squared residuals, each at most the trim's."""
    th, _, _, _, cost = fit.fit_robust(kind, th, s.x, s.y, s.z, s.sigma, perspective, FREE, 2)
    return th, cost / s.x.size


def _simpler(kind: int, th: Array, samples: Samples, perspective: bool) -> list[tuple[int, Array]]:
    points = points_of(samples, perspective)
    out = [(PLANE, start_plane(points))]
    if kind == CONE and th[6] < SLENDER_RAD:
        height = float(np.mean((points - th[:3]) @ th[3:6]))
        cylinder = np.zeros(SIZE)
        cylinder[:3], cylinder[3:6] = th[:3] + height * th[3:6], th[3:6]
        cylinder[6], cylinder[7] = abs(height) * np.tan(th[6]), th[7]
        out.append((CYLINDER, cylinder))
    return out


def turn_of(normals: Array) -> float:
    """Angle in radians over which all but `ENDS` of the unit normals (N, 3) spread."""
    middle = normals.mean(axis=0)
    cosines = normals @ (middle / max(float(np.linalg.norm(middle)), 1e-12))
    return 2.0 * float(np.arccos(np.clip(np.quantile(cosines, ENDS), -1.0, 1.0)))


def points_of(samples: Samples, perspective: bool) -> Array:
    """(N, 3) positions of the samples, metres."""
    x, y, z = samples.x, samples.y, samples.z
    return np.stack([x * z, y * z, z] if perspective else [x, y, z], axis=1)


def surface_normals(kind: int, th: Array, samples: Samples, perspective: bool) -> Array:
    """(N, 3) unit normals of the surface towards the sensor, at the samples."""
    normals = np.empty((samples.x.size, 3))
    normals_on(kind, th, samples.x, samples.y, samples.z, perspective, normals)
    return normals


def residuals_of(kind: int, th: Array, samples: Samples, perspective: bool) -> Array:
    """(N,) size of the residuals along the rays, in sigmas; a ray that misses counts as far off."""
    e = np.empty(samples.x.size)
    rays.residuals(kind, th, samples.x, samples.y, samples.z, samples.sigma, perspective, e)
    return np.asarray(np.where(np.isfinite(e), np.abs(e), rays.MISS_SIGMAS))
