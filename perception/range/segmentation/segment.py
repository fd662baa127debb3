"""Segmentation of a depth image: planes first, then model selection among all primitives.

1. Planes grow from the flattest blocks for as long as their model explains the next block in range and orientation.
2. The remaining blocks form components of smooth range. Every kind of primitive is fitted to each component, and
   Schwarz's criterion selects one. A component that no primitive explains is split by growing local fits.
3. Each pixel is assigned to the neighbouring surface that explains it best.
4. Steps 1 to 3 are repeated with smaller blocks on patches that are still unlabelled.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from hal.arrays import Array, Labels
from perception.range.fitting.surfaces import PLANE
from perception.range.noise import WORST_SHARE, NoiseModel
from perception.range.segmentation.boundary_pixels import contested_pixels, pixels_around, renamed_pixels
from perception.range.segmentation.grid import Grid, block_size, build_grid, seen_from
from perception.range.segmentation.grow_planes import grow_planes
from perception.range.segmentation.icm import REACH_PX, icm_sweep
from perception.range.segmentation.model_selection import Candidates, select_models
from perception.range.segmentation.pixel_assignment import assign_pixels, reassign_pixels
from perception.range.segmentation.seeds import seed_order
from perception.range.segmentation.unlabelled import unlabelled_patches
from perception.range.sensor import RangeSensorModel
from perception.range.tiles import for_each_tile

LEAST_PIXELS_AT_256 = 32  # pixels of the smallest surface in an image of 256 x 256 pixels
LEAST_FLAT_BLOCKS = 24  # a smaller flat patch may be a facet of a curved surface, so model selection decides about it
LEAST_CURVED_BLOCKS = 16  # smaller surfaces are searched for with smaller blocks
STEEP_SLOPE = 14.0  # blocks that remain after the large surfaces are found may be tilted by up to 86 degrees
LARGE_PLANE_BLOCKS = 80  # planes of so many blocks show whether the noise model is right
SETTLED_MEAN_SQUARE = 1.25  # of residuals cut at three sigmas; noise wider than modelled gives 1.5 and more
WIDER = 1.5  # factor by which the noise model is widened at a time
WIDENINGS = 5  # at most


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Task:
    """Input of every step of the segmentation.

    Attributes:
        depth_m: (H, W) depth in metres; the sensor's image, or the part of it that begins at `corner_px`.
        sensor: model of the whole image.
        depths_m: (5,) `typical_depths_m` of the whole image.
        tiles, pool: number of parts in which pixels are processed in parallel, and the threads for them.
        corner_px: row and column of the sensor's image at which `depth_m` begins.
        packed: (5,) the sensor of this part of the image, in the form that kernels read.
    """

    depth_m: Array
    sensor: RangeSensorModel
    depths_m: Array
    tiles: int = 1
    pool: ThreadPoolExecutor | None = None
    corner_px: tuple[int, int] = (0, 0)
    packed: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "packed", seen_from(self.sensor, self.corner_px))

    @property
    def least_pixels(self) -> float:
        """Number of pixels of the smallest surface that is searched for."""
        return LEAST_PIXELS_AT_256 * self.sensor.width_px * self.sensor.height_px / 65536

    def grid(self, depth_m: Array, noise: NoiseModel, size: int, **slope: float) -> Grid:
        """Build the grid of blocks of `size` pixels of a depth image from this task's sensor."""
        return build_grid(
            depth_m, self.sensor, noise, size, corner_px=self.corner_px, tiles=self.tiles, pool=self.pool, **slope
        )


