"""Model selection for a smooth component: all kinds of primitives are fitted, and Schwarz's criterion selects one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from hal.arrays import Array, Indices, Labels, Mask
from hal.jit import compiled
from perception.range.fitting.fit import fit_kinds
from perception.range.fitting.surfaces import QUADRIC, SIZE
from perception.range.segmentation.finish import SLOW_NOISE_AREA_PX
from perception.range.segmentation.grid import Grid
from perception.range.segmentation.grow_surface import GROW_SIGMAS, grow_surface
from perception.range.segmentation.links import smooth_components

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

    def arrays(self) -> tuple[Indices, Array]:
        """Return the kinds (n + 1,) and parameters (n + 1, 16) for compiled loops; entry 0 is unused."""
        kinds = np.array([0, *self.kinds], np.int64)
        table = np.array([np.zeros(SIZE), *self.parameters])
        return kinds, table


def select_models(grid: Grid, blocks: Labels, *, found: Candidates, least: int, slope_per_px: float) -> None:
    """Fit all kinds of primitives to each smooth component of unlabelled blocks, until a round finds no component.

    The surface that explains most of a component is assigned the blocks it explains, if there are at least `least`.
    Extends `blocks` (h, w) and `found`. `slope_per_px`: largest step that is not a jump, metres per pixel (and per metre of
    depth, if the sensor is a pinhole).
    """
    free = np.isfinite(grid.z) & (blocks == 0)
    turn_limit = float(np.cos(max(0.7, 5.0 * grid.normal_sigma_rad)))
    cos_limit = float(np.cos(max(0.5, 4.0 * grid.normal_sigma_rad)))
    flat_free, flat_blocks = free.ravel(), blocks.ravel()
    attempts, left, step = 0, np.flatnonzero(flat_free), slope_per_px * grid.size_px
    for _ in range(ROUNDS):
        starts, indices = smooth_components(left, grid, free, step, turn_limit, least, MOST_COMPONENTS)
        count = len(starts) - 1
        if count == 0 or attempts >= MOST_ATTEMPTS:
            break
        attempts += count
        for k in range(count):
            members = indices[starts[k] : starts[k + 1]]
            members = members[flat_free[members]]
            best = _best_model(grid, cos_limit, free, members, least) if len(members) >= least else None
            if best is None:
                # Blocks that no surface explains now are not tried again, because later rounds would fail as well.
                flat_free[members] = False
            else:
                kind, th, mine = best
                flat_blocks[mine] = found.add(kind, th)
                flat_free[mine] = False
        left = left[flat_free[left]]


def _best_model(
    grid: Grid, cos_limit: float, free: Mask, members: Indices, least: int
) -> tuple[int, Array, Indices] | None:
    """Return kind, parameters and blocks (flat indices) of the surface that explains most of `members`; None if none does."""
    kind, th, share = _fit_blocks(grid, members)
    fits = [(kind, th)]
    if kind < 0 or share < WHOLE_SHARE:
        fits += [_fit_blocks(grid, part)[:2] for part in _parts(grid, members)]
    queue, mark = np.empty(grid.z.size, np.int64), np.zeros(grid.z.size, np.uint8)
    best, best_gain, mine = -1, 0.0, queue[:0]
    for k, (kind, th) in enumerate(fits):
        if kind < 0:
            continue
        count, total = grow_surface(kind, th, grid, free, members, cos_limit, mark, k + 1, queue)
        gain = GROW_SIGMAS**2 * count - total
        if count >= least and total <= GOOD_MEAN_SQUARE * count and gain > best_gain:
            best, best_gain, mine = k, gain, queue[:count].copy()
    if best < 0:
        return None
    if best > 0 or len(mine) < 0.9 * len(members):
        kind, th, _ = _fit_blocks(grid, mine)
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


@compiled
def _fit_blocks(grid: Grid, members: Indices) -> tuple[int, Array, float]:
    """Fit all kinds to the blocks `members` (flat indices); returns the best kind, its parameters (16,) and share explained.

    The kind is -1 if none explains the blocks.
    """
    count = members.shape[0]
    if count < 5:
        return -1, np.zeros(SIZE), 0.0
    # Samples are evenly spread over the region; a deterministic choice makes results repeatable.
    n = min(count, FIT_SAMPLES)
    few, normals = np.empty((4, n)), np.empty((n, 3))
    for k in range(n):
        i = members[k if count == n else (k * (count - 1)) // (n - 1)]
        r, c = i // grid.z.shape[1], i % grid.z.shape[1]
        few[0, k], few[1, k], few[2, k], few[3, k] = grid.x[r, c], grid.y[r, c], grid.z[r, c], grid.sigma[r, c]
        for a in range(3):
            normals[k, a] = grid.normal[r, c, a]
    kinds = np.ones(5, np.bool_)
    kinds[QUADRIC] = count >= FEW_BLOCKS_FOR_QUADRIC
    # Slow noise is common to neighbouring samples, so `correlated` samples count as one independent sample.
    patches = max(count * grid.size_px**2 / SLOW_NOISE_AREA_PX, 1.0)
    correlated = 1.0 + grid.slow_share * max(n / patches - 1.0, 0.0)
    ths, mean2, kept, score = fit_kinds(few, normals, grid.perspective, kinds, correlated, GIVE_UP)
    best, least = -1, np.inf
    for k in range(5):
        if mean2[k] < GOOD_MEAN_SQUARE and kept[k] > GOOD_SHARE and score[k] < least:
            best, least = k, score[k]
    return best, ths[best].copy(), kept[best]
