"""Search for places where occluders of an object enter over its border: there they contrast with the plate."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from hal.arrays import Array, Image
from perception.vision.bilinear import step_counts
from perception.vision.patch import Patch, sample_at

STANDS_OUT = 14.0  # gray levels, and four sigmas of the noise; less in a dark picture, where all contrasts are lower
STANDS_OUT_SHARE, LEAST_STANDS_OUT = 0.12, 5.0
OUTSIDE = 0.06  # distance of the path from the border, over the object's larger half size


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


def border_crossings(
    patch: Patch, smooth: Image, *, half_width_m: float, half_height_m: float, is_round: bool, beyond: float = OUTSIDE
) -> list[Crossing]:
    """Return the places just outside an object's border that contrast with the plate.

    Args:
        smooth: result of `smoothed` for the patch.
        half_width_m, half_height_m: of the object; the patch must extend beyond it.
        is_round: whether the object is a disc (of `half_width_m`) and not a rectangle.
        beyond: distance of the path from the border, over the larger half size.
    """
    path_u, path_v, sides = _path(patch, half_width_m, half_height_m, is_round, 1.0 + beyond)
    inside = (path_u > 1) & (path_v > 1) & (path_u < patch.gray.shape[1] - 2) & (path_v < patch.gray.shape[0] - 2)
    if np.count_nonzero(inside) < 16:
        return []
    values = sample_at(smooth, path_u, path_v)
    typical = median_filter(np.round(values).astype(float), max(9, len(values) // 5) | 1, mode="wrap")
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


def _path(patch: Patch, w: float, h: float, is_round: bool, beyond: float) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return the patch coordinates u, v of a closed path around an object, enlarged by the factor `beyond`, and its sides.

    A rectangle is enlarged by the same amount on all sides, which are 0 to 3 from the top clockwise; a circle has side 0.
    """
    step = 0.8 / patch.px_per_m
    if is_round:
        a = np.linspace(0, 2 * np.pi, max(64, round(2 * np.pi * w * beyond / step)), endpoint=False)
        return *patch.pixel_of(beyond * w * np.sin(a), beyond * w * np.cos(a), 0.0), np.zeros(len(a), int)
    extra = (beyond - 1.0) * max(w, h)
    w, h = w + extra, h + extra
    nx, ny = max(16, round(2 * w / step)), max(16, round(2 * h / step))
    x, y = np.linspace(-w, w, nx), np.linspace(-h, h, ny)
    xs = np.concatenate([x, np.full(ny, w), x[::-1], np.full(ny, -w)])
    ys = np.concatenate([np.full(nx, h), y[::-1], np.full(nx, -h), y])
    return *patch.pixel_of(xs, ys, 0.0), np.repeat(np.arange(4), [nx, ny, nx, ny])


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


def _noise(patch: Patch) -> float:
    """Return the standard deviation of the patch's noise."""
    counts = step_counts(np.ascontiguousarray(patch.gray), 4)
    return float(np.searchsorted(np.cumsum(counts), 0.5 * counts.sum())) / 1.65
