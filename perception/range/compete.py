"""Models compete for one smooth component: every primitive is offered, the cheapest that explains it wins."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.range import fit, grow
from perception.range.finish import SLOW_NOISE_AREA_PX
from perception.range.grid import Grid
from perception.range.surfaces import QUADRIC, SIZE

Array = NDArray[np.float64]
Labels = NDArray[np.int32]
Flags = NDArray[np.bool_]

FIT_SAMPLES = 90
GOOD_MEAN_SQUARE = 2.0
GOOD_SHARE = 0.75
WHOLE_SHARE = 0.85  # a fit to the whole component that explains less has rivals grown from parts of it
LOCAL_BLOCKS = 45
LOCAL_TRIES = 5
FEW_BLOCKS_FOR_QUADRIC = 60
GIVE_UP = 14.0  # a fit that keeps three quarters within three sigmas leaves 8 at most, once it has converged


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
    kind, parameters, share = _fit_blocks(*_columns(grid), members)
    return Fit(kind=kind, parameters=parameters, share=share) if kind >= 0 else None


def _columns(grid: Grid) -> tuple[Array, Array, Array, Array, Array, bool, int, float]:
    x, y, z, sigma = (a.ravel() for a in (grid.x, grid.y, grid.z, grid.sigma))
    return x, y, z, sigma, grid.normal.reshape(-1, 3), grid.perspective, grid.size_px**2, grid.slow_share


@njit(cache=True, error_model="numpy", nogil=True)
def _fit_blocks(x, y, z, sigma, normal, perspective, pixels, slow_share, members):  # type: ignore[no-untyped-def]  # numba types it
    """Kind (-1 when none explains them), parameters (16,) and explained share of the blocks `members` (flat)."""
    count = members.shape[0]
    if count < 5:
        return -1, np.zeros(SIZE), 0.0
    # Evenly spread over the region; a fixed choice keeps results equal from run to run.
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
    # Slow noise covers samples together: so many count as one.
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


def _local_fits(grid: Grid, members: NDArray[np.int64]) -> list[Fit]:
    """Fits to small neighbourhoods spread over a component that no single primitive explains."""
    kinds, ths, shares = _fit_parts(*_columns(grid), members, grid.rms.ravel(), grid.z.shape[1])
    return [Fit(kind=int(kinds[k]), parameters=ths[k], share=float(shares[k])) for k in np.flatnonzero(kinds >= 0)]


@njit(cache=True, error_model="numpy", nogil=True)
def _fit_parts(  # type: ignore[no-untyped-def]  # numba types it
    x, y, z, sigma, normal, perspective, pixels, slow_share, members, rms, w
):
    """`_fit_blocks` of the blocks around `LOCAL_TRIES` seeds that are evenly spread over `members`."""
    kinds, ths, shares = np.full(LOCAL_TRIES, -1), np.zeros((LOCAL_TRIES, SIZE)), np.zeros(LOCAL_TRIES)
    inside = members[np.isfinite(rms[members])]
    if inside.shape[0] < LOCAL_TRIES + 2:
        return kinds, ths, shares
    near = np.empty(members.shape[0], members.dtype)
    for t in range(LOCAL_TRIES):
        seed = inside[((t + 1) * (inside.shape[0] - 1)) // (LOCAL_TRIES + 1)]
        count = 0
        for k in range(members.shape[0]):
            row, column = members[k] // w - seed // w, members[k] % w - seed % w
            if row * row + column * column <= LOCAL_BLOCKS / np.pi:
                near[count] = members[k]
                count += 1
        kinds[t], ths[t], shares[t] = _fit_blocks(x, y, z, sigma, normal, perspective, pixels, slow_share, near[:count])
    return kinds, ths, shares


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
