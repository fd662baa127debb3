"""Segmentation: lowest order first, and models compete.

1. Planes grow from the flattest blocks while their own model explains the next block (range and orientation).
2. What is left falls into components of smooth range; each is offered to every primitive, and the cheapest that
   explains it wins (Schwarz's criterion). A component that no primitive explains is split by growing local fits.
3. Pieces of one surface that an occluder parted are joined when one model explains both.
4. Pixels are claimed by the surface that explains them best; what no block could hold is tried again pixel by pixel.
Each round leaves fewer free blocks, and rounds end when no surface is added.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
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

Labels = NDArray[np.int32]

LEAST_PIXELS_AT_256 = 32  # per 256 x 256 pixels of image
LEAST_FLAT_BLOCKS = 24  # a smaller flat patch may be a facet of something bent; whole components decide about it
LEAST_CURVED_BLOCKS = 16  # smaller things wait for the pixels themselves
STEEP_SLOPE = 14.0  # what is left once the large surfaces are named may be seen as steep as 86 degrees
LARGE_PLANE_BLOCKS = 80
SETTLED_MEAN_SQUARE = 1.25  # residuals cut at three sigmas; wider noise than modelled drives them to 1.5 and more
WIDER = 1.5
WIDENINGS = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Task:
    """What every step needs: the (H, W) depth in metres, the sensor, and how many tiles share the pixel work.

    The depth may be a part of the sensor's image, which begins at row and column `corner_px`. `depths_m` (5,): the
    whole image's `typical_depths_m`. `packed` (5,): the sensor of this part of the image, as compiled loops read it.
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
        """Pixels of the smallest surface that is looked for."""
        return LEAST_PIXELS_AT_256 * self.sensor.width_px * self.sensor.height_px / 65536

    def grid(self, depth_m: Array, noise: NoiseModel, size: int, **slope: float) -> Grid:
        """Blocks of `size` pixels of a depth image of this task's sensor."""
        return build_grid(
            depth_m, self.sensor, noise, size, corner_px=self.corner_px, tiles=self.tiles, pool=self.pool, **slope
        )


def segment(task: Task, noise: NoiseModel) -> tuple[Labels, Candidates, NoiseModel]:
    """Segment a depth image.

    Returns:
        labels (H, W), 0 = none; the surfaces behind them; and the noise model, widened where the planes of the image
        themselves scatter more than the given one says.
    """
    found, grid, blocks, noise = _settled_planes(task, noise)
    size = grid.size_px
    least = max(LEAST_CURVED_BLOCKS if size > 1 else 6, round(task.least_pixels / size**2))
    select_models(grid, blocks, found=found, least=least, slope=STEEP_SLOPE, focal_px=float(task.packed[1]))
    labels = _claimed(task, noise, blocks, found, size=size)
    if size > 1:
        labels = _finer(task, noise, labels, found, size=(size + 1) // 2)
    return labels, found, noise


def _settled_planes(task: Task, noise: NoiseModel) -> tuple[Candidates, Grid, Labels, NoiseModel]:
    """Planes on the coarse grid, grown again under wider noise while large planes scatter more than it allows."""
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


def _finer(task: Task, noise: NoiseModel, labels: Labels, found: Candidates, *, size: int) -> Labels:
    """Surfaces too small for the coarse blocks, from the pixels that nothing explains yet; returns new labels.

    Only patches that can hold the smallest surface are looked at, and only the part of the image that holds them.
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
    select_models(grid, blocks, found=found, least=least, slope=STEEP_SLOPE, focal_px=float(task.packed[1]))
    if len(found.kinds) == before:
        return labels
    inside = labels[top : top + left_over.shape[0], left : left + left_over.shape[1]]
    inside[:] = np.where(inside > 0, inside, _claimed(part, noise, blocks, found, size=size))
    return _reclaimed(task, noise, labels, found, newest=before + 1)


def _claimed(task: Task, noise: NoiseModel, blocks: Labels, found: Candidates, *, size: int) -> Labels:
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


def _reclaimed(task: Task, noise: NoiseModel, labels: Labels, found: Candidates, *, newest: int) -> Labels:
    """`labels`, changed in place: the pixels beside surfaces of label `newest` and later are judged again."""
    rows, columns = _contested(task, labels, newest)
    judge = partial(reassign_pixels, task.depth_m, task.packed, noise.packed(), labels, *found.arrays())
    _judged(task, judge, labels, rows, columns)
    return labels


def icm_labels(task: Task, noise: NoiseModel, labels: Labels, found: Candidates, *, sweeps: int) -> Labels:
    """`labels`, changed in place by `sweeps` in which pixels between two equally good surfaces follow their neighbours."""
    slow = noise.slow_share(float(task.depths_m[2]))
    judge = partial(icm_sweep, task.depth_m, task.packed, noise.packed(), slow, labels, *found.arrays())
    rows, columns = _contested(task, labels, 1)
    for _ in range(sweeps):
        moved = _judged(task, judge, labels, rows, columns)
        # Around what did not move, every pixel would be judged as it was.
        rows, columns = pixels_around(*moved, REACH_PX, labels.shape)
    return labels


def _contested(task: Task, labels: Labels, newest: int) -> tuple[Labels, Labels]:
    """`contested_pixels` of the whole image."""
    parts: dict[int, tuple[Labels, Labels]] = {}

    def look(top: int, bottom: int) -> None:
        parts[top] = contested_pixels(labels, newest, top, bottom)

    for_each_tile(look, labels.shape[0], task.tiles, pool=task.pool)
    rows, columns = zip(*(parts[top] for top in sorted(parts)), strict=True)
    return np.concatenate(rows), np.concatenate(columns)


def _judged(
    task: Task, judge: Callable[..., object], labels: Labels, rows: Labels, columns: Labels
) -> tuple[Labels, Labels]:
    """Have all the pixels judged by the labels as they are, then name them, in place; returns those that moved."""
    names = np.empty_like(rows)
    for_each_tile(partial(judge, rows, columns, names), rows.size, task.tiles, pool=task.pool)
    moved: tuple[Labels, Labels] = renamed_pixels(labels, rows, columns, names)
    return moved


def _recover_planes(task: Task, grid: Grid, blocks: Labels, found: Candidates) -> float:
    """Grow planes over the grid; extends `blocks` and `found`. Returns the mean squared residual of large planes."""
    free = np.isfinite(grid.z) & (blocks == 0)
    least = max(LEAST_FLAT_BLOCKS, round(task.least_pixels / grid.size_px**2))
    cos_limit = float(np.cos(max(0.26, 4.0 * grid.normal_sigma_rad)))
    tried = np.zeros(free.shape, np.bool_)
    order = seed_order(grid.normal, grid.rms, free, grid.radius + 1)
    planes, counts, mean2 = grow_planes(
        grid.x,
        grid.y,
        grid.z,
        grid.sigma,
        grid.normal,
        grid.rms,
        free,
        blocks,
        len(found.kinds) + 1,
        grid.perspective,
        order,
        least,
        cos_limit,
        tried,
    )
    for th in planes:
        found.add(PLANE, th)
    large = counts >= LARGE_PLANE_BLOCKS
    return float(np.average(mean2[large], weights=counts[large])) if large.any() else 0.0
