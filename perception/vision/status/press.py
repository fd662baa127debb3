"""Height of a round cap by parallax; needs a camera whose model includes heights (otherwise see `shade`).

A cap at height z appears larger by z over the camera's distance, and displaced by the parallax; its edge shows both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.vision.image import WHITE_LEVEL
from perception.vision.patch import Patch, sample_at
from perception.vision.status.choice import contrast_noise
from perception.vision.status.occluder_bands import cables_across

EDGE_SIGMA_PX = 0.25  # standard deviation of one edge point, image px, including model errors of the cap
RESOLVED = 1.5  # widths of an edge; a wall that appears narrower merges with the face, and its foot cannot be located
# Width of a sharp edge; the excess width times PULL is the shift of an edge by its neighbours, px.
SHARP_PX, PULL = 1.8, 1.0
GLARED_PULL = 0.5  # widths by which an edge shifts whose bright side is saturated, because its steepest part is cut off
# Radii over the cap's; least share of the ring that is visible; tolerance in image px.
RING, RING_SHARE, RING_NEAR_PX = (1.08, 1.5), 0.5, 2.0
CLEAR_OF_RING = 1.6  # of the cap's radius; anything that crosses a circle of that size is no part of the button
PLACE_SIGMA_M = 3e-4  # building tolerance of the cap's position
RADIUS_SIGMA_M = 1.5e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class CapHeight:
    """Measured height of a cap's edge above the plate and its standard deviation, m."""

    height_m: float
    sigma_m: float


def cap_height(patch: Patch, *, radius_m: float, low_m: float, high_m: float, foot_m: float | None) -> CapHeight | None:
    """Return the height of a round cap by its silhouette, between the taught extremes.

    None if too little of it is found. Where height moves the edge outward, the silhouette is the cap's face; on the
    other side the wall is visible, and the silhouette is the cap's foot, which does not move. The unknowns are height,
    shift and radius; shift and radius have the building tolerance as prior.

    Args:
        foot_m: height of the foot's edge; None if it moves with the cap.
    """
    middle = (low_m + high_m) / 2
    a = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    x, y = radius_m * np.sin(a), radius_m * np.cos(a)
    (u, v), (u2, v2) = patch.pixel_of(x, y, middle), patch.pixel_of(x, y, middle + 1e-3)
    outward = ((u2 - u) * np.sin(a) - (v2 - v) * np.cos(a)) / patch.px_per_m / 1e-3  # m per m
    is_face = outward > 0
    expected = np.zeros_like(a) if foot_m is None else np.where(is_face, 0.0, outward * (foot_m - middle))
    use = is_face | (foot_m is not None)
    slack = 1.2 / patch.image_px_per_m
    reach = np.where(is_face, outward * (high_m - low_m) / 2, 0.0) + slack
    offset, found, width_px, glared = _edges(patch, radius_m, a, middle, expected, reach)
    beyond_m = CLEAR_OF_RING * radius_m
    hidden = cables_across(patch, radius_m=beyond_m)
    if hidden is not None:
        found &= sample_at(hidden.astype(np.uint8), *_at(patch, radius_m + offset, a, middle)) < 0.5
    ok = found & use
    if foot_m is not None:
        ok &= ~_on_ring(patch, radius_m, a, outward, offset + outward * middle)
    if ok.sum() < 0.4 * use.sum() or (ok & is_face).sum() < 6:
        return None
    if foot_m is not None and (~is_face).sum() > 8 and (ok & ~is_face).sum() < 0.4 * (~is_face).sum():
        return None  # the foot is not where a cap of this size has it, so other edges were found
    J = np.column_stack([np.where(is_face, outward, 0.0), np.sin(a), np.cos(a), np.ones_like(a)])[ok]
    prior = np.diag([1 / (high_m - low_m) ** 2, *[1 / PLACE_SIGMA_M**2] * 2, 1 / RADIUS_SIGMA_M**2])
    wall_px = np.abs(expected) * patch.image_px_per_m
    blurred = (~is_face) & (wall_px < RESOLVED * width_px)
    sigma = np.where(blurred, np.hypot(EDGE_SIGMA_PX, 0.5 * wall_px), EDGE_SIGMA_PX)[ok] / patch.image_px_per_m
    measured = (offset - expected)[ok]
    solution, N = np.zeros(4), prior
    for _ in range(6):
        residual = measured - J @ solution
        w = 1.0 / (1.0 + (residual / (2 * sigma)) ** 2) / sigma**2 / 3.0  # neighbours share their error
        N = J.T @ (w[:, None] * J) + prior
        solution = np.linalg.solve(N, J.T @ (w * measured))
    if float(np.median(np.abs(measured - J @ solution) / sigma)) > 2.0:
        return None  # another edge was found, such as that of a printed ring
    lean = float(np.mean(outward[is_face]))
    pull_px = PULL * max(width_px - SHARP_PX, 0.0) + GLARED_PULL * glared * width_px
    pull_m = pull_px / patch.image_px_per_m / lean
    return CapHeight(
        height_m=float(middle + solution[0]),
        sigma_m=float(np.hypot(np.sqrt(np.linalg.inv(N)[0, 0]), pull_m)),
    )


