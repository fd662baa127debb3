"""Ink of a display: how much every pixel differs from the background as segments do, and where it is visible."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from hal.jit import compiled
from perception.vision.status.digit_grid_worth import Float32

HEADROOM = 0.5  # share of a lit segment's level; with less room below white the pixel counts as unknown
SHOWS = 0.3  # share of a lit segment's level that exceeds noise
KERNEL = 0.30  # share of the picture's height: wider than any stroke, narrower than the variation of light
SATURATED = 252
GLARE = 80.0  # range of the background in gray levels: more indicates glare, which adds light, and not a gradient
# Light per gray level as cameras encode it: under glare, strokes have less gray contrast but the same light
# contrast.
LIGHT = np.round(255.0 * (np.arange(256) / 255.0) ** 2.2).astype(np.uint8)
BORDER_ROUNDS = 4
STROKE_SHOWS = 18.0  # gray levels
NEAR_STROKE = 0.12  # share of the picture's height
# Share of the picture's height from its border; least px there that no frame seen obliquely reaches
DEEP, LEAST_DEEP = 0.22, 0.3
WIDEST_STROKE = 0.17  # share of the picture's height


def segment_ink(gray: Image, is_dark: bool, hidden: NDArray[np.bool_] | None = None) -> tuple[Float32, Float32]:
    """Return ink and visibility (H, W): a hat transform with a kernel wider than a segment's stroke.

    The ink is 0 at the typical background. White-hat for glowing segments and black-hat for dark ones remove gradients
    and glare; they are computed on light instead of gray levels if glare makes the background uneven. Hidden and
    saturated pixels count as background and as not visible.
    """
    smooth = np.asarray(cv2.GaussianBlur(gray, (0, 0), max(0.6, 0.012 * gray.shape[0])), np.uint8)
    lost = _drowned(gray, is_dark) if hidden is None else hidden | _drowned(gray, is_dark)
    white = SATURATED
    covered = lost if is_dark else hidden  # glare stays as its own background: if filled, its edges would stand out
    ink, background = _hat(smooth, is_dark, covered)
    if _is_uneven(background, lost):
        ink, background = _hat(LIGHT[smooth], is_dark, covered)
        white = int(LIGHT[SATURATED])
    seen = (~lost).astype(np.float32)
    if not is_dark:
        lit = level_at(ink, 0.98)
        # Where glare leaves little room below white, a visible stroke is evidence, but a missing one is not.
        seen = seen * ((background < white - HEADROOM * lit) | (ink > SHOWS * lit)).astype(np.float32)
    ink = np.maximum(ink - level_at(ink[seen > 0] if lost.any() else ink, 0.35), 0.0) * seen
    return np.asarray(ink, np.float32), seen


def _is_uneven(background: Image, lost: NDArray[np.bool_]) -> bool:
    """Return whether the background varies so much that only glare explains it."""
    shown = background[::3, ::3][~lost[::3, ::3]].astype(np.float32)
    return shown.size > 0 and level_at(shown, 0.95) - level_at(shown, 0.05) > GLARE


def _hat(smooth: Image, is_dark: bool, covered: NDArray[np.bool_] | None) -> tuple[Float32, Image]:
    """Return the contrast (H, W) of strokes, and the background to which it is relative.

    Covered pixels are background.
    """
    size = max(5, round(KERNEL * smooth.shape[0])) | 1
    kernel = np.ones((size, size), np.uint8)
    filled = cv2.bitwise_not(smooth) if is_dark else smooth
    if covered is not None and covered.any():
        around = cv2.erode(np.where(covered, 255, filled).astype(np.uint8), kernel)
        filled = np.where(covered, around, filled).astype(np.uint8)
    background = cv2.morphologyEx(filled, cv2.MORPH_OPEN, kernel)
    return cv2.subtract(filled, background).astype(np.float32), np.asarray(background, np.uint8)


def _drowned(gray: Image, is_dark: bool) -> NDArray[np.bool_]:
    """Return a mask of the glare that hides segments: saturated areas wider than a stroke, which may itself saturate.

    Dark segments on a saturated background remain visible, and so does their absence beside others.
    """
    white = (gray >= SATURATED).astype(np.uint8)
    if not white.any():
        return np.zeros(gray.shape, bool)
    size = max(3, round(WIDEST_STROKE * gray.shape[0])) | 1
    drowned = cv2.morphologyEx(white, cv2.MORPH_OPEN, np.ones((size, size), np.uint8)) > 0
    return np.asarray(drowned & ~_near_strokes(gray)) if is_dark else np.asarray(drowned)


def _near_strokes(gray: Image) -> NDArray[np.bool_]:
    """Return a mask of the places near a visible dark stroke, where another would be visible, too.

    Light varies little over that distance.
    """
    rows = gray.shape[0]
    size = max(5, round(KERNEL * rows)) | 1
    smooth = cv2.GaussianBlur(gray, (0, 0), max(0.6, 0.012 * rows))
    darker = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT, np.ones((size, size), np.uint8))
    strokes = cv2.morphologyEx((darker > STROKE_SHOWS).astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    reach = round(NEAR_STROKE * rows)
    return np.asarray(cv2.dilate(strokes, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0)


def without_border(ink: Float32, *, framed: bool = False) -> tuple[Float32, NDArray[np.bool_] | None]:
    """Remove ink that is connected with the picture's border over a long stretch: a frame and not a segment.

    Parts of the frame between the digits may hide them or include them, so they are returned as unknown.

    Args:
        framed: whether a frame certainly surrounds the digits, so that anything touching the border is not a digit. It
        is
            removed level by level, because a frame may have far more contrast than the digits.

    Returns:
        the remaining ink (H, W), and a mask of what may hide digits. The mask is None if nothing does, and if the
        removed ink is certainly a frame.
    """
    lost: NDArray[np.bool_] | None = None
    for _ in range(BORDER_ROUNDS if framed else 1):
        found = _at_border(ink, 0.3 * level_at(ink, 0.985), framed)
        if found is None:
            break
        gone, deep = found
        ink = np.asarray(np.where(gone, 0.0, ink), np.float32)
        lost = deep if not framed and deep.any() else None
    return ink, lost


def _at_border(ink: Float32, least: float, framed: bool) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """Return the ink (H, W) above a level that is connected with the border, slightly dilated.

    Also returns its parts that reach deep inside. None if no ink reaches deep into the picture.
    """
    mask = (ink > least).astype(np.uint8)
    if not (mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()):
        return None
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    rows, columns = ink.shape
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    touching = np.bincount(edge, minlength=count)
    drop = touching > (0 if framed else 0.3 * min(rows, columns))
    if not framed:
        drop &= (stats[:, cv2.CC_STAT_WIDTH] > 0.5 * columns) | (stats[:, cv2.CC_STAT_HEIGHT] > 0.8 * rows)
    drop[0] = False
    if not drop.any():
        return None
    inset = round(DEEP * rows)
    core = labels[inset : rows - inset, inset : columns - inset]
    deep = drop & (np.bincount(core.ravel(), minlength=count) > LEAST_DEEP * rows)
    gone, lost = (cv2.dilate(part[labels].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 for part in (drop, deep))
    return np.asarray(gone), np.asarray(lost)


def level_at(ink: Float32, share: float) -> float:
    """Return a quantile of the ink (0 to 255), to one gray level: the level that this share of it does not exceed."""
    return _level_at(ink.ravel(), share)


@compiled
def _level_at(ink: Float32, share: float) -> float:
    """Compute `level_at`."""
    counts = np.zeros(256, np.int64)
    for value in ink:
        counts[min(255, int(value))] += 1
    level, upto = 0, counts[0]
    while upto < share * ink.size and level < 255:
        level += 1
        upto += counts[level]
    return float(level)


@compiled
def column_levels(ink: Float32, share: float) -> Float32:
    """Return a quantile (W,) of every column of the ink (0 to 255): the level that this share of it does not exceed."""
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
