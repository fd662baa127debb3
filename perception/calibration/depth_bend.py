"""Bend of a range camera's images, from recordings of flat walls: triangulation has errors that vary slowly over the image.

In inverse depth a plane is linear in the ray's coordinates, 1/z = a x + b y + c, at any distance; an error of the disparity
adds the same number to it at every distance. So the bend is a field of inverse depth over the image. A field that is itself
linear looks like another wall; that part cannot be told from walls, and is left to the calibration of the mount.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.calibration import DepthBendRecord, bilinear_weights
from hal.errors import InvalidRequest, NotObservable

ROWS, COLUMNS = 7, 9  # nodes of the field
STRIDE = 3  # every so many pixels are used, along rows and columns
ROUNDS = 8  # of robust weights
REJECT_SIGMAS = 4.0  # beyond this what is no wall, such as a shelf before it, has no weight (Tukey's biweight)
STIFF = 1e-3  # weight of the field's second differences, relative to the data of a node, for nodes that see little
HELD = 1e6  # weight that keeps the field free of a linear part, relative to the data
LEAST_SEEN = 0.7  # share of the image's blocks that a wall must cover
MOST_LEFT = 0.5  # of the bend, which may remain if each wall is taken alone: a bend that changes with the distance


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthBend:
    """Result of the calibration of a range camera's bend.

    Attributes:
        record: the field.
        before, after: root mean square of the walls' bend, 1/m, averaged over blocks of the image; times the square of a
            depth it is the error there.
        walls: number of walls.
    """

    record: DepthBendRecord
    before: float
    after: float
    walls: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Wall:
    """Measured samples of one wall: inverse depth (N,), ray coordinates with a one (N, 3), and weights of nodes (N, nodes)."""

    inverse: Array
    rays: Array
    nodes: Array


def calibrate_depth(
    walls_m: Sequence[Array], focal_px: tuple[float, float], centre_px: tuple[float, float]
) -> DepthBend:
    """Estimate the bend of a range camera from images of flat walls, best from several distances.

    Minimises sum rho(1/z - (a_k x + b_k y + c_k) + field(u, v)) over the field and the plane of every wall k.

    Args:
        walls_m: depth images (H, W), m; NaN where nothing was measured.
        focal_px, centre_px: of the camera.

    Raises:
        InvalidRequest: no images, or images of different sizes.
        NotObservable: a wall covers too little of the image, or the bend changes with the distance.
    """
    shape = _shape(walls_m)
    walls = [_samples(k, np.asarray(depth, float), focal_px, centre_px) for k, depth in enumerate(walls_m)]
    whole = _samples(0, np.ones(shape), focal_px, centre_px)
    linear = whole.rays.T @ whole.nodes / len(whole.rays)
    field = np.zeros(ROWS * COLUMNS)
    weights = [np.ones(len(wall.inverse)) for wall in walls]
    for _ in range(ROUNDS):
        field = _solved(walls, weights, linear)
        weights = [
            _weights(_off_plane(wall, wall.inverse + wall.nodes @ field, weight))
            for wall, weight in zip(walls, weights, strict=True)
        ]
    before, after = (
        _rms([_bent(wall, wall.inverse + wall.nodes @ added, w) for wall, w in zip(walls, weights, strict=True)])
        for added in (0.0 * field, field)
    )
    noise = _rms([_noise(wall, weight) for wall, weight in zip(walls, weights, strict=True)])
    result = DepthBend(
        record=DepthBendRecord(
            width_px=shape[1], height_px=shape[0],
            per_m=tuple(tuple(round(value, 8) for value in row) for row in field.reshape(ROWS, COLUMNS).tolist()),
        ),
        before=before, after=after, walls=len(walls),
    )  # fmt: skip
    if result.after > max(MOST_LEFT * result.before, noise):
        raise NotObservable(
            f"the bend is {result.before:.2g} per metre, and {result.after:.2g} remain: it is not the same in all"
            f" {len(walls)} images",
            hint="check that every image shows one flat wall; a sensor that measures time of flight has no such bend",
        )
    return result


def _shape(walls_m: Sequence[Array]) -> tuple[int, int]:
    """Return height and width of the images.

    Raises:
        InvalidRequest: no images, or images of different sizes.
    """
    shapes = {np.shape(depth) for depth in walls_m}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise InvalidRequest(
            f"depth images of the sizes {sorted(shapes)}" if shapes else "no depth images",
            hint="give images (H, W) of one range camera at one resolution",
        )
    height, width = next(iter(shapes))
    return height, width


def _samples(index: int, depth_m: Array, focal_px: tuple[float, float], centre_px: tuple[float, float]) -> _Wall:
    """Return the samples of an image.

    Raises:
        NotObservable: too little of it was measured.
    """
    thin = depth_m[::STRIDE, ::STRIDE]
    v, u = (STRIDE * part for part in np.nonzero(np.isfinite(thin) & (thin > 0.0)))
    nodes = _node_weights(u, v, depth_m.shape)
    seen = float((nodes.max(axis=0, initial=0.0) > 0.5).mean())
    if seen < LEAST_SEEN:
        raise NotObservable(
            f"image {index + 1} measures only {seen:.0%} of the view",
            hint="stand nearer to the wall, which must fill the image",
        )
    x, y = (u - centre_px[0]) / focal_px[0], (v - centre_px[1]) / focal_px[1]
    return _Wall(inverse=1.0 / depth_m[v, u], rays=np.column_stack([x, y, np.ones(len(x))]), nodes=nodes)


def _node_weights(u: NDArray[np.intp], v: NDArray[np.intp], shape: tuple[int, ...]) -> Array:
    """Return the bilinear weights (N, ROWS COLUMNS) of the field's nodes at pixels."""
    down, across = bilinear_weights(shape[0], ROWS)[v], bilinear_weights(shape[1], COLUMNS)[u]
    return np.asarray((down[:, :, None] * across[:, None, :]).reshape(len(down), -1))


