"""Assignment of pixels that several surfaces explain about equally well, by the labels of their neighbours.

Near a crease, and on the ring where a wrong plane intersects a sphere, the depth of one pixel cannot tell two surfaces
apart, least of all under slow noise, which neighbouring pixels share. Therefore the residual of a pixel is combined
with the labels around it (iterated conditional modes; Besag, J. R. Stat. Soc. B 48(3), 1986).
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Indices, Labels
from hal.jit import compiled
from perception.range.segmentation.grid import sigma_at
from perception.range.segmentation.pixel_assignment import ASSIGNMENT_SIGMAS, PLAIN_SIGMAS, misfit_of

REACH_PX = 2  # neighbours of 5 x 5
SIDE_PX = 2 * REACH_PX + 1
OWN = SIDE_PX * SIDE_PX // 2  # index of the pixel itself in the patch, the labels around it in row order
PATCH = 32  # size of the patch, padded with zeros so that it fills whole vector registers
SHARED_PX = 25.0  # pixels that share one value of the slow noise
NEIGHBOUR_WEIGHT = 3.0  # cost, as half a squared residual, of a label that no neighbour has
TOP_LABEL = np.int32(2**31 - 1)
SAFE_NEIGHBOURS = 5  # of eight, as at a straight border: a well explained pixel with so many keeps its label


@compiled
def icm_sweep(
    depth: Array, sen: Array, noise: Array, slow_share: float, labels: Labels, kinds: Indices, ths: Array, rows: Labels,
    columns: Labels, out: Labels, first: int, last: int,
) -> None:  # fmt: skip
    """Compute new labels of the pixels at `rows`, `columns` (N,) of `labels` (H, W); writes out[first:last].

    Each pixel gets the label of least cost among those in the 5 x 5 pixels around it. The cost is half the squared
    residual, divided by the number of pixels that share their noise, plus `NEIGHBOUR_WEIGHT` times the share of the
    labelled neighbours with another label. A pixel without a neighbour of another label keeps its own.
    """
    patch = np.zeros(PATCH, np.int32)
    perspective, per_x, per_y = sen[0] > 0, 1.0 / sen[1], 1.0 / sen[2]
    evidence = 0.5 / (1.0 + slow_share * (SHARED_PX - 1.0))
    for n in range(first, last):
        v, u = rows[n], columns[n]
        own, z = labels[v, u], depth[v, u]
        out[n] = own
        same, other = _beside(labels, v, u, own)
        if other == 0 or not np.isfinite(z):
            continue
        x, y, sigma = (u - sen[3]) * per_x, (v - sen[4]) * per_y, sigma_at(noise, z)
        e = misfit_of(own, kinds, ths, x, y, z, sigma, perspective) if own > 0 else np.inf
        if e < PLAIN_SIGMAS and same >= SAFE_NEIGHBOURS:
            continue
        _copy_patch(labels, v, u, patch)
        patch[OWN] = 0
        voters, mine = PATCH - _count(patch, np.int32(0)), _count(patch, own) if own > 0 else 0
        per_vote = NEIGHBOUR_WEIGHT / voters
        best = np.inf
        if e < ASSIGNMENT_SIGMAS and mine > 0:
            best = evidence * e * e + NEIGHBOUR_WEIGHT - per_vote * mine
        left, rival = voters - mine, TOP_LABEL
        while left > 0:
            rival = _largest_below(patch, own, rival)
            votes = _count(patch, rival)
            left -= votes
            least_cost = NEIGHBOUR_WEIGHT - per_vote * votes
            if least_cost >= best:
                continue  # even a residual of zero would cost more
            e = misfit_of(rival, kinds, ths, x, y, z, sigma, perspective)
            cost = evidence * e * e + least_cost
            if e < ASSIGNMENT_SIGMAS and cost < best:
                best, out[n] = cost, rival


@compiled
def _copy_patch(labels: Labels, v: int, u: int, patch: Labels) -> None:
    """Copy the labels around one pixel into `patch`; 0 beyond the image."""
    H, W = labels.shape
    inside = REACH_PX <= v < H - REACH_PX and REACH_PX <= u < W - REACH_PX
    top, left = v - REACH_PX, u - REACH_PX
    for i in range(SIDE_PX):
        for j in range(SIDE_PX):
            is_there = inside or (0 <= top + i < H and 0 <= left + j < W)
            patch[SIDE_PX * i + j] = labels[top + i, left + j] if is_there else 0


@compiled
def _beside(labels: Labels, v: int, u: int, own: np.int32) -> tuple[int, int]:
    """Count how many of the eight nearest neighbours have the pixel's own label, and how many another one."""
    H, W = labels.shape
    inside = 0 < v < H - 1 and 0 < u < W - 1
    same, other = -1, 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            k = labels[v + i, u + j] if inside or (0 <= v + i < H and 0 <= u + j < W) else np.int32(0)
            same += k == own
            other += (k != own) & (k > 0)
    return same, other


@compiled
def _count(patch: Labels, label: np.int32) -> int:
    """Count the entries of the patch that have the label."""
    n = np.int32(0)
    for i in range(PATCH):
        n += np.int32(patch[i] == label)
    return int(n)


@compiled
def _largest_below(patch: Labels, own: np.int32, bound: np.int32) -> np.int32:
    """Return the largest label in the patch below `bound` that is not the pixel's own; 0 if there is none."""
    most = np.int32(0)
    for i in range(PATCH):
        k = patch[i]
        most = max(most, k if (k < bound) & (k != own) else np.int32(0))
    return most
