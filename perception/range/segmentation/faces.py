"""Smooth faces that no primitive explains within the noise: real faces bulge, and get a tolerance for model error.

Upholstery and cardboard leave a plane by one or two hundredths of their size, many times the noise of a good sensor:
they fall into pieces, or stay unexplained. What bounds a face is not its model but its creases, and those show in what
tangent planes leave over, whatever the shape. So blocks between creases form faces; a face that the surfaces found
share out is described once more as a whole, under an error that widens until one surface holds it.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hal.arrays import Array
from perception.range.components import label_components
from perception.range.segmentation.compete import Candidates, fit_best
from perception.range.segmentation.grid import Grid
from perception.range.segmentation.links import smooth_links
from perception.range.segmentation.segment import STEEP_SLOPE, Task
from perception.range.segmentation.tangents import STEADY_RMS, TURN_RAD, bent_planes

Flags = NDArray[np.bool_]
Labels = NDArray[np.int32]

SHARP_RAD = 0.045  # normals noisier than this hide creases
WIDER = 2.0  # a try
TRIES = 7
MODEL_ERROR = 0.012  # of the size of a face: one sigma
WHOLE_SHARE = 0.8  # of a face that one surface holds already
HELD_SHARE = 0.85  # of a face that its surface must hold
LEAST_TIMES = 1.5  # the smallest surface: less is rubble
LEAST_BLOCKS = 16


def whole_faces(task: Task, grid: Grid, labels: Labels, found: Candidates) -> Labels:
    """Labels (H, W) after faces in pieces were described as wholes; extends `found` with their surfaces."""
    if grid.normal_sigma_rad > SHARP_RAD:
        return labels
    size = grid.size_px
    face, count = _faces(task, grid)
    least = max(LEAST_BLOCKS, round(LEAST_TIMES * task.least_pixels / size**2))
    names = np.zeros(count + 1, np.int32)
    for k in _shared_out(face, count, labels_of_blocks(labels, grid), least):
        members = np.flatnonzero(face.ravel() == k)
        surface = _described(grid, members)
        if surface is not None:
            names[k] = found.add(*surface)
    if not names.any():
        return labels
    new = np.repeat(np.repeat(names[face], size, 0), size, 1)[: labels.shape[0], : labels.shape[1]]
    return np.where((new > 0) & np.isfinite(task.depth_m), new, labels)


def labels_of_blocks(labels: Labels, grid: Grid) -> Labels:
    """(h, w) the label in the middle of each block."""
    half = grid.size_px // 2
    out = np.zeros(grid.z.shape, np.int32)
    middles = labels[half :: grid.size_px, half :: grid.size_px]
    out[: middles.shape[0], : middles.shape[1]] = middles
    return out


def _faces(task: Task, grid: Grid) -> tuple[Labels, int]:
    """(h, w) faces between creases, 0 = none, and their number; bridges up to two blocks wide join no faces."""
    normal, rms = grid.normal.copy(), grid.rms.copy()
    slope = STEEP_SLOPE * grid.size_px / task.packed[1]
    blocks = (grid.x, grid.y, grid.z, grid.count, grid.sigma, grid.perspective, grid.radius)
    bent_planes(*blocks, slope, normal, rms)
    core = np.isfinite(grid.z) & (rms < STEADY_RMS)
    inner = _eroded(_eroded(core).T).T.copy()
    right, down = smooth_links(
        grid.z,
        grid.sigma,
        inner,
        STEEP_SLOPE * grid.size_px,
        1.0 / task.packed[1],
        grid.perspective,
        normal,
        rms,
        float(np.cos(max(TURN_RAD, 5.0 * grid.normal_sigma_rad))),
    )
    face, sizes = label_components(inner, right, down, tiles=task.tiles, pool=task.pool)
    return _regrown(face, core), sizes.size - 1


def _eroded(core: Flags) -> Flags:
    """Blocks of the core whose neighbours above and below, where there are any, belong to it too."""
    inner = core.copy()
    inner[1:] &= core[:-1]
    inner[:-1] &= core[1:]
    return inner


@njit(cache=True, nogil=True)
def _regrown(face, core):  # type: ignore[no-untyped-def]  # numba types it
    """Faces after each block of the core beside one went to it: what the erosion had taken."""
    h, w = face.shape
    out = face.copy()
    for r in range(h):
        for c in range(w):
            if face[r, c] or not core[r, c]:
                continue
            for i in range(max(r - 1, 0), min(r + 2, h)):
                for j in range(max(c - 1, 0), min(c + 2, w)):
                    if face[i, j] and out[r, c] == 0:
                        out[r, c] = face[i, j]
    return out


@njit(cache=True, nogil=True)
def _shared_out(face, count, labels, least):  # type: ignore[no-untyped-def]  # numba types it
    """Faces of at least `least` blocks of which no label has `WHOLE_SHARE`: a majority vote and its count."""
    candidate, votes = np.zeros(count + 1, np.int32), np.zeros(count + 1, np.int32)
    sizes, holds = np.zeros(count + 1, np.int32), np.zeros(count + 1, np.int32)
    ff, fl = face.ravel(), labels.ravel()
    for i in range(ff.shape[0]):
        k = ff[i]
        if votes[k] == 0:
            candidate[k] = fl[i]
        votes[k] += 1 if fl[i] == candidate[k] else -1
        sizes[k] += 1
    for i in range(ff.shape[0]):
        k = ff[i]
        holds[k] += candidate[k] > 0 and fl[i] == candidate[k]
    ids = np.arange(count + 1)
    return ids[(ids > 0) & (sizes >= least) & (holds < WHOLE_SHARE * sizes)]


def _described(grid: Grid, members: NDArray[np.int64]) -> tuple[int, Array, float] | None:
    """Kind and parameters of the surface of the face `members` (flat blocks), and how many times the noise it needs."""
    sigma = float(np.median(grid.sigma.ravel()[members]))
    z = float(np.median(grid.z.ravel()[members])) if grid.perspective else 1.0
    extent = np.sqrt(members.size) * abs(float(grid.x[0, 1] - grid.x[0, 0])) * z
    for slack in WIDER ** np.arange(TRIES):
        if slack > 1.0 and slack * sigma > MODEL_ERROR * extent:
            return None
        kind, parameters, share = fit_best(grid, members, slack)
        if kind >= 0 and share >= HELD_SHARE:
            return kind, parameters, float(slack)
    return None
