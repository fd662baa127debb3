"""Segmentation: lowest order first, and models compete.

1. Planes grow from the flattest blocks while their own model explains the next block (range and orientation).
2. What is left falls into components of smooth range; each is offered to every primitive, and the cheapest that
   explains it wins (Schwarz's criterion). A component that no primitive explains is split by growing local fits.
3. Pieces of one surface that an occluder parted are joined when one model explains both.
4. Pixels are claimed by the surface that explains them best; what no block could hold is tried again pixel by pixel.
Each round leaves fewer free blocks, and rounds end when no surface is added.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from perception.range import fit, grow
from perception.range.claim import bucket, claim_borders, claim_pixels
from perception.range.finish import SLOW_NOISE_AREA_PX
from perception.range.grid import Grid, block_size, build_grid
from perception.range.noise import NoiseModel, typical_depths_m
from perception.range.sensor import RangeSensorModel
from perception.range.surfaces import CONE, CYLINDER, PLANE, QUADRIC, SIZE, SPHERE

Array = NDArray[np.float64]
Labels = NDArray[np.int32]
Flags = NDArray[np.bool_]

LEAST_PIXELS_AT_256 = 24  # per 256 x 256 pixels of image
FIT_SAMPLES = 100
LEAST_FLAT_BLOCKS = 24  # a smaller flat patch may be a facet of something bent; whole components decide about it
STEEP_SLOPE = 7.0  # what is left once the large surfaces are named may be seen as steep as 82 degrees
LEAST_CURVED_BLOCKS = 16  # smaller things wait for the pixels themselves
LARGE_PLANE_BLOCKS = 80
SETTLED_MEAN_SQUARE = 1.25  # residuals cut at three sigmas; wider noise than modelled drives them to 1.5 and more
WIDER = 1.5
WIDENINGS = 5
ROUNDS = 6
MOST_COMPONENTS = 48  # a round; bounds the time that rubble can cost
GOOD_MEAN_SQUARE = 2.0
GOOD_SHARE = 0.75
LOCAL_BLOCKS = 45
LOCAL_TRIES = 6
ALL_KINDS = np.ones(5, np.bool_)
FEW_BLOCKS_FOR_QUADRIC = 60


@dataclass(slots=True, eq=False)
class Candidates:
    """Surfaces found so far; label k is `kinds[k - 1]`, `parameters[k - 1]`. Grows while segmentation runs."""

    kinds: list[int] = field(default_factory=list)
    parameters: list[Array] = field(default_factory=list)

    def add(self, kind: int, parameters: Array) -> int:
        """Append a surface and return its label."""
        self.kinds.append(kind)
        self.parameters.append(parameters)
        return len(self.kinds)

    def arrays(self) -> tuple[NDArray[np.int64], Array]:
        """Kinds (n + 1,) and parameters (n + 1, 16), entry 0 unused, for compiled loops."""
        kinds = np.zeros(len(self.kinds) + 1, np.int64)
        table = np.zeros((len(self.kinds) + 1, SIZE))
        for k, (kind, th) in enumerate(zip(self.kinds, self.parameters, strict=True), 1):
            kinds[k], table[k] = kind, th
        return kinds, table


def segment(depth_m: Array, sensor: RangeSensorModel, noise: NoiseModel) -> tuple[Labels, Candidates, NoiseModel]:
    """Segment an (H, W) depth image in metres.

    Returns:
        labels (H, W), 0 = none; the surfaces behind them; and the noise model, widened where the planes of the image
        themselves scatter more than the given one says.
    """
    least = LEAST_PIXELS_AT_256 * depth_m.size / 65536
    found, grid, blocks, noise = _settled_planes(depth_m, sensor, noise, least)
    packed, law, size = sensor.packed(), noise.packed(), grid.size_px
    free = np.isfinite(grid.z) & (blocks == 0)
    _recover_curved(grid, packed, free, blocks, found=found, least=_least_curved(size, least))
    labels = np.zeros(depth_m.shape, np.int32)
    kinds, table = found.arrays()
    claim_pixels(depth_m, packed, law, blocks, size, kinds, table, labels)
    if size > 1:
        labels = reclaimed(depth_m, packed, law, labels, found, sweeps=1)
        labels = _finer(depth_m, sensor, noise, labels, found=found, size=size // 2, least=least)
    return reclaimed(depth_m, packed, law, labels, found), found, noise


def _settled_planes(
    depth_m: Array, sensor: RangeSensorModel, noise: NoiseModel, least: float
) -> tuple[Candidates, Grid, Labels, NoiseModel]:
    """Planes on the coarse grid, grown again under wider noise while large planes scatter more than it allows."""
    depths = typical_depths_m(depth_m)
    for attempt in range(WIDENINGS + 1):
        size = block_size((depth_m.shape[0], depth_m.shape[1]), noise, sensor, float(depths[2]))
        grid = build_grid(depth_m, sensor, noise, size)
        blocks = np.zeros(grid.z.shape, np.int32)
        found = Candidates()
        scatter = _recover_planes(grid, blocks, found, max(LEAST_FLAT_BLOCKS, round(least / size**2)))
        if scatter <= SETTLED_MEAN_SQUARE or attempt == WIDENINGS:
            break
        noise = noise.widened(WIDER, depths)
    return found, grid, blocks, noise


def _finer(
    depth_m: Array, sensor: RangeSensorModel, noise: NoiseModel, labels: Labels, *, found: Candidates, size: int,
    least: float,
) -> Labels:
    """Surfaces too small for the coarse blocks, from the pixels that nothing explains yet; returns new labels."""
    left = np.where(labels == 0, depth_m, np.nan)
    grid = build_grid(left, sensor, noise, size, jump_slope=STEEP_SLOPE)
    blocks = np.zeros(grid.z.shape, np.int32)
    before = len(found.kinds)
    free = np.isfinite(grid.z)
    _recover_planes(grid, blocks, found, max(LEAST_FLAT_BLOCKS, round(least / size**2)))
    free &= blocks == 0
    _recover_curved(grid, sensor.packed(), free, blocks, found=found, least=max(8, round(least / size**2)))
    if len(found.kinds) == before:
        return labels
    fine = np.zeros_like(labels)
    kinds, table = found.arrays()
    claim_pixels(left, sensor.packed(), noise.packed(), blocks, size, kinds, table, fine)
    return np.where(labels > 0, labels, fine)


def _least_curved(size: int, least: float) -> int:
    return max(LEAST_CURVED_BLOCKS if size > 1 else 6, round(least / size**2))


def reclaimed(
    depth_m: Array, packed: Array, law: Array, labels: Labels, found: Candidates, *, sweeps: int = 2
) -> Labels:
    """Labels after judging border pixels again `sweeps` times against the surfaces of `found`."""
    kinds, table = found.arrays()
    for _ in range(sweeps):
        out = np.empty_like(labels)
        claim_borders(depth_m, packed, law, labels, kinds, table, out)
        labels = out
    return labels


def _recover_planes(grid: Grid, blocks: Labels, found: Candidates, least: int) -> float:
    """Grow planes over the grid; extends `blocks` and `found`. Returns the mean squared residual of large planes."""
    free = np.isfinite(grid.z) & (blocks == 0)
    cos_limit = float(np.cos(max(0.26, 4.0 * grid.normal_sigma_rad)))
    tried = np.zeros(free.shape, np.bool_)
    order = grow.seed_order(grid.normal, grid.rms, free, grid.radius + 1)
    planes, counts, mean2 = grow.grow_planes(
        grid.x, grid.y, grid.z, grid.sigma, grid.normal, grid.rms, free, blocks, len(found.kinds) + 1,
        grid.perspective, order, least, cos_limit, tried,
    )
    for th in planes:
        found.add(PLANE, th)
    large = counts >= LARGE_PLANE_BLOCKS
    return float(np.average(mean2[large], weights=counts[large])) if large.any() else 0.0


def _recover_curved(
    grid: Grid, packed: Array, free: Flags, blocks: Labels, *, found: Candidates, least: int
) -> None:
    dead = np.zeros(free.shape, np.bool_)
    turn_limit = float(np.cos(max(0.7, 5.0 * grid.normal_sigma_rad)))
    step = STEEP_SLOPE * grid.size_px
    for _ in range(ROUNDS):
        label, sizes = grow.range_components(
            grid.z, grid.sigma, free & ~dead, step, 1.0 / packed[1], grid.perspective, grid.normal, grid.rms,
            turn_limit,
        )
        big = np.flatnonzero(sizes >= least)
        if big.size == 0:
            return
        big = big[np.argsort(-sizes[big], kind="stable")][:MOST_COMPONENTS]
        starts, indices = bucket(label, sizes.size - 1)
        for component in big:
            members = indices[starts[component] : starts[component + 1]].astype(np.int64)
            members = members[free.ravel()[members]]
            if members.size < least:
                continue
            if not _explain(grid, members, free, blocks, found=found, least=least):
                dead.ravel()[members] = True


def _explain(
    grid: Grid, members: NDArray[np.int64], free: Flags, blocks: Labels, *, found: Candidates, least: int
) -> bool:
    whole = _fit_best(grid, members)
    options = [] if whole is None else [whole]
    if whole is None or whole[2] < 0.85:
        options += _local_fits(grid, members)
    best, best_gain, best_blocks = None, 0.0, np.empty(0, np.int32)
    for kind, th, _ in options:
        indices, total = _grown(grid, kind, th, free, members)
        if indices.size < least or total > GOOD_MEAN_SQUARE * indices.size:
            continue
        gain = 9.0 * indices.size - total
        if gain > best_gain:
            best, best_gain, best_blocks = (kind, th), gain, indices
    if best is None:
        return False
    kind, th = best
    if whole is None or best_blocks.size < 0.9 * members.size:
        refit = _fit_best(grid, best_blocks.astype(np.int64))
        if refit is not None:
            kind, th = refit[0], refit[1]
    label = found.add(kind, th)
    blocks.ravel()[best_blocks] = label
    free.ravel()[best_blocks] = False
    return True


def _fit_best(grid: Grid, members: NDArray[np.int64]) -> tuple[int, Array, float] | None:
    """Cheapest kind for these blocks with its parameters and the share that it explains, or None."""
    normals = grid.normal.reshape(-1, 3)
    if members.size < 5:
        return None
    # Evenly spread over the region; a fixed choice keeps results equal from run to run.
    pick = members if members.size <= FIT_SAMPLES else members[_spread(members.size, FIT_SAMPLES)]
    x, y, z, sigma = (a.ravel()[pick] for a in (grid.x, grid.y, grid.z, grid.sigma))
    points = np.stack([x * z, y * z, z] if grid.perspective else [x, y, z], axis=1)
    kinds = ALL_KINDS.copy()
    if members.size < FEW_BLOCKS_FOR_QUADRIC:
        kinds[QUADRIC] = False
    known = np.isfinite(normals[pick, 0])
    if known.sum() < 10:
        kinds[[SPHERE, CYLINDER, CONE]] = False
    ths, mean2, kept, score = fit.fit_kinds(
        points, points[known], normals[pick[known]], x, y, z, sigma, grid.perspective, kinds,
        _correlated_samples(grid, pick.size, members.size),
    )
    score = np.where((mean2 < GOOD_MEAN_SQUARE) & (kept > GOOD_SHARE), score, np.inf)
    best = int(np.argmin(score))
    if not np.isfinite(score[best]):
        return None
    return best, ths[best], float(kept[best])


def _correlated_samples(grid: Grid, samples: int, blocks: int) -> float:
    """How many samples count as one, because slow noise covers them together."""
    patches = max(blocks * grid.size_px**2 / SLOW_NOISE_AREA_PX, 1.0)
    return 1.0 + grid.slow_share * max(samples / patches - 1.0, 0.0)


def _spread(size: int, count: int) -> NDArray[np.int64]:
    return np.linspace(0, size - 1, count).astype(np.int64)


def _local_fits(grid: Grid, members: NDArray[np.int64]) -> list[tuple[int, Array, float]]:
    """Fits to small neighbourhoods spread over a component that no single primitive explains."""
    w = grid.z.shape[1]
    rows, columns = members // w, members % w
    inside = np.isfinite(grid.rms.ravel()[members])
    if inside.sum() < 8:
        return []
    out = []
    seeds = np.flatnonzero(inside)[np.linspace(0, inside.sum() - 1, LOCAL_TRIES + 2).astype(int)[1:-1]]
    reach = np.sqrt(LOCAL_BLOCKS / np.pi)
    for seed in seeds:
        near = np.hypot(rows - rows[seed], columns - columns[seed]) <= reach
        best = _fit_best(grid, members[near])
        if best is not None:
            out.append(best)
    return out


def _grown(
    grid: Grid, kind: int, th: Array, free: Flags, members: NDArray[np.int64]
) -> tuple[NDArray[np.int32], float]:
    h, w = grid.z.shape
    queue = np.empty(h * w, np.int32)
    mark = np.zeros(h * w, np.uint8)
    cos_limit = float(np.cos(max(0.5, 4.0 * grid.normal_sigma_rad)))
    count, total = grow.grow_surface(
        kind, th, grid.x, grid.y, grid.z, grid.sigma, grid.normal, grid.rms, free, members, grid.perspective,
        cos_limit, mark, 1, queue,
    )
    return queue[:count].copy(), float(total)
