"""How far out a round cap stands: by parallax where the camera knows heights, and by the shadow or side it shows.

A cap at height z looks larger by z over the camera's distance and shifted by the parallax; its edge measures both.
A cap that stands out also casts a shadow, or shows its side, on one side only: the ring around it is uneven.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perception.vision.patch import Patch
from perception.vision.view import Array

EDGE_SIGMA_PX = 0.25  # of one edge point, image px, model error of a rendered or real cap included
PLACE_SIGMA_M = 3e-4  # building tolerance of the cap's place
RADIUS_SIGMA_M = 1.5e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class CapHeight:
    """Measured height of a cap's edge above the plate, m, one sigma, and the share of the edge that was found."""

    height_m: float
    sigma_m: float
    found: float


def cap_height(patch: Patch, *, radius_m: float, low_m: float, high_m: float) -> CapHeight | None:
    """Height of a round cap by its edge, between the taught extremes; None when too little edge is found.

    The unknowns are height, shift and radius; the last two carry the building tolerance as a prior.
    """
    middle = (low_m + high_m) / 2
    a = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    x, y = radius_m * np.sin(a), radius_m * np.cos(a)
    u, v = patch.pixel_of(x, y, middle)
    u2, v2 = patch.pixel_of(x, y, middle + 1e-3)
    per_height = ((u2 - u) * np.sin(a) - (v2 - v) * np.cos(a)) / patch.px_per_m / 1e-3  # outward, m per m
    reach = float(np.abs(per_height).max()) * (high_m - low_m) / 2 + 1.5 / patch.image_px_per_m
    t = np.arange(-reach, reach + 1e-9, 0.4 / patch.px_per_m)
    r = radius_m + t
    values = patch.sample(np.outer(np.sin(a), r), np.outer(np.cos(a), r), middle)
    slope = np.abs(np.gradient(values, axis=1))
    best = slope.argmax(axis=1)
    strength = slope[np.arange(len(a)), best]
    ok = (best > 0) & (best < len(t) - 1) & (strength > max(2.0, 0.3 * float(np.median(strength))))
    if ok.sum() < len(a) // 3:
        return None
    offset = t[best]
    J = np.column_stack([per_height, np.sin(a), np.cos(a), np.ones_like(a)])[ok]
    prior = np.diag([1 / (high_m - low_m) ** 2, *[1 / PLACE_SIGMA_M**2] * 2, 1 / RADIUS_SIGMA_M**2])
    sigma = EDGE_SIGMA_PX / patch.image_px_per_m
    solution, N = np.zeros(4), prior
    for _ in range(5):
        residual = offset[ok] - J @ solution
        w = 1.0 / (1.0 + (residual / (2 * sigma)) ** 2) / sigma**2 / 3.0  # neighbours share their error
        N = J.T @ (w[:, None] * J) + prior
        solution = np.linalg.solve(N, J.T @ (w * offset[ok]))
    return CapHeight(
        height_m=float(middle + solution[0]), sigma_m=float(np.sqrt(np.linalg.inv(N)[0, 0])), found=float(ok.mean())
    )


def one_sided_shade(
    patch: Patch, *, radius_m: float, ring: tuple[float, float], outside: tuple[float, float]
) -> tuple[float, float]:
    """First harmonic of the brightness around a cap over its surroundings; direction of its bright side (rad).

    `ring` and `outside` are shares of `radius_m`; the harmonic outside (a glare's gradient) is taken off.
    """
    a = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    inner, outer = (_around(patch, radius_m * np.linspace(*part, 4), a) for part in (ring, outside))
    level = max(float(np.median(outer)), 8.0)
    wave = np.exp(1j * a)
    harmonic = 2 * (inner * wave).mean() / level - 2 * (np.clip(outer, 0.6 * level, None) * wave).mean() / level
    return float(abs(harmonic)), float(np.angle(harmonic))


def sheen(patch: Patch, *, radius_m: float, towards_rad: float) -> float:
    """Brightest spot of a cap's face over the face's median, relative to the plate, if it lies on the side of the light.

    Negative when the brightest spot lies on another side.
    """
    a = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    r = radius_m * np.linspace(0.1, 0.62, 7)
    face = patch.sample(np.outer(r, np.sin(a)), np.outer(r, np.cos(a)))
    level = max(float(np.median(_around(patch, radius_m * np.array([1.2, 1.3]), a))), 8.0)
    smooth = cv2.blur(np.concatenate([face, face, face], axis=1), (7, 3))[:, len(a) : 2 * len(a)]
    k = int(smooth.argmax()) % len(a)
    height = float(smooth.max() - np.median(face)) / level
    return height * float(np.cos(a[k] - towards_rad))


def _around(patch: Patch, radii_m: Array, angles: Array) -> Array:
    values = patch.sample(np.outer(radii_m, np.sin(angles)), np.outer(radii_m, np.cos(angles)))
    return np.asarray(values.mean(axis=0), float)
