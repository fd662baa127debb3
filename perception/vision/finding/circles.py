"""Hough detection of circles in the plate's rectified picture.

Every edge pixel votes, for every radius, for the centres at which its gradient points (D. H. Ballard, Pattern
Recognition 13(2), 1981). A candidate is then verified by the share of its outline that has an edge along the normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jit import compiled, inlined
from perception.vision.finding.shapes import Edges, Float32, distinct

SMALL_PX = 24.0  # radius up to which circles are searched in small cells
CIRCLE_SAMPLES = 40  # points on an outline
CIRCLES_TRIED = 90  # peaks of the votes that are verified
LEAST_COVERAGE = 0.45
HOPELESS_COVERAGE = 0.25  # candidates below it are not refined
ALIGNED = 0.8  # least cosine between an edge's gradient and the outline's normal
# Steps of the search around a peak of the votes, whose cells are larger for large radii.
STEPS_LARGE_PX = np.array([3.0, 1.5, 0.7])
STEPS_SMALL_PX = STEPS_LARGE_PX[1:]
SAME_PX = np.array([4.0, 4.0, 2.0])  # differences of u, v and radius below which two circles are one
TURNS = np.linspace(0, 2 * np.pi, CIRCLE_SAMPLES, endpoint=False)
NORMALS = np.column_stack([np.sin(TURNS), -np.cos(TURNS)])


@dataclass(frozen=True, slots=True, kw_only=True)
class Circle:
    """A circle in picture pixels; `coverage` is the share of its outline on which there is an edge."""

    u: float
    v: float
    radius: float
    coverage: float


def find_circles(edges: Edges, *, least_px: float, most_px: float) -> list[Circle]:
    """Return the verified circles with radii between `least_px` and `most_px`, best first, without near-duplicates."""
    v, u = np.divmod(np.flatnonzero(edges.thin), edges.thin.shape[1])
    gx, gy = edges.along_x[v, u], edges.along_y[v, u]
    length = np.hypot(gx, gy)
    points = (u.astype(np.float64), v.astype(np.float64), gx / length, gy / length)
    found = []
    # The direction of an edge is wrong by a few degrees, so the votes of large circles scatter and need larger cells.
    for low, high, step, cell in ((least_px, SMALL_PX, 1.5, 2), (max(least_px, SMALL_PX), most_px, 2.0, 4)):
        radii = np.arange(round(low), round(high) + 1, step)
        if len(radii) < 3:
            continue
        height, width = edges.strong.shape
        votes = np.zeros((len(radii), height // cell + 2, width // cell + 2), np.float32)
        _vote(votes, *points, radii, cell)
        _pool(votes, radii)
        for u0, v0, r0 in _peaks(votes, radii, cell):
            circle = _verified_circle(edges, u0, v0, r0)
            if circle is not None:
                found.append(circle)
    return _distinct(found)


def _pool(votes: Float32, radii: Array) -> None:
    """Sum the votes in place over neighbouring places and radii, and divide by the circumference."""
    for plane in votes:
        cv2.GaussianBlur(plane, (5, 5), 0.9, dst=plane)
    _average(votes, radii.astype(np.float32))


def _peaks(votes: Float32, radii: Array, cell: int) -> list[tuple[float, float, float]]:
    """Return the strongest local maxima over place and radius, as (u, v, radius)."""
    best = votes.max(axis=0)
    local = (best >= cv2.dilate(best, np.ones((3, 3), np.uint8))) & (best > 0.5)
    v, u = np.nonzero(local)
    order = np.argsort(best[v, u])[::-1][:CIRCLES_TRIED]
    out = []
    for i in order:
        profile = votes[:, v[i], u[i]].copy()
        for _ in range(2):  # a second radius about the same middle: rims and rings are concentric
            k = int(profile.argmax())
            if profile[k] < 0.5:
                break
            out.append((float(u[i] * cell), float(v[i] * cell), float(radii[k])))
            profile[max(0, k - 3) : k + 4] = 0.0
    return out


def _verified_circle(edges: Edges, u0: float, v0: float, r0: float) -> Circle | None:
    """Return the best circle near a guess, or None if too little of its outline is an edge."""
    steps = STEPS_LARGE_PX if r0 >= SMALL_PX else STEPS_SMALL_PX
    maps = (edges.along_x, edges.along_y, edges.strength, edges.strong)
    u, v, radius, coverage = _climbed(*maps, NORMALS, steps, u0, v0, r0)
    return Circle(u=u, v=v, radius=radius, coverage=coverage) if coverage >= LEAST_COVERAGE else None


def circle_coverage(edges: Edges, circles: Array) -> Array:
    """Return the share (N,) of the outline of circles (N, 3; u, v, r) with an edge along the normal, in plain numpy."""
    nx, ny = NORMALS.T
    u = np.round(circles[:, :1] + circles[:, 2:] * nx).astype(int)
    v = np.round(circles[:, 1:2] + circles[:, 2:] * ny).astype(int)
    height, width = edges.strong.shape
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    s = edges.strength[v, u]
    aligned = np.abs(edges.along_x[v, u] * nx + edges.along_y[v, u] * ny) > ALIGNED * s
    return np.asarray((inside & edges.strong[v, u] & aligned).mean(axis=1))


def _distinct(circles: list[Circle]) -> list[Circle]:
    """Return the circles, best first, without those that nearly equal a better one."""
    ordered = sorted(circles, key=lambda c: c.coverage, reverse=True)
    values = np.array([[c.u, c.v, c.radius] for c in ordered]).reshape(-1, 3)
    return [ordered[k] for k in distinct(values, SAME_PX)]


@compiled
def _average(planes: Float32, radii: Float32) -> None:
    """Average every plane in place with its two neighbours along the radius; the outermost planes stay unchanged."""
    count, height, width = planes.shape
    before, here = planes[0].copy(), planes[0].copy()
    for k in range(count):
        inner = 0 < k < count - 1
        share = np.float32(1.0 / (3.0 * radii[k]))
        above = planes[k + 1 if inner else k]
        for y in range(height):
            for x in range(width):
                value = planes[k, y, x]
                here[y, x] = value
                planes[k, y, x] = ((before[y, x] if inner else value) + value + above[y, x]) * share
        before, here = here, before


@compiled
def _vote(votes: Float32, u: Array, v: Array, nx: Array, ny: Array, radii: Array, cell: int) -> None:
    """Add one vote per radius on either side of every edge pixel.

    The loop runs radius by radius, so that one plane of votes stays in the cache.
    """
    _, height, width = votes.shape
    share = 1.0 / cell  # the cell is a power of two, so this is exact, and faster than a division
    for k in range(len(radii)):
        plane = votes[k]
        reach = radii[k] * share
        for i in range(len(u)):
            x0, y0, dx, dy = u[i] * share + 0.5, v[i] * share + 0.5, reach * nx[i], reach * ny[i]
            for sign in (-1.0, 1.0):
                x, y = int(x0 + sign * dx), int(y0 + sign * dy)
                if 0 <= x < width and 0 <= y < height:
                    plane[y, x] += 1.0


@inlined
def _covered(
    gx: Float32, gy: Float32, strength: Float32, strong: NDArray[np.bool_], normals: Array, u: float, v: float, r: float
) -> float:
    """Return the `circle_coverage` of one circle."""
    height, width = strong.shape
    hits = 0
    for i in range(len(normals)):
        x, y = int(np.rint(u + r * normals[i, 0])), int(np.rint(v + r * normals[i, 1]))
        if x < 0 or y < 0 or x >= width or y >= height or not strong[y, x]:
            continue
        if abs(gx[y, x] * normals[i, 0] + gy[y, x] * normals[i, 1]) > ALIGNED * strength[y, x]:
            hits += 1
    return hits / len(normals)


@compiled
def _climbed(
    gx: Float32, gy: Float32, strength: Float32, strong: NDArray[np.bool_], normals: Array, steps: Array,
    u: float, v: float, r: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return (u, v, r, coverage) after hill climbing: the best of 27 neighbours per step, with shrinking steps."""
    score = -1.0
    for step in steps:
        best, best_u, best_v, best_r = -1.0, u, v, r
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    a, b, c = u + i * step, v + j * step, r + k * step
                    found = _covered(gx, gy, strength, strong, normals, a, b, c)
                    if found > best:
                        best, best_u, best_v, best_r = found, a, b, c
        if best <= score:
            break
        score, u, v, r = best, best_u, best_v, best_r
        if score < HOPELESS_COVERAGE:
            break
    return u, v, r, score
