"""Compiled distances between the capsules of the arm and boxes, and between two capsules."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Mask
from hal.jit import compiled, inlined
from manipulation.arm.kernels import frames

Index = NDArray[np.int64]

GOLDEN = 0.6180339887498949
SEARCH_STEPS = 16  # 0.618^16 of a 0.5 m link: 0.2 mm of arc, far less in distance near the minimum


@inlined
def point_box(x: float, y: float, z: float, half: Array) -> float:
    """Return the signed distance from a point in box axes to the box, negative inside."""
    dx, dy, dz = abs(x) - half[0], abs(y) - half[1], abs(z) - half[2]
    ox, oy, oz = max(dx, 0.0), max(dy, 0.0), max(dz, 0.0)
    return float(np.sqrt(ox * ox + oy * oy + oz * oz) + min(max(dx, dy, dz), 0.0))


@inlined
def span_box(cx: float, cy: float, cz: float, sx: float, sy: float, sz: float, half: Array) -> float:
    """Return the least signed distance between a box and the segment from c - s to c + s, both in its axes."""
    low, high = -1.0, 1.0
    t1, t2 = high - 2.0 * GOLDEN, low + 2.0 * GOLDEN
    f1 = point_box(cx + t1 * sx, cy + t1 * sy, cz + t1 * sz, half)
    f2 = point_box(cx + t2 * sx, cy + t2 * sy, cz + t2 * sz, half)
    best = min(f1, f2, point_box(cx - sx, cy - sy, cz - sz, half), point_box(cx + sx, cy + sy, cz + sz, half))
    for _ in range(SEARCH_STEPS):
        if f1 < f2:
            high, t2, f2 = t2, t1, f1
            t1 = high - GOLDEN * (high - low)
            f1 = point_box(cx + t1 * sx, cy + t1 * sy, cz + t1 * sz, half)
            best = min(best, f1)
        else:
            low, t1, f1 = t1, t2, f2
            t2 = low + GOLDEN * (high - low)
            f2 = point_box(cx + t2 * sx, cy + t2 * sy, cz + t2 * sz, half)
            best = min(best, f2)
    return float(best)


@compiled
def segment_box(start: Array, end: Array, rotation: Array, middle: Array, half: Array) -> float:
    """Return the least signed distance between the segment and the box (rotation: base_from_box)."""
    c, s = np.zeros(3), np.zeros(3)
    for k in range(3):
        for m in range(3):
            c[k] += rotation[m, k] * (0.5 * (start[m] + end[m]) - middle[m])
            s[k] += rotation[m, k] * 0.5 * (end[m] - start[m])
    return span_box(c[0], c[1], c[2], s[0], s[1], s[2], half)


@compiled
def segment_segment(p1: Array, q1: Array, p2: Array, q2: Array) -> float:
    """Return the least distance between two segments.

    Source: Ericson, Real-Time Collision Detection, 2005, section 5.1.9.
    """
    ux, uy, uz = q1[0] - p1[0], q1[1] - p1[1], q1[2] - p1[2]
    vx, vy, vz = q2[0] - p2[0], q2[1] - p2[1], q2[2] - p2[2]
    rx, ry, rz = p1[0] - p2[0], p1[1] - p2[1], p1[2] - p2[2]
    a, e = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
    f = vx * rx + vy * ry + vz * rz
    if a <= 1e-12 and e <= 1e-12:
        return float(np.sqrt(rx * rx + ry * ry + rz * rz))
    if a <= 1e-12:
        s, t = 0.0, min(max(f / e, 0.0), 1.0)
    else:
        c = ux * rx + uy * ry + uz * rz
        if e <= 1e-12:
            s, t = min(max(-c / a, 0.0), 1.0), 0.0
        else:
            b = ux * vx + uy * vy + uz * vz
            denominator = a * e - b * b
            s = min(max((b * f - c * e) / denominator, 0.0), 1.0) if denominator > 1e-12 else 0.0
            t = (b * s + f) / e
            if t < 0.0:
                s, t = min(max(-c / a, 0.0), 1.0), 0.0
            elif t > 1.0:
                s, t = min(max((b - c) / a, 0.0), 1.0), 1.0
    gx, gy, gz = rx + s * ux - t * vx, ry + s * uy - t * vy, rz + s * uz - t * vz
    return float(np.sqrt(gx * gx + gy * gy + gz * gz))


@compiled
def capsule_ends(dh: Array, q: Array, tool_ends: Array) -> Array:
    """Return the ends (n + m, 2, 3) in the base of all capsules: the n links, then the m of the tool on the flange."""
    n, m = dh.shape[0], tool_ends.shape[0]
    chain = frames(dh, q)
    out = np.empty((n + m, 2, 3))
    for i in range(n):
        for k in range(3):
            out[i, 0, k], out[i, 1, k] = chain[i, k, 3], chain[i + 1, k, 3]
    for i in range(m):
        for side in range(2):
            for k in range(3):
                total = chain[n, k, 3]
                for j in range(3):
                    total += chain[n, k, j] * tool_ends[i, side, j]
                out[n + i, side, k] = total
    return out


@compiled
def least_clearance(
    dh: Array,
    q: Array,
    tool_ends: Array,
    radii: Array,
    rotations: Array,
    middles: Array,
    halves: Array,
    watched: Mask,
    pairs: Index,
    stop_below: float,
    enough: float,
) -> float:
    """Return the least gap (m, negative when overlapping) over all watched capsule-box pairs and self pairs.

    `watched`: (capsules, boxes) of bool. The first gap below `stop_below` ends the search, and for a least gap above
    `enough` a lower bound that is not below it may be returned. With both infinite the result is exact.
    """
    ends = capsule_ends(dh, q, tool_ends)
    count, boxes = ends.shape[0], halves.shape[0]
    least = np.inf
    reach = np.empty(boxes)
    for j in range(boxes):
        reach[j] = np.sqrt(halves[j, 0] ** 2 + halves[j, 1] ** 2 + halves[j, 2] ** 2)
    for i in range(count - 1, -1, -1):  # the hand first, because it is the nearest to something most of the time
        a, b = ends[i, 0], ends[i, 1]
        x, y, z = 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])
        u, v, w = 0.5 * (b[0] - a[0]), 0.5 * (b[1] - a[1]), 0.5 * (b[2] - a[2])
        length = np.sqrt(u * u + v * v + w * w)
        for j in range(boxes):
            if not watched[i, j]:
                continue
            # The spheres around both, then the box around the segment, rule out most pairs.
            dx, dy, dz = x - middles[j, 0], y - middles[j, 1], z - middles[j, 2]
            gap = np.sqrt(dx * dx + dy * dy + dz * dz) - reach[j] - length - radii[i]
            if gap < min(least, enough):
                r, half = rotations[j], halves[j]
                cx, sx = r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz, r[0, 0] * u + r[1, 0] * v + r[2, 0] * w
                cy, sy = r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz, r[0, 1] * u + r[1, 1] * v + r[2, 1] * w
                cz, sz = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz, r[0, 2] * u + r[1, 2] * v + r[2, 2] * w
                gap = max(gap, around(abs(cx) - abs(sx), abs(cy) - abs(sy), abs(cz) - abs(sz), half) - radii[i])
                if gap < min(least, enough):
                    gap = span_box(cx, cy, cz, sx, sy, sz, half) - radii[i]
            least = min(least, gap)
            if least < stop_below:
                return float(least)
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        gap = segment_segment(ends[i, 0], ends[i, 1], ends[j, 0], ends[j, 1]) - radii[i] - radii[j]
        least = min(least, gap)
        if least < stop_below:
            return float(least)
    return float(least)


@inlined
def around(x: float, y: float, z: float, half: Array) -> float:
    """Return the distance from a box to a point at (|x|, |y|, |z|) in its axes, and a number below any gap inside it."""
    dx, dy, dz = max(0.0, x - half[0]), max(0.0, y - half[1]), max(0.0, z - half[2])
    total = dx * dx + dy * dy + dz * dz
    return float(np.sqrt(total)) if total > 0.0 else -1e9


@compiled
def first_hit(
    dh: Array,
    start: Array,
    end: Array,
    step_rad: float,
    tool_ends: Array,
    radii: Array,
    rotations: Array,
    middles: Array,
    halves: Array,
    watched: Mask,
    pairs: Index,
    margin: float,
) -> float:
    """Return the free fraction of the straight joint segment, 1 when all of it is free.

    It is checked every `step_rad` of the fastest joint. Steps are left out where the last gap shows that they are free,
    because no point of the arm moves further than each joint's turn times its distance to the furthest point behind it.
    """
    longest = np.max(np.abs(end - start))
    count = max(1, int(np.ceil(longest / step_rad)))
    way = largest_way(dh, (end - start) / count, tool_ends, radii)
    k = 1
    while k <= count:
        q = start + (k / count) * (end - start)
        enough = margin + (count - k + 1) * way  # a larger gap leaves out no more steps
        gap = least_clearance(dh, q, tool_ends, radii, rotations, middles, halves, watched, pairs, margin, enough)
        if gap < margin:
            return (k - 1) / count
        k += 1 + int(min((gap - margin) / max(way, 1e-12), 1.0 * count))
    return 1.0


@inlined
def largest_way(dh: Array, turns: Array, tool_ends: Array, radii: Array) -> float:
    """Return a bound of the way of any point of arm and tool for turns (n,) of the joints."""
    beyond, thickest = 0.0, 0.0
    for i in range(tool_ends.shape[0]):
        for side in range(2):
            beyond = max(beyond, np.sqrt(np.dot(tool_ends[i, side], tool_ends[i, side])))
    for i in range(radii.shape[0]):
        thickest = max(thickest, radii[i])
    total = 0.0
    for i in range(dh.shape[0] - 1, -1, -1):
        beyond += np.sqrt(dh[i, 0] * dh[i, 0] + dh[i, 1] * dh[i, 1])
        total += abs(turns[i]) * (beyond + thickest)
    return float(total)


@compiled
def all_clear(
    dh: Array,
    samples: Array,
    tool_ends: Array,
    radii: Array,
    rotations: Array,
    middles: Array,
    halves: Array,
    watched: Mask,
    pairs: Index,
    margin: float,
) -> bool:
    """Return whether the gaps at all configurations (m, n) are at least the margin."""
    for row in range(samples.shape[0]):
        gap = least_clearance(
            dh, samples[row], tool_ends, radii, rotations, middles, halves, watched, pairs, margin, margin
        )
        if gap < margin:
            return False
    return True


@compiled
def overlap_counts(dh: Array, configurations: Array, tool_ends: Array, radii: Array, pairs: Index) -> Array:
    """Return for each pair of capsules (k,) in how many of the configurations (m, n) it overlaps."""
    out = np.zeros(pairs.shape[0])
    for c in range(configurations.shape[0]):
        ends = capsule_ends(dh, configurations[c], tool_ends)
        for k in range(pairs.shape[0]):
            i, j = pairs[k, 0], pairs[k, 1]
            gap = segment_segment(ends[i, 0], ends[i, 1], ends[j, 0], ends[j, 1]) - radii[i] - radii[j]
            out[k] += gap < 0.0
    return out
