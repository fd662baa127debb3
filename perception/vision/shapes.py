"""Sub-objects with straight or round outlines in the plate's rectified picture: circles by votes, rectangles by runs.

Votes: every edge pixel names the centres that its gradient points at, for every radius (D. H. Ballard, Pattern
Recognition 13(2), 1981). A candidate is then verified on the outline itself: the share of it that has an edge of the
right direction. Both are insensitive to what a region method fails on: glare, shadow, cables, low contrast inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.vision.image import Image
from perception.vision.registration import noise_sigma
from perception.vision.view import Array

Float32 = NDArray[np.float32]

SMALL_PX = 24.0
CIRCLE_SAMPLES = 40
CIRCLES_TRIED = 90
LEAST_COVERAGE = 0.45
ALIGNED = 0.8  # cosine between an edge's gradient and the outline's normal
MAX_SIDES = 90
SLOT_MOST_PX = 12  # across


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edges:
    """Gradient of a picture: `along_x`, `along_y` (gray levels a px), and `strong`, where it exceeds noise
    and texture, and `thin`, the ridge of that."""

    along_x: Float32
    along_y: Float32
    strength: Float32
    strong: NDArray[np.bool_]
    thin: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Circle:
    """A circle in picture pixels; `coverage` is the share of its outline that is an edge."""

    u: float
    v: float
    radius: float
    coverage: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Rectangle:
    """An upright rectangle in picture pixels: middle, size, and the share of its outline that is an edge."""

    u: float
    v: float
    width: float
    height: float
    coverage: float


def find_edges(picture: Image, *, sigma_px: float = 1.0) -> Edges:
    """Edges of a picture; a slope counts when it exceeds four sigmas of its noise and a share of the gray level."""
    smooth = np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), sigma_px), np.float32)
    gx = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125), np.float32)
    gy = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125), np.float32)
    strength = np.asarray(cv2.magnitude(gx, gy), np.float32)
    least = 2.0 + 0.5 * noise_sigma(picture) / sigma_px
    strong = strength > np.maximum(least, 0.022 * smooth)
    return Edges(along_x=gx, along_y=gy, strength=strength, strong=strong, thin=_thinned(gx, gy, strength, strong))


def find_circles(edges: Edges, *, least_px: float, most_px: float) -> list[Circle]:
    """Verified circles with radii between `least_px` and `most_px`, best first, near-duplicates removed."""
    v, u = np.nonzero(edges.thin)
    gx, gy = edges.along_x[v, u], edges.along_y[v, u]
    length = np.hypot(gx, gy)
    points = (u.astype(np.float64), v.astype(np.float64), gx / length, gy / length)
    found = []
    # The direction of an edge errs by a few degrees, so the votes of large circles spread: count them in larger cells.
    for low, high, step, cell in ((least_px, SMALL_PX, 1.0, 2), (max(least_px, SMALL_PX), most_px, 2.0, 4)):
        radii = np.arange(round(low), round(high) + 1, step)
        if len(radii) < 3:
            continue
        height, width = edges.strong.shape
        votes = np.zeros((len(radii), height // cell + 2, width // cell + 2), np.float32)
        _vote(votes, *points, radii, cell)
        for u0, v0, r0 in _peaks(_pooled(votes, radii), radii, cell):
            circle = _verified_circle(edges, u0, v0, r0)
            if circle is not None:
                found.append(circle)
    return _distinct(found)


def _pooled(votes: Float32, radii: Array) -> Float32:
    """Votes summed over neighbouring places and radii, over the circumference."""
    blurred = np.stack([cv2.GaussianBlur(plane, (0, 0), 0.9) for plane in votes])
    blurred[1:-1] = (blurred[:-2] + blurred[1:-1] + blurred[2:]) / 3.0
    return np.asarray(blurred / radii[:, None, None].astype(np.float32), np.float32)


def find_rectangles(edges: Edges, *, least_px: float, most_px: float) -> list[Rectangle]:
    """Upright rectangles with sides between `least_px` and `most_px`, verified on all four sides."""
    flat, upright = _direction_maps(edges)
    rows, columns = _runs(flat, least_px), _runs(upright.T, least_px)
    flat_sum, upright_sum = _sums(flat, 1), _sums(upright, 0)
    found: list[Rectangle] = []
    for top, bottom in _pairs(rows, least_px, most_px):
        x0, x1 = (top[0] + bottom[0]) / 2, (top[1] + bottom[1]) / 2
        found.append(_judged(flat_sum, upright_sum, x0, top[2], x1, bottom[2]))
    for left, right in _pairs(columns, least_px, most_px):
        y0, y1 = (left[0] + right[0]) / 2, (left[1] + right[1]) / 2
        found.append(_judged(flat_sum, upright_sum, left[2], y0, right[2], y1))
    found = [r for r in found if r.coverage >= 0.55]
    kept: list[Rectangle] = []
    for r in sorted(found, key=lambda r: r.coverage, reverse=True):
        if not any(
            abs(r.u - k.u) + abs(r.v - k.v) < 5 and abs(r.width - k.width) < 5 and abs(r.height - k.height) < 5
            for k in kept
        ):
            kept.append(r)
    return kept


def find_slots(edges: Edges, *, least_px: float, most_px: float) -> list[tuple[float, float]]:
    """Middles of long thin things, flat or upright: slots and tracks, whatever covers part of them."""
    found = []
    flat, upright = _direction_maps(edges)
    for mask, is_flat in ((flat, True), (upright.T, False)):
        bridged = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((1, 25), np.uint8))
        bridged = cv2.morphologyEx(bridged, cv2.MORPH_OPEN, np.ones((1, round(least_px)), np.uint8))
        count, _, stats, middle = cv2.connectedComponentsWithStats(bridged, connectivity=8)
        for k in range(1, count):
            if least_px <= stats[k, 2] <= most_px and stats[k, 3] <= SLOT_MOST_PX:
                along, across = float(stats[k, 0] + (stats[k, 2] - 1) / 2), float(middle[k][1])
                found.append((along, across) if is_flat else (across, along))
    return found


@njit(cache=True)
def _vote(
    votes: Float32, u: Array, v: Array, nx: Array, ny: Array, radii: Array, cell: int
) -> None:  # pragma: no cover
    """One vote a radius on either side of every edge pixel."""
    _, height, width = votes.shape
    for i in range(len(u)):
        for k in range(len(radii)):
            for sign in (-1.0, 1.0):
                x = int((u[i] + sign * radii[k] * nx[i]) / cell + 0.5)
                y = int((v[i] + sign * radii[k] * ny[i]) / cell + 0.5)
                if 0 <= x < width and 0 <= y < height:
                    votes[k, y, x] += 1.0


def _thinned(gx: Float32, gy: Float32, s: Float32, strong: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Edge pixels that are not weaker than both neighbours along the gradient (to the nearest axis)."""
    out = np.zeros(strong.shape, bool)
    middle = s[1:-1, 1:-1]
    across_x = np.abs(gx[1:-1, 1:-1]) >= np.abs(gy[1:-1, 1:-1])
    flat = (middle >= s[1:-1, :-2]) & (middle > s[1:-1, 2:])
    upright = (middle >= s[:-2, 1:-1]) & (middle > s[2:, 1:-1])
    out[1:-1, 1:-1] = strong[1:-1, 1:-1] & np.where(across_x, flat, upright)
    return out


