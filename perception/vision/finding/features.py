"""Features that describe the appearance of a place on the plate: its look.

On circles of growing radius around a middle, independent of the object's rotation: relative gray (median), unevenness
(inner 70 % range), and edge strength (median and strong). Then, towards eight directions of the upright plate, relative
gray and edges on rings: a toggle's plate is taller than wide, a display wider than high. The features are logarithms of
ratios to the plate's own gray, so exposure and light cancel; medians and directions confine the effect of a cable or a
highlight to a few features.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.arrays import Array, Image
from perception.vision.finding.shapes import Edges, Rectangle
from perception.vision.look import AROUND_GROUPS, DIRECTIONS, GROUPS, LENGTH, RADII_M, RINGS
from perception.vision.patch import sample_at

PLATE_PX_PER_M = 1500.0  # resolution of the rectified plate
ANGLES = (np.arange(32) + 0.5) * 2 * np.pi / 32
AROUND_PX = (
    np.stack([np.outer(RADII_M, np.sin(ANGLES)), -np.outer(RADII_M, np.cos(ANGLES))]).reshape(2, -1) * PLATE_PX_PER_M
)
RANKS = (5, 16, 27)  # of 32 sorted values: 15, 50 and 85 %
AT_ONCE = 64  # places processed at a time, so that intermediate results stay in the cache
EACH = len(ANGLES) // DIRECTIONS
# (angles, DIRECTIONS) mean over two radii and the angles about a direction
TOWARDS = np.roll(np.kron(np.eye(DIRECTIONS), np.full((EACH, 1), 0.5 / EACH)), -(EACH // 2), axis=0).astype(np.float32)
EDGE_GAIN = 40.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ground:
    """The rectified plate, its edges and gray without objects, whether it is noisy, its rectangles and slots' middles."""

    picture: NDArray[np.float32]
    edges: Edges
    plate_gray: NDArray[np.float32]
    noisy: bool = False
    rectangles: tuple[Rectangle, ...] = ()
    slots: tuple[tuple[float, float], ...] = ()


def plate_gray(picture: Image) -> NDArray[np.float32]:
    """Return the gray (H, W) of the plate itself, by a median filter wide enough to suppress every object."""
    small = cv2.resize(picture, None, fx=1 / 6, fy=1 / 6, interpolation=cv2.INTER_AREA)
    framed = cv2.copyMakeBorder(small, 16, 16, 16, 16, cv2.BORDER_REFLECT)
    median = cv2.GaussianBlur(cv2.medianBlur(framed, 33)[16:-16, 16:-16], (0, 0), 2.0)
    return np.asarray(cv2.resize(median, picture.shape[::-1]), np.float32)


def look_at(ground: Ground, places_px: ArrayLike) -> Array:
    """Return the features (N, LENGTH) of places (N, 2; u, v) of the rectified plate: `GROUPS`, then `AROUND_GROUPS`."""
    places = np.asarray(places_px, float).reshape(-1, 2)
    parts = [_looks(ground, places[k : k + AT_ONCE]) for k in range(0, len(places), AT_ONCE)]
    return np.concatenate(parts).astype(float) if parts else np.zeros((0, LENGTH))


def _looks(ground: Ground, places: Array) -> NDArray[np.float32]:
    """Return the features of a few places."""
    u, v = places[:, :1] + AROUND_PX[0], places[:, 1:] + AROUND_PX[1]
    shape = (len(places), len(RADII_M), len(ANGLES))
    gray = sample_at(ground.picture, u, v).reshape(shape)
    edge = sample_at(ground.edges.strength, u, v).reshape(shape)
    height, width = ground.picture.shape
    at_u = np.clip(places[:, 0], 0, width - 1).astype(int)
    at_v = np.clip(places[:, 1], 0, height - 1).astype(int)
    level = ground.plate_gray[at_v, at_u][:, None]
    gray_around = np.log((_around(gray) + 6.0) / (level + 10.0))
    edge_around = np.log1p(EDGE_GAIN * _around(edge) / (level + 4.0))
    gray.sort(axis=2)
    edge.sort(axis=2)
    low, middle, high = (np.log((gray[:, :, k] + 6.0) / (level + 10.0)) for k in RANKS)
    edge_middle, edge_high = (np.log1p(EDGE_GAIN * edge[:, :, k] / (level + 4.0)) for k in RANKS[1:])
    return np.concatenate([middle, high - low, edge_middle, edge_high, gray_around, edge_around], axis=1)


def half_turned(looks: Array) -> Array:
    """Return the features (N, LENGTH) that the same places have after the picture is rotated by half a turn."""
    plain = len(GROUPS) * len(RADII_M)
    tables = looks[:, plain:].reshape(len(looks), len(AROUND_GROUPS), DIRECTIONS, RINGS)
    return np.concatenate([looks[:, :plain], np.roll(tables, DIRECTIONS // 2, axis=2).reshape(len(looks), -1)], axis=1)


def _around(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the means (N, DIRECTIONS * RINGS) of values (N, radii, angles), direction by direction."""
    rings = values[:, : 2 * RINGS].reshape(len(values), RINGS, 2, -1).sum(axis=2)
    return np.asarray((rings @ TOWARDS).transpose(0, 2, 1).reshape(len(values), -1))
