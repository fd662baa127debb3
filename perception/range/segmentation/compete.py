"""Models compete for one smooth component: every primitive is offered, the cheapest that explains it wins."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hal.arrays import Array
from perception.range.fitting import fit
from perception.range.fitting.surfaces import QUADRIC, SIZE
from perception.range.segmentation.finish import SLOW_NOISE_AREA_PX
from perception.range.segmentation.grid import Grid
from perception.range.segmentation.grow_surface import GROW_SIGMAS, grow_surface
from perception.range.segmentation.links import smooth_components

Labels = NDArray[np.int32]
Flags = NDArray[np.bool_]

ROUNDS = 6
MOST_COMPONENTS = 48  # a round
MOST_ATTEMPTS = 120  # on one grid: bounds the time that rubble can cost
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
    """Surfaces found so far; label k is `kinds[k - 1]`, `parameters[k - 1]`. Grows while segmentation runs.

    `slack[k - 1]`: how many times the noise the surface tolerates, where its face is no better a primitive.
    """

    kinds: list[int] = field(default_factory=list)
    parameters: list[Array] = field(default_factory=list)
    slack: list[float] = field(default_factory=list)

    def add(self, kind: int, parameters: Array, slack: float = 1.0) -> int:
        """Append a surface and return its label."""
        self.kinds.append(kind)
        self.parameters.append(parameters)
        self.slack.append(slack)
        return len(self.kinds)

    def arrays(self) -> tuple[NDArray[np.int64], Array]:
        """Kinds (n + 1,) and parameters (n + 1, 16), entry 0 unused, for compiled loops."""
        kinds = np.array([0, *self.kinds], np.int64)
        table = np.array([np.zeros(SIZE), *self.parameters])
        return kinds, table


def explain(grid: Grid, blocks: Labels, *, found: Candidates, least: int, slope: float, focal_px: float) -> None:
    """Offer each smooth component of unlabelled blocks to all primitives until no round adds a surface.

    The surface that explains most of a component takes its blocks, if they are at least `least`. Extends `blocks` (h, w)
    and `found`. `slope`: metres of depth per metre across that are no jump yet.
    """
    free: Flags = np.isfinite(grid.z) & (blocks == 0)
    turn_limit = float(np.cos(max(0.7, 5.0 * grid.normal_sigma_rad)))
    cos_limit = float(np.cos(max(0.5, 4.0 * grid.normal_sigma_rad)))
    kinds, ths = _explanations(
        grid.x, grid.y, grid.z, grid.sigma, grid.normal, grid.rms, grid.perspective, grid.size_px**2, grid.slow_share,
        slope * grid.size_px, 1.0 / focal_px, turn_limit, cos_limit, free, blocks, len(found.kinds) + 1, least,
    )  # fmt: skip
    for kind, th in zip(kinds.tolist(), ths, strict=True):
        found.add(kind, th)


def fit_best(grid: Grid, members: NDArray[np.int64], slack: float) -> tuple[int, Array, float]:
    """Kind (-1 when none does), parameters and explained share of what describes these blocks within `slack` sigmas."""
    x, y, z, sigma = (a.ravel() for a in (grid.x, grid.y, grid.z, slack * grid.sigma))
    normal = grid.normal.reshape(-1, 3)
    kind, th, share = _fit_blocks(
        x, y, z, sigma, normal, grid.perspective, grid.size_px**2, grid.slow_share, members
    )  # fmt: skip
    return int(kind), th, float(share)


@njit(cache=True, error_model="numpy", nogil=True)
def _explanations(  # type: ignore[no-untyped-def]  # numba types it
    x, y, z, sigma, normal, rms, perspective, pixels, slow_share, slope, inverse_f, turn_limit, cos_limit, free, blocks,
    first_label, least,
):  # fmt: skip
    """Kinds (M,) and parameters (M, 16) of the surfaces found, labelled from `first_label` in `blocks`; see `explain`."""
    kinds, ths = np.zeros(ROUNDS * MOST_COMPONENTS, np.int64), np.zeros((ROUNDS * MOST_COMPONENTS, SIZE))
    flat_free, flat_blocks = free.ravel(), blocks.ravel()
    found, attempts, left = 0, 0, np.flatnonzero(flat_free)
    for _ in range(ROUNDS):
        starts, indices = smooth_components(
            left, z, sigma, free, slope, inverse_f, perspective, normal, rms, turn_limit, least, MOST_COMPONENTS
        )  # fmt: skip
        count = starts.shape[0] - 1
        if count == 0 or attempts >= MOST_ATTEMPTS:
            break
        attempts += count
        for k in range(count):
            members = indices[starts[k] : starts[k + 1]]
            members, kind = members[flat_free[members]], -1
            if members.shape[0] >= least:
                kind, th, mine = _explanation(
                    x, y, z, sigma, normal, rms, perspective, pixels, slow_share, cos_limit, free, members, least
                )  # fmt: skip
                if kind >= 0:
                    kinds[found], ths[found] = kind, th
                    flat_blocks[mine] = first_label + found
                    flat_free[mine] = False
                    found += 1
            if kind < 0:
                # What nothing explains now, nothing will: it must not be offered again.
                flat_free[members] = False
        left = left[flat_free[left]]
    return kinds[:found].copy(), ths[:found].copy()


@njit(cache=True, error_model="numpy", nogil=True)
def _explanation(  # type: ignore[no-untyped-def]  # numba types it
    x, y, z, sigma, normal, rms, perspective, pixels, slow_share, cos_limit, free, members, least
):
    """Kind (-1 when there is none), parameters and blocks (flat) of the surface that explains most of `members`."""
    h, w = z.shape
    fx, fy, fz, fs, fn = x.ravel(), y.ravel(), z.ravel(), sigma.ravel(), normal.reshape(h * w, 3)
    kinds, ths = np.full(1 + LOCAL_TRIES, -1), np.zeros((1 + LOCAL_TRIES, SIZE))
    kinds[0], ths[0], share = _fit_blocks(fx, fy, fz, fs, fn, perspective, pixels, slow_share, members)
    if kinds[0] < 0 or share < WHOLE_SHARE:
        _fit_parts(
            fx, fy, fz, fs, fn, perspective, pixels, slow_share, members, rms.ravel(), w, kinds[1:], ths[1:]
        )  # fmt: skip
    queue, mark = np.empty(h * w, np.int64), np.zeros(h * w, np.uint8)
    best, best_gain, mine = -1, 0.0, queue[:0]
    for k in range(kinds.shape[0]):
        if kinds[k] < 0:
            continue
        count, total = grow_surface(
            kinds[k], ths[k], x, y, z, sigma, normal, rms, free, members, perspective, cos_limit, mark, k + 1, queue
        )
        gain = GROW_SIGMAS**2 * count - total
        if count >= least and total <= GOOD_MEAN_SQUARE * count and gain > best_gain:
            best, best_gain, mine = k, gain, queue[:count].copy()
    if best < 0:
        return -1, ths[0], mine
    if best > 0 or mine.shape[0] < 0.9 * members.shape[0]:
        kind, th, _ = _fit_blocks(fx, fy, fz, fs, fn, perspective, pixels, slow_share, mine)
        if kind >= 0:
            return kind, th, mine
    return kinds[best], ths[best].copy(), mine


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


@njit(cache=True, error_model="numpy", nogil=True)
def _fit_parts(  # type: ignore[no-untyped-def]  # numba types it
    x, y, z, sigma, normal, perspective, pixels, slow_share, members, rms, w, kinds, ths
):
    """`_fit_blocks` of the blocks around seeds that are evenly spread over `members`, into `kinds` and `ths`."""
    inside = members[np.isfinite(rms[members])]
    tries = kinds.shape[0]
    if inside.shape[0] < tries + 2:
        return
    near = np.empty(members.shape[0], members.dtype)
    for t in range(tries):
        seed = inside[((t + 1) * (inside.shape[0] - 1)) // (tries + 1)]
        count = 0
        for k in range(members.shape[0]):
            row, column = members[k] // w - seed // w, members[k] % w - seed % w
            if row * row + column * column <= LOCAL_BLOCKS / np.pi:
                near[count] = members[k]
                count += 1
        kinds[t], ths[t], _ = _fit_blocks(x, y, z, sigma, normal, perspective, pixels, slow_share, near[:count])
