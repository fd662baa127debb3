"""Search for occluders of an object: cables and fingers enter over its border, which no part of the object does.

A path around the object, just outside of it, is searched for places that contrast with the plate; from each, the same
gray is followed. If it reaches deep into the object, it covers the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.jit import compiled
from perception.vision.bilinear import step_counts
from perception.vision.patch import Patch, sample_at

STANDS_OUT = 14.0  # gray levels, and four sigmas of the noise; less in a dark picture, where all contrasts are lower
STANDS_OUT_SHARE, LEAST_STANDS_OUT = 0.12, 5.0
LARGEST_SHARE = 0.4  # of the object; a larger region of a cable's gray has leaked into the object
RIM_PX = 4.0  # width of the border zone
LEAKED = 4.0  # ratio of a region's extent along the border to its width there, from which it has leaked into a frame
OUTSIDE = 0.06  # distance of the path from the border, over the object's larger half size
DEEP = 0.35  # of the object's smaller half size; labels and ticks do not reach so far inside


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Crossing:
    """A place on the path around an object that contrasts with the plate, where something enters.

    Attributes:
        middle_px, tangent: (2,) its middle in the patch, and the path's unit direction there.
        length_px: length along the path where the contrast exceeds half, without the skirts of its blur.
        gray: of its middle.
        is_darker: whether it is darker than the plate around it.
        by: contrast to the plate in gray levels.
        side: of a rectangle's path, 0 to 3 from the top clockwise; 0 of a round one.
    """

    middle_px: Array
    tangent: Array
    length_px: float
    gray: float
    is_darker: bool
    by: float
    side: int


def covered(patch: Patch, *, half_width_m: float, half_height_m: float, is_round: bool) -> NDArray[np.bool_] | None:
    """Return a mask (H, W) of the occluders of the object in the patch; None if there are none.

    Args:
        half_width_m, half_height_m: of the object; the patch must extend beyond it.
        is_round: whether the object is a disc (of `half_width_m`) and not a rectangle.
    """
    smooth = smoothed(patch)
    found = border_crossings(
        patch, half_width_m=half_width_m, half_height_m=half_height_m, is_round=is_round, smooth=smooth
    )
    if not found:
        return None
    return followed_in(
        patch, found, smooth=smooth, half_width_m=half_width_m, half_height_m=half_height_m, is_round=is_round
    )


def followed_in(
    patch: Patch, found: Sequence[Crossing], *, smooth: Image, half_width_m: float, half_height_m: float, is_round: bool,
    through: bool = False,
) -> NDArray[np.bool_] | None:  # fmt: skip
    """Return a mask (H, W) of what can be followed by its gray from crossings deep into the object.

    None if nothing can.

    Args:
        smooth: result of `smoothed` for the patch.
        half_width_m, half_height_m, is_round: as for `covered`.
        through: whether it must leave at another side of a rectangle, because labels lead into a slot and end there.
    """
    if not found:
        return None
    places = np.round([crossing.middle_px for crossing in found]).astype(int)
    sides = np.array([crossing.side for crossing in found])
    depth = _depth(patch, half_width_m, half_height_m, is_round)
    least = DEEP * min(half_width_m, half_height_m) * patch.px_per_m
    mask = np.zeros(patch.gray.shape, bool)
    rim = depth <= RIM_PX
    for crossing, (u, v) in zip(found, places.tolist(), strict=True):
        region = _followed(smooth, (u, v))
        if through and not (region[places[:, 1], places[:, 0]] & (sides != crossing.side)).any():
            continue
        within = region & (depth > 0)
        if within.sum() > LARGEST_SHARE * (depth > 0).sum() or not within.any():
            continue
        if is_round and np.count_nonzero(within & rim) > LEAKED * RIM_PX * max(crossing.length_px, RIM_PX):
            continue
        if float(depth[within].max()) >= least:
            mask |= region
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0) if mask.any() else None


def border_crossings(
    patch: Patch, *, half_width_m: float, half_height_m: float, is_round: bool, beyond: float = OUTSIDE,
    smooth: Image | None = None,
) -> list[Crossing]:  # fmt: skip
    """Return the places just outside an object's border that contrast with the plate; arguments as for `covered`.

    Args:
        beyond: distance of the path from the border, over the larger half size.
        smooth: result of `smoothed` for the patch, if it is already computed.
    """
    path_u, path_v = _path(patch, half_width_m, half_height_m, is_round, 1.0 + beyond)
    inside = (path_u > 1) & (path_v > 1) & (path_u < patch.gray.shape[1] - 2) & (path_v < patch.gray.shape[0] - 2)
    if np.count_nonzero(inside) < 16:
        return []
    values = sample_at(smoothed(patch) if smooth is None else smooth, path_u, path_v)
    typical = ring_medians(np.round(values).astype(np.uint8), max(9, len(values) // 5) | 1)
    least = np.minimum(np.maximum(STANDS_OUT_SHARE * typical, LEAST_STANDS_OUT), STANDS_OUT)
    off = np.abs(values - typical)
    odd = inside & (off > least)
    if odd.any():
        odd &= off > 4.0 * _noise(patch)
    runs = _runs(odd)
    if not runs:
        return []
    n = len(values)
    points = np.column_stack([path_u, path_v])
    sides = np.zeros(n, int) if is_round else _sides(patch, points, half_width_m, half_height_m)
    found = []
    for first, last in runs:
        at = np.arange(first, last + 1) % n
        middle = int(at[len(at) // 2])
        step = points[(middle + 1) % n] - points[(middle - 1) % n]
        gray = float(np.median(values[at[len(at) // 3 : len(at) - len(at) // 3]]))  # without its blurred edges
        by = gray - float(typical[middle])
        found.append(
            Crossing(
                middle_px=points[middle],
                tangent=step / max(float(np.linalg.norm(step)), 1e-9),
                length_px=0.8 * float(np.count_nonzero(off[at] > 0.5 * abs(by))),
                gray=gray,
                is_darker=by < 0,
                by=abs(by),
                side=int(sides[middle]),
            )
        )
    return found


def smoothed(patch: Patch) -> Image:
    """Return the smoothed gray image in which crossings are searched for."""
    return np.asarray(cv2.GaussianBlur(patch.gray, (0, 0), 1.0), np.uint8)


def _sides(patch: Patch, points: Array, w: float, h: float) -> NDArray[np.int64]:
    """Return the side (N,) of the rectangle for every point of its path: 0 to 3 from the top clockwise."""
    x, y = ((points[:, k] - patch.pixel_of(0.0, 0.0, 0.0)[k]) / patch.px_per_m for k in (0, 1))
    flat = np.abs(y) - h > np.abs(x) - w
    return np.asarray(np.where(flat, np.where(y < 0, 0, 2), np.where(x > 0, 1, 3)), np.int64)


def _path(patch: Patch, w: float, h: float, is_round: bool, beyond: float) -> tuple[Array, Array]:
    """Return the patch coordinates u, v of a closed path around an object, enlarged by the factor `beyond`.

    A rectangle is enlarged by the same amount on all sides.
    """
    step = 0.8 / patch.px_per_m
    if is_round:
        a = np.linspace(0, 2 * np.pi, max(64, round(2 * np.pi * w * beyond / step)), endpoint=False)
        return patch.pixel_of(beyond * w * np.sin(a), beyond * w * np.cos(a), 0.0)
    extra = (beyond - 1.0) * max(w, h)
    w, h = w + extra, h + extra
    nx, ny = max(16, round(2 * w / step)), max(16, round(2 * h / step))
    x, y = np.linspace(-w, w, nx), np.linspace(-h, h, ny)
    xs = np.concatenate([x, np.full(ny, w), x[::-1], np.full(ny, -w)])
    ys = np.concatenate([np.full(nx, h), y[::-1], np.full(nx, -h), y])
    return patch.pixel_of(xs, ys, 0.0)


def _depth(patch: Patch, w: float, h: float, is_round: bool) -> Array:
    """Return the distance (H, W) inside the object's border, px; negative outside."""
    v, u = np.indices(patch.gray.shape)
    u0, v0 = patch.pixel_of(0.0, 0.0, 0.0)
    if is_round:
        return np.asarray(w * patch.px_per_m - np.hypot(u - u0, v - v0))
    return np.asarray(np.minimum(w * patch.px_per_m - np.abs(u - u0), h * patch.px_per_m - np.abs(v - v0)))


