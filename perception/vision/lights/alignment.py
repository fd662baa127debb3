"""Registration of two images of one scene between which lights, glare and exposure have changed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.errors import PerceptionError

Image = NDArray[np.float32]
Edges = tuple[NDArray[np.intp], NDArray[np.intp], tuple[Image, Image]]
"""Rows and columns of pixels of the second image whose gradients constrain the motion, and its gradient images."""

LEAST_AGREEMENT = 0.6  # correlation of the gradients after registration; usually above 0.9, 0.1 for unrelated images
EDGE_PIXELS = 6_000  # used for the fit; 16 000 gave the same shift within 0.01 px
ITERATIONS = 10
SHIFT_FIRST = 3  # iterations with translation only; rotation and growth are added when most edges overlap
TONE_BINS = 16  # gray levels are grouped into so many bins
COMMON_SHARE = 0.007  # of the pixels: a gray level so frequent cannot come from lamps alone
FEW_EDGES = 200  # with fewer edge pixels no registration is attempted


class CameraMoved(PerceptionError):
    """The two images do not show the same view, so that their difference means nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageAlignment:
    """Registration of the first image to the second.

    Attributes:
        second_from_first: (2, 3) affine map of pixels (shift, rotation and growth).
        shift_px: (2,) motion of the image centre.
        warped: (H, W) the first image resampled to the second's view, in the second's gray levels.
        inside: (H, W) whether `warped` is known.
        agreement: correlation of the gradients, 0 to 1; 1 also if the scene has no edges to compare.
    """

    second_from_first: Array
    shift_px: tuple[float, float]
    warped: Image
    inside: NDArray[np.bool_]
    agreement: float


def register(first: Image, second: Image, *, noise: float) -> ImageAlignment:
    """Estimate motion and gain between two gray images, robustly against what has changed.

    Phase correlation of the half-size gradient images gives the start of a Gauss-Newton fit of shift, rotation, growth
    and brightness over the strongest edges, with Tukey's weights.

    Args:
        first, second: (H, W) gray levels.
        noise: standard deviation of a pixel (gray levels); weaker edges are ignored.

    Raises:
        CameraMoved: after the fit the edges still do not agree.

    Source: Lucas, Kanade, IJCAI 1981; Kuglin, Hines, 1975.
    """
    edges, start = _strong_edges(second, least=3.0 * noise), np.eye(3)[:2]
    if min(len(edges[0]), len(_strong_edges(first, least=3.0 * noise)[0])) < FEW_EDGES:
        return _result(first, second, None, start)  # in the dark only the lights themselves have edges
    start[:, 2] = _coarse_shift(first, second)
    fit = _result(first, second, edges, _refined(first, second, edges, start, noise))
    if fit.agreement < LEAST_AGREEMENT:
        raise CameraMoved(
            f"the images with lights off and on do not match (edge agreement {fit.agreement:.2f})",
            hint="hold the camera and the scene still between the two images, or take both again",
            agreement=round(fit.agreement, 3),
        )
    return fit


def _refined(first: Image, second: Image, edges: Edges, affine: Array, noise: float) -> Array:
    """Return the map (2, 3) of a fit of shift, rotation, growth, gain and offset by Gauss-Newton steps from `affine`."""
    rows, columns, both = edges
    height, width = second.shape
    gx, gy = (g[rows, columns].astype(float) for g in both)
    x, y = (columns - width / 2.0) / width, (rows - height / 2.0) / width
    target = second[rows, columns].astype(float)
    gain, offset = 1.0, 0.0
    one = np.ones_like(x)
    for iteration in range(ITERATIONS):
        source = _sample(first, affine, rows, columns)
        e = target - gain * source - offset
        motion = [gx, gy, gy * x - gx * y, gx * x + gy * y][: 2 if iteration < SHIFT_FIRST else 4]
        J = np.stack([source, one, *motion], axis=1)
        known = np.isfinite(e)
        scale = max(1.4826 * float(np.median(np.abs(e[known]))), noise)
        w = np.where(known, np.clip(1.0 - (e / (4.685 * scale)) ** 2, 0.0, None) ** 2, 0.0)
        J, e = np.where(known[:, None], J, 0.0), np.where(known, e, 0.0)
        step = np.linalg.lstsq((J * w[:, None]).T @ J, (J * w[:, None]).T @ e, rcond=1e-12)[0]
        gain, offset = gain + step[0], offset + step[1]
        # If the content moves by a + B (p - centre), the gray level of a pixel changes by -gradient . (that motion).
        turn, growth = (step[4] / width, step[5] / width) if len(step) > 4 else (0.0, 0.0)
        move = np.array([[1.0 - growth, turn, 0.0], [-turn, 1.0 - growth, 0.0], [0.0, 0.0, 1.0]])
        centre = np.array([width / 2.0, height / 2.0])
        move[:2, 2] = centre - move[:2, :2] @ centre - step[2:4]
        affine = (move @ np.vstack([affine, [0.0, 0.0, 1.0]]))[:2]
        if iteration >= SHIFT_FIRST and np.abs(step[2:4]).max() < 0.01:
            break
    return affine


