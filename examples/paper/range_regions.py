"""Repeats the paper's Fig. 10: a scene of four objects, segmented into six regions by the methods of 1990 and of today.

    python -m examples.paper.range_regions [--seed N]

The method of 1990 (Section III) applies a median against gross errors, a Gaussian against measurement errors, then
features of increasing order (range, orientation, curvature), each of which divides the regions further, and fits a
general quadric to each region by Givens rotations. It works on the 8-bit codes, of which the scene fills a fraction
(Fig. 7). Printed are the regions that overlap a surface of the scene by 0.8 either way, and how many of these have its
type.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import cv2
import numpy as np

from examples.paper.quadric import classify, fit_qr
from hal.arrays import Array, Image, Labels, Mask
from hal.errors import NotObservable
from perception.range import OrthographicSensor, SurfaceType, analyse

PAPER_REGIONS = 6  # "image was segmented into six regions", Fig. 10; no errors are given
SHARES = (0.1, 0.25, 0.5, 0.75, 1.0)  # fractions of the 8-bit range that the scene fills, Fig. 7
SIDE_PX, PITCH_M = 256, 0.001
SENSOR = OrthographicSensor(width_px=SIDE_PX, height_px=SIDE_PX, pixel_pitch_m=PITCH_M)
NOISE_M = 0.00025
TABLE_M, RELIEF_M = 0.6, 0.06
LEAST_PIXELS = 60
JUMP_M = 0.004  # step of the smoothed depth between neighbours that separates regions
CREASE_RAD = 0.35  # angle between the normals of neighbours that separates regions
FLAT_PER_M = 6.0  # a smaller mean curvature counts as zero
FLAT_RMS_M = 0.0006  # a region with a larger residual of the plane fit is fitted by a quadric


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """Depth image (H, W) in metres, the true labels (H, W) from 1 on, and the type of each surface."""

    depth_m: Array
    labels: Labels
    types: tuple[SurfaceType, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regions:
    """Labels (H, W) from 1 on, 0 for no region, and the type of each region, None if it is unknown."""

    labels: Labels
    types: tuple[SurfaceType | None, ...]


def scene(seed: int) -> Scene:
    """Draw a table with a box, a ball, two pipes and a cone, seen from straight above: six surfaces."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:SIDE_PX, :SIDE_PX] * PITCH_M
    dx, dy = rng.uniform(-0.006, 0.006, (2, 5))
    heights = np.full((6, SIDE_PX, SIDE_PX), -np.inf)
    heights[0] = 0.0
    box = (abs(u - 0.06 - dx[0]) < 0.03) & (abs(v - 0.06 - dy[0]) < 0.025)
    heights[1][box] = 0.03
    ball = 0.03**2 - (u - 0.19 - dx[1]) ** 2 - (v - 0.06 - dy[1]) ** 2
    heights[2][ball > 0] = np.sqrt(ball[ball > 0]) + 0.012
    for k, (at, radius) in enumerate(((0.13, 0.02), (0.185, 0.014)), 3):
        pipe = np.where(abs(u - 0.06 - dx[k - 1]) < 0.045, radius**2 - (v - at - dy[k - 1]) ** 2, -1.0)
        heights[k][pipe > 0] = np.sqrt(pipe[pipe > 0]) + 0.006
    away = np.hypot(u - 0.19 - dx[4], v - 0.17 - dy[4])
    heights[5][away < 0.04] = 0.055 - 1.2 * away[away < 0.04]
    depth = TABLE_M - heights.max(axis=0) + rng.normal(0.0, NOISE_M, u.shape)
    gross = rng.random(u.shape)
    depth[gross < 0.005], depth[gross > 0.995] = TABLE_M - RELIEF_M, TABLE_M
    types = (SurfaceType.PLANE, SurfaceType.PLANE, SurfaceType.SPHERE, *2 * (SurfaceType.CYLINDER,), SurfaceType.CONE)
    return Scene(depth_m=depth, labels=(heights.argmax(axis=0) + 1).astype(np.int32), types=types)


