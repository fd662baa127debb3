"""Models compete for one smooth component: every primitive is offered, the cheapest that explains it wins."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from perception.range import fit, grow
from perception.range.finish import SLOW_NOISE_AREA_PX
from perception.range.grid import Grid
from perception.range.surfaces import CONE, CYLINDER, QUADRIC, SIZE, SPHERE

Array = NDArray[np.float64]
Labels = NDArray[np.int32]
Flags = NDArray[np.bool_]

FIT_SAMPLES = 90
GOOD_MEAN_SQUARE = 2.0
GOOD_SHARE = 0.75
WHOLE_SHARE = 0.85  # a fit to the whole component that explains less has rivals grown from parts of it
LOCAL_BLOCKS = 45
LOCAL_TRIES = 5
ALL_KINDS = np.ones(5, np.bool_)
FEW_BLOCKS_FOR_QUADRIC = 60
LEAST_NORMALS = 10


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """A surface that explains `share` of the blocks it was fitted to."""

    kind: int
    parameters: Array
    share: float


def explain(
    grid: Grid, members: NDArray[np.int64], free: Flags, blocks: Labels, *, found: Candidates, least: int
) -> bool:
    """Find the surface that explains most of the component `members` (flat block indices) and take its blocks.

    Extends `blocks` and `found`, clears `free`. Returns whether a surface of at least `least` blocks was found.
    """
    whole = fit_best(grid, members)
    options = [] if whole is None else [whole]
    if whole is None or whole.share < WHOLE_SHARE:
        options += _local_fits(grid, members)
    best, best_gain, best_blocks = None, 0.0, np.empty(0, np.int32)
    for option in options:
        indices, total = _grown(grid, option, free, members)
        if indices.size < least or total > GOOD_MEAN_SQUARE * indices.size:
            continue
        gain = grow.GROW_SIGMAS**2 * indices.size - total
        if gain > best_gain:
            best, best_gain, best_blocks = option, gain, indices
    if best is None:
        return False
    if best is not whole or best_blocks.size < 0.9 * members.size:
        best = fit_best(grid, best_blocks.astype(np.int64)) or best
    blocks.ravel()[best_blocks] = found.add(best.kind, best.parameters)
    free.ravel()[best_blocks] = False
    return True


def fit_best(grid: Grid, members: NDArray[np.int64]) -> Fit | None:
    """The kind that explains these blocks most cheaply, or None when none does."""
    if members.size < 5:
        return None
    normals = grid.normal.reshape(-1, 3)
    # Evenly spread over the region; a fixed choice keeps results equal from run to run.
    pick = members if members.size <= FIT_SAMPLES else members[_spread(members.size, FIT_SAMPLES)]
    x, y, z, sigma = (a.ravel()[pick] for a in (grid.x, grid.y, grid.z, grid.sigma))
    points = np.stack([x * z, y * z, z] if grid.perspective else [x, y, z], axis=1)
    kinds = ALL_KINDS.copy()
    kinds[QUADRIC] = members.size >= FEW_BLOCKS_FOR_QUADRIC
    known = np.isfinite(normals[pick, 0])
    kinds[[SPHERE, CYLINDER, CONE]] = int(np.count_nonzero(known)) >= LEAST_NORMALS
    ths, mean2, kept, score = fit.fit_kinds(
        points,
        points[known],
        normals[pick[known]],
        x,
        y,
        z,
        sigma,
        grid.perspective,
        kinds,
        _correlated_samples(grid, pick.size, members.size),
    )
    score = np.where((mean2 < GOOD_MEAN_SQUARE) & (kept > GOOD_SHARE), score, np.inf)
    best = int(np.argmin(score))
    if not np.isfinite(score[best]):
        return None
    return Fit(kind=best, parameters=ths[best], share=float(kept[best]))


def _correlated_samples(grid: Grid, samples: int, blocks: int) -> float:
    """How many samples count as one, because slow noise covers them together."""
    patches = max(blocks * grid.size_px**2 / SLOW_NOISE_AREA_PX, 1.0)
    return 1.0 + grid.slow_share * max(samples / patches - 1.0, 0.0)


def _spread(size: int, count: int) -> NDArray[np.int64]:
    return (np.arange(count) * (size - 1)) // (count - 1)


def _local_fits(grid: Grid, members: NDArray[np.int64]) -> list[Fit]:
    """Fits to small neighbourhoods spread over a component that no single primitive explains."""
    w = grid.z.shape[1]
    rows, columns = members // w, members % w
    inside = np.flatnonzero(np.isfinite(grid.rms.ravel()[members]))
    if inside.size < LOCAL_TRIES + 2:
        return []
    reach2 = LOCAL_BLOCKS / np.pi
    out = []
    for seed in inside[_spread(inside.size, LOCAL_TRIES + 2)[1:-1]]:
        near = (rows - rows[seed]) ** 2 + (columns - columns[seed]) ** 2 <= reach2
        best = fit_best(grid, members[near])
        if best is not None:
            out.append(best)
    return out


def _grown(grid: Grid, option: Fit, free: Flags, members: NDArray[np.int64]) -> tuple[NDArray[np.int32], float]:
    h, w = grid.z.shape
    queue, mark = np.empty(h * w, np.int32), np.zeros(h * w, np.uint8)
    cos_limit = float(np.cos(max(0.5, 4.0 * grid.normal_sigma_rad)))
    count, total = grow.grow_surface(
        option.kind,
        option.parameters,
        grid.x,
        grid.y,
        grid.z,
        grid.sigma,
        grid.normal,
        grid.rms,
        free,
        members,
        grid.perspective,
        cos_limit,
        mark,
        1,
        queue,
    )
    return queue[:count].copy(), float(total)
