"""Focus, exposure, noise and flicker of a camera, from a few frames of a scene at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

TILES = (4, 6)  # rows and columns of the map of sharpness
REBLUR_PX = (0.7, 2.0)
OPERATOR_PX2 = 1.0 / 3.0  # variance of the blur that a difference across two pixels adds, px^2
LEAST_EDGES = 12  # in a tile
EDGE_NOISES = 8.0  # least slope of an edge, relative to the noise
LEAST_SLOPE = 4.0  # gray levels per px
CLIPPED = 250


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageQuality:
    """Measures of an image.

    Attributes:
        blur_px: median blur of its edges, as the sigma of a Gaussian; NaN without edges.
        blur_map_px: the same for each tile (rows, columns); NaN where a tile has too few edges.
        directed: larger over smaller blur of upright and level edges, 1 if there are too few of either.
        clipped_share: share of the pixels that are saturated; `bright_level`: their 95 % quantile.
        noise: standard deviation of a pixel from frame to frame, gray levels.
        flicker: largest change of the mean brightness between frames, as a share.
        is_frozen: whether all frames are equal to the last bit.
        histogram: (256,) share of the pixels at each gray level.
    """

    blur_px: float
    blur_map_px: Array
    directed: float
    clipped_share: float
    bright_level: float
    noise: float
    flicker: float
    is_frozen: bool
    histogram: Array


def quality_of(frames: Sequence[NDArray[np.uint8]]) -> ImageQuality:
    """Measure the quality of gray frames (H, W) of one scene; at least two."""
    last = frames[-1]
    differences = [b.astype(np.float32) - a for a, b in pairwise(frames)]
    noise = float(np.median([1.4826 * np.median(np.abs(d - np.median(d))) for d in differences]) / np.sqrt(2.0))
    blur, is_upright = _blurs(last, noise)
    rows, columns = TILES
    tiles = np.full(TILES, np.nan)
    for i, band in enumerate(np.array_split(np.arange(last.shape[0]), rows)):
        for j, lane in enumerate(np.array_split(np.arange(last.shape[1]), columns)):
            part = blur[band[0] : band[-1] + 1, lane[0] : lane[-1] + 1]
            if np.isfinite(part).sum() >= LEAST_EDGES:
                tiles[i, j] = np.nanmedian(part)
    sides = [blur[np.isfinite(blur) & side] for side in (is_upright, ~is_upright)]
    means = np.array([frame.mean() for frame in frames])
    counts = np.bincount(last.ravel(), minlength=256)
    return ImageQuality(
        blur_px=float(np.nanmedian(blur)) if np.isfinite(blur).sum() >= LEAST_EDGES else float("nan"),
        blur_map_px=tiles,
        directed=_ratio(*(float(np.median(side)) for side in sides)) if min(map(len, sides)) >= LEAST_EDGES else 1.0,
        clipped_share=float((last >= CLIPPED).mean()),
        bright_level=float(np.quantile(last, 0.95)),
        noise=noise,
        flicker=float(np.ptp(means) / max(means.mean(), 1.0)),
        is_frozen=all(np.array_equal(frames[0], frame) for frame in frames[1:]),
        histogram=counts / counts.sum(),
    )


def _ratio(a: float, b: float) -> float:
    return max(a, b) / max(min(a, b), 1e-3)


def _blurs(gray: NDArray[np.uint8], noise: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return the blur at each edge pixel (NaN elsewhere) and whether that edge is upright.

    The slope of an edge of blur s falls as 1 / sqrt(s^2 + r^2) when the image is blurred by r more, so the slopes at two
    values of r give s. Source: S. Zhuo, T. Sim, Pattern Recognition 44(9), 2011.
    """
    image = gray.astype(np.float32)
    slopes = []
    for r in REBLUR_PX:
        blurred = cv2.GaussianBlur(image, (0, 0), r)
        slopes.append((cv2.Scharr(blurred, -1, 1, 0) / 32, cv2.Scharr(blurred, -1, 0, 1) / 32))
    (gx, gy), (sx, sy) = slopes
    slope, soft = np.hypot(gx, gy), np.hypot(sx, sy)
    top = cv2.dilate(slope, np.ones((3, 3), np.uint8))
    is_edge = (slope >= top) & (slope > max(LEAST_SLOPE, EDGE_NOISES * noise / 3))
    near, far = (r * r + OPERATOR_PX2 for r in REBLUR_PX)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio2 = (slope / np.maximum(soft, 1e-6)) ** 2
        blur = np.where(
            is_edge & (ratio2 > 1.0), np.sqrt(np.maximum((far - ratio2 * near) / (ratio2 - 1.0), 0.0)), np.nan
        )
    return np.asarray(blur, float), np.asarray(np.abs(gx) > np.abs(gy))
