"""Final refinement of each region on all its pixels, with covariance and residuals; regions too small are dropped."""

from __future__ import annotations

from dataclasses import replace
from math import isnan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Mask
from hal.jit import as_numpy_scalar, compiled
from hal.small_algebra import solve_positive
from perception.range.fitting.fit import fit_robust
from perception.range.fitting.last_step import last_step
from perception.range.fitting.surfaces import FREEDOM, PLANE, SIZE, depth_on
from perception.range.noise import NoiseModel
from perception.range.primitives import (
    COVARIANCE_OVER,
    TYPE_OF_KIND,
    Surface,
    frame_vectors,
    named_covariance,
    primitive_of,
)
from perception.range.segmentation.bend import straightened
from perception.range.segmentation.regions import Regions, spread
from perception.range.segmentation.run_length import pixels_of

Labels = NDArray[np.int32]

COARSE_SAMPLES = 300  # after a fit to these, one step on all pixels is enough
NAMING_SAMPLES = 150  # samples that decide whether a surface is reported as a simpler kind
MIDDLE_STRIDE = 4  # every fourth of the coarse samples is used for the medians
SLOW_NOISE_AREA_PX = 150.0  # pixels that share one value of the slow noise; limits the gain of averaging
STEP_AREA_PX = 16.0  # the same for quantisation steps
NO_SHIFT = 1e-9  # pixels; makes positions robust to rounding just below a whole number
FARTHEST_SIGMAS = 50.0  # largest displacement of a surface by the last step
ROUNDS = as_numpy_scalar(1)  # of robust weights
FREE = np.zeros(9, np.bool_)


class Refinement(NamedTuple):
    """Result of the final fit of one region.

    Attributes:
        frame: (2, 3) tangent vectors in which tilts are expressed.
        parameters: (16,) of the surface.
        information: (9, 9) matrix over the tangent parameters.
        inverse: (p, p) of `information` over the free parameters; NaN if they are not all determined.
        middles: (4,) medians of x, y, z and sigma.
        squares: sum of the squared residuals of the kept pixels, in squared sigmas.
        kept: number of pixels within the trim.
    """

    frame: Array
    parameters: Array
    information: Array
    inverse: Array
    middles: Array
    squares: float
    kept: int


def refine_surface(
    label: int,
    kind: int,
    th: Array,
    regions: Regions,
    own: int,
    *,
    noise: NoiseModel,
    fixed: NDArray[np.bool_] = FREE,
) -> tuple[Surface, Array]:
    """Fit a surface to the depths of all its pixels; returns the surface and its parameters (16,).

    Args:
        label: label of the returned surface.
        kind, th: kind and initial parameters.
        own: label of its pixels in `regions`.
        fixed: (9,) which tangent parameters keep their initial value.
    """
    n = int(regions.sizes[own])
    th, H, inverse, middles, squares, kept = refined(
        kind, th, regions.depth_m, regions.packed, regions.law, regions.runs_of(own), n, fixed
    )
    refinement = Refinement(frame_vectors(kind, th), th, H, inverse, middles, squares, kept)
    perspective = bool(regions.packed[0] > 0)
    return _surface(label, kind, refinement, n, noise=noise, perspective=perspective, fixed=fixed), th


def refine_surfaces(
    owns: list[int], kinds: list[int], parameters: list[Array], regions: Regions, noise: NoiseModel
) -> tuple[list[Surface], list[int], Array]:
    """Apply `refine_surface` to the regions with labels `owns`, which become labels 1 to M.

    A surface that only sensor errors make curved is reported as the simpler kind, such as a plane. Pixels are still
    assigned by the curved surface, so the kinds (M,) and parameters (M, 16) of the curved ones are returned after the
    surfaces.
    """
    if not owns:
        return [], [], np.zeros((0, SIZE))
    kinds_before, ths_before, surfaces = [], np.empty((len(owns), SIZE)), []
    for i, own in enumerate(owns):
        kind, th = kinds[own - 1], parameters[own - 1]
        surface, th = refine_surface(i + 1, kind, th, regions, own, noise=noise)
        kinds_before.append(kind)
        ths_before[i] = th
        name, start = _straight(kind, th, regions, own)
        if name != kind:
            surface, _ = refine_surface(i + 1, name, start, regions, own, noise=noise)
        surfaces.append(surface)
    return surfaces, kinds_before, ths_before


def _straight(kind: int, th: Array, regions: Regions, own: int) -> tuple[int, Array]:
    """Return the simpler kind that slow sensor errors may have bent into this one, with initial parameters."""
    if kind == PLANE:
        return kind, th
    pixels = int(regions.sizes[own])
    few = np.empty((4, min(pixels, NAMING_SAMPLES)))
    spread(regions.depth_m, regions.packed, regions.law, regions.runs_of(own), pixels, 0.5, few)
    return straightened(kind, th, few, regions.law, bool(regions.packed[0] > 0))


