"""Registration of the panel model to the image: image edges are searched along the normals of the model's edges.

The scheme is that of C. Harris and C. Stennett, RAPID, BMVC 1990, with a shrinking search window, a prior from the
known pose, and Cauchy weights (Huber, Robust Statistics, 1981) that limit the influence of labels, shadows and cables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.jit import compiled
from hal.panel import Panel
from perception.vision.noise import noise_sigma
from perception.vision.projection import PanelProjection
from perception.vision.registration.edge_search import strongest_edges
from perception.vision.registration.outline import Outline, edges_of, plate_edges

WINDOWS_PX = (8.0, 5.0, 3.0, 2.0)  # half lengths of the search; the predicted pose is good to a few pixels
# Half length of the last search, and largest offset of an edge that confirms the model.
LAST_LOOK_PX, NEAR_PX = 2.5, 2.0
SMOOTHING_SIGMA_PX = 0.8
SLOPE_NOISE = 0.35  # noise of the central difference after that smoothing, relative to the image's noise
EDGE_TO_NOISE = 4.0  # least slope of an edge, relative to the slope's noise
NORMAL_STEP_M = 1e-3  # step on the plate that gives the direction of a normal in the image
MEASUREMENT_SIGMA_PX = 0.5  # least scale of the residuals in the robust weights
GROWTH_SIGMA_PX = 2.0  # prior standard deviation of an object's growth
EDGE_BIAS_SIGMA_PX = 0.8  # a printed or real cast shadow shifts a whole outline by about 1 px
REGISTERED_SIGMA_PX = 0.15  # standard deviation of the panel's registration as a whole
FRAMED = 0.5  # share of a side of the plate
MIN_VISIBLE = 16  # with fewer edge samples in the image nothing can be said about the panel


V = TypeVar("V", bound=PanelProjection)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """Result of a registration: the view, and how well the model's edges were found.

    Attributes:
        view: the registered view.
        support: share of the visible model edges with an image edge within 2 px; NaN if too few are in view.
        is_framed: whether a horizontal and a vertical side of the plate's border were found, so that the edges of other
        objects cannot have misled it.
        objects: per object name, the fit to its own edges; only for kinds with edges that every state shows.
    """

    view: PanelProjection
    support: float
    is_framed: bool
    objects: dict[str, ObjectFit]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectFit:
    """Displacement of an object's own edges from their positions in the registered view.

    Attributes:
        shift_px: (2,) the displacement, with the building tolerance as prior; zero if it was not measured.
        shift_sigma_px: standard deviation of each of its coordinates.
        edge_share: share of its edges that were found; NaN if too few are in view.
        measured_px: (2,) the displacement according to this image alone; None if it was not measured.
        covariance_px: (2, 2) of `measured_px`.
    """

    shift_px: Array
    shift_sigma_px: float
    edge_share: float
    measured_px: Array | None = None
    covariance_px: Array | None = None


def register(gray: Image, view: PanelProjection, panel: Panel) -> Registration:
    """Move `view` so that the projected edges of the panel coincide with edges in the image.

    Args:
        gray: (H, W) uint8, as the camera recorded it (with distortion).
        view: prediction, good to a few pixels.
    """
    image = edge_image(gray)
    own = {panel_object.name: edges for panel_object in panel.objects if (edges := edges_of(panel_object)) is not None}
    border = plate_edges(panel)
    everything = _joined([border, *own.values()])
    delta = np.zeros(len(view.prior_sigma))
    for window in WINDOWS_PX:
        delta = _step(image, view, delta, everything, window, view.moved(delta).motion(everything.points_m))
    moved = view.moved(delta)
    visible, near = confirmed(image, moved, everything)
    built_m = panel.tolerances.position_m
    local = {name: fit_object(image, moved, edges, built_m) for name, edges in own.items()}
    return Registration(
        view=moved,
        support=float(near.sum() / visible.sum()) if visible.sum() >= MIN_VISIBLE else float("nan"),
        is_framed=_is_framed(visible[: len(border.points_m)], near[: len(border.points_m)]),
        objects=local,
    )


def _is_framed(visible: NDArray[np.bool_], near: NDArray[np.bool_]) -> bool:
    """Return whether most of a horizontal and of a vertical side of the border is in view, and edges confirm most of that."""
    seen, found = (mask.reshape(4, -1).mean(axis=1) for mask in (visible, near))
    top, right, bottom, left = (seen >= FRAMED) & (found >= FRAMED * seen)
    return bool((top or bottom) and (left or right))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeImage:
    """An image prepared for the edge search: `smooth` (H, W) gray, and the standard deviation of a slope's noise."""

    smooth: NDArray[np.float32]
    slope_noise: float


