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


@compiled
def segment_box(start: Array, end: Array, rotation: Array, middle: Array, half: Array) -> float:
    """Return the least signed distance between the segment and the box (rotation: base_from_box)."""
    a, b = np.empty(3), np.empty(3)
    for k in range(3):
        a[k] = b[k] = 0.0
        for m in range(3):
            a[k] += rotation[m, k] * (start[m] - middle[m])
            b[k] += rotation[m, k] * (end[m] - middle[m])
    d = b - a
    low, high = 0.0, 1.0
    t1, t2 = high - GOLDEN, GOLDEN
    f1 = point_box(a[0] + t1 * d[0], a[1] + t1 * d[1], a[2] + t1 * d[2], half)
    f2 = point_box(a[0] + t2 * d[0], a[1] + t2 * d[1], a[2] + t2 * d[2], half)
    best = min(f1, f2, point_box(a[0], a[1], a[2], half), point_box(b[0], b[1], b[2], half))
    for _ in range(SEARCH_STEPS):
        if f1 < f2:
            high, t2, f2 = t2, t1, f1
            t1 = high - GOLDEN * (high - low)
            f1 = point_box(a[0] + t1 * d[0], a[1] + t1 * d[1], a[2] + t1 * d[2], half)
            best = min(best, f1)
        else:
            low, t1, f1 = t1, t2, f2
            t2 = low + GOLDEN * (high - low)
            f2 = point_box(a[0] + t2 * d[0], a[1] + t2 * d[1], a[2] + t2 * d[2], half)
            best = min(best, f2)
    return best


@inlined
def outside_of_box(middle: Array, half_span: Array, rotation: Array, half: Array) -> float:
    """Return a lower bound of the distance of a segment from a box: that of the box around it in the box's axes.

    `middle` and `half_span` (3,) of the segment are given from the middle of the box, in the axes of the base.
    """
    total = 0.0
    for k in range(3):
        place, reach = 0.0, 0.0
        for m in range(3):
            place += rotation[m, k] * middle[m]
            reach += rotation[m, k] * half_span[m]
        gap = max(0.0, abs(place) - abs(reach) - half[k])
        total += gap * gap
    return float(np.sqrt(total)) if total > 0.0 else -1e9


@compiled
def segment_segment(p1: Array, q1: Array, p2: Array, q2: Array) -> float:
    """Return the least distance between two segments.

    Source: Ericson, Real-Time Collision Detection, 2005, section 5.1.9.
    """
    d1, d2, r = q1 - p1, q2 - p2, p1 - p2
    a, e = np.dot(d1, d1), np.dot(d2, d2)
    f = np.dot(d2, r)
    if a <= 1e-12 and e <= 1e-12:
        return float(np.sqrt(np.dot(r, r)))
    if a <= 1e-12:
        s, t = 0.0, min(max(f / e, 0.0), 1.0)
    else:
        c = np.dot(d1, r)
        if e <= 1e-12:
            s, t = min(max(-c / a, 0.0), 1.0), 0.0
        else:
            b = np.dot(d1, d2)
            denominator = a * e - b * b
            s = min(max((b * f - c * e) / denominator, 0.0), 1.0) if denominator > 1e-12 else 0.0
            t = (b * s + f) / e
            if t < 0.0:
                s, t = min(max(-c / a, 0.0), 1.0), 0.0
            elif t > 1.0:
                s, t = min(max((b - c) / a, 0.0), 1.0), 1.0
    gap = r + s * d1 - t * d2
    return float(np.sqrt(np.dot(gap, gap)))


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
    enough: float,
) -> float:
    """Return the least gap (m, negative when overlapping) over all watched capsule-box pairs and self pairs.

    `watched`: (capsules, boxes) of bool. For gaps above `enough` a lower bound may be returned, and the first gap below
    it ends the search, so a validity check is cheap. With `enough` infinite the result is exact.
    """
    ends = capsule_ends(dh, q, tool_ends)
    least = np.inf
    for i in range(ends.shape[0]):
        for j in range(halves.shape[0]):
            if watched[i, j]:
                # The bounding sphere of the box, then the box around the segment, rule out most pairs.
                reach = np.sqrt(np.dot(halves[j], halves[j]))
                centre = 0.5 * (ends[i, 0] + ends[i, 1])
                span = ends[i, 1] - ends[i, 0]
                apart = centre - middles[j]
                bound = np.sqrt(np.dot(apart, apart)) - reach - 0.5 * np.sqrt(np.dot(span, span)) - radii[i]
                if bound >= min(least, enough):
                    least = min(least, bound)
                    continue
                bound = outside_of_box(centre - middles[j], 0.5 * span, rotations[j], halves[j]) - radii[i]
                if bound >= min(least, enough):
                    least = min(least, bound)
                    continue
                gap = segment_box(ends[i, 0], ends[i, 1], rotations[j], middles[j], halves[j]) - radii[i]
                least = min(least, gap)
                if least < enough < np.inf:
                    return float(least)
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        gap = segment_segment(ends[i, 0], ends[i, 1], ends[j, 0], ends[j, 1]) - radii[i] - radii[j]
        least = min(least, gap)
        if least < enough < np.inf:
            return float(least)
    return float(least)


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
        gap = least_clearance(dh, q, tool_ends, radii, rotations, middles, halves, watched, pairs, np.inf)
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
        gap = least_clearance(dh, samples[row], tool_ends, radii, rotations, middles, halves, watched, pairs, margin)
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
