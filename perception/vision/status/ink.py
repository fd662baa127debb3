"""The ink of a display: how much every pixel differs from the background as segments do, and what can be seen of it."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.vision.image import Image
from perception.vision.status.comb_jit import Float32

HEADROOM = 0.5  # of a lit segment: where less is left below white, nothing can be told
KERNEL = 0.30  # of the picture's height: wider than any stroke, narrower than what light does
SATURATED = 252
WIDEST_STROKE = 0.17  # of the picture's height


def segment_ink(gray: Image, is_dark: bool, hidden: NDArray[np.bool_] | None = None) -> tuple[Float32, Float32]:
    """(ink, seen), both (H, W): hat transform with a kernel wider than a segment's stroke, 0 at the typical background.

    White-hat for glowing segments, black-hat for dark ones, so gradients and glare vanish. Hidden and drowned pixels
    are taken as background and as not seen.
    """
    smooth = cv2.GaussianBlur(gray, (0, 0), max(0.6, 0.012 * gray.shape[0]))
    if is_dark:
        smooth = cv2.bitwise_not(smooth)
    size = max(5, round(KERNEL * gray.shape[0])) | 1
    kernel = np.ones((size, size), np.uint8)
    lost = _drowned(gray, is_dark) if hidden is None else hidden | _drowned(gray, is_dark)
    if not lost.any():
        seen = np.ones(gray.shape, np.float32)
        background = cv2.morphologyEx(smooth, cv2.MORPH_OPEN, kernel)
        ink = cv2.subtract(smooth, background).astype(np.float32)
    else:
        seen = (~lost).astype(np.float32)
        background = cv2.erode(np.where(lost, 255, smooth).astype(np.uint8), kernel)
        filled = np.where(lost, background, smooth).astype(np.uint8)
        background = cv2.morphologyEx(filled, cv2.MORPH_OPEN, kernel)
        ink = cv2.subtract(filled, background).astype(np.float32)
    if not is_dark:
        seen = seen * (SATURATED - background > HEADROOM * level_at(ink, 0.98)).astype(np.float32)
    ink = np.maximum(ink - level_at(ink[seen > 0] if lost.any() else ink, 0.35), 0.0) * seen
    return np.asarray(ink, np.float32), seen


def _drowned(gray: Image, is_dark: bool) -> NDArray[np.bool_]:
    """Where glare hides glowing segments: saturated, and wider than a stroke, which may be saturated itself.

    A bright ground that is saturated hides no dark segment: its absence is seen.
    """
    white = (gray >= SATURATED).astype(np.uint8)
    if is_dark or not white.any():
        return np.zeros(gray.shape, bool)
    size = max(3, round(WIDEST_STROKE * gray.shape[0])) | 1
    return np.asarray(cv2.morphologyEx(white, cv2.MORPH_OPEN, np.ones((size, size), np.uint8)) > 0)


def without_border(ink: Float32) -> Float32:
    """The ink less what hangs together with the picture's border over a long stretch: a frame, not a segment."""
    strong = level_at(ink, 0.985)
    mask = (ink > 0.3 * strong).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    rows, columns = ink.shape
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    touching = np.bincount(edge, minlength=count)
    drop = [k for k in range(1, count) if touching[k] > 0.3 * min(rows, columns) and
            (stats[k, cv2.CC_STAT_WIDTH] > 0.5 * columns or stats[k, cv2.CC_STAT_HEIGHT] > 0.8 * rows)]  # fmt: skip
    if not drop:
        return ink
    gone = cv2.dilate(np.isin(labels, drop).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.asarray(np.where(gone, 0.0, ink), np.float32)


def level_at(ink: Float32, share: float) -> float:
    """The level that this share of the ink (from 0 to 255) does not exceed, to a level."""
    counts = np.bincount(ink.astype(np.uint8).ravel(), minlength=256)
    return float(np.searchsorted(np.cumsum(counts), share * ink.size))


@njit(cache=True)
def column_levels(ink: Float32, share: float) -> Float32:  # pragma: no cover
    """(W,) the level that this share of every column of the ink (from 0 to 255) does not exceed, to a level."""
    rows, columns = ink.shape
    out = np.zeros(columns, np.float32)
    counts = np.zeros(256, np.int64)
    for x in range(columns):
        counts[:] = 0
        for y in range(rows):
            counts[min(255, int(ink[y, x]))] += 1
        level, above = 256, 0
        while above < (1.0 - share) * rows and level > 0:
            level -= 1
            above += counts[level]
        out[x] = level
    return out
