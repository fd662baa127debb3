"""Model selection for a smooth component: all kinds of primitives are fitted, and Schwarz's criterion selects one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Indices
from hal.jit import compiled
from perception.range.fitting import fit
from perception.range.fitting.surfaces import QUADRIC, SIZE
from perception.range.segmentation.finish import SLOW_NOISE_AREA_PX
from perception.range.segmentation.grid import Grid
from perception.range.segmentation.grow_surface import GROW_SIGMAS, grow_surface
from perception.range.segmentation.links import smooth_components

Labels = NDArray[np.int32]
Flags = NDArray[np.bool_]

ROUNDS = 6
MOST_COMPONENTS = 48  # per round
MOST_ATTEMPTS = 120  # per grid; bounds the time spent on irregular scenes
FIT_SAMPLES = 90
GOOD_MEAN_SQUARE = 2.0  # squared sigmas; largest mean square of a surface that explains its blocks
GOOD_SHARE = 0.75  # least share of the samples within the trim of such a surface
WHOLE_SHARE = 0.85  # if a fit to the whole component explains less, fits to parts of it are tried as well
LOCAL_BLOCKS = 45  # in such a part
LOCAL_TRIES = 5  # number of such parts
FEW_BLOCKS_FOR_QUADRIC = 60  # a quadric is not fitted to smaller components
GIVE_UP = 14.0  # mean square of a rough fit above which a kind is dropped; one that can succeed has 8 at most

Fit = Callable[[Indices], tuple[int, Array, float]]
"""A function of the flat indices of blocks that returns the best kind, its parameters and the share explained."""


@dataclass(slots=True, eq=False)
class Candidates:
    """Surfaces found so far: label k has kind `kinds[k - 1]` and parameters `parameters[k - 1]` (16,)."""

    kinds: list[int] = field(default_factory=list)
    parameters: list[Array] = field(default_factory=list)

    def add(self, kind: int, parameters: Array) -> int:
        """Append a surface and return its label."""
        self.kinds.append(kind)
        self.parameters.append(parameters)
        return len(self.kinds)

    def arrays(self) -> tuple[NDArray[np.int64], Array]:
        """Return the kinds (n + 1,) and parameters (n + 1, 16) for compiled loops; entry 0 is unused."""
        kinds = np.array([0, *self.kinds], np.int64)
        table = np.array([np.zeros(SIZE), *self.parameters])
        return kinds, table


def select_models(grid: Grid, blocks: Labels, *, found: Candidates, least: int, slope: float, focal_px: float) -> None:
    """Fit all kinds of primitives to each smooth component of unlabelled blocks, until a round finds no component.

    The surface that explains most of a component is assigned the blocks it explains, if there are at least `least`.
    Extends `blocks` (h, w) and `found`. `slope`: largest slope, metres of depth per metre across, that is not a jump.
    """
    free: Flags = np.isfinite(grid.z) & (blocks == 0)
    turn_limit = float(np.cos(max(0.7, 5.0 * grid.normal_sigma_rad)))
    cos_limit = float(np.cos(max(0.5, 4.0 * grid.normal_sigma_rad)))
    flat_free, flat_blocks = free.ravel(), blocks.ravel()
    fit_of, attempts, left = _fit_of(grid), 0, np.flatnonzero(flat_free)
    for _ in range(ROUNDS):
        starts, indices = smooth_components(
            left, grid.z, grid.sigma, free, slope * grid.size_px, 1.0 / focal_px, grid.perspective, grid.normal, grid.rms,
            turn_limit, least, MOST_COMPONENTS,
        )  # fmt: skip
        count = len(starts) - 1
        if count == 0 or attempts >= MOST_ATTEMPTS:
            break
        attempts += count
        for k in range(count):
            members = indices[starts[k] : starts[k + 1]]
            members = members[flat_free[members]]
            best = _best_model(grid, fit_of, cos_limit, free, members, least) if len(members) >= least else None
            if best is None:
                # Blocks that no surface explains now are not tried again, because later rounds would fail as well.
                flat_free[members] = False
            else:
                kind, th, mine = best
                flat_blocks[mine] = found.add(kind, th)
                flat_free[mine] = False
        left = left[flat_free[left]]


def _best_model(
    grid: Grid, fit_of: Fit, cos_limit: float, free: Flags, members: Indices, least: int
) -> tuple[int, Array, Indices] | None:
    """Return kind, parameters and blocks (flat indices) of the surface that explains most of `members`; None if none does."""
    kind, th, share = fit_of(members)
    fits = [(kind, th)]
    if kind < 0 or share < WHOLE_SHARE:
        fits += [fit_of(part)[:2] for part in _parts(grid, members)]
    queue, mark = np.empty(grid.z.size, np.int64), np.zeros(grid.z.size, np.uint8)
    best, best_gain, mine = -1, 0.0, queue[:0]
    for k, (kind, th) in enumerate(fits):
        if kind < 0:
            continue
        count, total = grow_surface(
            kind, th, grid.x, grid.y, grid.z, grid.sigma, grid.normal, grid.rms, free, members, grid.perspective, cos_limit,
            mark, k + 1, queue,
        )  # fmt: skip
        gain = GROW_SIGMAS**2 * count - total
        if count >= least and total <= GOOD_MEAN_SQUARE * count and gain > best_gain:
            best, best_gain, mine = k, gain, queue[:count].copy()
    if best < 0:
        return None
    if best > 0 or len(mine) < 0.9 * len(members):
        kind, th, _ = fit_of(mine)
        if kind >= 0:
            return kind, th, mine
    return *fits[best], mine


def _parts(grid: Grid, members: Indices) -> Iterator[Indices]:
    """Yield the blocks around each of some seeds that are evenly spread over `members`."""
    inside = members[np.isfinite(grid.rms.ravel()[members])]
    width = grid.z.shape[1]
    if len(inside) < LOCAL_TRIES + 2:
        return
    rows, columns = np.divmod(members, width)
    for t in range(LOCAL_TRIES):
        row, column = divmod(int(inside[((t + 1) * (len(inside) - 1)) // (LOCAL_TRIES + 1)]), width)
        yield members[(rows - row) ** 2 + (columns - column) ** 2 <= LOCAL_BLOCKS / np.pi]


def _fit_of(grid: Grid) -> Fit:
    """Return `_fit_blocks` for the blocks of a grid, as a function of their flat indices."""
    x, y, z, sigma = (a.ravel() for a in (grid.x, grid.y, grid.z, grid.sigma))
    normal = grid.normal.reshape(-1, 3)
    return partial(_fit_blocks, x, y, z, sigma, normal, grid.perspective, grid.size_px**2, grid.slow_share)


@compiled
def _fit_blocks(
    x: Array, y: Array, z: Array, sigma: Array, normal: Array, perspective: bool, pixels: int, slow_share: float,
    members: Indices,
) -> tuple[int, Array, float]:  # fmt: skip
    """Fit all kinds to the blocks `members` (flat indices); returns the best kind, its parameters (16,) and share explained.

    The kind is -1 if none explains the blocks. `pixels`: number of pixels per block. `slow_share`: as in `Grid`.
    """
    count = members.shape[0]
    if count < 5:
        return -1, np.zeros(SIZE), 0.0
    # Samples are evenly spread over the region; a deterministic choice makes results repeatable.
    n = min(count, FIT_SAMPLES)
    points, P, N = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    few = np.empty((4, n))
    known = 0
    for k in range(n):
        i = members[k if count == n else (k * (count - 1)) // (n - 1)]
        scale = z[i] if perspective else 1.0
        few[0, k], few[1, k], few[2, k], few[3, k] = x[i], y[i], z[i], sigma[i]
        points[k, 0], points[k, 1], points[k, 2] = x[i] * scale, y[i] * scale, z[i]
        if np.isfinite(normal[i, 0]):
            P[known], N[known] = points[k], normal[i]
            known += 1
    kinds = np.ones(5, np.bool_)
    kinds[QUADRIC] = count >= FEW_BLOCKS_FOR_QUADRIC
    # Slow noise is common to neighbouring samples, so `correlated` samples count as one independent sample.
    patches = max(count * pixels / SLOW_NOISE_AREA_PX, 1.0)
    correlated = 1.0 + slow_share * max(n / patches - 1.0, 0.0)
    ths, mean2, kept, score = fit.fit_kinds(
        points, P[:known], N[:known], few[0], few[1], few[2], few[3], perspective, kinds, correlated, GIVE_UP
    )
    best, least = -1, np.inf
    for k in range(5):
        if mean2[k] < GOOD_MEAN_SQUARE and kept[k] > GOOD_SHARE and score[k] < least:
            best, least = k, score[k]
    return best, ths[best].copy(), kept[best]
