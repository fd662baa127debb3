"""Score of a model in a given pose against a depth image, pixel by pixel, and the search for the best pose nearby.

A pixel that the model covers is explained (measured and rendered depth agree), hidden (the measured depth is nearer) or
contradicted (the sensor sees through the model). Its gain is the log-likelihood under the model, with a lower bound for
gross errors, minus the log-likelihood under the bare panel. Hidden pixels cost little, because anything may stand in
front. Beyond the outline, depth that continues smoothly from an explained pixel also contradicts the model, because the
object is then larger than the model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Indices, Mask
from hal.jit import compiled
from perception.range.matching.solids import MOVES, render, window_of

HIT = 3.0  # log-likelihood of a pixel that agrees, relative to a gross error
HIDDEN = -0.4  # log-likelihood of a pixel whose depth is in front of the model
MIXED = -0.4  # at a depth jump half of the beams measure some depth between its sides, so this costs little
SEEN_THROUGH = -3.0  # log-likelihood of a pixel whose depth is behind the model
GOES_ON = -2.0  # log-likelihood of a pixel beyond the outline whose depth continues smoothly
RING_PX = 2  # distance from the outline at which that is tested
SLACK_M = 0.0002  # deviation of real components from their models, apart from sizes and heights
SLOPE_SHARE = 0.3  # standard deviation of an outline's position in pixels
STEEPEST_M = 0.004  # largest depth step to the next pixel that is allowed for in this way
TRIES = 4  # most rounds of the coordinate search per step size
HITS, BEHIND, RING, FRONT, COVERED, BETWEEN = range(6)  # indices of the `counts` of `judged`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """The image data that hypotheses are compared with.

    Attributes:
        depth_m: (H, W), NaN where there is no reading or a better match owns the pixel.
        panel_m: (H, W) depth of the bare panel.
        sigma_m: (H, W) standard deviation of the depth.
        packed: `RangeSensorModel.packed()`.
        R, p: (3, 3) and (3,) sensor_from_panel.
    """

    depth_m: Array
    panel_m: Array
    sigma_m: Array
    packed: Array
    R: Array
    p: Array

    @property
    def pitch_m(self) -> float:
        """Distance between neighbouring pixels on the panel."""
        return float((self.p[2] if self.packed[0] > 0 else 1.0) / self.packed[1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solid:
    """A model in the form that the kernels use.

    Attributes:
        rows: (S, 16) table as in `solids`.
        boxes: (S, 2, 3) bounding box of each row, object frame.
        tolerance_m: (S,) of each surface.
        slide: (3,) direction in which the sliding part moves, object frame; zeros without one.
    """

    rows: Array
    boxes: Array
    tolerance_m: Array
    slide: Array


@compiled
def _placed(
    boxes: Array, slide: Array, q: Array, R0: Array, p0: Array, sen: Array, limit: Indices, R: Array, p: Array,
    window: Indices,
) -> None:  # fmt: skip
    """Write the pose of the hypothesis q into `R`, `p`, and the pixels that the solid covers into `window`.

    R0, p0: sensor_from_panel. R, p: sensor_from_object. The window has a margin for pixels beyond the outline.
    """
    c, s = np.cos(q[2]), np.sin(q[2])
    for a in range(3):
        R[a, 0] = c * R0[a, 0] + s * R0[a, 1]
        R[a, 1] = c * R0[a, 1] - s * R0[a, 0]
        R[a, 2] = R0[a, 2]
        p[a] = p0[a] + q[0] * R0[a, 0] + q[1] * R0[a, 1]
    box = np.empty((2, 3))
    for a in range(3):
        # For speed one box is used for all rows; it also holds those that do not slide.
        box[0, a] = boxes[:, 0, a].min() + min(slide[a] * q[3], 0.0)
        box[1, a] = boxes[:, 1, a].max() + max(slide[a] * q[3], 0.0)
    window_of(box, np.zeros(3), R, p, sen, RING_PX + 1, limit, window)


@compiled
def _lifts(
    m: Array, k: Indices, window: Indices, stride: int, h: int, w: int, z: Array, sigma: Array, tolerance: Array,
    is_free: Mask, lift: Array,
) -> None:  # fmt: skip
    """Estimate into `lift` (S,) how much deeper each row of this component lies than in its model.

    m, k: rendered depth and row number of the pixels of `window`; `is_free` (S,): rows whose height may differ, by up
    to their tolerance.
    """
    S = lift.shape[0]
    weight, total = np.zeros(S), np.zeros(S)
    for j in range(h):
        for i in range(w):
            s = k[j, i]
            if s < 0 or not is_free[s]:
                continue
            v, u = window[1] + j * stride, window[0] + i * stride
            if v < 0 or u < 0 or v >= z.shape[0] or u >= z.shape[1]:
                continue
            r = z[v, u] - m[j, i]
            if abs(r) < tolerance[s] + 3.0 * sigma[v, u]:
                g = 1.0 / (sigma[v, u] * sigma[v, u])
                weight[s] += g
                total[s] += g * r
    for s in range(S):
        prior = 4.0 / (tolerance[s] * tolerance[s] + 1e-12)
        lift[s] = min(max(total[s] / (weight[s] + prior), -tolerance[s]), tolerance[s])


@compiled
def judged(
    rows: Array, boxes: Array, tolerance: Array, slide: Array, q: Array, z: Array, panel: Array, sigma: Array,
    sen: Array, R0: Array, p0: Array, stride: int, rim: bool, m: Array, k: Indices, lift: Array, hits: Indices,
    counts: Array,
) -> float:  # fmt: skip
    """Return the log-likelihood gain of the hypothesis q = (x, y, yaw, state, size change of each row) over the panel.

    Args:
        z, panel, sigma: images of `View`.
        stride: every `stride`-th pixel is used.
        rim: whether to count pixels beyond the outline whose depth continues smoothly; only with `stride` 1.
        m, k, hits: scratch: rendered depth, row, and whether the pixel is explained, packed as by `render`.
        lift: (S,) filled with how much deeper than rendered each row was found.
        counts: (6,) filled with the number of pixels that are explained (HITS), seen through (BEHIND), continuing
            beyond the outline (RING), hidden (FRONT), covered (COVERED), and mixed with a neighbour (BETWEEN).
    """
    H, W = z.shape
    S = rows.shape[0]
    R, p, window = np.empty((3, 3)), np.empty(3), np.empty(4, np.int64)
    limit = np.array([-W // 2, -H // 2, W + W // 2, H + H // 2])
    _placed(boxes, slide, q, R0, p0, sen, limit, R, p, window)
    h, w = (window[3] - window[1] + stride - 1) // stride, (window[2] - window[0] + stride - 1) // stride
    counts[:] = 0.0
    if h <= 0 or w <= 0:
        return -1e3
    shift = slide * q[3]
    render(rows, boxes, q[4:], shift, R, p, sen, window, stride, m, k)
    slides_up = abs(slide[2]) > 0.5
    is_free = np.empty(S, np.bool_)
    for s in range(S):
        is_free[s] = tolerance[s] > 0.0 and not (slides_up and rows[s, MOVES] > 0.0)
    _lifts(m, k, window, stride, h, w, z, sigma, tolerance, is_free, lift)
    score = _priors(q, tolerance, is_free, lift)
    for j in range(h):
        for i in range(w):
            s = k[j, i]
            hits[j, i] = 0
            if s < 0:
                continue
            counts[COVERED] += 1.0
            v, u = window[1] + j * stride, window[0] + i * stride
            if v < 0 or u < 0 or v >= H or u >= W or not np.isfinite(z[v, u]):
                score += HIDDEN
                continue
            least = sigma[v, u] * sigma[v, u] + SLACK_M * SLACK_M
            slope = SLOPE_SHARE * min(_slope(m, k, j, i, h, w) / stride, STEEPEST_M)
            wide = least + slope * slope
            r, b = z[v, u] - m[j, i] - lift[s], z[v, u] - panel[v, u]
            gain = HIT - 0.5 * r * r / wide - 0.5 * np.log(wide / least)
            floor, kind = (HIDDEN, FRONT) if r < 0.0 else (SEEN_THROUGH, BEHIND)
            if gain > 0.0:
                hits[j, i], kind = 1, HITS
            elif r > 0.0 and z[v, u] < _deepest_beside(m, k, j, i, h, w, panel[v, u]) - 3.0 * sigma[v, u]:
                floor, kind = MIXED, BETWEEN
            counts[kind] += 1.0
            score += max(gain, floor) - max(HIT - 0.5 * b * b / least, 0.0)
    if rim:
        score += GOES_ON * _going_on(m, k, window, h, w, z, panel, sigma, hits, counts)
    return score * stride * stride


@compiled
def _priors(q: Array, tolerance: Array, is_free: Mask, lift: Array) -> float:
    """Return the log prior of deviations from the model's heights and sizes; a tolerance is two standard deviations."""
    out = 0.0
    for s in range(tolerance.shape[0]):
        if not is_free[s]:
            lift[s] = 0.0
        t = 0.5 * tolerance[s] + 1e-9
        out -= 0.5 * ((lift[s] / t) ** 2 + (q[4 + s] / t) ** 2)
    return out


