"""What a place on the plate looks like, told in numbers that a person can check, whichever way the object is turned.

Around a middle, on circles of growing radius: relative gray (median), unevenness (inner 70 % range), and edge strength
(median and strong). Logarithms of ratios to the plate's own gray, so exposure and light cancel; medians, so a cable or a
highlight spoils a few numbers and not all. For closed regions: the paper's size, height, width, aspect and Fourier shape
descriptors (C. T. Zahn and R. Z. Roskies, IEEE Trans. Computers 21(3), 1972, in the complex form of G. H. Granlund, 1972).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception.vision.image import Image
from perception.vision.patch import sample_at
from perception.vision.shapes import Edges
from perception.vision.view import Array

PLATE_PX_PER_M = 1500.0  # resolution of the rectified plate
RADII_M = np.arange(0.0015, 0.045, 0.003)
ANGLES = np.linspace(0.0, 2 * np.pi, 48, endpoint=False)
AROUND_PX = (
    np.stack([np.outer(RADII_M, np.sin(ANGLES)), -np.outer(RADII_M, np.cos(ANGLES))]).reshape(2, -1) * PLATE_PX_PER_M
)
RANKS = (7, 24, 40)  # of 48: 15, 50 and 85 %
GROUPS = ("gray", "uneven", "edge", "strong_edge")
LENGTH = len(GROUPS) * len(RADII_M)
EDGE_GAIN = 40.0
DESCRIPTORS = 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ground:
    """The rectified plate, its edges and the gray that it would have without objects."""

    picture: NDArray[np.float32]
    edges: Edges
    plate_gray: NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionShape:
    """The paper's spatial features of a closed region.

    Attributes:
        area_px, width_px, height_px: size; width and height of the upright box.
        aspect: longer over shorter side of the smallest enclosing rectangle.
        descriptors: magnitudes of the contour's Fourier coefficients 2..13 over that of the first: no place, size, turn.
    """

    area_px: float
    width_px: float
    height_px: float
    aspect: float
    descriptors: tuple[float, ...]


def plate_gray(picture: Image) -> NDArray[np.float32]:
    """(H, W) gray of the plate itself: a median wide enough to overlook every object."""
    small = cv2.resize(picture, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    framed = cv2.copyMakeBorder(small, 24, 24, 24, 24, cv2.BORDER_REFLECT)
    median = cv2.GaussianBlur(cv2.medianBlur(framed, 49)[24:-24, 24:-24], (0, 0), 3.0)
    return np.asarray(cv2.resize(median, picture.shape[::-1]), np.float32)


def look_at(ground: Ground, places_px: ArrayLike) -> Array:
    """(N, LENGTH) looks of (N, 2) places (u, v) of the rectified plate, in the order of `GROUPS`."""
    places = np.asarray(places_px, float)
    u, v = places[:, :1] + AROUND_PX[0], places[:, 1:] + AROUND_PX[1]
    shape = (len(places), len(RADII_M), len(ANGLES))
    gray = np.sort(sample_at(ground.picture, u, v).reshape(shape), axis=2)
    edge = np.sort(sample_at(ground.edges.strength, u, v).reshape(shape), axis=2)
    height, width = ground.picture.shape
    at_u = np.clip(places[:, 0], 0, width - 1).astype(int)
    at_v = np.clip(places[:, 1], 0, height - 1).astype(int)
    level = ground.plate_gray[at_v, at_u].astype(float)[:, None] + 4.0
    low, middle, high = (np.log((gray[:, :, k] + 6.0) / (level + 6.0)) for k in RANKS)
    edge_middle, edge_high = edge[:, :, RANKS[1]], edge[:, :, RANKS[2]]
    return np.concatenate(
        [middle, high - low, np.log1p(EDGE_GAIN * edge_middle / level), np.log1p(EDGE_GAIN * edge_high / level)], axis=1
    )


def region_shape(mask: NDArray[np.bool_]) -> RegionShape | None:
    """Shape of the largest part of a mask; None for less than 8 pixels."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    contour = max(contours, key=cv2.contourArea).reshape(-1, 2).astype(np.int32)
    area = float(cv2.contourArea(contour))
    if area < 8.0:
        return None
    _, _, width, height = cv2.boundingRect(contour)
    (_, _), (a, b), _ = cv2.minAreaRect(contour)
    return RegionShape(
        area_px=area,
        width_px=float(width),
        height_px=float(height),
        aspect=float(max(a, b) / max(min(a, b), 1e-9)),
        descriptors=_fourier(contour),
    )


def _fourier(contour: NDArray[np.int32]) -> tuple[float, ...]:
    closed = np.vstack([contour, contour[:1]]).astype(float)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    s = np.linspace(0.0, length[-1], 128, endpoint=False)
    z = np.interp(s, length, closed[:, 0]) + 1j * np.interp(s, length, closed[:, 1])
    spectrum = np.abs(np.fft.fft(z))
    first = max(float(spectrum[1]), float(spectrum[-1]), 1e-9)
    return tuple(float(spectrum[k] + spectrum[-k]) / first for k in range(2, 2 + DESCRIPTORS))
