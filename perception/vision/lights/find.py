"""Detection of lights in a pair of images, off and on (paper, Section II-B, Fig. 5): register, subtract, grow regions.

The threshold comes from the noise of the pair itself: gray-level noise, and residuals of misregistered edges. Glare
that has moved between the images is large and smooth, so a top-hat filter removes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.errors import InvalidRequest
from perception.vision.image import check_image
from perception.vision.lights.alignment import ImageAlignment, gradients, register
from perception.vision.lights.core import lamp_core, level_at
from perception.vision.noise import noise_sigma

Image = NDArray[np.float32]

SEED_SIGMAS = 6.0  # an image of 640x480 has 3e5 pixels: with 6 sigma, noise makes no seed
LEAST_AREA_PX = 4.0  # of a lamp
# Least standard deviation of a centre, from registration and lens blooming; measured on synthetic pairs.
CENTRE_FLOOR_PX = 0.04
MOST_BLOBS = 16
CLEAR_SIGMAS = 15.0  # a blob that stands out by this much is certain; glare that has moved gives 4 to 8
CLEAR_BLOB_SIGMAS = 60.0  # the same for the blob as a whole; noise and edges reach about 20
LEAST_ASPECT = 0.25  # a round lamp seen at 75 degrees


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightBlobs:
    """Places that became brighter, best first; there may be none.

    Attributes:
        centres_px: (N, 2) sub-pixel centres in the image with lights on.
        covariance_px: (N, 2, 2) of the centres, px^2.
        area_px: (N,) area of the lit region.
        aspect: (N,) minor over major axis, 1 for a disc.
        fill: (N,) area over that of the ellipse with the same moments; 1 for a disc, less for arcs and corners.
        contrast: (N,) rise of the gray level.
        score: (N,) 0 to 1, similarity to a lamp: round, filled, clear of the noise.
        threshold: mean rise of the gray level that makes a seed, from the noise.
        shift_px: camera motion between the two images.
    """

    centres_px: Array
    covariance_px: Array
    area_px: Array
    aspect: Array
    fill: Array
    contrast: Array
    score: Array
    threshold: float
    shift_px: tuple[float, float]

    def __len__(self) -> int:
        return len(self.centres_px)


def find_lights(
    image_off: NDArray[Any], image_on: NDArray[Any], *, largest_diameter_px: float | None = None
) -> LightBlobs:
    """Return all places that became brighter from one image to the other and are about as compact as a lamp.

    Args:
        image_off, image_on: (H, W) gray or (H, W, 3) RGB, 8 bit; the camera may have moved by some pixels in between.
        largest_diameter_px: larger regions are glare or shadow; 1/12 of the image height if None.

    Raises:
        InvalidRequest: not images, or of different size.
        CameraMoved: the two do not show the same view.
    """
    off, on = gray_of(image_off), gray_of(image_on)
    if off.shape != on.shape:
        raise InvalidRequest(
            f"image sizes differ: {off.shape[::-1]} off, {on.shape[::-1]} on", hint="take both with one camera setting"
        )
    registration = register(off, on, noise=_raw_noise(image_off, image_on))
    diameter = largest_diameter_px if largest_diameter_px is not None else on.shape[0] / 12.0
    rise = _rise(on, registration, diameter)
    sigma = _noise(rise, registration)
    return _described(_grow(rise, sigma, registration.inside, diameter), sigma, registration)


def gray_of(image: NDArray[Any]) -> Image:
    """Return the float32 gray levels (H, W) of an 8-bit gray or RGB image.

    Raises:
        InvalidRequest: see `check_image`.
    """
    check_image(image)
    # The mean and not the luma, in which a blue lamp would be darker than a green one.
    return np.asarray(image if image.ndim == 2 else image[:, :, :3].mean(axis=2), np.float32)


def _raw_noise(*images: NDArray[Any]) -> float:
    """Return the noise of one pixel of two images."""
    grays = [np.ascontiguousarray(gray_of(image), np.uint8) for image in images]
    return max(float(np.mean([noise_sigma(gray) for gray in grays])), 0.5)


def _rise(on: Image, registration: ImageAlignment, diameter: float) -> Image:
    """Return the smoothed difference on - off, without anything that is wider than a lamp (white top-hat)."""
    difference = np.where(registration.inside, on - registration.warped, 0.0).astype(np.float32)
    difference = np.asarray(cv2.blur(difference, (3, 3)))
    half = (difference.shape[1] // 2, difference.shape[0] // 2)
    side = int(diameter / 2.0) | 1
    small = cv2.resize(difference, half, interpolation=cv2.INTER_AREA)
    opened = cv2.morphologyEx(small, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    wide = cv2.resize(cv2.blur(opened, (side, side)), difference.shape[::-1], interpolation=cv2.INTER_LINEAR)
    rise: Image = (difference - np.maximum(wide, 0.0)).astype(np.float32)
    return rise


def _noise(rise: Image, registration: ImageAlignment) -> Image:
    """Return the standard deviation (H, W) of `rise` where nothing has changed.

    sigma^2 = a + c |grad I|^2: noise, and misregistered edges; each from quantiles of this pair.
    """
    gx, gy = gradients(registration.warped)
    slope2 = np.asarray(gx * gx + gy * gy)
    sample = (slice(2, -2, 3), slice(2, -2, 3))
    slope, change = slope2[sample], rise[sample]
    flat = change[slope <= np.median(slope)]
    a = max((1.4826 * float(np.median(np.abs(flat - np.median(flat))))) ** 2, 0.05)
    steep = slope >= max(float(np.quantile(slope, 0.95)), 1.0)
    c = 0.0
    if steep.sum() > 50:
        excess = change[steep] ** 2 - a
        # The lower quartile, 0.10 for chi-square with 1 degree, holds even if glare has moved over half of the edges.
        c = max(float(np.quantile(excess / slope[steep], 0.25)) / 0.2, 0.0)
    return np.asarray(np.sqrt(a + max(c, 0.01) * slope2), np.float32)


Blob = tuple[Array, Array, float, float, float, float, float]
"""Centre, its covariance, area, contrast, aspect, fill and score."""
Seed = tuple[float, int, int, NDArray[np.bool_]]
"""A connected part: the sum of its rise, left and top px, and its mask."""


def _grow(rise: Image, sigma: Image, inside: NDArray[np.bool_], diameter: float) -> list[Blob]:
    """Return the lamp-like parts of the connected regions that stand out of the noise."""
    found = []
    margin = 8
    seeds = _seeds(rise, (rise > SEED_SIGMAS * sigma) & inside, diameter)
    for _, x, y, mask in sorted(seeds, key=lambda seed: -seed[0])[: 2 * MOST_BLOBS]:
        h, w = mask.shape
        x0, y0 = max(x - margin, 0), max(y - margin, 0)
        window = (slice(y0, y + h + margin), slice(x0, x + w + margin))
        padded = np.zeros(rise[window].shape, bool)
        padded[y - y0 : y - y0 + h, x - x0 : x - x0 + w] = mask
        blob = _measured(rise[window], sigma[window], padded, (x0, y0))
        if blob is not None:
            found.append(blob)
    return found


def _seeds(rise: Image, lit: NDArray[np.bool_], diameter: float) -> list[Seed]:
    """Return connected parts that are neither specks nor streaks.

    Those too large for a lamp are split at half their height. The glow that connects a lamp with its surroundings is
    lower than the lamp, so splitting separates the lamp.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats(lit.astype(np.uint8), connectivity=8)
    wide, high, area = stats[1:, 2], stats[1:, 3], stats[1:, 4]
    large = np.maximum(wide, high) > 1.5 * diameter
    compact = (np.maximum(wide, high) <= 4 * np.minimum(wide, high) + 4) & (area >= 0.3 * wide * high)
    usable = np.flatnonzero((area >= 3) & (large | compact))
    found: list[Seed] = []
    for k in usable[np.argsort(-area[usable])][: 8 * MOST_BLOBS] + 1:
        x, y, w, h = (int(v) for v in stats[k][:4])
        part, inner = labels[y : y + h, x : x + w] == k, rise[y : y + h, x : x + w]
        if not large[k - 1]:
            found.append((float(inner[part].sum()), x, y, part))
            continue
        level = 0.5 * (float(np.quantile(inner[part], 0.999)) + float(inner[part].min()))
        higher = part & (inner > level)
        if 3 <= higher.sum() < part.sum():
            found += [(total, x + u, y + v, mask) for total, u, v, mask in _seeds(inner, higher, diameter)]
    return found