def edge_image(gray: Image) -> EdgeImage:
    """Prepare an image for the edge search; needed once per image for any number of `follow_edges` and `confirmed`."""
    smooth = np.asarray(cv2.GaussianBlur(gray.astype(np.float32), (5, 5), SMOOTHING_SIGMA_PX), np.float32)
    slope_noise = SLOPE_NOISE * noise_sigma(gray)
    return EdgeImage(smooth=smooth, slope_noise=slope_noise)


def follow_edges(image: EdgeImage, view: V, outline: Outline, windows_px: Sequence[float]) -> V:
    """Return `view` moved so that one outline coincides with edges in the image; unchanged if too few edges are found.

    windows_px: half lengths of the search, one after the other.
    """
    delta = np.zeros(len(view.prior_sigma))
    motion = view.motion(outline.points_m)  # nearly constant within a dozen pixels
    for window in windows_px:
        delta = _step(image, view, delta, outline, window, motion)
    return view.moved(delta)


def confirmed(image: EdgeImage, view: PanelProjection, outline: Outline) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which samples of the outline (N,) are inside the image, and which have an edge within `NEAR_PX`."""
    found = _look(image, view, outline, LAST_LOOK_PX)
    return found.visible, found.ok & (np.abs(found.offset_px) <= NEAR_PX)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """Edges found along the normals of an outline.

    Attributes:
        offset_px: (N,) signed offsets along the normals.
        normals_px: (N, 2) unit normals in the image.
        visible, ok: (N,) whether the search lies inside the image, and whether it found an edge.
    """

    offset_px: Array
    normals_px: Array
    visible: NDArray[np.bool_]
    ok: NDArray[np.bool_]


def _look(image: EdgeImage, view: PanelProjection, edges: Outline, window_px: float) -> _Found:
    """Find the strongest image edge along every normal of the model."""
    points, ahead = _with_ahead(view, edges)
    normals = ahead - points
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(length > 0, length, 1.0)
    offset, slope, visible = strongest_edges(image.smooth, points, normals, window_px)
    ok = visible & (slope > EDGE_TO_NOISE * image.slope_noise + 0.5)
    return _Found(offset_px=offset, normals_px=normals, visible=visible, ok=ok)


def _with_ahead(view: PanelProjection, edges: Outline) -> tuple[Array, Array]:
    """Return the samples of an outline in the image, and the points `NORMAL_STEP_M` ahead of them, (N, 2) px each."""
    count = len(edges.points_m)
    both_m = np.concatenate([edges.points_m, edges.points_m])
    both_m[count:, :2] += NORMAL_STEP_M * edges.normals
    both_px = view.project(both_m)
    return both_px[:count], both_px[count:]


def _step(
    image: EdgeImage, reference: PanelProjection, delta: Array, edges: Outline, window_px: float, motion: Array
) -> Array:
    """Do two Gauss-Newton steps on the edges found in one window; returns the motion parameters.

    `motion` (N, 2, P) are the derivatives of the samples over the parameters.
    """
    sigma = reference.prior_sigma
    information = np.diag(1.0 / sigma**2)
    for _ in range(2):
        found = _look(image, reference.moved(delta), edges, window_px)
        if found.ok.sum() < len(delta):
            return delta
        N, g = _normal_equations(motion, found.normals_px, found.offset_px, found.ok)
        delta = delta + np.linalg.solve(N + information, g - information @ delta)
    return delta


@compiled
def _normal_equations(motion: Array, normals_px: Array, offset_px: Array, ok: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return J^T W J and J^T W r of the edges found, with Cauchy weights W.

    J is the motion (N, 2, P) along the normals (N, 2), and r is the offset (N,) found there.
    """
    weights = _weights(offset_px[ok], MEASUREMENT_SIGMA_PX)
    count = motion.shape[2]
    N, g = np.zeros((count, count)), np.zeros(count)
    for n, k in enumerate(np.flatnonzero(ok)):
        weight = weights[n]
        along = motion[k, 0] * normals_px[k, 0] + motion[k, 1] * normals_px[k, 1]
        for i in range(count):
            g[i] += weight * along[i] * offset_px[k]
            for j in range(count):
                N[i, j] += weight * along[i] * along[j]
    return N, g