def _runs(odd: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last index of every run of True on a closed path, without single samples and long runs."""
    n = len(odd)
    if odd.all() or not odd.any():
        return []
    start = int(np.flatnonzero(~odd)[0])
    rolled = np.roll(odd, -start)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rolled.astype(np.int8), [0]])))
    runs = [(int(a) + start, int(b) - 1 + start) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [(a, b) for a, b in runs if 2 <= b - a + 1 <= n // 6]


def _followed(smooth: NDArray[np.uint8], seed: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the connected region of about the same gray as the pixel `seed`."""
    mask = np.zeros((smooth.shape[0] + 2, smooth.shape[1] + 2), np.uint8)
    flags = 4 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    cv2.floodFill(smooth.copy(), mask, seed, 1.0, 16.0, 16.0, flags)
    return mask[1:-1, 1:-1] > 0


def _noise(patch: Patch) -> float:
    """Return the standard deviation of the patch's noise."""
    counts = step_counts(np.ascontiguousarray(patch.gray), 4)
    return float(np.searchsorted(np.cumsum(counts), 0.5 * counts.sum())) / 1.65


@compiled
def ring_medians(values: NDArray[np.uint8], size: int) -> Array:
    """Return the sliding median (N,) of `size` values (odd, at most N) along a closed path, by a sliding histogram."""
    n, half = len(values), size // 2
    counts = np.zeros(256, np.int64)
    for k in range(-half, half + 1):
        counts[values[k % n]] += 1
    medians = np.empty(n)
    level, below = 0, 0  # below: number of values in the window that are less than level
    for i in range(n):
        while below + counts[level] <= half:
            below += counts[level]
            level += 1
        while below > half:
            level -= 1
            below -= counts[level]
        medians[i] = level
        gone, come = values[(i - half) % n], values[(i + half + 1) % n]
        counts[gone] -= 1
        counts[come] += 1
        below += int(come < level) - int(gone < level)
    return medians
