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

from hal.arrays import Array
from perception.range.filters import gaussian, remove_gross_errors
from perception.range.fitting.rays import LOOSE
from perception.range.noise import NoiseModel, estimate_noise
from perception.range.sensor import RangeSensorModel

CURVATURE_GOAL_PER_M = 4.0  # noise of H that still tells a ball of 0.1 m radius from a plane
CHUNK, ROW = 128, 144  # pixels worked on at a time; a row of the scratch array holds them and a neighbour on each side
ABOVE, HERE, BELOW = 0, ROW, 2 * ROW  # rows of depth, each from one pixel before the chunk
ACROSS = 3 * ROW  # x of each pixel's ray at depth 1
GU, GV, NORMAL, MEAN, GAUSS = 4 * ROW, 5 * ROW, 6 * ROW, 9 * ROW, 10 * ROW  # the normal takes three rows
SCRATCH = 11 * ROW
SCALES_PX = (1.0, 1.5, 2.0, 3.0, 4.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalGeometry:
    """(H, W) maps; NaN beside holes and at the image border.

    `gu`, `gv`: metres of depth per pixel. `normal` (H, W, 3) towards the sensor. `mean_curvature_per_m`,
    `gaussian_curvature_per_m2`: H and K. `scale_px`: sigma of the gaussian that regularised the derivatives.
    """

    gu: Array
    gv: Array
    normal: Array
    mean_curvature_per_m: Array
    gaussian_curvature_per_m2: Array
    scale_px: float

    @property
    def orientation_rad(self) -> Array:
        """atan2(gu, gv), the paper's orientation feature, (H, W)."""
        return np.asarray(np.arctan2(self.gu, self.gv))


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


def geometry_of(depth_m: Array | NDArray[np.float32], sensor: RangeSensorModel, *, scale_px: float) -> LocalGeometry:
    """Geometry by central differences of an already smoothed (H, W) depth image; float32 stays float32, and is faster."""
    z = np.ascontiguousarray(depth_m)
    gu, gv, mean, gauss = (np.empty_like(z) for _ in range(4))
    normal = np.empty((*z.shape, 3), z.dtype)
    _fused(z, sensor.packed(), np.empty(SCRATCH, z.dtype), gu, gv, normal, mean, gauss)
    return LocalGeometry(
        gu=gu, gv=gv, normal=normal, mean_curvature_per_m=mean, gaussian_curvature_per_m2=gauss, scale_px=scale_px
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


@njit(cache=True, nogil=True, error_model="numpy")
def _fused(z, sen, work, gu, gv, normal, mean, gauss):  # type: ignore[no-untyped-def]  # numba types it
    """Fill the maps from `z` (H, W), a chunk of a row at a time; all in the type of `z`, `work` (SCRATCH,) too."""
    H, W = z.shape
    for v in range(H):
        if v in (0, H - 1):
            gu[v], gv[v], normal[v], mean[v], gauss[v] = np.nan, np.nan, np.nan, np.nan, np.nan
            continue
        for u in (0, W - 1):
            gu[v, u], gv[v, u], normal[v, u], mean[v, u], gauss[v, u] = np.nan, np.nan, np.nan, np.nan, np.nan
        for first in range(1, W - 1, CHUNK):
            n = min(CHUNK, W - 1 - first)
            for k in range(3):
                work[k * ROW : k * ROW + n + 2] = z[v - 1 + k, first - 1 : first + n + 1]
            for i in range(n):
                work[ACROSS + i] = (first + i - sen[3]) / sen[1]
            _forms(n, work.dtype.type((v - sen[4]) / sen[2]), sen, work)
            gu[v, first : first + n] = work[GU : GU + n]
            gv[v, first : first + n] = work[GV : GV + n]
            for k in range(3):
                normal[v, first : first + n, k] = work[NORMAL + k * ROW : NORMAL + k * ROW + n]
            mean[v, first : first + n] = work[MEAN : MEAN + n]
            gauss[v, first : first + n] = work[GAUSS : GAUSS + n]


@njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _forms(n, y, sen, work):  # type: ignore[no-untyped-def]  # numba types it
    """Derivatives, normal, H and K of one chunk, without a branch: rows 4 to 10 of `work` from rows 0 to 3."""
    as_type = work.dtype.type
    half, quarter, two, one = as_type(0.5), as_type(0.25), as_type(2.0), as_type(1.0)
    # X = z (p x, p y, 1) + (1 - p) (x, y, 0), p = 1 for a pinhole and 0 for parallel rays.
    p, ax, ay = as_type(1.0 if sen[0] > 0 else 0.0), as_type(1.0 / sen[1]), as_type(1.0 / sen[2])
    py = p * y
    for i in range(n):
        c, left, right = work[HERE + 1 + i], work[HERE + i], work[HERE + 2 + i]
        above, below = work[ABOVE + 1 + i], work[BELOW + 1 + i]
        px = p * work[ACROSS + i]
        zu, zv = half * (right - left), half * (below - above)
        zuu, zvv = right - two * c + left, below - two * c + above
        zuv = quarter * (work[BELOW + 2 + i] - work[BELOW + i] - work[ABOVE + 2 + i] + work[ABOVE + i])
        nothing = (zuu + zvv + zuv) * as_type(0.0)  # NaN where a neighbour is missing
        reach = p * c + (one - p)
        xu0, xu1 = zu * px + reach * ax, zu * py
        xv0, xv1 = zv * px, zv * py + reach * ay
        a0, a1 = zuu * px + two * p * zu * ax, zuu * py
        b0, b1 = zuv * px + p * zv * ax, zuv * py + p * zu * ay
        d0, d1 = zvv * px, zvv * py + two * p * zv * ay
        # X_v x X_u points back to the sensor (x right, y down, z away).
        n0, n1, n2 = xv1 * zu - zv * xu1, zv * xu0 - xv0 * zu, xv0 * xu1 - xv1 * xu0
        area = n0 * n0 + n1 * n1 + n2 * n2  # = E G - F^2
        inverse = one / np.sqrt(area)
        n0, n1, n2 = n0 * inverse, n1 * inverse, n2 * inverse
        E, F, G = xu0 * xu0 + xu1 * xu1 + zu * zu, xu0 * xv0 + xu1 * xv1 + zu * zv, xv0 * xv0 + xv1 * xv1 + zv * zv
        # Towards the sensor is outward, so a bulge curves against the normal: minus signs make it positive.
        e, f, g = -(a0 * n0 + a1 * n1 + zuu * n2), -(b0 * n0 + b1 * n1 + zuv * n2), -(d0 * n0 + d1 * n1 + zvv * n2)
        inverse *= inverse
        work[GU + i] = zu + nothing
        work[GV + i] = zv + nothing
        work[NORMAL + i] = n0 + nothing
        work[NORMAL + ROW + i] = n1 + nothing
        work[NORMAL + 2 * ROW + i] = n2 + nothing
        work[MEAN + i] = half * (e * G - two * f * F + g * E) * inverse
        work[GAUSS + i] = (e * g - f * f) * inverse