@compiled
def _weights(residuals: Array, least_sigma: float) -> Array:
    """Return the Cauchy weights of residuals whose scale is their median magnitude, but at least `least_sigma`."""
    scale = max(1.4826 * float(np.median(np.abs(residuals))), least_sigma)
    weights: Array = 1.0 / (1.0 + (residuals / (1.5 * scale)) ** 2) / scale**2
    return weights


def fit_object(image: EdgeImage, view: PanelProjection, edges: Outline, built_m: float) -> ObjectFit:
    """Fit the displacement of an object to its own edges.

    `built_m` is the standard deviation of the object's position on the plate. The edges of an object have a common
    error that does not average out, because a cast shadow or a side wall moves all edges of one side.
    """
    points, ahead = _with_ahead(view, edges)
    scale_px_per_m = float(np.nanmedian(np.linalg.norm(ahead - points, axis=1))) / NORMAL_STEP_M
    reach_px = edges.reach_m * scale_px_per_m
    prior_px = float(np.hypot(REGISTERED_SIGMA_PX, built_m * scale_px_per_m))
    found = _look(image, view, edges, float(np.clip(1.5 + reach_px, 4.0, 9.0)))
    visible = int(found.visible.sum())
    if found.ok.sum() < 6:
        share = 0.0 if visible >= 6 else float("nan")
        return ObjectFit(shift_px=np.zeros(2), shift_sigma_px=prior_px, edge_share=share)
    r = found.offset_px[found.ok]
    # The third unknown is growth: all around the object a bezel or a printed ring may be the stronger edge.
    J = np.column_stack([found.normals_px[found.ok], np.ones(len(r))])
    prior = np.diag([1e-6, 1e-6, 1 / (GROWTH_SIGMA_PX + reach_px) ** 2])
    solution, N = np.array([0.0, 0.0, float(np.median(r))]), prior
    for _ in range(4):
        w = _weights(r - J @ solution, 0.3) / 2.0  # neighbouring samples share their noise
        N = J.T @ (w[:, None] * J) + prior
        solution = np.linalg.solve(N, J.T @ (w * r))
    share = float((np.abs(r - J @ solution) < 1.5).sum() / max(1, visible))
    measured = np.linalg.inv(N)[:2, :2] + np.eye(2) * EDGE_BIAS_SIGMA_PX**2
    gain = np.linalg.inv(np.eye(2) / prior_px**2 + np.linalg.inv(measured))
    return ObjectFit(
        shift_px=gain @ np.linalg.solve(measured, solution[:2]),
        shift_sigma_px=float(np.sqrt(np.trace(gain) / 2)),
        edge_share=share,
        measured_px=solution[:2],
        covariance_px=measured,
    )


def _joined(outlines: list[Outline]) -> Outline:
    """Return several outlines as one."""
    return Outline(points_m=np.vstack([o.points_m for o in outlines]), normals=np.vstack([o.normals for o in outlines]))
