"""Mean depth of small blocks of pixels; of a block across a depth jump, only the side of its median counts.

Blocks are processed in runs of neighbours in a row. The quantities of a run are rows of one scratch array at fixed
offsets, and the loops have no branch; the module `tangents` says why.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Labels
from hal.jit import compiled

JUMP_SLOPE = 2.5  # a surface seen steeper than 68 degrees counts as a jump between blocks
BLOCK_SAMPLES = 4  # most samples along one side of a block; in larger blocks not every pixel is used
MOST_SAMPLES = BLOCK_SAMPLES**2
RUN = 128  # largest number of blocks in a run
MEDIAN, PER_Z, NEAR, FAST, SLOW, STEP = (row * RUN for row in range(6))  # where each row begins
M, SU, SV, SQ = (row * RUN for row in range(6, 10))  # sums over the samples near the median
SAMPLES = 10 * RUN
SCRATCH = SAMPLES + MOST_SAMPLES * RUN


@compiled
def mean_blocks(
    depth: Array, sen: Array, noise: Array, b: int, x: Array, y: Array, z: Array, sigma: Array, count: Labels, top: int,
    bottom: int,
) -> None:  # fmt: skip
    """Average blocks of b x b pixels of `depth` (H, W); writes rows [top, bottom) of (h, w) arrays as in `Grid`.

    `count` becomes the number of a block's samples that are as near to its median as noise and slope allow. If these are
    less than half, as where most readings are missing, `z` and `sigma` are NaN.
    """
    w = x.shape[1]
    hop = (b + BLOCK_SAMPLES - 1) // BLOCK_SAMPLES
    side = (b + hop - 1) // hop
    work = np.empty(SCRATCH)
    for r in range(top, bottom):
        for start in range(0, w, RUN):
            end = min(start + RUN, w)
            _load(depth, b, hop, side, r, start, end - start, work)
            _medians(side, end - start, work)
            work[M:SAMPLES] = 0.0
            if _is_any_known(end - start, work):
                _sums(sen, noise, b, hop, side, end - start, work)
            _place(sen, b, r, start, x[r, start:end], y[r, start:end], work)
            _means(sen, side, z[r, start:end], sigma[r, start:end], count[r, start:end], work)


@compiled
def _load(depth: Array, b: int, hop: int, side: int, r: int, start: int, n: int, work: Array) -> None:
    """Load the samples of `n` blocks from block (r, start) on, one row per position in the block; NaN beyond the image.

    `hop`: distance of neighbouring samples in pixels; `side`: number of samples along a block.
    """
    H, W = depth.shape
    for i in range(side):
        row = depth[min(r * b + i * hop, H - 1)]
        for j in range(side):
            out = work[SAMPLES + (i * side + j) * RUN :]
            first = start * b + j * hop
            inside = min(n, (W - first + b - 1) // b) if r * b + i * hop < H else 0
            for c in range(inside):
                out[c] = row[first + c * b]
            for c in range(inside, n):
                out[c] = np.nan


@compiled
def _medians(side: int, n: int, work: Array) -> None:
    """Fill row MEDIAN with the lower medians of the corner samples of `n` blocks; missing readings sort last.

    The lower median is always a measured value, never a mean of two values on either side of a jump. It is NaN if only one
    of the four is known.
    """
    at_q, at_s = SAMPLES + (side - 1) * RUN, SAMPLES + side * (side - 1) * RUN
    at_t = SAMPLES + (side * side - 1) * RUN
    for c in range(n):
        p, q, s, t = work[SAMPLES + c], work[at_q + c], work[at_s + c], work[at_t + c]
        p, q = p if p == p else np.inf, q if q == q else np.inf  # noqa: PLR0124 - NaN is not itself
        s, t = s if s == s else np.inf, t if t == t else np.inf  # noqa: PLR0124 - as above
        low_1, high_1, low_2, high_2 = min(p, q), max(p, q), min(s, t), max(s, t)
        second, third = min(max(low_1, low_2), high_1, high_2), max(low_1, low_2, min(high_1, high_2))
        # The second of three or four readings, the first of two.
        median = min(low_1, low_2) if third == np.inf else second
        work[MEDIAN + c] = median if second < np.inf else np.nan


@compiled
def _is_any_known(n: int, work: Array) -> bool:
    """Return whether any of the first `n` medians is a depth."""
    known = False
    for c in range(n):
        known |= work[MEDIAN + c] == work[MEDIAN + c]
    return known


@compiled
def _sums(sen: Array, noise: Array, b: int, hop: int, side: int, n: int, work: Array) -> None:
    """Fill the rows M, SU, SV and SQ, the sums over the samples near the median of each block."""
    perspective = sen[0] > 0
    _reach(noise, JUMP_SLOPE * 0.7 * b / sen[1], perspective, n, work)
    for k in range(side * side):
        _add(work[SAMPLES + k * RUN :], k // side * hop, k % side * hop, n, work)


@compiled
def _reach(noise: Array, slope: float, perspective: bool, n: int, work: Array) -> None:
    """Fill the rows FAST, SLOW and STEP with variances of one pixel at the medians, and row NEAR with the limit of `_add`.

    The limit is the largest distance of a sample from the median that noise and `slope` explain.
    """
    for c in range(n):
        median = work[MEDIAN + c]
        z2 = median * median
        white, slow, step = noise[0] + noise[1] * z2, noise[2] + noise[3] * z2, noise[4] + noise[5] * z2
        fast = max(white * white, step * step / 12.0)
        work[FAST + c], work[SLOW + c], work[STEP + c] = fast, slow * slow, step * step
        work[NEAR + c] = slope * (median if perspective else 1.0) + 3.0 * np.sqrt(fast + slow * slow)
        work[PER_Z + c] = 1.0 / median if perspective else 0.0


@compiled
def _add(samples: Array, row: int, column: int, n: int, work: Array) -> None:
    """Add one sample of each block, at this row and column of the block, to the sums over samples near the median.

    Under perspective planes are linear in 1 / z, so 1 / z is averaged, by its series: with d the distance from the median
    and q = d / median, the sum is of d (1 - q + q^2), which is median (1 - 1 / (1 + q)) up to third order.
    """
    u, v = float(column), float(row)
    for c in range(n):
        d = samples[c] - work[MEDIAN + c]
        near = abs(d) <= work[NEAR + c]  # refuses NaN
        q = d * work[PER_Z + c]
        work[SQ + c] += d * (1.0 - q * (1.0 - q)) if near else 0.0
        work[SU + c] += u if near else 0.0
        work[SV + c] += v if near else 0.0
        work[M + c] += 1.0 if near else 0.0


@compiled
def _place(sen: Array, b: int, r: int, start: int, x: Array, y: Array, work: Array) -> None:
    """Compute the mean ray coordinates of the samples near the median; those of the block's centre if there are none."""
    middle = 0.5 * (b - 1)
    for c in range(x.shape[0]):
        m = work[M + c]
        x[c] = (float(np.int32(start + c)) * b + (work[SU + c] / m if m > 0.0 else middle) - sen[3]) / sen[1]
    for c in range(y.shape[0]):
        m = work[M + c]
        y[c] = (r * b + (work[SV + c] / m if m > 0.0 else middle) - sen[4]) / sen[2]


@compiled
def _means(sen: Array, side: int, z: Array, sigma: Array, count: Labels, work: Array) -> None:
    """Compute the mean depth of each block, its standard deviation and the number of samples used."""
    perspective, full = sen[0] > 0, side * side
    for c in range(z.shape[0]):
        median, m = work[MEDIAN + c], work[M + c]
        mean = work[SQ + c] / m
        depth = median / (1.0 - mean * work[PER_Z + c]) if perspective else median + mean
        z[c] = depth if 2.0 * m >= full else np.nan
    for c in range(sigma.shape[0]):
        m = work[M + c]
        # Neighbours share quantisation steps, so averaging reduces their error little.
        kept = max(work[FAST + c] / m, work[STEP + c] / 24.0)
        sigma[c] = np.sqrt(kept + work[SLOW + c]) if 2.0 * m >= full else np.nan
    for c in range(count.shape[0]):
        count[c] = int(work[M + c]) if 2.0 * work[M + c] >= full else 0
