"""A pointer about a known pivot, found without outliers.

The face is unrolled to (angle, radius). Along the angle, a morphological closing or opening paints the face without
thin structures, so glare, gradients and shadow borders vanish and what is left is ink (black-hat, white-hat). A
pointer has ink at *every* radius between hub and numerals; a numeral, a tick or a cable has it at some. The score of an
angle is therefore a low quantile over the radii, not their mean. The opposite end is shorter and fails the same test.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.vision.patch import Patch, sample_at
from perception.vision.view import Array

ANGLE_STEP_PX = 0.7  # at the outer radius
RIVAL_APART_RAD = np.deg2rad(14.0)  # further than a pointer is wide
PIVOT_SIGMA_PX = 0.5  # how far the true pivot may lie from the registered middle, image px
REFINE_RAD = np.deg2rad(7.0)
NUMERAL = 1.6  # times the ink of the typical row

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class PointerFit:
    """The best pointer hypothesis.

    Attributes:
        angle_rad: clockwise from straight up.
        sigma_rad: one sigma.
        strength: ink at the pointer over the ink's noise.
        contrast: ink at the pointer, gray levels.
        rival_ratio: score of the best other direction over this one's.
        rival_rad: where that is.
        supported: share of the radii with clear ink.
        is_dark: pointer darker than the face.
        unknown: share of the directions that something lies across.
    """

    angle_rad: float
    sigma_rad: float
    strength: float
    contrast: float
    rival_ratio: float
    rival_rad: float
    supported: float
    is_dark: bool
    unknown: float


def find_pointer(
    patch: Patch,
    *,
    pivot_m: tuple[float, float],
    inner_m: float,
    outer_m: float,
    fine_m: tuple[float, float],
    limits_rad: tuple[float, float] | None = None,
    width_rad: float = np.deg2rad(30.0),
    plane_z_m: float | None = None,
    quantile: float = 0.3,
    cover: NDArray[np.bool_] | None = None,
    dark: bool | None = None,
    prior_pivot_px: float = PIVOT_SIGMA_PX,
) -> PointerFit | None:
    """The pointer about `pivot_m`, or None when nothing stands out.

    Args:
        inner_m, outer_m: radii over which every pointer has ink.
        fine_m: radii used to refine the angle, from where the pointer is to where it ends.
        limits_rad: smallest and largest angle, or None for a full turn.
        width_rad: what is wider than this is not a pointer.
        cover: (H, W) mask of what lies across the face (see `cover`), or None.
        dark: polarity if it is known.
    """
    angles = _angles(patch, outer_m, limits_rad)
    radii = np.arange(min(inner_m, fine_m[0]), max(outer_m, fine_m[1]), 1.0 / patch.px_per_m)
    polar = unroll(patch, pivot_m, radii, angles, plane_z_m)
    hidden = _hidden(patch, cover, pivot_m, radii, angles)
    if hidden.any():
        shown = np.where(hidden, np.nan, polar)
        with np.errstate(all="ignore"):
            polar = np.where(hidden, np.nan_to_num(np.nanmedian(shown, axis=1, keepdims=True)), polar).astype(
                np.float32
            )
    rows = (radii >= inner_m) & (radii <= outer_m)
    if rows.sum() < 4:
        return None
    best: PointerFit | None = None
    for is_dark in (True, False) if dark is None else (dark,):
        ink = ink_along_angle(polar, width_rad / (angles[1] - angles[0]), is_dark, wraps=limits_rad is None)
        fit = _fit(
            ink,
            hidden,
            rows,
            radii,
            angles=angles,
            patch=patch,
            fine_m=fine_m,
            wraps=limits_rad is None,
            quantile=quantile,
            is_dark=is_dark,
            prior_pivot_px=prior_pivot_px,
        )
        if fit is not None and (
            best is None or fit.strength * (1 - fit.rival_ratio) > best.strength * (1 - best.rival_ratio)
        ):
            best = fit
    return best


def unroll(patch: Patch, pivot_m: tuple[float, float], radii_m: Array, angles_rad: Array, z_m: float | None) -> Float32:
    """(radii, angles) gray values about a pivot; angles clockwise from straight up."""
    x = pivot_m[0] + radii_m[:, None] * np.sin(angles_rad)
    y = pivot_m[1] + radii_m[:, None] * np.cos(angles_rad)
    return patch.sample(x, y, z_m)


def ink_along_angle(polar: Float32, width: float, is_dark: bool, *, wraps: bool) -> Float32:
    """Black-hat (or white-hat) along the angle; `width` in columns is the widest thing kept."""
    size = max(3, round(width)) | 1
    pad = size
    wide = (
        np.pad(polar, ((0, 0), (pad, pad)), mode="wrap") if wraps else np.pad(polar, ((0, 0), (pad, pad)), mode="edge")
    )
    wide = np.asarray(cv2.blur(wide, (1, 3)), np.float32)  # noise would otherwise lift the closing everywhere
    kernel = np.ones((1, size), np.uint8)
    operation = cv2.MORPH_BLACKHAT if is_dark else cv2.MORPH_TOPHAT
    ink = cv2.morphologyEx(wide, operation, kernel)[:, pad:-pad]
    return np.asarray(np.maximum(ink - np.median(ink, axis=1, keepdims=True), 0.0), np.float32)


def _hidden(
    patch: Patch, cover: NDArray[np.bool_] | None, pivot_m: tuple[float, float], radii_m: Array, angles_rad: Array
) -> NDArray[np.bool_]:
    """(radii, angles) what something lies across, or what is outside the image."""
    x = pivot_m[0] + radii_m[:, None] * np.sin(angles_rad)
    y = pivot_m[1] + radii_m[:, None] * np.cos(angles_rad)
    lost = ~patch.inside if cover is None else cover | ~patch.inside
    if not lost.any():
        return np.zeros((len(radii_m), len(angles_rad)), bool)
    return np.asarray(sample_at(lost.astype(np.uint8), *patch.pixel_of(x, y)) > 0.2)


def _low_mean(columns: Array, low: float, high: float) -> Array:
    """Mean of every column between two quantiles; infinite entries are unknown, and a column half unknown scores 0."""
    ordered = np.sort(columns, axis=0)
    known = np.isfinite(ordered)
    count = known.sum(axis=0)
    total = np.vstack([np.zeros(columns.shape[1]), np.cumsum(np.where(known, ordered, 0.0), axis=0)])
    first = (low * count).astype(int)
    last = np.maximum(first + 2, np.round(high * count).astype(int)).clip(max=len(columns))
    at = np.arange(columns.shape[1])
    mean = (total[last, at] - total[first, at]) / (last - first)
    return np.where(count >= 0.5 * len(columns), mean, 0.0)


def _angles(patch: Patch, outer_m: float, limits_rad: tuple[float, float] | None) -> Array:
    step = ANGLE_STEP_PX / (outer_m * patch.px_per_m)
    if limits_rad is None:
        count = int(np.clip(2 * np.pi / step, 90, 1440))
        return 2 * np.pi * np.arange(count) / count - np.pi
    span = limits_rad[1] - limits_rad[0]
    return np.linspace(*limits_rad, int(np.clip(span / step, 40, 1440)))


def _fit(
    ink: Float32,
    hidden: NDArray[np.bool_],
    rows: NDArray[np.bool_],
    radii: Array,
    *,
    angles: Array,
    patch: Patch,
    fine_m: tuple[float, float],
    wraps: bool,
    quantile: float,
    is_dark: bool,
    prior_pivot_px: float,
) -> PointerFit | None:
    use = ink[rows]
    score = _low_mean(np.where(hidden[rows], np.inf, use), 0.5 * quantile, quantile + 0.25)
    unknown = float((hidden[rows].mean(axis=0) > 0.5).mean())
    score = cv2.GaussianBlur(score[None].astype(np.float32), (0, 0), 1.0, borderType=cv2.BORDER_REPLICATE)[0]
    noise = 1.4826 * float(np.median(score)) + 0.5
    top = int(score.argmax())
    peak = float(score[top])
    if peak < 2.0 * noise:
        return None
    apart = np.abs(wrapped(angles - angles[top])) if wraps else np.abs(angles - angles[top])
    others = np.where(apart > RIVAL_APART_RAD, score, 0.0)
    rival = int(others.argmax())
    angle, sigma = _refine(
        ink, radii, angles, float(angles[top]), patch=patch, fine_m=fine_m, prior_pivot_px=prior_pivot_px, wraps=wraps
    )
    column = use[:, max(0, top - 1) : top + 2].max(axis=1)
    return PointerFit(
        angle_rad=angle,
        sigma_rad=sigma,
        strength=peak / noise,
        contrast=peak,
        rival_ratio=float(others[rival]) / peak,
        rival_rad=float(angles[rival]),
        supported=float((column > 0.35 * np.median(column) + noise).mean()),
        is_dark=is_dark,
        unknown=unknown,
    )


def _refine(
    ink: Float32,
    radii: Array,
    angles: Array,
    start_rad: float,
    *,
    patch: Patch,
    fine_m: tuple[float, float],
    prior_pivot_px: float,
    wraps: bool,
) -> tuple[float, float]:
    """Angle and sigma from the ink's centre at every radius: theta(r) = theta0 + e / r, e the pivot's offset across."""
    offset = wrapped(angles - start_rad) if wraps else angles - start_rad
    rows = (radii >= fine_m[0]) & (radii <= fine_m[1])
    r, part = radii[rows], ink[rows].astype(float)
    near = np.broadcast_to(np.abs(offset) < REFINE_RAD, part.shape)
    e_sigma = prior_pivot_px / patch.image_px_per_m
    solution, N = np.zeros(2), np.eye(2)
    for _ in range(3):
        theta, mass, width_rad = _row_centres(part, offset, near)
        if (mass > 0).sum() < 3:
            return start_rad, float(np.deg2rad(3.0))
        solution, N = _fit_line(r, theta, mass, e_sigma, 0.15 / patch.px_per_m)
        # What touches the pointer (a numeral, a tick) widens some rows: look again within the pointer's own width only.
        half_m = 0.6 * float(np.percentile((width_rad * r)[mass > 0], 35)) + 0.6 / patch.px_per_m
        middle = solution[0] + solution[1] / r
        near = np.abs(offset[None, :] - middle[:, None]) < (half_m / r)[:, None]
    correlated = 2.0  # neighbouring rows of an oversampled patch share their noise
    sigma = float(np.sqrt(correlated * np.linalg.inv(N)[0, 0]))
    return float(start_rad + solution[0]), sigma


def _row_centres(part: Array, offset: Array, near: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Per radius: centre of the ink within `near` (rad), its mass, and its width (rad)."""
    shown = np.where(near, part, 0.0)
    top = shown.max(axis=1, keepdims=True)
    # A pointer is of one gray: rows where something stands out much more belong to a numeral or a tick beside it.
    top = np.where(top > NUMERAL * float(np.median(top)), 0.0, top)
    shown = np.where(top > 0, shown, 0.0)
    shown = np.maximum(shown - 0.3 * top, 0.0)
    mass = shown.sum(axis=1)
    step = float(abs(offset[1] - offset[0]))
    centre = (shown * offset).sum(axis=1) / np.where(mass > 0, mass, 1.0)
    return centre, mass, mass * step / np.where(top[:, 0] > 0, 0.7 * top[:, 0], 1.0)


def _fit_line(r: Array, theta: Array, mass: Array, e_sigma: float, least_m: float) -> tuple[Array, Array]:
    """(theta0, e) of theta(r) = theta0 + e / r by Cauchy-weighted least squares, and the normal matrix."""
    weight = np.minimum(mass / np.median(mass[mass > 0]), 2.0) * (mass > 0)
    A = np.column_stack([np.ones_like(r), 1.0 / r])
    solution, N = np.array([float(np.median(theta[mass > 0])), 0.0]), np.eye(2)
    for _ in range(5):
        residual_m = (theta - A @ solution) * r
        scale = max(1.4826 * float(np.median(np.abs(residual_m[mass > 0]))), least_m)
        w = weight / (1.0 + (residual_m / (1.5 * scale)) ** 2) * r**2 / scale**2
        N = A.T @ (w[:, None] * A) + np.diag([0.0, 1.0 / e_sigma**2])
        solution = np.linalg.solve(N, A.T @ (w * theta))
    return solution, N


def wrapped(angle_rad: Array) -> Array:
    """Angles brought to -pi..pi."""
    return np.asarray((angle_rad + np.pi) % (2 * np.pi) - np.pi)
