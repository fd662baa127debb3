"""Fit of the dominant plane near an expected one, as in the mission step "scan the panel and fit its plane"."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from hal.arrays import Array, Mask
from hal.errors import InvalidRequest, NotFound
from perception.range.analysis import checked_depth
from perception.range.features import RangeFeature, plane_feature
from perception.range.fitting.surfaces import PLANE, SIZE
from perception.range.noise import NoiseModel, estimate_noise
from perception.range.plate_fit import fit_plate
from perception.range.primitives import Surface, primitive_of
from perception.range.segmentation.finish import refine_surface
from perception.range.segmentation.grid import Grid, block_size, build_grid
from perception.range.segmentation.regions import regions_of
from perception.range.sensor import RangeSensorModel
from perception.range.sweep import SweptErrors

HYPOTHESES = 24  # seeds whose planes are tried, per direction of the normal
INLIER_SIGMAS = 3.0
LEAST_BLOCKS = 12  # least number of blocks near the expected plane, and on the plane found
LEAST_SHARE = 0.05  # of the valid pixels: a plane with fewer is not the panel
SCATTERED = 0.5  # least length of the mean of the normals; if they scatter more, it has no direction


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaneFit:
    """The plane found, as a surface and as a fusion feature.

    Attributes:
        surface: the plane with its covariance, in the sensor frame.
        feature: the same plane for fusion.
        inliers: (H, W) pixels that lie on the plane.
        sight_share: their share of all valid pixels.
        noise: the noise model used.
    """

    surface: Surface
    feature: RangeFeature
    inliers: Mask
    sight_share: float
    noise: NoiseModel


def fit_plane_near(
    depth_m: ArrayLike,
    sensor: RangeSensorModel,
    *,
    point_m: ArrayLike,
    normal: ArrayLike,
    sigma_offset_m: float = 0.02,
    sigma_angle_rad: float = 0.1,
    noise: NoiseModel | None = None,
    swept: SweptErrors | None = None,
) -> PlaneFit:
    """Fit the largest plane that agrees with an expected one within three standard deviations.

    The expectation only selects inliers and is no prior of the fit, so the result may be fused with its source.

    Args:
        depth_m: (H, W) depth in metres, NaN where missing.
        point_m, normal: (3,) expected plane in the sensor frame; the normal may point either way.
        sigma_offset_m, sigma_angle_rad: standard deviations of the expectation.
        noise: noise model to use instead of an estimate from the image.
        swept: errors of the sweep from which the image was put together.

    Raises:
        InvalidRequest: the image, sensor or expectation is not usable.
        NotFound: no plane of at least 5 % of the image lies near the expectation.
    """
    depth, depths = checked_depth(depth_m, sensor)
    expected, through = _checked_expectation(point_m, normal, sigma_offset_m, sigma_angle_rad)
    law = noise or estimate_noise(depth, sensor, depths_m=depths)
    middle = float(np.nanmedian(depth))
    grid = build_grid(depth, sensor, law, block_size((depth.shape[0], depth.shape[1]), law, sensor, middle))
    points, sigma, normals = _block_points(grid)
    away = (points - through) @ expected
    lateral = np.linalg.norm(points - through - away[:, None] * expected, axis=1)
    gate = 3.0 * np.sqrt(sigma_offset_m**2 + (lateral * np.tan(min(sigma_angle_rad, 1.0))) ** 2 + sigma**2)
    near = np.abs(away) <= gate
    turn_rad = 3.0 * float(np.hypot(sigma_angle_rad, grid.normal_sigma_rad)) + 0.05
    plane = _most_supported(points[near], sigma[near], normals[near], expected, sigma_angle_rad, turn_rad)
    if plane is None:
        raise NotFound(
            "no plane lies near the expected one",
            hint=f"widen the expectation ({sigma_offset_m:.3f} m, {sigma_angle_rad:.2f} rad) or rescan from elsewhere",
        )
    return _fitted(depth, sensor, law, plane, swept)


def _checked_expectation(
    point_m: ArrayLike, normal: ArrayLike, sigma_offset_m: float, sigma_angle_rad: float
) -> tuple[Array, Array]:
    """Return the expected unit normal, towards the sensor, and the point.

    Raises:
        InvalidRequest: they are not usable.
    """
    n, p = np.asarray(normal, float), np.asarray(point_m, float)
    length = float(np.linalg.norm(n)) if n.shape == (3,) else 0.0
    if n.shape != (3,) or p.shape != (3,) or not np.isfinite([*n, *p]).all() or length < 1e-9:
        raise InvalidRequest("expected plane needs a finite point and a normal", hint="pass two vectors of 3 numbers")
    if not (sigma_offset_m > 0 and sigma_angle_rad > 0):
        raise InvalidRequest("the expectation's sigmas must be positive", hint="say how well the plane is known")
    n = n / length
    return (n if n @ p < 0 else -n), p


def _block_points(grid: Grid) -> tuple[Array, Array, Array]:
    """Return points (N, 3), standard deviations (N,) and normals (N, 3) of the blocks that have a tangent plane."""
    x, y, z = grid.x.ravel(), grid.y.ravel(), grid.z.ravel()
    points = np.stack([x * z, y * z, z] if grid.perspective else [x, y, z], axis=1)
    ok = np.isfinite(z) & np.isfinite(grid.rms.ravel())
    return points[ok], grid.sigma.ravel()[ok], grid.normal.reshape(-1, 3)[ok]


def _most_supported(
    points: Array, sigma: Array, normals: Array, expected: Array, sigma_angle_rad: float, turn_rad: float
) -> Array | None:
    """Return normal and offset (4,) of the plane hypothesis with the most inlier blocks, refitted; None if all fail.

    `turn_rad`: largest angle between the normals of a block and of the expected plane.
    """
    facing = np.flatnonzero(np.arccos(np.clip(normals @ expected, -1.0, 1.0)) <= turn_rad)
    if facing.size < LEAST_BLOCKS:
        return None
    seeds = facing[np.linspace(0, facing.size - 1, min(HYPOTHESES, facing.size)).astype(int)]
    # The normal of a single block is too noisy to be extrapolated across the panel, so a seed only gives the offset.
    middle = np.median(normals[facing], axis=0)
    length = float(np.linalg.norm(middle))
    plane, support = None, LEAST_BLOCKS - 1
    for n in (expected, middle / length) if length > SCATTERED else (expected,):
        for seed in seeds:
            candidate, count = _refitted(points, sigma, np.array([*n, n @ points[seed]]), sigma_angle_rad)
            if count > support:
                plane, support = candidate, count
    if plane is None:
        return None
    limit = 3.0 * sigma_angle_rad + 0.02
    return plane if np.arccos(np.clip(plane[:3] @ expected, -1.0, 1.0)) <= limit else None


def _refitted(points: Array, sigma: Array, plane: Array, sigma_angle_rad: float) -> tuple[Array, int]:
    """Refit a plane to its inliers by weighted principal axes, with a shrinking tolerance.

    Returns the plane (4,) and the number of its inliers.
    """
    thin = max(1, len(points) // 1500)
    P, s = points[::thin], sigma[::thin]
    inside = np.zeros(len(P), bool)
    for slack in (0.5 * min(sigma_angle_rad, 0.2), 0.1 * min(sigma_angle_rad, 0.2), 0.0, 0.0):
        lateral = np.linalg.norm(P - plane[3] * plane[:3], axis=1)
        inside = np.abs(P @ plane[:3] - plane[3]) <= INLIER_SIGMAS * s + slack * np.minimum(lateral, 0.1)
        if inside.sum() < LEAST_BLOCKS // 2:
            return plane, 0
        w = 1.0 / s[inside] ** 2
        centre = (w[:, None] * P[inside]).sum(axis=0) / w.sum()
        d = P[inside] - centre
        n = np.linalg.eigh((w[:, None] * d).T @ d)[1][:, 0]
        n = n if n @ plane[:3] > 0 else -n
        plane = np.array([*n, n @ centre])
    return plane, int(inside.sum()) * thin


def _fitted(
    depth: Array, sensor: RangeSensorModel, noise: NoiseModel, plane: Array, swept: SweptErrors | None
) -> PlaneFit:
    """Fit a plane (4,) to all pixels near it, and collect the result.

    Raises:
        NotFound: fewer than `LEAST_SHARE` of the valid pixels lie on it.
    """
    th = np.zeros(SIZE)
    th[:4] = plane
    points = sensor.points(depth)
    sigma = noise.sigma_m(depth)
    for _ in range(2):
        with np.errstate(invalid="ignore"):
            inliers = np.abs(points @ th[:3] - th[3]) <= INLIER_SIGMAS * sigma
        own = regions_of(depth, sensor.packed(), noise.packed(), inliers.astype(np.int32), 1)
        surface, th = refine_surface(1, PLANE, th, own, 1, noise=noise)
    refined = fit_plate(
        points, sigma, normal=th[:3], offset_m=th[3], frame=surface.frame, gate=INLIER_SIGMAS, swept=swept
    )
    if refined is not None:
        th[:4] = [*refined.normal, refined.offset_m]
        plate = primitive_of(PLANE, th, surface.middle_m)
        surface = replace(surface, primitive=plate, frame=refined.frame, covariance=refined.covariance)
    valid = int(np.isfinite(depth).sum())
    share = float(inliers.sum()) / valid
    if share < LEAST_SHARE:
        raise NotFound(
            f"the plane near the expected place holds only {100 * share:.1f} % of the image",
            hint="point the scanner at the panel, or widen the expectation",
        )
    return PlaneFit(surface=surface, feature=plane_feature(surface), inliers=inliers, sight_share=share, noise=noise)