def segment(task: Task, noise: NoiseModel) -> tuple[Labels, Candidates, NoiseModel]:
    """Segment a depth image.

    Returns:
        labels (H, W), 0 = none; the surfaces that they index; and the noise model, widened if the residuals of the
        large planes are larger than the given one allows.
    """
    found, grid, blocks, noise = _planes_and_noise(task, noise)
    size = grid.size_px
    least = max(LEAST_CURVED_BLOCKS if size > 1 else 6, round(task.least_pixels / size**2))
    select_models(grid, blocks, found=found, least=least, slope_per_px=STEEP_SLOPE / float(task.packed[1]))
    labels = _assign_all_pixels(task, noise, blocks, found, size=size)
    if size > 1:
        labels = _add_small_surfaces(task, noise, labels, found, size=(size + 1) // 2)
    return labels, found, noise


def _planes_and_noise(task: Task, noise: NoiseModel) -> tuple[Candidates, Grid, Labels, NoiseModel]:
    """Grow planes on the coarse grid; repeat with wider noise while large planes scatter more than it allows."""
    depths = task.depths_m
    shape = (task.depth_m.shape[0], task.depth_m.shape[1])
    for attempt in range(WIDENINGS + 1):
        size = block_size(shape, noise, task.sensor, float(depths[2]))
        grid = task.grid(task.depth_m, noise, size)
        blocks = np.zeros(grid.z.shape, np.int32)
        found = Candidates()
        scatter = _recover_planes(task, grid, blocks, found)
        worst = noise.sigma_of(float(depths[2])) * WIDER > WORST_SHARE * abs(float(depths[2]))
        if scatter <= SETTLED_MEAN_SQUARE or attempt == WIDENINGS or worst:
            break
        noise = noise.widened(WIDER, depths)
    return found, grid, blocks, noise


def _add_small_surfaces(task: Task, noise: NoiseModel, labels: Labels, found: Candidates, *, size: int) -> Labels:
    """Find surfaces that are too small for the coarse blocks among the unlabelled pixels; returns the new labels.

    Only patches that are large enough for the smallest surface are processed, and only the part of the image around
    them.
    """
    least = max(8, round(task.least_pixels / size**2))
    patches = unlabelled_patches(task.depth_m, labels, least if size == 1 else least * size**2 // 2, align_px=size)
    if patches is None:
        return labels
    (top, left), left_over = patches
    part = replace(task, depth_m=left_over, corner_px=(top, left))
    grid = part.grid(left_over, noise, size, jump_slope=STEEP_SLOPE)
    blocks = np.zeros(grid.z.shape, np.int32)
    before = len(found.kinds)
    _recover_planes(part, grid, blocks, found)
    select_models(grid, blocks, found=found, least=least, slope_per_px=STEEP_SLOPE / float(task.packed[1]))
    if len(found.kinds) == before:
        return labels
    inside = labels[top : top + left_over.shape[0], left : left + left_over.shape[1]]
    inside[:] = np.where(inside > 0, inside, _assign_all_pixels(part, noise, blocks, found, size=size))
    return _reassign_beside(task, noise, labels, found, newest=before + 1)


def _assign_all_pixels(task: Task, noise: NoiseModel, blocks: Labels, found: Candidates, *, size: int) -> Labels:
    """Assign every pixel to the best surface of the blocks around it; returns labels (H, W)."""
    labels = np.zeros(task.depth_m.shape, np.int32)
    kinds, table = found.arrays()
    packed, law = task.packed, noise.packed()
    for_each_tile(
        lambda top, bottom: assign_pixels(task.depth_m, packed, law, blocks, size, kinds, table, labels, top, bottom),
        blocks.shape[0],
        task.tiles,
        pool=task.pool,
    )
    return labels


def _reassign_beside(task: Task, noise: NoiseModel, labels: Labels, found: Candidates, *, newest: int) -> Labels:
    """Reassign the pixels beside surfaces of label `newest` and later; returns `labels`, changed in place."""
    rows, columns = _contested_of_image(task, labels, newest)
    judge = partial(reassign_pixels, task.depth_m, task.packed, noise.packed(), labels, *found.arrays())
    _relabel(task, judge, labels, rows, columns)
    return labels


def icm_labels(task: Task, noise: NoiseModel, labels: Labels, found: Candidates, *, sweeps: int) -> Labels:
    """Reassign pixels that several surfaces explain by their neighbours' labels, in `sweeps` iterations (see `icm`).

    Returns `labels`, changed in place.
    """
    slow = noise.slow_share(float(task.depths_m[2]))
    judge = partial(icm_sweep, task.depth_m, task.packed, noise.packed(), slow, labels, *found.arrays())
    rows, columns = _contested_of_image(task, labels, 1)
    for _ in range(sweeps):
        moved = _relabel(task, judge, labels, rows, columns)
        # The decision for a pixel can change only if a label around it has changed.
        rows, columns = pixels_around(*moved, REACH_PX, labels.shape)
    return labels


def _contested_of_image(task: Task, labels: Labels, newest: int) -> tuple[Labels, Labels]:
    """Return rows and columns of the `contested_pixels` of the whole image, computed in tiles."""
    parts: dict[int, tuple[Labels, Labels]] = {}

    def look(top: int, bottom: int) -> None:
        parts[top] = contested_pixels(labels, newest, top, bottom)

    for_each_tile(look, labels.shape[0], task.tiles, pool=task.pool)
    rows, columns = zip(*(parts[top] for top in sorted(parts)), strict=True)
    return np.concatenate(rows), np.concatenate(columns)


def _relabel(
    task: Task, judge: Callable[..., object], labels: Labels, rows: Labels, columns: Labels
) -> tuple[Labels, Labels]:
    """Compute new labels of the pixels with `judge`, all from the current labels, and only then write them.

    Returns rows and columns of the pixels that changed.
    """
    names = np.empty_like(rows)
    for_each_tile(partial(judge, rows, columns, names), rows.size, task.tiles, pool=task.pool)
    moved: tuple[Labels, Labels] = renamed_pixels(labels, rows, columns, names)
    return moved


def _recover_planes(task: Task, grid: Grid, blocks: Labels, found: Candidates) -> float:
    """Grow planes over the grid; extends `blocks` and `found`. Returns the mean squared residual of large planes."""
    free = np.isfinite(grid.z) & (blocks == 0)
    least = max(LEAST_FLAT_BLOCKS, round(task.least_pixels / grid.size_px**2))
    cos_limit = float(np.cos(max(0.26, 4.0 * grid.normal_sigma_rad)))
    order = seed_order(grid, free, grid.radius + 1)
    planes, counts, mean2 = grow_planes(grid, free, blocks, len(found.kinds) + 1, order, least, cos_limit)
    for th in planes:
        found.add(PLANE, th)
    large = counts >= LARGE_PLANE_BLOCKS
    return float(np.average(mean2[large], weights=counts[large])) if large.any() else 0.0
