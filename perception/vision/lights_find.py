"""Lights found in an image pair, off and on (paper, Section II-B, Fig. 5): register, subtract, threshold, grow regions.

The threshold comes from the noise of the pair itself: grey-level noise by brightness, and what misregistration leaves
on edges. Glare that moved in between is large and smooth, and falls to a top-hat.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.errors import InvalidRequest
from perception.vision.lights_registration import Registration, register

Array = NDArray[np.float64]
Image = NDArray[np.float32]

SEED_SIGMAS = 6.0  # a 640x480 image has 3e5 pixels: 6 sigma leaves no noise seed
GROW_SHARE = 0.5  # a region ends where the difference falls to half of its top: the lamp's rim at any blur
LEAST_AREA_PX = 4.0
CENTRE_FLOOR_PX = 0.04  # registration and lens blooming, measured on drawn pairs
MOST_BLOBS = 24
LEAST_ASPECT = 0.25  # a round lamp seen 75 degrees aslant


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightBlobs:
    """Places that became brighter, best first; N may be 0.

    Attributes:
        centres_px: (N, 2) sub-pixel centres in the image with lights on.
        covariance_px: (N, 2, 2) of the centres, px^2.
        area_px: (N,) area of the lit region.
        aspect: (N,) minor over major axis, 1 for a disc.
        fill: (N,) area over that of the ellipse with the same moments; 1 for a disc, less for arcs and corners.
        contrast: (N,) rise of the grey level.
        score: (N,) 0..1, how much like a lamp: round, filled, clear of the noise.
        threshold: mean grey-level rise that made a seed, from the noise.
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
    """Everything that became brighter from one image to the other and is about as compact as a lamp.

    Args:
        image_off, image_on: (H, W) gray or (H, W, 3) RGB, 8 bit; the camera may have moved by some pixels in between.
        largest_diameter_px: larger regions are glare or shadow; 1/12 of the image height when None.

    Raises:
        InvalidRequest: not images, or of different size.
        CameraMoved: the two do not show the same view.
    """
    off, on = gray_of(image_off), gray_of(image_on)
    if off.shape != on.shape:
        raise InvalidRequest(
            f"image sizes differ: {off.shape[::-1]} off, {on.shape[::-1]} on", hint="take both with one camera setting"
        )
    registration = register(off, on, noise=_raw_noise(off, on))
    diameter = largest_diameter_px if largest_diameter_px is not None else on.shape[0] / 12.0
    rise = _rise(on, registration, diameter)
    sigma = _noise(on, registration)
    regions = _grow(rise, sigma, registration.inside, diameter)
    return _describe(regions, sigma, registration)


def gray_of(image: NDArray[Any]) -> Image:
    """(H, W) float32 grey levels of an 8-bit gray or RGB image.

    Raises:
        InvalidRequest: another shape or type, or smaller than 16x16.
    """
    array = np.asarray(image)
    if array.dtype != np.uint8 or not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)):
        raise InvalidRequest(
            f"expected (H, W) or (H, W, 3) with 8 bits, got {array.shape} {array.dtype}", hint="convert the image first"
        )
    if min(array.shape[:2]) < 16:
        raise InvalidRequest(f"image is only {array.shape[1]}x{array.shape[0]}", hint="16x16 is the least")
    if array.ndim == 3:
        return (array @ np.array([0.299, 0.587, 0.114], np.float32)).astype(np.float32)
    return array.astype(np.float32)


def _raw_noise(off: Image, on: Image) -> float:
    """Noise of one pixel from second differences, which smooth shading and most of the edges do not reach."""
    rough = [np.median(np.abs(i[1::3, 2::3] - 2.0 * i[1::3, 1:-1:3][:, : i[1::3, 2::3].shape[1]]
                              + i[1::3, :-2:3][:, : i[1::3, 2::3].shape[1]])) for i in (off, on)]
    return max(1.4826 * float(np.mean(rough)) / float(np.sqrt(6.0)), 0.5)


