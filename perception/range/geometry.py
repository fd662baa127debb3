"""Local geometry of a range image: derivatives, normals, orientation, mean and gaussian curvature.

The paper's formulas hold for a graph surface g(u, v) of parallel rays; a pinhole image needs the fundamental forms of
the surface X(u, v) = O + z D, of which the graph is a special case. Both are here, the second by default:

    n = X_u x X_v / |X_u x X_v|;  H = (e G - 2 f F + g E) / (2 (E G - F^2));  K = (e g - f^2) / (E G - F^2)

Curvature is positive for a surface that bulges towards the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.range.filters import gaussian, remove_gross_errors
from perception.range.noise import NoiseModel, estimate_noise
from perception.range.sensor import RangeSensorModel

Array = NDArray[np.float64]

CURVATURE_GOAL_PER_M = 4.0  # noise of H that still tells a ball of 0.1 m radius from a plane
SCALES_PX = (1.0, 1.5, 2.0, 3.0, 4.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalGeometry:
    """(H, W) maps; NaN beside holes and at the image border.

    `gu`, `gv`: metres of depth per pixel. `normal` (H, W, 3) towards the sensor. `orientation_rad`: atan2(gu, gv), the
    paper's orientation feature. `mean_curvature_per_m`, `gaussian_curvature_per_m2`: H and K. `scale_px`: sigma of the
    gaussian that regularised the derivatives.
    """

    gu: Array
    gv: Array
    normal: Array
    orientation_rad: Array
    mean_curvature_per_m: Array
    gaussian_curvature_per_m2: Array
    scale_px: float


def local_geometry(
    depth_m: Array, sensor: RangeSensorModel, *, noise: NoiseModel | None = None, scale_px: float | None = None
) -> LocalGeometry:
    """Geometry of an (H, W) depth image in metres, after removal of gross errors and an edge-keeping gaussian.

    Args:
        noise: estimated from the image when not given.
        scale_px: sigma of the gaussian; chosen from the noise when not given.
    """
    law = noise or estimate_noise(depth_m, sensor)
    scale = scale_px if scale_px is not None else choose_scale(depth_m, sensor, law)
    clean = gaussian(remove_gross_errors(depth_m, sensor, law), sensor, law, sigma_px=scale)
    return geometry_of(clean, sensor, scale_px=scale)


def choose_scale(depth_m: Array, sensor: RangeSensorModel, noise: NoiseModel) -> float:
    """Smallest gaussian whose second derivatives are steady enough: sigma(g_uu) = sigma sqrt(3 / (4 pi)) / (2 s^3)."""
    middle = float(np.nanmedian(depth_m)) if np.isfinite(depth_m).any() else 1.0
    sigma, pitch = float(noise.sigma_m(middle)), sensor.pitch_m(middle)
    for scale in SCALES_PX:
        curvature = sigma * np.sqrt(3.0 / (4.0 * np.pi)) / (2.0 * scale**3) / pitch**2
        if curvature <= CURVATURE_GOAL_PER_M:
            return scale
    return SCALES_PX[-1]


def geometry_of(depth_m: Array, sensor: RangeSensorModel, *, scale_px: float) -> LocalGeometry:
    """Geometry by central differences of an already smoothed (H, W) depth image."""
    gu, gv, normal, mean, gauss = _fused(np.ascontiguousarray(depth_m), sensor.packed())
    return LocalGeometry(
        gu=gu,
        gv=gv,
        normal=normal,
        orientation_rad=np.arctan2(gu, gv),
        mean_curvature_per_m=mean,
        gaussian_curvature_per_m2=gauss,
        scale_px=scale_px,
    )


def curvature_class(geometry: LocalGeometry, *, flat_per_m: float) -> NDArray[np.int8]:
    """(H, W) sign class 3 (sign H) + sign K of Besl and Jain (1986), -4 to 4; 0 is flat, 99 unknown.

    `flat_per_m`: principal curvatures smaller than this count as zero.
    """
    H, K = geometry.mean_curvature_per_m, geometry.gaussian_curvature_per_m2
    sign_h = np.where(np.abs(H) < flat_per_m, 0, np.sign(H))
    sign_k = np.where(np.abs(K) < flat_per_m**2, 0, np.sign(K))
    return np.where(np.isfinite(H), 3 * np.nan_to_num(sign_h) + np.nan_to_num(sign_k), 99).astype(np.int8)


def graph_curvature(g: Array) -> tuple[Array, Array]:
    """H and K of a graph surface g(u, v) with unit pixel pitch, exactly as printed in the paper (interior pixels).

    H = ((1 + gv^2) guu + (1 + gu^2) gvv - 2 gu gv guv) / (2 (1 + gu^2 + gv^2)^(3/2))
    K = (guu gvv - guv^2) / (1 + gu^2 + gv^2)^2
    """
    gu, gv = (g[1:-1, 2:] - g[1:-1, :-2]) / 2, (g[2:, 1:-1] - g[:-2, 1:-1]) / 2
    guu = g[1:-1, 2:] - 2 * g[1:-1, 1:-1] + g[1:-1, :-2]
    gvv = g[2:, 1:-1] - 2 * g[1:-1, 1:-1] + g[:-2, 1:-1]
    guv = (g[2:, 2:] - g[2:, :-2] - g[:-2, 2:] + g[:-2, :-2]) / 4
    q = 1 + gu**2 + gv**2
    return ((1 + gv**2) * guu + (1 + gu**2) * gvv - 2 * gu * gv * guv) / (2 * q**1.5), (guu * gvv - guv**2) / q**2


@njit(cache=True, nogil=True)
def _fused(z, sen):  # type: ignore[no-untyped-def]
    H, W = z.shape
    gu, gv = np.full((H, W), np.nan), np.full((H, W), np.nan)
    normal = np.full((H, W, 3), np.nan)
    mean, gauss = np.full((H, W), np.nan), np.full((H, W), np.nan)
    perspective = sen[0] > 0
    ax, ay = 1.0 / sen[1], 1.0 / sen[2]
    for v in range(1, H - 1):
        y = (v - sen[4]) * ay
        for u in range(1, W - 1):
            x = (u - sen[3]) * ax
            c = z[v, u]
            zu, zv = 0.5 * (z[v, u + 1] - z[v, u - 1]), 0.5 * (z[v + 1, u] - z[v - 1, u])
            zuu = z[v, u + 1] - 2.0 * c + z[v, u - 1]
            zvv = z[v + 1, u] - 2.0 * c + z[v - 1, u]
            zuv = 0.25 * (z[v + 1, u + 1] - z[v + 1, u - 1] - z[v - 1, u + 1] + z[v - 1, u - 1])
            if not np.isfinite(zuu + zvv + zuv):
                continue
            gu[v, u], gv[v, u] = zu, zv
            if perspective:  # X = z (x, y, 1)
                xu0, xu1, xu2 = zu * x + c * ax, zu * y, zu
                xv0, xv1, xv2 = zv * x, zv * y + c * ay, zv
                a0, a1, a2 = zuu * x + 2.0 * zu * ax, zuu * y, zuu
                b0, b1, b2 = zuv * x + zv * ax, zuv * y + zu * ay, zuv
                d0, d1, d2 = zvv * x, zvv * y + 2.0 * zv * ay, zvv
            else:  # X = (x, y, z)
                xu0, xu1, xu2, xv0, xv1, xv2 = ax, 0.0, zu, 0.0, ay, zv
                a0, a1, a2, b0, b1, b2, d0, d1, d2 = 0.0, 0.0, zuu, 0.0, 0.0, zuv, 0.0, 0.0, zvv
            # X_v x X_u points back to the sensor (x right, y down, z away).
            n0, n1, n2 = xv1 * xu2 - xv2 * xu1, xv2 * xu0 - xv0 * xu2, xv0 * xu1 - xv1 * xu0
            length = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            if length <= 0.0:
                continue
            n0, n1, n2 = n0 / length, n1 / length, n2 / length
            E = xu0 * xu0 + xu1 * xu1 + xu2 * xu2
            F = xu0 * xv0 + xu1 * xv1 + xu2 * xv2
            G = xv0 * xv0 + xv1 * xv1 + xv2 * xv2
            # Towards the sensor is outward, so a bulge curves against the normal: minus signs make it positive.
            e = -(a0 * n0 + a1 * n1 + a2 * n2)
            f = -(b0 * n0 + b1 * n1 + b2 * n2)
            g = -(d0 * n0 + d1 * n1 + d2 * n2)
            area = E * G - F * F
            normal[v, u, 0], normal[v, u, 1], normal[v, u, 2] = n0, n1, n2
            mean[v, u] = 0.5 * (e * G - 2.0 * f * F + g * E) / area
            gauss[v, u] = (e * g - f * f) / area
    return gu, gv, normal, mean, gauss
