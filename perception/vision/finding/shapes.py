"""Edges of the plate's rectified picture, and its rectangles and slots, found by runs of edge pixels.

A candidate is verified by the share of its outline that has an edge of the right direction. Unlike region methods, this
is insensitive to glare, shadow, cables and low contrast inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.jit import compiled
from perception.vision.finding.components import Runs, bridged, connected, runs_of
from perception.vision.noise import noise_sigma

Float32 = NDArray[np.float32]
Mask = NDArray[np.uint8]
Indices = NDArray[np.int64]

TEXTURE = 0.022  # share of the gray level that the slopes of a printed or brushed surface reach
STEEPER = 1.8  # a gradient so much stronger in one direction than in the other is that of a horizontal or vertical edge
MAX_SIDES = 90  # longest runs that are paired
SIDE_GAP_PX, SLOT_GAP_PX = 8, 24  # gaps that are bridged, by a cable for example
SIDE_MOST_PX = 6  # largest thickness of a side
SIDES_UNEVEN_PX = 9  # opposite sides end less than this apart
SLOT_MOST_PX = 12  # largest width of a slot
LEAST_BOX_PX = 4
SAME_PX = np.array([3.0, 3.0, 5.0, 5.0])  # differences of middle and size below which two rectangles are one
LEAST_COVERAGE = 0.55


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Edges that lie along the rows of a picture: the mask (H, W) of their pixels, and its `runs_of`."""

    mask: Mask
    runs: Runs


DirectionMaps = tuple[Rows, Rows]  # horizontal edges, and vertical ones of the transposed picture


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
    strong, thin = _ridges(gx, gy, strength, smooth, np.float32(least))
    return Edges(along_x=gx, along_y=gy, strength=strength, strong=strong, thin=thin)


def find_rectangles(maps: DirectionMaps, *, least_px: float, most_px: float) -> list[Rectangle]:
    """Return upright rectangles with sides between `least_px` and `most_px`, verified on all four sides."""
    flat, upright = maps
    boxes = _between_sides(_sides(flat, least_px), least_px, most_px)
    across = _between_sides(_sides(upright, least_px), least_px, most_px)
    boxes = np.concatenate([boxes, across[:, [1, 0, 3, 2]]])
    coverage = _coverage(flat.mask, upright.mask, boxes)
    boxes, coverage = boxes[coverage >= LEAST_COVERAGE], coverage[coverage >= LEAST_COVERAGE]
    order = np.argsort(-coverage, kind="stable")
    laid = np.hstack([boxes[order, :2] + boxes[order, 2:], boxes[order, 2:] - boxes[order, :2]]) * [0.5, 0.5, 1.0, 1.0]
    kept = distinct(laid, SAME_PX)
    return [
        Rectangle(u=u, v=v, width=width, height=height, coverage=share)
        for (u, v, width, height), share in zip(laid[kept].tolist(), coverage[order][kept].tolist(), strict=True)
    ]


@compiled
def distinct(values: Array, apart: Array) -> Indices:
    """Return which of the rows (N, D) differ from every earlier one of these by `apart` (D,) or more in some column."""
    kept = np.empty(len(values), np.int64)
    count = 0
    for k in range(len(values)):
        is_new = True
        for j in kept[:count]:
            column = 0
            while column < len(apart) and abs(values[k, column] - values[j, column]) < apart[column]:
                column += 1
            if column == len(apart):
                is_new = False
                break
        if is_new:
            kept[count] = k
            count += 1
    return kept[:count]


def find_slots(maps: DirectionMaps, *, least_px: float, most_px: float) -> list[tuple[float, float]]:
    """Return the middles of long thin horizontal or vertical shapes: slots and tracks, even if partly covered."""
    found = []
    flat, upright = maps
    for rows, is_flat in ((flat, True), (upright, False)):
        tracks = bridged(rows.runs, SLOT_GAP_PX, round(least_px))
        for left, _, width, height, _, across in connected(tracks, diagonal=True):
            if least_px <= width <= most_px and height <= SLOT_MOST_PX:
                along = float(left + (width - 1) / 2)
                found.append((along, float(across)) if is_flat else (float(across), along))
    return found


