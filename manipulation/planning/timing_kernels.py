"""Compiled passes over a path: the highest speed along it, its smoothing in time, and what it asks of the joints.

The path is given on an even grid as `path` (4, N, n): joints and their first three derivatives by the distance s along
the path. `limits` (3, n) are the largest speed, acceleration and jerk of the joints.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from manipulation.arm.kernels import tool_and_jacobian
from manipulation.planning.smooth_path import path_at

BISECTIONS = 44
TINY = 1e-12


@inlined
def push_range(path: Array, i: int, x: float, most: Array, out: Array) -> None:
    """Write the least and the largest s'' (2,) at grid point i for s'^2 = x: |q_s s'' + q_ss x| <= most."""
    out[0], out[1] = -1e18, 1e18
    for k in range(most.shape[0]):
        slope, bend = path[1, i, k], path[2, i, k] * x
        if abs(slope) < TINY:
            if abs(bend) > most[k]:
                out[0], out[1] = 1.0, -1.0
                return
            continue
        a, b = (-most[k] - bend) / slope, (most[k] - bend) / slope
        out[0] = max(out[0], min(a, b))
        out[1] = min(out[1], max(a, b))


@compiled
def squared_speeds(path: Array, step: float, ceiling: Array, most: Array) -> Array:
    """Return the highest s'^2 (N,) from rest to rest below `ceiling` (N,) within the accelerations `most` (n,).

    A pass backwards finds from which speeds the rest of the path can be braked; the pass forwards is as fast as they
    allow.

    Source: Pham and Pham, IEEE T-RO 34(3), 2018 (reachability along the path).
    """
    count = ceiling.shape[0]
    reach, out, u = np.zeros(count), np.zeros(count), np.zeros(2)
    for i in range(count - 2, -1, -1):
        low, high = 0.0, ceiling[i]
        push_range(path, i, high, most, u)
        if u[0] <= u[1] and high + 2.0 * step * u[0] <= reach[i + 1]:
            reach[i] = high
            continue
        for _ in range(BISECTIONS):
            x = 0.5 * (low + high)
            push_range(path, i, x, most, u)
            if u[0] <= u[1] and x + 2.0 * step * u[0] <= reach[i + 1]:
                low = x
            else:
                high = x
        reach[i] = low
    out[0] = 0.0
    for i in range(count - 1):
        push_range(path, i, out[i], most, u)
        out[i + 1] = max(0.0, min(reach[i + 1], out[i] + 2.0 * step * max(u[1], 0.0 if out[i] == 0.0 else u[1])))
    out[count - 1] = 0.0
    return out


@compiled
def distances(x: Array, step: float, dt_s: float) -> Array:
    """Return the distances (M,) along the path at multiples of `dt_s` for s'^2 = x (N,) on the grid, up to its end."""
    count = x.shape[0]
    times = np.zeros(count)
    for i in range(count - 1):
        times[i + 1] = times[i] + 2.0 * step / max(np.sqrt(x[i]) + np.sqrt(x[i + 1]), 1e-7)
    ticks = int(np.ceil(times[count - 1] / dt_s)) + 1
    out = np.empty(ticks)
    i = 0
    for tick in range(ticks):
        t = min(tick * dt_s, times[count - 1])
        while i < count - 2 and times[i + 1] <= t:
            i += 1
        u = (x[i + 1] - x[i]) / (2.0 * step)
        after = t - times[i]
        out[tick] = min(step * i + (np.sqrt(x[i]) + 0.5 * u * after) * after, step * (count - 1))
    out[ticks - 1] = step * (count - 1)
    return out


@compiled
def smoothed(s: Array, width: int) -> Array:
    """Return the moving mean of distances (M,) over `width` ticks, (M + width - 1,), at rest before and behind.

    A mean over the time T turns each step of the acceleration into a ramp that lasts T.
    """
    count = s.shape[0]
    out = np.empty(count + width - 1)
    total = width * s[0]
    for k in range(out.shape[0]):
        total += s[min(k, count - 1)] - s[min(max(k - width, 0), count - 1)]
        out[k] = total / width
    out[0], out[out.shape[0] - 1] = s[0], s[count - 1]
    return out