def coded(depth_m: Array, share: float) -> tuple[Image, float, float]:
    """Return the depth as 8-bit codes, the depth of code 0 and the step; the scene fills `share` of the codes."""
    step = 1.1 * RELIEF_M / share / 255.0
    near = TABLE_M - 0.5 * RELIEF_M - 127.5 * step
    return np.clip(np.rint((depth_m - near) / step), 0, 255).astype(np.uint8), near, step


def regions_of_1990(codes: Image, near_m: float, step_m: float) -> Regions:
    """Segment as the paper does: median, Gaussian, then division by range, orientation and curvature."""
    stretched = cv2.medianBlur(codes, 5).astype(np.float64)
    z = cv2.GaussianBlur(near_m + step_m * stretched, (0, 0), 1.5)
    gv, gu = np.gradient(z, PITCH_M)
    guv, guu = np.gradient(gu, PITCH_M)
    gvv, _ = np.gradient(gv, PITCH_M)
    slope = 1.0 + gu**2 + gv**2
    mean_curvature = ((1 + gv**2) * guu + (1 + gu**2) * gvv - 2 * gu * gv * guv) / (2 * slope**1.5)
    normal = np.stack([gu, gv, -np.ones_like(z)], axis=-1) / np.sqrt(slope)[..., None]
    is_even = np.ones(z.shape, np.bool_)
    for axis in (0, 1):
        turn = 1.0 - np.sum(normal * np.roll(normal, 1, axis), axis=-1)
        is_even &= (np.abs(z - np.roll(z, 1, axis)) < JUMP_M) & (turn < 1.0 - np.cos(CREASE_RAD))
    bends = np.where(np.abs(mean_curvature) < FLAT_PER_M, 0, np.sign(mean_curvature))
    labels, types = np.zeros(z.shape, np.int32), list[SurfaceType | None]()
    for sign in (-1, 0, 1):
        count, parts = cv2.connectedComponents((is_even & (bends == sign)).astype(np.uint8), connectivity=4)
        for part in range(1, count):
            mine = parts == part
            if np.count_nonzero(mine) >= LEAST_PIXELS:
                types.append(_name(SENSOR.points(z)[mine]))
                labels[mine] = len(types)
    return Regions(labels=labels, types=tuple(types))


def _name(points_m: Array) -> SurfaceType | None:
    """Return the type of the plane or quadric through points (N, 3)."""
    spread = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    if spread[2] / np.sqrt(len(points_m)) < FLAT_RMS_M:
        return SurfaceType.PLANE
    try:
        return classify(fit_qr(points_m, leaves=8))
    except NotObservable:
        return None


def regions_of_today(codes: Image, near_m: float, step_m: float) -> Regions:
    """Segment the same codes by `perception.range.analyse`."""
    found = analyse(near_m + step_m * codes.astype(np.float64), SENSOR)
    return Regions(labels=found.labels, types=tuple(surface.type for surface in found.surfaces))


def right(true: Scene, found: Regions, tolerance: float = 0.8) -> tuple[int, int]:
    """Return how many surfaces a region overlaps by `tolerance` either way, and how many of these are named."""
    hits, named = 0, 0
    for own, kind in enumerate(true.types, 1):
        mine: Mask = true.labels == own
        counts = np.bincount(found.labels[mine], minlength=len(found.types) + 1)
        counts[0] = 0
        best = int(counts.argmax())
        size = np.count_nonzero(found.labels == best)
        if counts[best] >= tolerance * max(np.count_nonzero(mine), size):
            hits += 1
            named += found.types[best - 1] == kind
    return hits, named


def main() -> None:
    """Command line entry; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    made = scene(parser.parse_args().seed)
    print(f"the paper: {PAPER_REGIONS} regions of {PAPER_REGIONS} surfaces on one image, without errors")
    print("share of the codes   1990: right, named   today: right, named")
    for share in SHARES:
        image = coded(made.depth_m, share)
        before, now = right(made, regions_of_1990(*image)), right(made, regions_of_today(*image))
        print(f"{share:18.2f}   {before[0]:11d}, {before[1]:5d}   {now[0]:12d}, {now[1]:5d}")


if __name__ == "__main__":
    main()