@compiled
def _slope(m: Array, k: Indices, j: int, i: int, h: int, w: int) -> float:
    """Return the larger of the horizontal and vertical depth steps to a neighbour in the same row of the solid.

    m, k: rendered depth and row number; (j, i): the pixel.
    """
    out = 0.0
    if i > 0 and k[j, i - 1] == k[j, i]:
        out = abs(m[j, i] - m[j, i - 1])
    elif i + 1 < w and k[j, i + 1] == k[j, i]:
        out = abs(m[j, i] - m[j, i + 1])
    if j > 0 and k[j - 1, i] == k[j, i]:
        out = max(out, abs(m[j, i] - m[j - 1, i]))
    elif j + 1 < h and k[j + 1, i] == k[j, i]:
        out = max(out, abs(m[j, i] - m[j + 1, i]))
    return out


@compiled
def _deepest_beside(m: Array, k: Indices, j: int, i: int, h: int, w: int, panel: float) -> float:
    """Return the greatest rendered depth in the 3x3 pixels around one; where the solid is absent, that is `panel`.

    At a depth jump a beam may mix this depth with that of the pixel.
    """
    out = m[j, i]
    for b in range(max(j - 1, 0), min(j + 2, h)):
        for a in range(max(i - 1, 0), min(i + 2, w)):
            out = max(out, m[b, a] if k[b, a] >= 0 else panel)
    return float(out)