@compiled
def joints_at(path: Array, step: float, s: Array) -> Array:
    """Return the joints (M, n) at distances (M,), by the quintic that has the grid's first two derivatives."""
    last = path.shape[1] - 1
    n = path.shape[2]
    out = np.empty((s.shape[0], n))
    for row in range(s.shape[0]):
        i = min(max(int(s[row] / step), 0), last - 1)
        u = min(max(s[row] / step - i, 0.0), 1.0)
        u3, w = u * u * u, 1.0 - u
        w3 = w * w * w
        a0, b0 = w3 * (1.0 + 3.0 * u + 6.0 * u * u), u3 * (1.0 + 3.0 * w + 6.0 * w * w)
        a1, b1 = w3 * u * (1.0 + 3.0 * u) * step, -u3 * w * (1.0 + 3.0 * w) * step
        a2, b2 = 0.5 * w3 * u * u * step * step, 0.5 * u3 * w * w * step * step
        for k in range(n):
            out[row, k] = (
                a0 * path[0, i, k] + a1 * path[1, i, k] + a2 * path[2, i, k]
                + b0 * path[0, i + 1, k] + b1 * path[1, i + 1, k] + b2 * path[2, i + 1, k]
            )  # fmt: skip
    return out


@compiled
def demands(joints: Array, s: Array, step: float, tip: Array, limits: Array, tip_limit: float, dt_s: float) -> Array:
    """Return for each tick (M,) by which factor time must be stretched there for all limits to hold, and never 0.

    Speeds, accelerations and jerks are differences of the joints (M, n) from tick to tick, as drives see them; before
    and behind the path the arm rests. `tip` (N,) is the way of the tip per distance along the path, on the grid.
    """
    count, n = joints.shape
    out = np.full(count + 3, 1e-9)
    q = np.empty((4, n))
    for row in range(count + 3):
        worst = 0.0
        for k in range(n):
            for back in range(4):
                q[back, k] = joints[min(max(row - back, 0), count - 1), k]
            v = abs(q[0, k] - q[1, k]) / dt_s
            a = abs(q[0, k] - 2.0 * q[1, k] + q[2, k]) / (dt_s * dt_s)
            j = abs(q[0, k] - 3.0 * q[1, k] + 3.0 * q[2, k] - q[3, k]) / (dt_s * dt_s * dt_s)
            worst = max(worst, v / limits[0, k], np.sqrt(a / limits[1, k]), np.cbrt(j / limits[2, k]))
        if 0 < row < count:
            i = min(int(s[row] / step), tip.shape[0] - 2)
            fastest = max(tip[i], tip[i + 1])
            worst = max(worst, fastest * (s[row] - s[row - 1]) / (dt_s * tip_limit))
        out[row] = max(worst, 1e-9)
    return out


@compiled
def lowered(ceiling: Array, x: Array, raw: Array, excess: Array, width: int, step: float, power: float) -> Array:
    """Return the ceiling (N,) of s'^2, lowered where the profile x (N,) leads to an excess (M,) above 1.

    A tick depends on the distances `raw` of the `width` ticks before it.
    """
    out = ceiling.copy()
    last, end = raw.shape[0] - 1, ceiling.shape[0] - 1
    for tick in range(excess.shape[0]):
        if excess[tick] <= 1.0:
            continue
        low = int(raw[min(max(tick - width - 2, 0), last)] / step)
        high = min(int(raw[min(tick, last)] / step) + 1, end)
        for i in range(low, high + 1):
            out[i] = min(out[i], x[i] / excess[tick] ** power)
    return out


@compiled
def tip_ways(dh: Array, path: Array, flange_from_tool: Array) -> Array:
    """Return the way of the tool's tip per distance along the path (N,), m/rad."""
    out = np.empty(path.shape[1])
    for i in range(path.shape[1]):
        _, jacobian = tool_and_jacobian(dh, path[0, i], flange_from_tool)
        way = jacobian[:3] @ path[1, i]
        out[i] = np.sqrt(way @ way)
    return out


def warm(dh: Array) -> None:
    """Compile every function of this file, or load it from the cache."""
    path = path_at(
        np.array([0.1 * dh[:, 0], 0.1 * dh[:, 0] + 1.0]), np.array([0.0, 1.0]), np.zeros(2), np.linspace(0.0, 1.0, 3)
    )
    ones, step = np.ones(3), 0.5
    x = squared_speeds(path, step, ones, np.ones(dh.shape[0]))
    raw = distances(x, step, 0.1)
    s = smoothed(raw, 2)
    excess = demands(
        joints_at(path, step, s), s, step, tip_ways(dh, path, np.eye(4)), np.ones((3, dh.shape[0])), 1.0, 0.1
    )
    lowered(ones, x, raw, excess, 2, step, 1.0)