def _measured(rise: Image, sigma: Image, seed: NDArray[np.bool_], corner: tuple[int, int]) -> Blob | None:
    """Measure the lamp in a connected part; None if it is too small, or only the rim of something brighter.

    `corner`: column and row at which the window `rise` begins in the image.
    """
    core = lamp_core(rise, seed)
    if core is None or core.weights.sum() < LEAST_AREA_PX:
        return None
    if core.top > 1.3 * level_at(rise[seed], 0.99):
        return None  # the rim of something brighter, which has its own seed
    rows, columns = np.nonzero(core.weights > 0.05)
    w, contrast = core.weights[rows, columns].astype(float), core.top - core.glow
    area = float(w.sum())
    pixels = np.column_stack([columns + corner[0], rows + corner[1]]).astype(float)
    centre = w @ pixels / area
    e = pixels - centre
    moments = (w[:, None] * e).T @ e / area
    low, high = np.linalg.eigvalsh(moments)
    aspect = float(np.sqrt(max(low, 1e-3) / max(high, 1e-3)))
    fill = area / (4.0 * np.pi * np.sqrt(max(low * high, 1e-6)))  # a uniform ellipse has area 4 pi sqrt(det moments)
    noise = float(np.sqrt(np.mean(sigma[rows, columns] ** 2)))
    # d centre = sum e dw / area with dw = noise / top; the factor 3 is because smoothing correlates neighbours.
    covariance = 3.0 * (noise / contrast / area) ** 2 * (e.T @ e) + CENTRE_FLOOR_PX**2 * np.eye(2)
    sigmas = contrast / noise
    clear = min(sigmas / CLEAR_SIGMAS, 1.0) * min(sigmas * np.sqrt(area) / CLEAR_BLOB_SIGMAS, 1.0)
    round_ = min(aspect / 0.5, 1.0)
    full = float(np.exp(-0.5 * ((fill - 0.96) / 0.1) ** 2))
    return centre, covariance, area, contrast, aspect, fill, clear * round_ * full


def _described(blobs: list[Blob], sigma: Image, registration: ImageAlignment) -> LightBlobs:
    """Return the blobs, best first."""
    rows = sorted((blob for blob in blobs if blob[4] >= LEAST_ASPECT), key=lambda blob: -blob[6])[:MOST_BLOBS]
    threshold = SEED_SIGMAS * float(np.median(sigma[::8, ::8]))
    column = [np.array([row[i] for row in rows]) for i in range(7)]
    return LightBlobs(
        centres_px=column[0].reshape(-1, 2), covariance_px=column[1].reshape(-1, 2, 2), area_px=column[2],
        contrast=column[3], aspect=column[4], fill=column[5], score=column[6], threshold=threshold,
        shift_px=registration.shift_px,
    )  # fmt: skip