def _surface(
    label: int,
    kind: int,
    refinement: Refinement,
    pixels: int,
    *,
    noise: NoiseModel,
    perspective: bool,
    fixed: NDArray[np.bool_],
) -> Surface:
    """Build the surface that is reported for a region from its final fit; scales the covariance by the residuals."""
    frame, th, H, inverse, middles, squares, kept = refinement
    misfit = sqrt(squares / max(kept - int(FREEDOM[kind]), 1))
    x, y, depth, sigma = middles.tolist()
    loss = averaging_loss(noise, depth)
    known = _pseudo_inverse(H, kind, fixed) if isnan(inverse[0, 0]) else inverse
    covariance = known * (max(misfit**2, 0.05) * loss)
    middle = np.array([x * depth, y * depth, depth] if perspective else [x, y, depth])
    return Surface(
        label=label,
        type=TYPE_OF_KIND[kind],
        primitive=primitive_of(kind, th, middle),
        covariance=named_covariance(kind, th, covariance),
        covariance_over=COVARIANCE_OVER[kind],
        frame=frame,
        pixels=pixels,
        rms_m=misfit * sigma if pixels else 0.0,
        misfit=misfit,
        middle_m=middle,
    )


@compiled
def refined(
    kind: int, th: Array, depth: Array, sen: Array, noise: Array, runs: Labels, pixels: int, fixed: Mask,
) -> tuple[Array, Array, Array, Array, float, int]:  # fmt: skip
    """Fit a surface to the pixels of the runs (R, 3): robustly to an evenly spread sample, then with one step on all.

    `pixels` is the number of pixels in the runs, `th` the initial parameters and `fixed` (9,) which of them stay.

    Returns:
        the fields of `Refinement` except the frame.
    """
    if pixels == 0:
        return th, np.zeros((9, 9)), np.full((FREEDOM[kind], FREEDOM[kind]), np.nan), np.full(4, np.nan), 0.0, 0
    few = np.empty((4, min(pixels, COARSE_SAMPLES)))
    spread(depth, sen, noise, runs, pixels, NO_SHIFT, few)
    th, _ = fit_robust(kind, th, few[0], few[1], few[2], few[3], sen[0] > 0, fixed, ROUNDS)
    middles = np.empty(4)
    for a in range(4):
        middles[a] = np.median(few[a, ::MIDDLE_STRIDE].copy())
    start = th
    th, H, kept, used = last_step(kind, start, depth, sen, noise, runs, fixed)
    # On a nearly flat face the step may pass through zero curvature and move the surface behind the sensor. A step
    # that displaces the middle of the region too far is therefore rejected.
    before = depth_on(kind, start, middles[0], middles[1], sen[0] > 0)
    after = depth_on(kind, th, middles[0], middles[1], sen[0] > 0)
    if np.isfinite(before) and not abs(after - before) < FARTHEST_SIGMAS * middles[3]:
        th = start
    return th, H, _inverse(H, FREEDOM[kind], fixed), middles, kept, used


@compiled
def _inverse(H: Array, p: int, fixed: Mask) -> Array:
    """Return the inverse (p, p) of `H` over the free parameters, zero elsewhere; NaN if they are not all determined."""
    A, b, out, scale = np.empty((p, p)), np.empty(p), np.zeros((p, p)), np.empty(p)
    for i in range(p):
        scale[i] = 1.0 / np.sqrt(max(H[i, i], 1e-300))
    for k in range(p):
        for i in range(p):
            for j in range(p):
                held = fixed[i] or fixed[j]
                A[i, j] = (1.0 if i == j else 0.0) if held else H[i, j] * scale[i] * scale[j]
            b[i] = 1.0 if i == k and not fixed[k] else 0.0
        if not solve_positive(A, b, p):
            out[:] = np.nan
            return out
        for i in range(p):
            out[i, k] = b[i] * scale[i] * scale[k]
    return out


def without_crumbs(labels: Labels, surfaces: list[Surface], least: float) -> tuple[Labels, list[Surface]]:
    """Drop surfaces that have kept fewer than `least` pixels; returns renumbered labels and surfaces."""
    pixels = pixels_of(labels, len(surfaces)).tolist()
    kept = [s for s in surfaces if pixels[s.label] >= least]
    if len(kept) == len(surfaces):
        return labels, surfaces
    renamed = np.zeros(len(surfaces) + 1, np.int32)
    renamed[[s.label for s in kept]] = np.arange(1, len(kept) + 1)
    return renamed[labels], [replace(s, label=new) for new, s in enumerate(kept, 1)]


def averaging_loss(noise: NoiseModel, depth_m: float) -> float:
    """Return the factor (>= 1) by which a parameter's variance exceeds its value for white noise of the same size.

    Neighbouring pixels share slow noise and quantisation steps, so averaging over them reduces these errors less.
    """
    z2 = depth_m * depth_m
    white = (noise.white[0] + noise.white[1] * z2) ** 2
    slow = (noise.correlated[0] + noise.correlated[1] * z2) ** 2
    step = (noise.step[0] + noise.step[1] * z2) ** 2 / 12.0
    step = max(step - white, 0.0)
    total = white + slow + step
    return float((white + SLOW_NOISE_AREA_PX * slow + STEP_AREA_PX * step) / max(total, 1e-30))


def _pseudo_inverse(H: Array, kind: int, fixed: NDArray[np.bool_]) -> Array:
    """Return the pseudo-inverse (p, p) of a singular information matrix: the covariance of the determined directions."""
    p = int(FREEDOM[kind])
    free = np.flatnonzero(~fixed[:p])
    out = np.zeros((p, p))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[free], 1e-300))
    inner = np.linalg.pinv(H[np.ix_(free, free)] * np.outer(scale, scale), rcond=1e-12, hermitian=True)
    out[np.ix_(free, free)] = inner * np.outer(scale, scale)
    return out
