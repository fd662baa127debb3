"""Score of a model in a given pose against a depth image, pixel by pixel, and the search for the best pose nearby.

A pixel that the model covers is explained (measured and rendered depth agree), hidden (the measured depth is nearer) or
contradicted (the sensor sees through the model). Its gain is the log-likelihood under the model, with a lower bound for
gross errors, minus the log-likelihood under the bare panel. Hidden pixels cost little, because anything may stand in
front. Beyond the outline, depth that continues smoothly from an explained pixel also contradicts the model, because the
object is then larger than the model.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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


class View(NamedTuple):
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


class Solid(NamedTuple):
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


class Drawing(NamedTuple):
    """A hypothesis drawn over the `window` (u0, v0, u1, v1, exclusive) of an image; arrays begin at its first pixel.

    Attributes:
        depth_m, rows: rendered depth (infinite where nothing is hit) and row number, or -1.
        hits: 1 where the image agrees.
        lift_m: (S,) how much deeper than rendered each row was found.
        counts: (6,) numbers of pixels that are explained (HITS), seen through (BEHIND), continuing beyond the outline
            (RING), hidden (FRONT), covered (COVERED), and mixed with a neighbour (BETWEEN).
    """

    window: Indices
    depth_m: Array
    rows: Indices
    hits: Indices
    lift_m: Array
    counts: Array


@compiled
def new_drawing(solid: Solid, view: View, stride: int) -> Drawing:
    """Allocate a drawing of every `stride`-th pixel."""
    H, W = view.depth_m.shape
    n = (2 * H + stride) // stride, (2 * W + stride) // stride
    window, lift_m, counts = np.empty(4, np.int64), np.empty(solid.rows.shape[0]), np.empty(6)
    return Drawing(window, np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64), lift_m, counts)


@compiled
def _place(solid: Solid, q: Array, view: View, R: Array, p: Array, window: Indices) -> None:
    """Write the pose of the hypothesis q, sensor_from_object, into `R`, `p`, and the pixels of the solid into `window`.

    The window has a margin for pixels beyond the outline, and may reach beyond the image by half its size.
    """
    c, s = np.cos(q[2]), np.sin(q[2])
    for a in range(3):
        R[a, 0] = c * view.R[a, 0] + s * view.R[a, 1]
        R[a, 1] = c * view.R[a, 1] - s * view.R[a, 0]
        R[a, 2] = view.R[a, 2]
        p[a] = view.p[a] + q[0] * view.R[a, 0] + q[1] * view.R[a, 1]
    box = np.empty((2, 3))
    for a in range(3):
        # For speed one box is used for all rows; it also holds those that do not slide.
        box[0, a] = solid.boxes[:, 0, a].min() + min(solid.slide[a] * q[3], 0.0)
        box[1, a] = solid.boxes[:, 1, a].max() + max(solid.slide[a] * q[3], 0.0)
    H, W = view.depth_m.shape
    limit = np.array([-W // 2, -H // 2, W + W // 2, H + H // 2])
    window_of(box, np.zeros(3), R, p, view.packed, RING_PX + 1, limit, window)


@compiled
def _estimate_lifts(drawn: Drawing, stride: int, h: int, w: int, solid: Solid, view: View, is_free: Mask) -> None:
    """Estimate how much deeper each row of this component lies than in its model.

    `is_free` (S,): rows whose height may differ, by up to their tolerance.
    """
    tolerance, z, sigma, lift = solid.tolerance_m, view.depth_m, view.sigma_m, drawn.lift_m
    weight, total = np.zeros(lift.shape[0]), np.zeros(lift.shape[0])
    for j in range(h):
        for i in range(w):
            s = drawn.rows[j, i]
            if s < 0 or not is_free[s]:
                continue
            v, u = drawn.window[1] + j * stride, drawn.window[0] + i * stride
            if v < 0 or u < 0 or v >= z.shape[0] or u >= z.shape[1]:
                continue
            r = z[v, u] - drawn.depth_m[j, i]
            if abs(r) < tolerance[s] + 3.0 * sigma[v, u]:
                g = 1.0 / (sigma[v, u] * sigma[v, u])
                weight[s] += g
                total[s] += g * r
    for s in range(lift.shape[0]):
        prior = 4.0 / (tolerance[s] * tolerance[s] + 1e-12)
        lift[s] = min(max(total[s] / (weight[s] + prior), -tolerance[s]), tolerance[s]) if is_free[s] else 0.0


@compiled
def judged(solid: Solid, q: Array, view: View, stride: int, rim: bool, drawn: Drawing) -> float:
    """Return the log-likelihood gain of the hypothesis q = (x, y, yaw, state, size change of each row) over the panel.

    Args:
        stride: every `stride`-th pixel is used.
        rim: whether to count pixels beyond the outline whose depth continues smoothly; only with `stride` 1.
        drawn: filled; a drawing for that stride.
    """
    window, m, k, counts = drawn.window, drawn.depth_m, drawn.rows, drawn.counts
    z, sigma = view.depth_m, view.sigma_m
    R, p = np.empty((3, 3)), np.empty(3)
    _place(solid, q, view, R, p, window)
    h, w = (window[3] - window[1] + stride - 1) // stride, (window[2] - window[0] + stride - 1) // stride
    counts[:] = 0.0
    if h <= 0 or w <= 0:
        return -1e3
    render(solid.rows, solid.boxes, q[4:], solid.slide * q[3], R, p, view.packed, window, stride, m, k)
    slides_up = abs(solid.slide[2]) > 0.5
    is_free = (solid.tolerance_m > 0.0) & ~(slides_up & (solid.rows[:, MOVES] > 0.0))
    _estimate_lifts(drawn, stride, h, w, solid, view, is_free)
    # The prior of deviations from the model's heights and sizes: a tolerance is two standard deviations.
    t = 0.5 * solid.tolerance_m + 1e-9
    score = -0.5 * np.sum((drawn.lift_m / t) ** 2 + (q[4:] / t) ** 2)
    for j in range(h):
        for i in range(w):
            s = k[j, i]
            drawn.hits[j, i] = 0
            if s < 0:
                continue
            counts[COVERED] += 1.0
            v, u = window[1] + j * stride, window[0] + i * stride
            if v < 0 or u < 0 or v >= z.shape[0] or u >= z.shape[1] or not np.isfinite(z[v, u]):
                score += HIDDEN
                continue
            least = sigma[v, u] * sigma[v, u] + SLACK_M * SLACK_M
            slope = SLOPE_SHARE * min(_slope(m, k, j, i, h, w) / stride, STEEPEST_M)
            wide = least + slope * slope
            r, b = z[v, u] - m[j, i] - drawn.lift_m[s], z[v, u] - view.panel_m[v, u]
            gain = HIT - 0.5 * r * r / wide - 0.5 * np.log(wide / least)
            floor, kind = (HIDDEN, FRONT) if r < 0.0 else (SEEN_THROUGH, BEHIND)
            if gain > 0.0:
                drawn.hits[j, i], kind = 1, HITS
            elif r > 0.0 and z[v, u] < _deepest_beside(m, k, j, i, h, w, view.panel_m[v, u]) - 3.0 * sigma[v, u]:
                floor, kind = MIXED, BETWEEN
            counts[kind] += 1.0
            score += max(gain, floor) - max(HIT - 0.5 * b * b / least, 0.0)
    if rim:
        score += GOES_ON * _going_on(drawn, h, w, view)
    return score * stride * stride


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
def _going_on(drawn: Drawing, h: int, w: int, view: View) -> float:
    """Count pixels beyond the outline, or in front of the model, whose depth continues smoothly from explained pixels.

    An occluder is separated from the model by a depth jump. Depth in front of the model without a jump therefore means
    that the object is larger than the model.
    """
    window, m, k, hits, z = drawn.window, drawn.depth_m, drawn.rows, drawn.hits, view.depth_m
    for j in range(h):
        for i in range(w):
            if k[j, i] >= 0 and hits[j, i] != 0:
                continue
            v, u = window[1] + j, window[0] + i
            if v < 0 or u < 0 or v >= z.shape[0] or u >= z.shape[1]:
                continue
            depth, s = z[v, u], view.sigma_m[v, u]
            if not depth < view.panel_m[v, u] - 4.0 * s or (k[j, i] >= 0 and depth > m[j, i] - 2.0 * s):
                continue
            for dj, di in ((RING_PX, 0), (-RING_PX, 0), (0, RING_PX), (0, -RING_PX)):
                a, b = j + dj, i + di
                if a < 0 or b < 0 or a >= h or b >= w or k[a, b] < 0 or hits[a, b] == 0:
                    continue
                step = 0.0
                if 0 <= a + dj < h and 0 <= b + di < w and k[a + dj, b + di] == k[a, b]:
                    step = abs(m[a + dj, b + di] - m[a, b])
                if abs(depth - z[window[1] + a, window[0] + b]) < 3.0 * s + SLACK_M + min(step, STEEPEST_M):
                    drawn.counts[RING] += 1.0
                    break
    return float(drawn.counts[RING])


@compiled
def climbed(
    solid: Solid, q: Array, view: View, ways: Array, low: Array, high: Array, levels: int, stride: int, rim: bool,
) -> float:  # fmt: skip
    """Move `q` to a local maximum of the gain by coordinate search along `ways`; returns its gain.

    Args:
        ways: (M, 4 + S) steps, tried forwards and backwards one at a time.
        low, high: (4 + S,) bounds of the hypothesis.
        levels: number of step sizes, each half the previous one; 0 only computes the gain.
    """
    drawn = new_drawing(solid, view, stride)
    best = judged(solid, q, view, stride, rim, drawn)
    size = 1.0
    for _ in range(levels):
        for _ in range(TRIES):
            start = best
            for c in range(ways.shape[0]):
                for sign in (size, -size):
                    moved = np.minimum(np.maximum(q + sign * ways[c], low), high)
                    now = judged(solid, moved, view, stride, rim, drawn)
                    if now > best + 1e-9:
                        best = now
                        q[:] = moved
                        break
            if best <= start:
                break
        size *= 0.5
    return best


def explained(solid: Solid, q: Array, view: View) -> tuple[Array, Indices, Mask]:
    """Return the pixels that the hypothesis q = (x, y, yaw, state, size change of each row) covers and explains.

    Returns `Drawing.counts`, and for the image the row rendered (H, W) or -1, and whether each pixel agrees (H, W).
    """
    H, W = view.depth_m.shape
    drawn = new_drawing(solid, view, 1)
    judged(solid, q, view, 1, True, drawn)
    u0, v0, u1, v1 = np.clip(drawn.window, 0, [W, H, W, H])
    part = slice(v0 - drawn.window[1], v1 - drawn.window[1]), slice(u0 - drawn.window[0], u1 - drawn.window[0])
    rows, pixels = np.full((H, W), -1, np.int64), np.zeros((H, W), bool)
    rows[v0:v1, u0:u1] = drawn.rows[part]
    pixels[v0:v1, u0:u1] = drawn.hits[part] > 0
    return drawn.counts, rows, pixels