def _peaks(votes: Float32, radii: Array, cell: int) -> list[tuple[float, float, float]]:
    """The strongest local maxima over place and radius."""
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
    """Best circle near a guess, if enough of its outline is an edge."""
    place = np.array([u0, v0, r0])
    score = -1.0
    for step in (3.0, 1.5, 0.7) if r0 >= SMALL_PX else (1.5, 0.7):
        du, dv, dr = np.meshgrid(*[np.array([-1.0, 0.0, 1.0]) * step] * 3, indexing="ij")
        tried = place + np.column_stack([du.ravel(), dv.ravel(), dr.ravel()])
        scores = circle_coverage(edges, tried)
        k = int(scores.argmax())
        if scores[k] <= score:
            break
        place, score = tried[k], float(scores[k])
        if score < 0.25:
            return None
    if score < LEAST_COVERAGE:
        return None
    return Circle(u=float(place[0]), v=float(place[1]), radius=float(place[2]), coverage=score)


def circle_coverage(edges: Edges, circles: Array) -> Array:
    """(N,) share of the outline of (N, 3) circles (u, v, r) that has an edge along the normal."""
    a = np.linspace(0, 2 * np.pi, CIRCLE_SAMPLES, endpoint=False)
    nx, ny = np.sin(a), -np.cos(a)
    u = np.round(circles[:, :1] + circles[:, 2:] * nx).astype(int)
    v = np.round(circles[:, 1:2] + circles[:, 2:] * ny).astype(int)
    height, width = edges.strong.shape
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    s = edges.strength[v, u]
    aligned = np.abs(edges.along_x[v, u] * nx + edges.along_y[v, u] * ny) > ALIGNED * s
    return np.asarray((inside & edges.strong[v, u] & aligned).mean(axis=1))