def _solved(walls: Sequence[_Wall], weights: Sequence[Array], linear: Array) -> Array:
    """Return the field (nodes,) of least squares with the planes of all walls, by its normal equations.

    Args:
        linear: (3, nodes) parts of the field along x, y and 1, which are held at zero.
    """
    count = ROWS * COLUMNS
    N, rhs = np.zeros((count, count)), np.zeros(count)
    for wall, weight in zip(walls, weights, strict=True):
        # The field and the wall's plane p: nodes field - rays p = -inverse; p is eliminated.
        A, B = wall.nodes * weight[:, None], wall.rays * weight[:, None]
        across = np.linalg.solve(wall.rays.T @ B, B.T)
        A = A - (A.T @ wall.rays @ across).T
        N += A.T @ wall.nodes
        rhs -= A.T @ wall.inverse
    scale = float(np.trace(N)) / count
    bends = _second_differences()
    N += scale * (STIFF * bends.T @ bends + HELD * linear.T @ linear)
    return np.asarray(np.linalg.solve(N, rhs))


def _second_differences() -> Array:
    """Return the second differences of a field along its rows and columns, as rows of a matrix."""
    down, across = (np.diff(np.eye(n), 2, axis=0) for n in (ROWS, COLUMNS))
    return np.vstack([np.kron(down, np.eye(COLUMNS)), np.kron(np.eye(ROWS), across)])


def _off_plane(wall: _Wall, inverse: Array, weight: Array) -> Array:
    """Return by how much inverse depths differ from their plane."""
    B = wall.rays * weight[:, None]
    return np.asarray(inverse - wall.rays @ np.linalg.solve(wall.rays.T @ B, B.T @ inverse))


def _weights(off: Array) -> Array:
    """Return Tukey's biweights of residuals."""
    sigma = max(1.4826 * float(np.median(np.abs(off))), 1e-12)
    return np.asarray(np.clip(1.0 - (off / (REJECT_SIGMAS * sigma)) ** 2, 0.0, None) ** 2)


def _bent(wall: _Wall, inverse: Array, weight: Array) -> Array:
    """Return by how much the parts of a wall that the nodes cover are off its plane, (nodes,) 1/m."""
    share = wall.nodes * weight[:, None]
    return np.asarray((share.T @ _off_plane(wall, inverse, weight)) / np.maximum(share.sum(axis=0), 1e-9))


def _noise(wall: _Wall, weight: Array) -> float:
    """Return the standard deviation of those parts by the noise of the pixels, if it is independent."""
    share = wall.nodes * weight[:, None]
    sigma = 1.4826 * float(np.median(np.abs(_off_plane(wall, wall.inverse, weight))))
    return sigma * float(np.sqrt(np.mean((share**2).sum(axis=0) / np.maximum(share.sum(axis=0), 1e-9) ** 2)))


def _rms(parts: Sequence[Array] | Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(parts))))