def _rise(on: Image, registration: Registration, diameter: float) -> Image:
    """Difference on - off, smoothed, without what is wider than a lamp (white top-hat)."""
    import cv2

    difference = np.where(registration.inside, on - registration.warped, 0.0).astype(np.float32)
    difference = np.asarray(cv2.blur(difference, (3, 3)))
    half = (difference.shape[1] // 2, difference.shape[0] // 2)
    side = int(diameter / 2.0) | 1
    small = cv2.resize(difference, half, interpolation=cv2.INTER_AREA)
    opened = cv2.morphologyEx(small, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    wide = cv2.resize(cv2.blur(opened, (side, side)), difference.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(difference - np.maximum(wide, 0.0), np.float32)


def _noise(on: Image, registration: Registration) -> Image:
    """(H, W) standard deviation of `_rise` where nothing changed.

    sigma^2 = a + b I + c |grad I|^2: read noise, shot noise, and misregistered edges; each from medians of this pair.
    """
    import cv2

    base = registration.warped
    difference = np.asarray(cv2.blur(on - base, (3, 3)))[2:-2, 2:-2]
    gx = cv2.Sobel(base, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    gy = cv2.Sobel(base, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    slope2 = np.asarray(gx * gx + gy * gy)
    sample = (slice(None, None, 3), slice(None, None, 3))
    level, slope, change = base[2:-2, 2:-2][sample], slope2[2:-2, 2:-2][sample], difference[sample]
    flat = slope <= np.median(slope)
    a, b = _level_noise(level[flat], change[flat])
    steep = slope >= max(float(np.quantile(slope, 0.95)), 1.0)
    c = 0.0
    if steep.sum() > 50:
        excess = change[steep] ** 2 - (a + b * level[steep])
        c = max(float(np.median(excess / slope[steep])) * 2.2, 0.0)  # the median of chi-square 1 is 0.455
    widened = cv2.dilate(slope2, np.ones((3, 3), np.uint8))
    return np.sqrt(np.maximum(a + b * np.clip(base, 0.0, 255.0), 0.05) + max(c, 0.01) * widened).astype(np.float32)


def _level_noise(level: NDArray[Any], change: NDArray[Any]) -> tuple[float, float]:
    """Variance a + b * level of the change, from the median absolute deviation in bands of brightness."""
    order = np.argsort(level)
    bands = [part for part in np.array_split(order, 8) if len(part) >= 30]
    overall = (1.4826 * float(np.median(np.abs(change - np.median(change))))) ** 2
    if len(bands) < 3:
        return max(overall, 0.05), 0.0
    x = np.array([float(level[part].mean()) for part in bands])
    y = np.array([(1.4826 * float(np.median(np.abs(change[part] - np.median(change[part]))))) ** 2 for part in bands])
    if np.ptp(x) < 10.0:
        return max(overall, 0.05), 0.0
    b = max(float(np.polyfit(x, y, 1)[0]), 0.0)
    return max(float(np.median(y - b * x)), 0.05), b


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Region:
    """Pixels of one blob: coordinates (n, 2), coverage weights (n,) 0..1, rise at the top, mean noise."""

    pixels: Array
    weights: Array
    top: float
    sigma: float


def _grow(rise: Image, sigma: Image, inside: NDArray[np.bool_], diameter: float) -> list[_Region]:
    """Connected regions above `GROW_SHARE` of their own top, around pixels that stand out of the noise."""
    import cv2

    seeds = ((rise > SEED_SIGMAS * sigma) & inside).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(seeds, connectivity=8)
    regions = []
    margin = 6
    for k in np.argsort(-stats[1:, cv2.CC_STAT_AREA])[: 4 * MOST_BLOBS] + 1:
        x, y, w, h, area = (int(v) for v in stats[k])
        if area < 3 or max(w, h) > 1.5 * diameter:
            continue
        x0, y0 = max(x - margin, 0), max(y - margin, 0)
        window = (slice(y0, y + h + margin), slice(x0, x + w + margin))
        region = _region(rise[window], sigma[window], labels[window] == k, (x0, y0))
        if region is not None:
            regions.append(region)
    return regions


def _region(rise: Image, sigma: Image, seed: NDArray[np.bool_], corner: tuple[int, int]) -> _Region | None:
    import cv2

    top = float(np.quantile(rise[seed], 0.7))
    lit = (rise > GROW_SHARE * top).astype(np.uint8)
    _, labels = cv2.connectedComponents(lit, connectivity=4)
    touched = np.unique(labels[seed & (lit > 0)])
    touched = touched[touched > 0]
    if not len(touched):
        return None
    main = max(touched, key=lambda t: int(((labels == t) & seed).sum()))
    body = (labels == main).astype(np.uint8)
    near = cv2.dilate(body, np.ones((3, 3), np.uint8)) > 0
    weights = np.where(near, np.clip(rise / top, 0.0, 1.0), 0.0)
    rows, columns = np.nonzero(weights > 0.05)
    if weights.sum() < LEAST_AREA_PX:
        return None
    return _Region(
        pixels=np.column_stack([columns + corner[0], rows + corner[1]]).astype(float),
        weights=weights[rows, columns].astype(float),
        top=top,
        sigma=float(np.sqrt(np.mean(sigma[rows, columns] ** 2))),
    )


def _describe(regions: list[_Region], sigma: Image, registration: Registration) -> LightBlobs:
    rows = [row for row in map(_measure, regions) if row[4] >= LEAST_ASPECT]
    rows.sort(key=lambda row: -row[6])
    rows = rows[:MOST_BLOBS]
    threshold = SEED_SIGMAS * float(np.median(sigma[::8, ::8]))
    column = [np.array([row[i] for row in rows]) for i in range(7)]
    return LightBlobs(
        centres_px=column[0].reshape(-1, 2), covariance_px=column[1].reshape(-1, 2, 2), area_px=column[2],
        contrast=column[3], aspect=column[4], fill=column[5], score=column[6], threshold=threshold,
        shift_px=registration.shift_px,
    )  # fmt: skip


def _measure(region: _Region) -> tuple[Array, Array, float, float, float, float, float]:
    """Centre, its covariance, area, contrast, aspect, fill and score of one region."""
    w, area = region.weights, float(region.weights.sum())
    centre = w @ region.pixels / area
    e = region.pixels - centre
    moments = (w[:, None] * e).T @ e / area
    low, high = np.linalg.eigvalsh(moments)
    aspect = float(np.sqrt(max(low, 1e-3) / max(high, 1e-3)))
    fill = area / (4.0 * np.pi * np.sqrt(max(low * high, 1e-6)))  # a uniform ellipse has area 4 pi sqrt(det moments)
    # d centre = sum e dw / area with dw = noise / top; smoothing ties about three neighbours together, hence the 3.
    covariance = 3.0 * (region.sigma / region.top / area) ** 2 * (e.T @ e) + CENTRE_FLOOR_PX**2 * np.eye(2)
    clear = min(region.top / region.sigma / 20.0, 1.0)
    round_ = min(aspect / 0.5, 1.0)
    full = float(np.exp(-0.5 * ((fill - 0.97) / 0.12) ** 2))
    return centre, covariance, area, region.top, aspect, fill, clear * round_ * full