def _distinct(circles: list[Circle]) -> list[Circle]:
    kept: list[Circle] = []
    for c in sorted(circles, key=lambda c: c.coverage, reverse=True):
        if not any(np.hypot(c.u - k.u, c.v - k.v) < 4 and abs(c.radius - k.radius) < 2 for k in kept):
            kept.append(c)
    return kept


def _direction_maps(edges: Edges) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Where there is a flat edge, and where an upright one; each widened by one pixel across."""
    ax, ay = np.abs(edges.along_x), np.abs(edges.along_y)
    ones = np.ones(3, np.uint8)
    flat = cv2.dilate((edges.thin & (ay > 1.8 * ax)).astype(np.uint8), ones[:, None])
    upright = cv2.dilate((edges.thin & (ax > 1.8 * ay)).astype(np.uint8), ones[None, :])
    return flat > 0, upright > 0


def _runs(flat: NDArray[np.bool_], least_px: float) -> list[tuple[float, float, float]]:
    """(start, end, row) of flat edges longer than `least_px`, short gaps bridged."""
    bridged = cv2.morphologyEx(flat.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((1, 9), np.uint8))
    bridged = cv2.morphologyEx(bridged, cv2.MORPH_OPEN, np.ones((1, max(5, round(0.8 * least_px))), np.uint8))
    count, _, stats, middle = cv2.connectedComponentsWithStats(bridged, connectivity=4)
    runs = [
        (float(stats[k, 0]), float(stats[k, 0] + stats[k, 2] - 1), float(middle[k][1]))
        for k in range(1, count)
        if stats[k, 2] >= least_px and stats[k, 3] <= 6
    ]
    runs.sort(key=lambda run: run[0] - run[1])
    return runs[:MAX_SIDES]


def _pairs(
    runs: list[tuple[float, float, float]], least_px: float, most_px: float
) -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
    """Runs that face each other."""
    out = []
    for i, a in enumerate(runs):
        for b in runs[i + 1 :]:
            gap = abs(a[2] - b[2])
            if (
                least_px <= gap <= most_px
                and abs(a[0] - b[0]) < 9
                and abs(a[1] - b[1]) < 9
                and a[1] - a[0] <= most_px + 9
            ):
                out.append((a, b) if a[2] < b[2] else (b, a))
    return out


def _sums(mask: NDArray[np.bool_], axis: int) -> NDArray[np.int32]:
    pad = [(0, 0), (0, 0)]
    pad[axis] = (1, 0)
    return np.asarray(np.pad(np.cumsum(mask, axis=axis, dtype=np.int32), pad))


def _judged(
    flat: NDArray[np.int32], upright: NDArray[np.int32], x0: float, y0: float, x1: float, y1: float
) -> Rectangle:
    """Coverage of the four sides: the mean, held down by the worst side."""
    a, b = round(max(x0, 0)), round(min(x1, flat.shape[1] - 2))
    c, d = round(max(y0, 0)), round(min(y1, upright.shape[0] - 2))
    if b - a < 4 or d - c < 4:
        return Rectangle(u=x0, v=y0, width=0.0, height=0.0, coverage=0.0)
    sides = [(flat[row, b + 1] - flat[row, a]) / (b - a + 1) for row in (c, d)]
    sides += [
        max(
            (upright[d + 1, col + k] - upright[c, col + k]) / (d - c + 1)
            for k in (-1, 0, 1)
            if 0 <= col + k < upright.shape[1]
        )
        for col in (a, b)
    ]
    coverage = float(np.mean(sides) * 0.6 + min(sides) * 0.4)
    return Rectangle(u=(x0 + x1) / 2, v=(y0 + y1) / 2, width=x1 - x0, height=y1 - y0, coverage=coverage)
