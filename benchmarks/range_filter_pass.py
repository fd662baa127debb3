"""Filter pass as a unit of time: median, Gaussian, normals, mean and Gaussian curvature in single precision.

The curvatures follow from the fundamental forms of the surface X(u, v) = O + z D over the image's rays, of which the
paper's graph g(u, v) is a special case:

    n = X_u x X_v / |X_u x X_v|;  H = (e G - 2 f F + g E) / (2 (E G - F^2));  K = (e g - f^2) / (E G - F^2)

Curvature is positive for a surface that is convex towards the sensor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jit import REORDERED, compiled
from perception.range.sensor import RangeSensorModel

Single = NDArray[np.float32]

CHUNK, ROW = 128, 144  # pixels per step; a row of the scratch array holds them and a neighbour on each side
ABOVE, HERE, BELOW = 0, ROW, 2 * ROW  # rows of depth, each from one pixel before the chunk
ACROSS = 3 * ROW  # x of each pixel's ray at depth 1
GU, GV, NORMAL, MEAN, GAUSS = 4 * ROW, 5 * ROW, 6 * ROW, 9 * ROW, 10 * ROW  # the normal takes three rows
SCRATCH = 11 * ROW


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalGeometry:
    """(H, W) maps of derivatives, normals and curvatures; NaN beside holes and at the image border.

    `gu`, `gv`: metres of depth per pixel. `normal` (H, W, 3) towards the sensor. `mean_curvature_per_m`,
    `gaussian_curvature_per_m2`: H and K.
    """

    gu: Single
    gv: Single
    normal: Single
    mean_curvature_per_m: Single
    gaussian_curvature_per_m2: Single


def geometry_of(depth_m: Array | Single, sensor: RangeSensorModel) -> LocalGeometry:
    """Return the local geometry of a smoothed (H, W) depth image by central differences."""
    z = np.ascontiguousarray(depth_m, np.float32)
    gu, gv, mean, gauss = (np.empty_like(z) for _ in range(4))
    normal = np.empty((*z.shape, 3), z.dtype)
    _fused(z, sensor.packed(), np.empty(SCRATCH, z.dtype), gu, gv, normal, mean, gauss)
    return LocalGeometry(gu=gu, gv=gv, normal=normal, mean_curvature_per_m=mean, gaussian_curvature_per_m2=gauss)


def filter_pass(depth_m: Array, sensor: RangeSensorModel) -> Callable[[], object]:
    """Return a function to be timed: 5x5 median, Gaussian, derivatives, normals, H and K of one image.

    It is our fastest version: OpenCV's median and Gaussian on one thread, then fused and vectorised derivatives.
    """
    cv2.setNumThreads(1)
    single = depth_m.astype(np.float32)

    def run() -> object:
        smooth = cv2.GaussianBlur(cv2.medianBlur(single, 5), (0, 0), 1.5)
        return geometry_of(np.asarray(smooth, np.float32), sensor)

    run()
    return run


@compiled
def _fused(
    z: Single, sen: Array, work: Single, gu: Single, gv: Single, normal: Single,
    mean: Single, gauss: Single,
) -> None:  # fmt: skip
    """Fill the maps from `z` (H, W), a chunk of a row at a time; all arrays, also `work` (SCRATCH,), have z's type."""
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


@compiled(fastmath=REORDERED)
def _forms(n: int, y: float | np.float32, sen: Array, work: Single) -> None:
    """Compute derivatives, normal, H and K of one chunk without branches: rows 4 to 10 of `work` from rows 0 to 3."""
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
        # The normal points outward to the sensor, and a convex surface curves away from it, hence the minus signs.
        e, f, g = -(a0 * n0 + a1 * n1 + zuu * n2), -(b0 * n0 + b1 * n1 + zuv * n2), -(d0 * n0 + d1 * n1 + zvv * n2)
        inverse *= inverse
        work[GU + i] = zu + nothing
        work[GV + i] = zv + nothing
        work[NORMAL + i] = n0 + nothing
        work[NORMAL + ROW + i] = n1 + nothing
        work[NORMAL + 2 * ROW + i] = n2 + nothing
        work[MEAN + i] = half * (e * G - two * f * F + g * E) * inverse
        work[GAUSS + i] = (e * g - f * f) * inverse