@compiled
def _going_on(
    m: Array, k: Indices, window: Indices, h: int, w: int, z: Array, panel: Array, sigma: Array, hits: Indices,
    counts: Array,
) -> float:  # fmt: skip
    """Count pixels beyond the outline, or in front of the model, whose depth continues smoothly from explained pixels.

    An occluder is separated from the model by a depth jump. Depth in front of the model without a jump therefore means
    that the object is larger than the model.
    """
    for j in range(h):
        for i in range(w):
            if k[j, i] >= 0 and hits[j, i] != 0:
                continue
            v, u = window[1] + j, window[0] + i
            if v < 0 or u < 0 or v >= z.shape[0] or u >= z.shape[1]:
                continue
            depth, s = z[v, u], sigma[v, u]
            if not depth < panel[v, u] - 4.0 * s or (k[j, i] >= 0 and depth > m[j, i] - 2.0 * s):
                continue
            for dj, di in ((RING_PX, 0), (-RING_PX, 0), (0, RING_PX), (0, -RING_PX)):
                a, b = j + dj, i + di
                if a < 0 or b < 0 or a >= h or b >= w or k[a, b] < 0 or hits[a, b] == 0:
                    continue
                step = 0.0
                if 0 <= a + dj < h and 0 <= b + di < w and k[a + dj, b + di] == k[a, b]:
                    step = abs(m[a + dj, b + di] - m[a, b])
                if abs(depth - z[window[1] + a, window[0] + b]) < 3.0 * s + SLACK_M + min(step, STEEPEST_M):
                    counts[RING] += 1.0
                    break
    return float(counts[RING])


