"""Corners of a rectangle on the panel, measured by lines through the image edges along its four sides.

A corner is the intersection of two lines that are fitted to dozens of edge points, so it is more exact than a corner
detector, and a partly hidden side does no harm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from perception.vision.projection import CameraProjection
from perception.vision.registration.edge_search import strongest_edges
from perception.vision.registration.register import EDGE_TO_NOISE, EdgeImage

SAMPLE_PX = 2.5  # distance of samples along a side; the noise of nearer ones is common, because the image is smoothed
LEAST_SAMPLES, MOST_SAMPLES = 6, 120
MARGIN = 0.06  # share of a side that is left out at each end, where the other side's edge is in the search window
LEAST_SEEN = 0.5  # share of a side's samples that must lie on one line
SAMPLE_SIGMA_PX = 0.1  # least standard deviation of a sample
ON_LINE = 2.5  # standard deviations within which a sample counts as on the line
STEP_M = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredCorners:
    """Four corners in the image.

    Attributes:
        points_px: (4, 2); `covariance_px`: (4, 2, 2) of edge noise.
        edge_normals_px: (4, 2, 2) for each corner the unit normals of the two sides that meet there.
    """

    points_px: Array
    covariance_px: Array
    edge_normals_px: Array


def measure_corners(
    image: EdgeImage, view: CameraProjection, corners_m: Array, window_px: float, bias_px: Array
) -> MeasuredCorners | None:
    """Measure the corners (4, 3) m of a rectangle, clockwise, near where `view` predicts them.

    Args:
        window_px: half length of the search across each side.
        bias_px: (4,) one sigma of an offset of each whole side, which does not average out.

    Returns: None if a side is not seen.
    """
    predicted = view.project(corners_m)
    if not np.isfinite(predicted).all():
        return None
    lines, variances, normals = np.empty((4, 2)), np.empty((4, 2)), np.empty((4, 2))
    for k in range(4):
        side = _fit_side(image, view, corners_m[k], corners_m[(k + 1) % 4], corners_m.mean(axis=0), window_px)
        if side is None:
            return None
        lines[k], variances[k], normals[k] = side
    variances += bias_px[:, None] ** 2
    before = np.roll(np.arange(4), 1)  # of the sides that meet at a corner, the one before it and the one after it
    meeting = np.stack([normals[before], normals], axis=1)
    back = np.linalg.inv(meeting)
    offsets = np.column_stack([lines[before, 1], lines[:, 0]])
    half = back * np.sqrt(np.column_stack([variances[before, 1], variances[:, 0]]))[:, None]
    return MeasuredCorners(
        points_px=predicted + (back @ offsets[:, :, None])[:, :, 0], covariance_px=half @ half.swapaxes(1, 2),
        edge_normals_px=meeting,
    )  # fmt: skip


def _fit_side(
    image: EdgeImage, view: CameraProjection, start_m: Array, end_m: Array, middle_m: Array, window_px: float
) -> tuple[Array, Array, Array] | None:
    """Fit a line to the edges along one side.

    Returns: offsets (2,) px of the line at start and end, their variances (2,), and the unit normal (2,) in
    the image; None if too few samples show an edge.
    """
    length_px = float(np.linalg.norm(np.diff(view.project(np.stack([start_m, end_m])), axis=0)))
    count = int(np.clip(length_px / SAMPLE_PX, LEAST_SAMPLES, MOST_SAMPLES))
    s = MARGIN + (1.0 - 2.0 * MARGIN) * (np.arange(count) + 0.5) / count
    points_m = start_m + s[:, None] * (end_m - start_m)
    along = (end_m - start_m) / np.linalg.norm(end_m - start_m)
    outward = (start_m + end_m) / 2 - middle_m
    outward = outward - (outward @ along) * along
    outward /= np.linalg.norm(outward)
    points = view.project(points_m)
    normals = view.project(points_m + STEP_M * outward) - points
    # The sides are straight within a search window, so that one normal, across the side in the image, serves for all.
    across = points[-1] - points[0]
    normal = np.array([-across[1], across[0]]) / np.linalg.norm(across)
    normal *= np.sign(normal @ normals.mean(axis=0)) or 1.0
    offset, slope, visible = strongest_edges(image.smooth, points, np.tile(normal, (count, 1)), window_px)
    ok = visible & (slope > EDGE_TO_NOISE * image.slope_noise + 0.5)
    if ok.sum() < max(LEAST_SAMPLES / 2, LEAST_SEEN * count):
        return None
    A = np.column_stack([1.0 - s[ok], s[ok]])
    r = offset[ok]
    line = np.full(2, float(np.median(r)))
    for _ in range(8):
        e = r - A @ line
        scale = max(1.4826 * float(np.median(np.abs(e))), SAMPLE_SIGMA_PX)
        w = 1.0 / (1.0 + (e / (2.0 * scale)) ** 2) ** 2
        line = np.linalg.solve(A.T @ (w[:, None] * A), A.T @ (w * r))
    e = r - A @ line
    scale = max(1.4826 * float(np.median(np.abs(e))), SAMPLE_SIGMA_PX)
    on_line = np.abs(e) < ON_LINE * scale + 0.3
    if on_line.sum() < LEAST_SEEN * count:
        return None
    spread = np.linalg.inv(A[on_line].T @ A[on_line]) * scale**2
    return line, np.diag(spread).copy(), normal