def _at(patch: Patch, r_m: Array, a: Array, z_m: float) -> tuple[Array, Array]:
    """Return the patch coordinates of places around the middle, by radius and angle."""
    return patch.pixel_of(r_m * np.sin(a), r_m * np.cos(a), z_m)


def _on_ring(patch: Patch, radius_m: float, a: Array, outward: Array, at_plate_m: Array) -> NDArray[np.bool_]:
    """Return a mask (N,) of the face's edges that belong to a ring around the cap, printed or flat, as gray as the cap.

    The ring's outer edge is visible all along the side where height does not move the cap over it.

    Args:
        outward: (N,) how far height moves the face's edge outward, m per m.
        at_plate_m: (N,) how far beyond the cap's radius every edge would lie on the plate.
    """
    seen = a[outward <= np.median(outward)]
    r = radius_m * np.linspace(*RING, 24)
    values = patch.sample(np.sin(seen)[:, None] * r, np.cos(seen)[:, None] * r, 0.0)
    slope = np.abs(np.diff(values, axis=1))
    radius = r[slope.argmax(axis=1)] + (r[1] - r[0]) / 2
    beyond = float(np.median(radius)) - radius_m
    near_m = RING_NEAR_PX / patch.image_px_per_m
    is_ring = float((np.abs(radius - radius_m - beyond) < near_m).mean()) > RING_SHARE
    return np.asarray((outward > 0) & is_ring & (np.abs(at_plate_m - beyond) < near_m), bool)


def _edges(
    patch: Patch, radius_m: float, a: Array, z_m: float, expected_m: Array, reach_m: Array
) -> tuple[Array, NDArray[np.bool_], float, float]:
    """Return the radial offset of the strongest edge near each expected offset, and whether it is an edge.

    Also returns the typical width of the edges, image px, and the share of them that have a saturated side.
    """
    t = np.linspace(-1.0, 1.0, 25)
    r = radius_m + expected_m[:, None] + reach_m[:, None] * t
    values = patch.sample(np.sin(a)[:, None] * r, np.cos(a)[:, None] * r, z_m)
    slope = np.abs(np.gradient(values, axis=1)) / np.maximum(reach_m[:, None] * patch.px_per_m * (t[1] - t[0]), 1e-6)
    best = slope.argmax(axis=1)
    strength = slope[np.arange(len(a)), best]
    found = (
        (best > 1)
        & (best < len(t) - 2)
        & (strength > max(2.0 * contrast_noise(patch), 0.3 * float(np.median(strength))))
    )
    steps = np.abs(np.diff(values, axis=1)).sum(axis=1)
    width = steps / np.maximum(strength, 1e-6) / patch.px_per_m * patch.image_px_per_m
    if not found.any():
        return expected_m + reach_m * t[best], found, np.inf, 1.0
    glared = float((values[found].max(axis=1) >= WHITE_LEVEL).mean())
    return expected_m + reach_m * t[best], found, float(np.median(width[found])), glared
