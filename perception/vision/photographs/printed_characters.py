"""Finds printed characters in a picture of a dial: pieces of ink of their size, and the parts of pieces that are joined."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from perception.vision.photographs.printed_digits import OTHER, Float32, cell_of, shipped_network

AROUND_PX = 61  # side of the square over whose mean ink stands out
SHARPENED, SHARP_PX = 1.5, 5.0  # characters that a blurred picture joins part again
# Least ink, gray levels, and over the strongest ink so near: faint ink needs little, and characters that touch part at more.
LEAST_LEVELS, INK_SHARES, NEAR_PX = 8.0, (0.2, 0.3, 0.42, 0.55, 0.7), 15
TALL_PX = (11.0, 58.0)  # of a character
SLENDER, WIDE = 0.12, 1.15  # ratio of its width to its height
LEAST_DIGIT = 0.15  # probability; what is no numeral will not fit a scale
TOUCHING, MOST_WIDE = (
    (0.45, 0.9),
    3.0,
)  # widths of characters that touch, over their height; of a piece over `TALL_PX[1]`
LIKELY = 0.6  # probability from which the widest of the digits that overlap is taken
OF_PART = 0.5  # least probability of each part of a wide piece, and what parts are worth beside whole pieces
LEAST_AREA_PX, SAME_PLACE = 4, 0.5  # of a piece; share of the smaller one's area by which two are one
MOST_CHARACTERS = 400


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Characters:
    """Pieces of ink: boxes (N, 4) left, top, width and height, px; (N, 11) probabilities of what they are."""

    boxes: Array
    kinds: Array


def inks(face: Image) -> Iterator[Float32]:
    """Yield how far the picture is darker, and how far brighter, than the mean around."""
    level = face.astype(np.float32)
    sharp = level + SHARPENED * (level - cv2.GaussianBlur(level, (0, 0), SHARP_PX))
    over = cv2.blur(level, (AROUND_PX, AROUND_PX)) - sharp
    yield np.asarray(np.maximum(over, 0.0), np.float32)
    yield np.asarray(np.maximum(-over, 0.0), np.float32)


def strong(ink: Float32) -> Iterator[NDArray[np.bool_]]:
    """Yield where ink is stronger than a share of the strongest near it, for each of `INK_SHARES`."""
    strongest = cv2.dilate(ink, np.ones((NEAR_PX, NEAR_PX), np.uint8))
    for share in INK_SHARES:
        yield np.asarray(ink > np.maximum(LEAST_LEVELS, share * strongest))


def characters(ink: Float32) -> Characters:
    """Return the pieces of ink with the size of characters, points and signs; of those that overlap the likeliest digit."""
    pieces = [_pieces(ink, is_strong) for is_strong in strong(ink)]
    boxes, kinds = (np.concatenate([piece[k] for piece in pieces]) for k in (0, 1))
    digit = kinds[:, :OTHER].max(axis=1, initial=0.0)
    wide = np.sqrt(boxes[:, 2] / boxes[:, 3])  # each half of a 0 whose ends are faint resembles a 1
    rank = np.where(digit > LEAST_DIGIT, digit * np.where(digit > LIKELY, 1.0 + wide, 1.0), 0.0)
    left = list(np.lexsort((boxes[:, 0], -boxes[:, 3], -rank)))
    kept: list[int] = []
    while left and len(kept) < MOST_CHARACTERS:
        first = left.pop(0)
        kept.append(first)
        overlap = _overlap(boxes[first], boxes[left]) > SAME_PLACE
        left = [k for k, same in zip(left, overlap, strict=True) if not same]
    return Characters(boxes=boxes[kept], kinds=kinds[kept])


def _pieces(ink: Float32, is_ink: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the boxes (N, 4) of connected ink and of its parts, and (N, 11) probabilities of what they are."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(is_ink.astype(np.uint8), connectivity=8)
    fits = (stats[:, 3] < TALL_PX[1]) & (stats[:, 2] < MOST_WIDE * TALL_PX[1])
    rows = 1 + np.flatnonzero((fits & (stats[:, cv2.CC_STAT_AREA] >= LEAST_AREA_PX))[1:])
    whole = stats[rows, :4].astype(float)
    pieces = [_piece(ink, np.asarray(labels, np.int32), int(k), stats[k, :4].tolist()) for k in rows]
    of_whole = _kinds_of(pieces, whole)
    boxes, kinds = [whole], [of_whole]
    for piece, box, kind in zip(pieces, whole, of_whole, strict=True):
        if kind[:OTHER].max() > LEAST_DIGIT:
            continue
        for columns in _splits(piece):
            parts = np.array([[box[0] + first, box[1], last - first, box[3]] for first, last in columns])
            of_parts = _kinds_of([piece[:, first:last] for first, last in columns], parts)
            if of_parts[:, :OTHER].max(axis=1).min() > OF_PART:
                boxes.append(parts)
                kinds.append(OF_PART * of_parts)
    return np.concatenate(boxes), np.concatenate(kinds)


def _piece(ink: Float32, labels: NDArray[np.int32], label: int, box: list[int]) -> Float32:
    """Return the ink of one piece alone."""
    x, y, w, h = box
    cut = np.s_[y : y + h, x : x + w]
    return np.where(labels[cut] == label, ink[cut], 0.0).astype(np.float32)


def _kinds_of(pieces: Sequence[Float32], boxes: Array) -> Array:
    """Return (N, 11) probabilities of what pieces are; what has not the shape of a character is none."""
    kinds = np.zeros((len(boxes), OTHER + 1))
    kinds[:, OTHER] = 1.0
    rows = np.flatnonzero(is_tall(boxes))
    if len(rows):
        kinds[rows] = shipped_network().probabilities(np.array([cell_of(pieces[int(k)]) for k in rows]))
    return kinds


def _splits(piece: Float32) -> Iterator[list[tuple[int, int]]]:
    """Yield the columns of two to four characters of which a wide piece may consist, cut where there is least ink."""
    h, w = piece.shape
    if h < TALL_PX[0]:
        return
    column = piece.sum(axis=0)
    for count in (2, 3, 4):
        pitch = w / count
        if not TOUCHING[0] * h < pitch < TOUCHING[1] * h:
            continue
        cuts = [0]
        for k in range(1, count):
            low, high = round((k - 0.25) * pitch), round((k + 0.25) * pitch) + 1
            cuts.append(low + int(column[low:high].argmin()))
        yield list(pairwise([*cuts, w]))


def is_tall(boxes: Array) -> NDArray[np.bool_]:
    """Return which boxes have the height and the shape of a character."""
    w, h = boxes[:, 2], boxes[:, 3]
    return np.asarray((h > TALL_PX[0]) & (w > SLENDER * h) & (w < WIDE * h))


def _overlap(box: Array, others: Array) -> Array:
    """Return the area that a box shares with each of the others, over the smaller one's."""
    low = np.maximum(box[:2], others[:, :2])
    high = np.minimum(box[:2] + box[2:], others[:, :2] + others[:, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), axis=1)
    return np.asarray(shared / np.minimum(np.prod(box[2:]), np.prod(others[:, 2:], axis=1)))