def _result(first: Image, second: Image, edges: Edges | None, affine: Array) -> ImageAlignment:
    """Resample the first image with the fitted map, and compute gray levels and agreement."""
    height, width = second.shape
    flags = cv2.INTER_CUBIC
    warped = np.asarray(
        cv2.warpAffine(first, affine, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE), np.float32
    )
    inside = cv2.warpAffine(np.ones_like(first), affine, (width, height), flags=cv2.INTER_NEAREST) > 0.5
    gain, offset = _tones(warped[inside], second[inside])
    warped = np.asarray(gain * warped + offset, np.float32)
    agreement = 1.0
    if edges is not None:
        a, b = (np.concatenate([g[edges[:2]] for g in both]) for both in (gradients(warped), edges[2]))
        agreement = float((a @ b) / np.sqrt(max((a @ a) * (b @ b), 1e-12)))
    centre = affine @ [width / 2.0, height / 2.0, 1.0] - [width / 2.0, height / 2.0]
    return ImageAlignment(
        second_from_first=affine, shift_px=(float(centre[0]), float(centre[1])),
        warped=warped, inside=inside, agreement=agreement,
    )  # fmt: skip


def _tones(first: NDArray[Any], second: NDArray[Any]) -> tuple[float, float]:
    """Return gain and offset between gray levels, from the median change at each level that is common in the image.

    A gain fitted on edges alone would be wrong, because resampling flattens them.
    """
    first, second = first[::7], second[::7]
    levels = np.clip(first / (256.0 / TONE_BINS), 0, TONE_BINS - 1).astype(np.intp)
    counts = np.bincount(levels, minlength=TONE_BINS)
    common = np.flatnonzero(counts >= COMMON_SHARE * len(first))
    change = second - first
    x = np.array([float(np.median(first[levels == b])) for b in common])
    y = np.array([float(np.median(change[levels == b])) for b in common])
    if len(common) < 3 or np.ptp(x) < 32.0:
        return 1.0, float(np.median(change))
    slope, offset = np.polyfit(x, y, 1, w=np.sqrt(counts[common]))
    return 1.0 + float(slope), float(offset)


def gradients(image: Image) -> tuple[Image, Image]:
    """Return the central differences of the slightly smoothed image, gray levels per pixel."""
    return (
        np.asarray(cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)),
        np.asarray(cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)),
    )


def _strong_edges(image: Image, *, least: float) -> Edges:
    """Return the strongest edge pixels of an image, at most about `EDGE_PIXELS`."""
    both = gradients(image)
    strength = np.hypot(*both)
    inner = strength[4:-4, 4:-4]
    sample = inner[::4, ::4]
    share = min(1.0, EDGE_PIXELS / max(inner.size, 1))
    limit = max(float(np.quantile(sample, 1.0 - share)) if sample.size else np.inf, least)
    rows, columns = np.nonzero(inner > limit)
    return rows + 4, columns + 4, both


def _coarse_shift(first: Image, second: Image) -> Array:
    """Return the shift (2,) in pixels of the first image's content, accurate to about half a pixel."""
    half = (max(first.shape[1] // 2, 1), max(first.shape[0] // 2, 1))
    maps = []
    for image in (first, second):
        small = cv2.resize(image, half, interpolation=cv2.INTER_AREA)
        gx, gy = gradients(np.asarray(small, np.float32))
        strength = np.hypot(gx, gy)
        maps.append(np.minimum(strength, np.quantile(strength[::2, ::2], 0.98)))
    (dx, dy), _ = cv2.phaseCorrelate(maps[0], maps[1], cv2.createHanningWindow(half, cv2.CV_32F))
    return np.array([dx * first.shape[1] / half[0], dy * first.shape[0] / half[1]])


def _sample(image: Image, affine: Array, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Array:
    """Return the first image's bilinear values at pixels of the second; NaN outside."""
    inverse = np.linalg.inv(affine[:, :2])
    x, y = inverse @ (np.stack([columns, rows]) - affine[:, 2:])
    height, width = image.shape
    outside = (x < 0) | (y < 0) | (x > width - 1.001) | (y > height - 1.001)
    x, y = np.where(outside, 0.0, x), np.where(outside, 0.0, y)
    i, j = y.astype(np.intp), x.astype(np.intp)
    fx, fy = x - j, y - i
    top = image[i, j] * (1 - fx) + image[i, j + 1] * fx
    bottom = image[i + 1, j] * (1 - fx) + image[i + 1, j + 1] * fx
    return np.where(outside, np.nan, top * (1 - fy) + bottom * fy)
