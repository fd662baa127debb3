"""Robust search for a pointer about a known pivot.

The face is unrolled to (angle, radius). A morphological closing or opening along the angle estimates the face without
thin structures; the difference (black-hat, white-hat) is the ink, without glare, gradients and shadow borders. A
pointer has ink at *every* radius between hub and numerals; a numeral, a tick or a cable has it only at some. The score
of an angle is therefore a low quantile over the radii, not their mean. The opposite, shorter end fails the same test.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.vision.bilinear import polar_values
from perception.vision.patch import Patch
from perception.vision.status.pointer_axis import pointer_axis

ANGLE_STEP_PX = 0.7  # at the outer radius
RIVAL_APART_RAD = np.deg2rad(14.0)  # larger than the width of a pointer
PIVOT_SIGMA_PX = 0.5  # standard deviation of the pivot's position relative to the registered middle, image px
REFINE_RAD = float(np.deg2rad(7.0))  # half width of the search when the angle is refined
ROUGH_SIGMA_RAD = float(np.deg2rad(3.0))  # standard deviation of a pointer whose axis cannot be fitted
# Half width of the area whose median is the face; pointer and numerals cover less than half of it.
ABOUT_RAD = float(np.deg2rad(60.0))
GAP = 0.35  # of what seems a pointer's ink; a gap between two bright things has less
LEAST_OFF_FACE = 0.7  # of a pointer's ink; 99 % of 250 pointers read correctly have more than 0.82
#: Share of the radii next to the hub, and largest ratio of a pointer's ink at all radii to its ink there. For the
#: pointers of 340 gauges the ratio is at most 1.6, for numerals and words that were taken for one at least 2.5.
INNER_SHARE, INNER_TIMES = 1 / 3, 1.8
CORRELATED = 2.0  # because neighbouring rows of an oversampled patch share their noise
TYPICAL_OF = 240  # number of columns from which the typical ink of a face is estimated

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class PointerFit:
    """The best pointer hypothesis.

    Attributes:
        angle_rad: clockwise from straight up.
        sigma_rad: standard deviation of the angle.
        strength: ink at the pointer over the ink's noise.
        contrast: ink at the pointer, gray levels.
        rival_ratio: score of the best other direction over this one's.
        rival_rad: angle of that direction.
        supported: share of the visible radii with clear ink.
        shown: the same share of all radii.
        is_dark: whether the pointer is darker than the face.
        unknown: share of the directions that are mostly occluded.
    """

    angle_rad: float
    sigma_rad: float
    strength: float
    contrast: float
    rival_ratio: float
    rival_rad: float
    supported: float
    shown: float
    is_dark: bool
    unknown: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PointerSearch:
    """Where a pointer is searched, and what is known of it.

    Attributes:
        pivot_m: point about which it turns, in the patch's plane.
        inner_m, outer_m: radii over which every pointer has ink.
        fine_m: radii used to refine the angle, from where the pointer begins to where it ends.
        limits_rad: smallest and largest angle, or None for a full turn.
        width_rad: anything wider is not a pointer.
        quantile: of the ink over the radii that is the score of a direction.
        dark: polarity, if it is known.
        pivot_sigma_px: standard deviation of the pivot's position, image px.
        from_hub: whether the inner radii are next to the hub, where the pointer has ink and numerals have none.
    """

    pivot_m: tuple[float, float]
    inner_m: float
    outer_m: float
    fine_m: tuple[float, float]
    limits_rad: tuple[float, float] | None = None
    width_rad: float = float(np.deg2rad(30.0))
    quantile: float = 0.3
    dark: bool | None = None
    pivot_sigma_px: float = PIVOT_SIGMA_PX
    from_hub: bool = False


def find_pointer(patch: Patch, search: PointerSearch, *, cover: NDArray[np.bool_] | None = None) -> PointerFit | None:
    """Return the clearest pointer about the pivot, or None when nothing stands out.

    Args:
        cover: (H, W) mask of what lies across the face (see `occluder_bands`), or None.
    """
    limits_rad, wraps = search.limits_rad, search.limits_rad is None
    angles = _angles(patch, search.outer_m, limits_rad)
    radii = np.arange(
        min(search.inner_m, search.fine_m[0]), max(search.outer_m, search.fine_m[1]), 1.0 / patch.px_per_m
    )
    polar = unroll(patch, search.pivot_m, radii, angles)
    hidden = _hidden(patch, cover, search.pivot_m, radii, angles)
    if hidden.any():
        shown = np.where(hidden, np.nan, polar)
        shown[hidden.all(axis=1)] = 0.0
        polar = np.where(hidden, np.nanmedian(shown, axis=1, keepdims=True), polar).astype(np.float32)
    rows = (radii >= search.inner_m) & (radii <= search.outer_m)
    if rows.sum() < 4:
        return None
    found: list[tuple[PointerFit, Float32]] = []
    for is_dark in (True, False) if search.dark is None else (search.dark,):
        ink = ink_along_angle(polar, search.width_rad / (angles[1] - angles[0]), is_dark, wraps=wraps)
        fit = _rough(
            ink[rows], hidden[rows], angles, wraps=wraps, quantile=search.quantile, is_dark=is_dark, from_hub=search.from_hub
        )  # fmt: skip
        if fit is not None:
            found.append((fit, ink))
    if not found:
        return None
    if wraps:
        off_face = [_off_face(fit, polar[rows], ink[rows], angles) for fit, ink in found]
        if max(off_face) < GAP:
            return None
        found = [pointer for pointer, off in zip(found, off_face, strict=True) if off > LEAST_OFF_FACE] or found
    fit, ink = max(found, key=lambda pointer: _clarity(pointer[0]))
    offset = wrapped(angles - fit.angle_rad) if wraps else angles - fit.angle_rad
    fine = (radii >= search.fine_m[0]) & (radii <= search.fine_m[1])
    e_sigma = search.pivot_sigma_px / patch.image_px_per_m
    angle, variance = pointer_axis(ink[fine], hidden[fine], radii[fine], offset, REFINE_RAD, e_sigma, patch.px_per_m)
    if np.isnan(angle):
        return replace(fit, sigma_rad=ROUGH_SIGMA_RAD)
    return replace(fit, angle_rad=fit.angle_rad + angle, sigma_rad=float(np.sqrt(CORRELATED * variance)))


def _off_face(fit: PointerFit, polar: Float32, ink: Float32, angles: Array) -> float:
    """Return the difference between a pointer's gray and the face's, relative to its ink.

    A gap between two bright things has dark ink, but the face's gray.
    """
    top = int(np.abs(wrapped(angles - fit.angle_rad)).argmin())
    column = slice(max(0, top - 1), top + 2)
    face = np.median(polar[:, np.abs(wrapped(angles - fit.angle_rad)) < ABOUT_RAD], axis=1)
    darker = face - polar[:, column].mean(axis=1)
    return float(
        np.median(darker if fit.is_dark else -darker) / max(float(np.median(ink[:, column].max(axis=1))), 1e-6)
    )


def _clarity(fit: PointerFit) -> float:
    """Return how clearly a pointer stands out, for comparing both polarities."""
    return fit.strength * (1 - fit.rival_ratio)


def unroll(patch: Patch, pivot_m: tuple[float, float], radii_m: Array, angles_rad: Array) -> Float32:
    """Return the gray values (radii, angles) around a pivot; angles are clockwise from straight up."""
    u, v = patch.pixel_of(*pivot_m)
    directions = np.stack([np.sin(angles_rad), -np.cos(angles_rad)])
    gray = np.ascontiguousarray(patch.gray)
    return polar_values(gray, (float(u), float(v)), radii_m * patch.px_per_m, directions)


def ink_along_angle(polar: Float32, width: float, is_dark: bool, *, wraps: bool) -> Float32:
    """Return the black-hat (or white-hat) along the angle; `width` in columns is that of the widest structure kept."""
    size = max(3, round(width)) | 1
    pad = size
    wide = (
        np.pad(polar, ((0, 0), (pad, pad)), mode="wrap") if wraps else np.pad(polar, ((0, 0), (pad, pad)), mode="edge")
    )
    wide = np.asarray(cv2.blur(wide, (1, 3)), np.float32)  # otherwise noise would raise the closing everywhere
    kernel = np.ones((1, size), np.uint8)
    operation = cv2.MORPH_BLACKHAT if is_dark else cv2.MORPH_TOPHAT
    ink = cv2.morphologyEx(wide, operation, kernel)[:, pad:-pad]
    typical = np.median(ink[:, :: max(1, ink.shape[1] // TYPICAL_OF)], axis=1, keepdims=True)
    return np.asarray(np.maximum(ink - typical, 0.0), np.float32)


def _hidden(
    patch: Patch, cover: NDArray[np.bool_] | None, pivot_m: tuple[float, float], radii_m: Array, angles_rad: Array
) -> NDArray[np.bool_]:
    """Return a mask (radii, angles) of the samples that are occluded or outside the image."""
    lost = ~patch.inside if cover is None else cover | ~patch.inside
    if not lost.any():
        return np.zeros((len(radii_m), len(angles_rad)), bool)
    return unroll(replace(patch, gray=lost.astype(np.uint8)), pivot_m, radii_m, angles_rad) > 0.2


def _low_mean(columns: Float32, hidden: NDArray[np.bool_], low: float, high: float) -> Array:
    """Return the mean of every column between two quantiles of the visible values; 0 if most of it is hidden."""
    if not hidden.any():
        ranks = slice(int(low * len(columns)), max(int(low * len(columns)) + 2, round(high * len(columns))))
        return np.asarray(np.sort(columns, axis=0)[ranks].mean(axis=0, dtype=float))
    ordered = np.sort(np.where(hidden, np.inf, columns), axis=0)
    known = np.isfinite(ordered)
    count = known.sum(axis=0)
    first = (low * count).astype(int)
    last = np.maximum(first + 2, np.round(high * count).astype(int))  # at least two ranks
    rank = np.arange(len(columns))[:, None]
    mean = np.where((rank >= first) & (rank < last) & known, ordered, 0.0).sum(axis=0, dtype=float) / (last - first)
    return np.where(count >= 0.5 * len(columns), mean, 0.0)


def _angles(patch: Patch, outer_m: float, limits_rad: tuple[float, float] | None) -> Array:
    """Return the angles at which the face is sampled."""
    step = ANGLE_STEP_PX / (outer_m * patch.px_per_m)
    if limits_rad is None:
        count = int(np.clip(2 * np.pi / step, 90, 1440))
        return 2 * np.pi * np.arange(count) / count - np.pi
    span = limits_rad[1] - limits_rad[0]
    return np.linspace(*limits_rad, int(np.clip(span / step, 40, 1440)))


def _rough(
    ink: Float32, hidden: NDArray[np.bool_], angles: Array, *, wraps: bool, quantile: float, is_dark: bool, from_hub: bool
) -> PointerFit | None:  # fmt: skip
    """Find the direction with the most ink at all radii, to one column; None if none stands out."""
    everywhere = _ink_of_columns(ink, hidden, quantile)
    noise = 1.4826 * float(np.median(everywhere)) + 0.5
    score = _from_hub(everywhere, ink, hidden, quantile) if from_hub else everywhere
    top = int(score.argmax())
    peak = float(score[top])
    if peak < 2.0 * noise:
        return None
    apart = np.abs(wrapped(angles - angles[top])) if wraps else np.abs(angles - angles[top])
    others = np.where(apart > RIVAL_APART_RAD, score, 0.0)
    rival = int(others.argmax())
    column = ink[:, max(0, top - 1) : top + 2].max(axis=1)
    known = ~hidden[:, top]
    clear = column > 0.35 * np.median(column[known]) + noise
    return PointerFit(
        angle_rad=float(angles[top]),
        sigma_rad=ROUGH_SIGMA_RAD,
        strength=peak / noise,
        contrast=peak,
        rival_ratio=float(others[rival]) / peak,
        rival_rad=float(angles[rival]),
        supported=float(clear[known].mean()),
        shown=float((clear & known).mean()),
        is_dark=is_dark,
        unknown=float((hidden.mean(axis=0) > 0.5).mean()),
    )


def _ink_of_columns(ink: Float32, hidden: NDArray[np.bool_], quantile: float) -> Float32:
    """Return the ink (angles,) that a direction reaches at most of its radii."""
    mean = _low_mean(ink, hidden, 0.5 * quantile, quantile + 0.25).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(mean[None], (0, 0), 1.0, borderType=cv2.BORDER_REPLICATE)[0], np.float32)


def _from_hub(score: Float32, ink: Float32, hidden: NDArray[np.bool_], quantile: float) -> Float32:
    """Return the score (angles,), reduced if the inner radii have little ink: numerals and words begin farther out."""
    inner = max(2, round(INNER_SHARE * len(ink)))
    limit = INNER_TIMES * _ink_of_columns(ink[:inner], hidden[:inner], quantile)
    is_hidden = hidden[:inner].mean(axis=0) >= 0.5
    return np.asarray(np.where(is_hidden, score, np.minimum(score, limit)), np.float32)


def wrapped(angle_rad: Array) -> Array:
    """Return angles wrapped to -pi..pi."""
    return np.asarray((angle_rad + np.pi) % (2 * np.pi) - np.pi)
