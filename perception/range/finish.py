"""Last refinement of each region on its own pixels, with covariance and figures of fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.range import fit
from perception.range.claim import bucket, gather
from perception.range.noise import NoiseModel
from perception.range.primitives import (
    COVARIANCE_OVER,
    TYPE_OF_KIND,
    Surface,
    frame_vectors,
    named_covariance,
    primitive_of,
)
from perception.range.sensor import RangeSensorModel
from perception.range.surfaces import FREEDOM, PLANE, QUADRIC

Array = NDArray[np.float64]
Labels = NDArray[np.int32]

COARSE_SAMPLES = 300  # a refined start on these leaves the full fit one step
FULL_STEPS = 1
SLOW_NOISE_AREA_PX = 150.0  # pixels that share one value of the slow noise; sets how little averaging gains on it
STEP_AREA_PX = 16.0
FREE = np.zeros(9, np.bool_)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples:
    """Pixels of one region as the fits read them, (N,) each: ray coordinates, depth and its standard deviation, m."""

    x: Array
    y: Array
    z: Array
    sigma: Array


def samples_by_label(
    depth_m: Array, sensor: RangeSensorModel, noise: NoiseModel, labels: Labels, count: int
) -> list[Samples]:
    """The pixels of labels 1 to `count`; entry 0 of the list is label 1."""
    starts, indices = bucket(labels, count)
    out = []
    packed, law = sensor.packed(), noise.packed()
    for k in range(1, count + 1):
        mine = indices[starts[k] : starts[k + 1]]
        x, y, z, sigma = (np.empty(mine.size) for _ in range(4))
        gather(depth_m, packed, law, mine, x, y, z, sigma)
        out.append(Samples(x=x, y=y, z=z, sigma=sigma))
    return out


def thinned(samples: Samples, most: int) -> Samples:
    """At most `most` of the samples, evenly spread; the same choice every time."""
    n = samples.x.size
    if n <= most:
        return samples
    pick = np.linspace(0, n - 1, most).astype(np.int64)
    return Samples(x=samples.x[pick], y=samples.y[pick], z=samples.z[pick], sigma=samples.sigma[pick])


def refine_surface(
    label: int,
    kind: int,
    th: Array,
    samples: Samples,
    *,
    sensor: RangeSensorModel,
    noise: NoiseModel,
    fixed: NDArray[np.bool_] = FREE,
) -> tuple[Surface, Array]:
    """The surface after the ray-depth fit to all its pixels, and its parameter vector."""
    perspective = bool(sensor.packed()[0] > 0)
    few = thinned(samples, COARSE_SAMPLES)
    th, _, _, _, _ = fit.fit_robust(kind, th, few.x, few.y, few.z, few.sigma, perspective, fixed, 1)
    s = samples
    if kind == PLANE and not fixed.any():
        th, H, cost, used = fit.refine_plane(th, s.x, s.y, s.z, s.sigma, perspective, fit.TRIM_SIGMAS)
    else:
        th, H, cost, used = fit.refine(
            kind, th, s.x, s.y, s.z, s.sigma, perspective, FULL_STEPS, 0.0, fit.TRIM_SIGMAS, fixed
        )
    n = s.x.size
    kept = max(cost - (n - used) * fit.TRIM_SIGMAS**2, 0.0)
    misfit = float(np.sqrt(kept / max(used - FREEDOM[kind], 1)))
    depth = float(np.median(few.z)) if n else np.nan
    covariance = _covariance(H, kind, fixed) * max(misfit**2, 0.05) * averaging_loss(noise, depth)
    x, y = (float(np.median(a)) for a in (few.x, few.y))
    middle = np.array([x * depth, y * depth, depth] if perspective else [x, y, depth])
    surface = Surface(
        label=label,
        type=TYPE_OF_KIND[kind],
        primitive=primitive_of(kind, th, middle),
        covariance=named_covariance(kind, th, covariance),
        covariance_over=COVARIANCE_OVER[kind],
        frame=frame_vectors(kind, th) if kind != QUADRIC else np.eye(3)[:2],
        pixels=n,
        rms_m=misfit * float(np.median(few.sigma)) if n else 0.0,
        misfit=misfit,
        middle_m=middle,
    )
    return surface, th


def averaging_loss(noise: NoiseModel, depth_m: float) -> float:
    """How many times larger a parameter's variance is than for white noise of the same size (>= 1)."""
    z2 = depth_m * depth_m
    white = (noise.white[0] + noise.white[1] * z2) ** 2
    slow = (noise.correlated[0] + noise.correlated[1] * z2) ** 2
    step = (noise.step[0] + noise.step[1] * z2) ** 2 / 12.0
    step = max(step - white, 0.0)
    total = white + slow + step
    return float((white + SLOW_NOISE_AREA_PX * slow + STEP_AREA_PX * step) / max(total, 1e-30))


def _covariance(H: Array, kind: int, fixed: NDArray[np.bool_]) -> Array:
    p = int(FREEDOM[kind])
    free = np.flatnonzero(~fixed[:p])
    out = np.zeros((p, p))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[free], 1e-300))
    A = H[np.ix_(free, free)] * np.outer(scale, scale)
    try:
        inner = np.linalg.inv(A)
    except np.linalg.LinAlgError:
        inner = np.linalg.pinv(A, rcond=1e-12, hermitian=True)
    out[np.ix_(free, free)] = inner * np.outer(scale, scale)
    return out