@compiled
def _ridges(
    gx: Float32, gy: Float32, s: Float32, smooth: Float32, least: np.float32
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where a gradient is strong, and where it is moreover no weaker than both neighbours along its nearest axis.

    Args:
        s: magnitude of the gradient (gx, gy) of the picture `smooth`.
        least: magnitude that noise does not reach.
    """
    height, width = s.shape
    strong, thin = np.zeros((height, width), np.bool_), np.zeros((height, width), np.bool_)
    share = np.float32(TEXTURE)
    for y in range(height):
        for x in range(width):
            strong[y, x] = s[y, x] > max(least, share * smooth[y, x])
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            here = s[y, x]
            is_across_x = abs(gx[y, x]) >= abs(gy[y, x])
            is_flat = (here >= s[y, x - 1]) & (here > s[y, x + 1])
            is_upright = (here >= s[y - 1, x]) & (here > s[y + 1, x])
            thin[y, x] = strong[y, x] & ((is_across_x & is_flat) | (~is_across_x & is_upright))
    return strong, thin


def direction_maps(edges: Edges) -> DirectionMaps:
    """Return where there are horizontal edges, and where vertical ones, each widened by one pixel on both sides."""
    flat, upright = _directions(edges.along_x, edges.along_y, edges.thin)
    return Rows(mask=flat, runs=runs_of(flat)), Rows(mask=upright, runs=runs_of(upright))


@compiled
def _directions(gx: Float32, gy: Float32, thin: NDArray[np.bool_]) -> tuple[Mask, Mask]:
    """Return the mask (H, W) of the widened horizontal edges, and the transposed mask (W, H) of the vertical ones."""
    height, width = thin.shape
    flat, upright = np.zeros((height, width), np.uint8), np.zeros((width, height), np.uint8)
    for y in range(height):
        for x in range(width):
            if not thin[y, x]:
                continue
            across, along = abs(gx[y, x]), abs(gy[y, x])
            if along > STEEPER * across:
                flat[max(y - 1, 0) : y + 2, x] = 1
            elif across > STEEPER * along:
                upright[max(x - 1, 0) : x + 2, y] = 1
    return flat, upright


def _sides(rows: Rows, least_px: float) -> Array:
    """Return start, end and row (N, 3) of the edges longer than `least_px`, longest first."""
    long = bridged(rows.runs, SIDE_GAP_PX, round(0.8 * least_px))
    left, _, width, height, _, row = connected(long, diagonal=False).T
    sides = np.column_stack([left, left + width - 1, row])[(width >= least_px) & (height <= SIDE_MOST_PX)]
    return np.asarray(sides[np.argsort(sides[:, 0] - sides[:, 1], kind="stable")[:MAX_SIDES]])


def _between_sides(runs: Array, least_px: float, most_px: float) -> Array:
    """Return the boxes (N, 4; start, row, end, row) between runs that are opposite sides of a rectangle."""
    one, other = np.triu_indices(len(runs), 1)
    a, b = runs[one], runs[other]
    apart = np.abs(a - b)
    fits = (apart[:, 2] >= least_px) & (apart[:, 2] <= most_px) & (apart[:, :2] < SIDES_UNEVEN_PX).all(axis=1)
    fits &= a[:, 1] - a[:, 0] <= most_px + SIDES_UNEVEN_PX
    a, b = a[fits], b[fits]
    start, end, _ = ((a + b) / 2).T
    return np.column_stack([start, np.minimum(a[:, 2], b[:, 2]), end, np.maximum(a[:, 2], b[:, 2])])


@compiled
def _coverage(flat: Mask, upright: Mask, boxes: Array) -> Array:
    """Return the coverage (N,) of boxes (N, 4; x0, y0, x1, y1): the mean over the sides, lowered by the worst side.

    A vertical side may be a pixel beside the box. `flat`, `upright`: the masks of the direction maps.
    """
    height, width = flat.shape
    coverage = np.zeros(len(boxes))
    for k in range(len(boxes)):
        x0, y0 = round(max(boxes[k, 0], 0.0)), round(max(boxes[k, 1], 0.0))
        x1, y1 = round(min(boxes[k, 2], width - 1.0)), round(min(boxes[k, 3], height - 1.0))
        if min(x1 - x0, y1 - y0) < LEAST_BOX_PX:
            continue
        sides = np.zeros(4)
        sides[0], sides[1] = flat[y0, x0 : x1 + 1].mean(), flat[y1, x0 : x1 + 1].mean()
        for beside in (-1, 0, 1):
            left, right = min(max(x0 + beside, 0), width - 1), min(max(x1 + beside, 0), width - 1)
            sides[2] = max(sides[2], upright[left, y0 : y1 + 1].mean())
            sides[3] = max(sides[3], upright[right, y0 : y1 + 1].mean())
        coverage[k] = 0.6 * sides.mean() + 0.4 * sides.min()
    return coverage
