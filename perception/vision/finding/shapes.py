"""Edges of the plate's rectified picture, and its rectangles and slots, found by runs of edge pixels.

A candidate is verified by the share of its outline that has an edge of the right direction. Unlike region methods, this
is insensitive to glare, shadow, cables and low contrast inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from perception.vision.finding.components import components
from perception.vision.noise import noise_sigma

Float32 = NDArray[np.float32]
DirectionMaps = tuple[NDArray[np.bool_], NDArray[np.bool_]]  # flat edges, upright edges

MAX_SIDES = 90  # longest runs that are paired
SLOT_MOST_PX = 12  # largest width of a slot


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edges:
    """Gradient of a picture and its edges, (H, W) each.

    Attributes:
        along_x, along_y, strength: gradient and its magnitude, gray levels per px.
        strong: where the magnitude exceeds noise and texture.
        thin: ridge of the magnitude where it is strong.
    """

    along_x: Float32
    along_y: Float32
    strength: Float32
    strong: NDArray[np.bool_]
    thin: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rectangle:
    """An upright rectangle in picture pixels: middle, size, and the share of its outline on which there is an edge."""

    u: float
    v: float
    width: float
    height: float
    coverage: float


def find_edges(picture: Image, *, sigma_px: float = 1.0) -> Edges:
    """Return the edges of a picture: slopes of more than four sigmas of their noise and a share of the gray level."""
    smooth = np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), sigma_px), np.float32)
    gx = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125), np.float32)
    gy = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125), np.float32)
    strength = np.asarray(cv2.magnitude(gx, gy), np.float32)
    least = 2.0 + 0.5 * noise_sigma(picture) / sigma_px
    strong = strength > np.maximum(least, 0.022 * smooth)
    return Edges(along_x=gx, along_y=gy, strength=strength, strong=strong, thin=_thinned(gx, gy, strength, strong))


def find_rectangles(maps: DirectionMaps, *, least_px: float, most_px: float) -> list[Rectangle]:
    """Return upright rectangles with sides between `least_px` and `most_px`, verified on all four sides."""
    flat, upright = maps
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


def find_slots(maps: DirectionMaps, *, least_px: float, most_px: float) -> list[tuple[float, float]]:
    """Return the middles of long thin horizontal or vertical shapes: slots and tracks, even if partly covered."""
    found = []
    flat, upright = maps
    for mask, is_flat in ((flat, True), (upright.T, False)):
        bridged = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((1, 25), np.uint8))
        bridged = cv2.morphologyEx(bridged, cv2.MORPH_OPEN, np.ones((1, round(least_px)), np.uint8))
        for left, _, width, height, _, across in components(np.asarray(bridged, np.uint8), diagonal=True):
            if least_px <= width <= most_px and height <= SLOT_MOST_PX:
                along = float(left + (width - 1) / 2)
                found.append((along, float(across)) if is_flat else (float(across), along))
    return found


def _thinned(gx: Float32, gy: Float32, s: Float32, strong: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the strong pixels that are not weaker than both neighbours along the gradient (to the nearest axis)."""
    out = np.zeros(strong.shape, bool)
    middle = s[1:-1, 1:-1]
    across_x = np.abs(gx[1:-1, 1:-1]) >= np.abs(gy[1:-1, 1:-1])
    flat = (middle >= s[1:-1, :-2]) & (middle > s[1:-1, 2:])
    upright = (middle >= s[:-2, 1:-1]) & (middle > s[2:, 1:-1])
    out[1:-1, 1:-1] = strong[1:-1, 1:-1] & np.where(across_x, flat, upright)
    return out


def direction_maps(edges: Edges) -> DirectionMaps:
    """Return where there are horizontal edges, and where vertical ones, each widened by one pixel on both sides."""
    ax, ay = np.abs(edges.along_x), np.abs(edges.along_y)
    ones = np.ones(3, np.uint8)
    flat = cv2.dilate((edges.thin & (ay > 1.8 * ax)).astype(np.uint8), ones[:, None])
    upright = cv2.dilate((edges.thin & (ax > 1.8 * ay)).astype(np.uint8), ones[None, :])
    return flat > 0, upright > 0


def _runs(flat: NDArray[np.bool_], least_px: float) -> list[tuple[float, float, float]]:
    """Return (start, end, row) of horizontal edges longer than `least_px`, with short gaps bridged, longest first."""
    bridged = cv2.morphologyEx(flat.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((1, 9), np.uint8))
    bridged = cv2.morphologyEx(bridged, cv2.MORPH_OPEN, np.ones((1, max(5, round(0.8 * least_px))), np.uint8))
    runs = [
        (float(left), float(left + width - 1), float(row))
        for left, _, width, height, _, row in components(np.asarray(bridged, np.uint8), diagonal=False)
        if width >= least_px and height <= 6
    ]
    runs.sort(key=lambda run: run[0] - run[1])
    return runs[:MAX_SIDES]


def _pairs(
    runs: list[tuple[float, float, float]], least_px: float, most_px: float
) -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
    """Return the pairs of runs that are opposite sides of a rectangle."""
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
    """Return the cumulative sums of a mask along an axis, beginning with 0."""
    pad = [(0, 0), (0, 0)]
    pad[axis] = (1, 0)
    return np.asarray(np.pad(np.cumsum(mask, axis=axis, dtype=np.int32), pad))


def _judged(
    flat: NDArray[np.int32], upright: NDArray[np.int32], x0: float, y0: float, x1: float, y1: float
) -> Rectangle:
    """Return a rectangle with its coverage: the mean over its four sides, lowered by the worst side.

    `flat`, `upright`: cumulative sums of the direction maps.
    """
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
