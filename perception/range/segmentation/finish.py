"""Final refinement of each region on all its pixels, with covariance and residuals; regions too small are dropped."""

from __future__ import annotations

from dataclasses import replace
from math import isnan, sqrt

import numpy as np

from hal.arrays import Array, Labels
from hal.jit import as_numpy_scalar, compiled
from hal.small_algebra import LEAST_PIVOT, factor, solve_lower, solve_upper
from perception.range.fitting.fit import fit_robust
from perception.range.fitting.last_step import last_step
from perception.range.fitting.surfaces import FREEDOM, PLANE, depth_on
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
from perception.range.segmentation.run_length import runs_of

COARSE_SAMPLES = 300  # after a fit to these, one step on all pixels is enough
NAMING_SAMPLES = 150  # samples that decide whether a surface is reported as a simpler kind
MIDDLE_STRIDE = 4  # every fourth of the coarse samples is used for the medians
SLOW_NOISE_AREA_PX = 150.0  # pixels that share one value of the slow noise; limits the gain of averaging
STEP_AREA_PX = 16.0  # the same for quantisation steps
NO_SHIFT = 1e-9  # pixels; makes positions robust to rounding just below a whole number
FARTHEST_SIGMAS = 50.0  # largest displacement of a surface by the last step
ROUNDS = as_numpy_scalar(1)  # of robust weights


def refine_surface(
    label: int, kind: int, th: Array, regions: Regions, own: int, *, noise: NoiseModel
) -> tuple[Surface, Array]:
    """Fit a surface to the depths of all its pixels; returns the surface and its parameters (16,).

    The covariance is scaled by the residuals.

    Args:
        label: label of the returned surface.
        kind, th: kind and initial parameters.
        own: label of its pixels in `regions`.
    """
    pixels = int(regions.sizes[own])
    th, H, inverse, middles, squares, kept = refined(
        kind, th, regions.depth_m, regions.packed, regions.law, regions.runs_of(own), pixels
    )
    misfit = sqrt(squares / max(kept - int(FREEDOM[kind]), 1))
    x, y, depth, sigma = middles.tolist()
    known = _pseudo_inverse(H, int(FREEDOM[kind])) if isnan(inverse[0, 0]) else inverse
    covariance = known * (max(misfit**2, 0.05) * averaging_loss(noise, depth))
    middle = np.array([x * depth, y * depth, depth] if regions.packed[0] > 0 else [x, y, depth])
    surface = Surface(
        label=label,
        type=TYPE_OF_KIND[kind],
        primitive=primitive_of(kind, th, middle),
        covariance=named_covariance(kind, th, covariance),
        covariance_over=COVARIANCE_OVER[kind],
        frame=frame_vectors(kind, th),
        pixels=pixels,
        rms_m=misfit * sigma if pixels else 0.0,
        misfit=misfit,
        middle_m=middle,
    )
    return surface, th


def refine_surfaces(
    owns: list[int], kinds: list[int], parameters: list[Array], regions: Regions, noise: NoiseModel
) -> tuple[list[Surface], list[Array]]:
    """Apply `refine_surface` to the regions with labels `owns`, which become labels 1 to M.

    A surface that only sensor errors make curved is reported as the simpler kind, such as a plane. Pixels are still
    assigned by the curved surface, so the parameters (16,) of the curved ones are returned beside the surfaces.
    """
    surfaces, ths = [], []
    for i, own in enumerate(owns, 1):
        kind = kinds[own - 1]
        surface, th = refine_surface(i, kind, parameters[own - 1], regions, own, noise=noise)
        if kind != PLANE:
            few = regions.sampled(own, NAMING_SAMPLES)
            name, start = straightened(kind, th, few, regions.law, bool(regions.packed[0] > 0))
            if name != kind:
                surface, _ = refine_surface(i, name, start, regions, own, noise=noise)
        surfaces.append(surface)
        ths.append(th)
    return surfaces, ths


@compiled
def refined(
    kind: int, th: Array, depth: Array, sen: Array, noise: Array, runs: Labels, pixels: int,
) -> tuple[Array, Array, Array, Array, float, int]:  # fmt: skip
    """Fit a surface to the pixels of the runs (R, 3): robustly to an evenly spread sample, then with one step on all.

    `pixels` is the number of pixels in the runs, `th` the initial parameters.

    Returns:
        parameters (16,); the information matrix (9, 9) over the p tangent parameters, and its inverse (p, p), NaN if they
        are not all determined; medians (4,) of x, y, z and sigma; the sum of the squared residuals of the kept pixels, in
        squared sigmas; and the number of pixels within the trim.
    """
    if pixels == 0:
        return th, np.zeros((9, 9)), np.full((FREEDOM[kind], FREEDOM[kind]), np.nan), np.full(4, np.nan), 0.0, 0
    few = np.empty((4, min(pixels, COARSE_SAMPLES)))
    spread(depth, sen, noise, runs, pixels, NO_SHIFT, few)
    start, _ = fit_robust(kind, th, few, sen[0] > 0, ROUNDS)
    middles = np.empty(4)
    for a in range(4):
        middles[a] = np.median(few[a, ::MIDDLE_STRIDE].copy())
    th, H, kept, used = last_step(kind, start, depth, sen, noise, runs)
    # On a nearly flat face the step may pass through zero curvature and move the surface behind the sensor. A step
    # that displaces the middle of the region too far is therefore rejected.
    before = depth_on(kind, start, middles[0], middles[1], sen[0] > 0)
    after = depth_on(kind, th, middles[0], middles[1], sen[0] > 0)
    if np.isfinite(before) and not abs(after - before) < FARTHEST_SIGMAS * middles[3]:
        th = start
    return th, H, _inverse(H, FREEDOM[kind]), middles, kept, used


@compiled
def _inverse(H: Array, p: int) -> Array:
    """Return the inverse (p, p) of the first p rows of `H`; NaN if they are not all determined."""
    A, out, scale = np.empty((p, p)), np.eye(p), np.empty(p)
    for i in range(p):
        scale[i] = 1.0 / np.sqrt(max(H[i, i], 1e-300))
        for j in range(i + 1):
            A[i, j] = H[i, j] * scale[i] * scale[j]
    if not factor(A, A, 0.0, 0.0, LEAST_PIVOT, A, p):
        return np.full((p, p), np.nan)
    for k in range(p):
        solve_lower(A, out[k], p)
        solve_upper(A, out[k], p)
        for i in range(p):
            out[k, i] *= scale[i] * scale[k]
    return out


def without_crumbs(labels: Labels, surfaces: list[Surface], least: float) -> tuple[Labels, list[Surface]]:
    """Drop surfaces that have kept fewer than `least` pixels; returns renumbered labels and surfaces."""
    pixels = runs_of(labels, len(surfaces))[2].tolist()
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
    white, slow, step = (a + b * z2 for a, b in (noise.white, noise.correlated, noise.step))
    variance = white**2 + slow**2
    coded = max(step**2 / 12.0 - white**2, 0.0)
    loss = white**2 + SLOW_NOISE_AREA_PX * slow**2 + STEP_AREA_PX * coded
    return float(loss / max(variance + coded, 1e-30))


def _pseudo_inverse(H: Array, p: int) -> Array:
    """Return the pseudo-inverse (p, p) of a singular information matrix: the covariance of the determined directions."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[:p], 1e-300))
    both = np.outer(scale, scale)
    return np.asarray(np.linalg.pinv(H[:p, :p] * both, rcond=1e-12, hermitian=True) * both)