@compiled
def climbed(
    rows: Array, boxes: Array, tolerance: Array, slide: Array, q: Array, ways: Array, low: Array, high: Array,
    levels: int, z: Array, panel: Array, sigma: Array, sen: Array, R0: Array, p0: Array, stride: int, rim: bool,
) -> float:  # fmt: skip
    """Move `q` to a local maximum of the gain by coordinate search along `ways`; returns its gain.

    Args:
        ways: (M, 4 + S) steps, tried forwards and backwards one at a time.
        low, high: (4 + S,) bounds of the hypothesis.
        levels: number of step sizes, each half the previous one; 0 only computes the gain.
    """
    H, W = z.shape
    n = (2 * H + stride) // stride, (2 * W + stride) // stride
    m, k, hits = np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64)
    lift, counts = np.empty(rows.shape[0]), np.empty(6)
    best = judged(rows, boxes, tolerance, slide, q, z, panel, sigma, sen, R0, p0, stride, rim, m, k, lift, hits, counts)
    size = 1.0
    for _ in range(levels):
        for _ in range(TRIES):
            start = best
            for c in range(ways.shape[0]):
                for sign in (size, -size):
                    moved = np.minimum(np.maximum(q + sign * ways[c], low), high)
                    now = judged(
                        rows,
                        boxes,
                        tolerance,
                        slide,
                        moved,
                        z,
                        panel,
                        sigma,
                        sen,
                        R0,
                        p0,
                        stride,
                        rim,
                        m,
                        k,
                        lift,
                        hits,
                        counts,
                    )
                    if now > best + 1e-9:
                        best = now
                        q[:] = moved
                        break
            if best <= start:
                break
        size *= 0.5
    return best


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Explained:
    """The pixels of a hypothesis: (6,) `counts` as in `judged`, (H, W) row rendered or -1, and whether each agrees."""

    counts: Array
    rows: NDArray[np.int64]
    pixels: NDArray[np.bool_]


def explained(solid: Solid, q: Array, view: View) -> Explained:
    """Return the pixels that the hypothesis q = (x, y, yaw, state, size change of each row) covers and explains."""
    H, W = view.depth_m.shape
    n = 2 * H + 1, 2 * W + 1
    m, k, hits = np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64)
    lift, counts = np.empty(len(solid.rows)), np.empty(6)
    judged(
        solid.rows, solid.boxes, solid.tolerance_m, solid.slide, q, view.depth_m, view.panel_m, view.sigma_m,
        view.packed, view.R, view.p, 1, True, m, k, lift, hits, counts,
    )  # fmt: skip
    R, p, window = np.empty((3, 3)), np.empty(3), np.empty(4, np.int64)
    limit = np.array([-W // 2, -H // 2, W + W // 2, H + H // 2])
    _placed(solid.boxes, solid.slide, q, view.R, view.p, view.packed, limit, R, p, window)
    u0, v0, u1, v1 = np.clip(window, 0, [W, H, W, H])
    part = slice(v0 - window[1], v1 - window[1]), slice(u0 - window[0], u1 - window[0])
    rows, pixels = np.full((H, W), -1, np.int64), np.zeros((H, W), bool)
    rows[v0:v1, u0:u1] = k[part]
    pixels[v0:v1, u0:u1] = hits[part] > 0
    return Explained(counts=counts, rows=rows, pixels=pixels)
