"""Triangle meshes of the cell's shapes: vertices, vertex normals, texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array

FINE_M = 0.012  # circles of at most this radius have FEW corners
FEW, MANY = 20, 40
DISC = 72


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """T triangles: `points_m` and `normals` (T, 3, 3), `uv` (T, 3, 2) with v upwards.

    Counter-clockwise seen from outside.
    """

    points_m: Array
    normals: Array
    uv: Array


def merge(meshes: list[Mesh]) -> Mesh:
    """Return all triangles in one mesh."""
    return Mesh(
        points_m=np.concatenate([mesh.points_m for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        uv=np.concatenate([mesh.uv for mesh in meshes]),
    )


def placed(mesh: Mesh, rotation: Array, translation_m: Array) -> Mesh:
    """Return the mesh in the parent's axes."""
    return Mesh(points_m=mesh.points_m @ rotation.T + translation_m, normals=mesh.normals @ rotation.T, uv=mesh.uv)


def box(size_m: Array) -> Mesh:
    """Return a box centred at the origin."""
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = sign
            a, b = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            corners = np.array([normal + sa * a + sb * b for sa, sb in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
            faces.append(_fan(corners[:: int(sign)] * size_m / 2.0, np.tile(normal, (4, 1))))
    return merge(faces)


def cylinder(radius_m: float, length_m: float) -> Mesh:
    """Return a cylinder along z centred at the origin."""
    count = _corners(radius_m)
    ring = _ring(count)
    low = np.column_stack([radius_m * ring, np.full(count, -length_m / 2)])
    high = low + np.array([0.0, 0.0, length_m])
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    normals = np.column_stack([ring, np.zeros(count)])
    after = np.roll(np.arange(count), -1)
    side = [
        _fan(np.array([low[i], low[j], high[j], high[i]]), normals[[i, j, j, i]])
        for i, j in zip(range(count), after.tolist(), strict=True)
    ]
    return merge([*side, _fan(high, up), _fan(low[::-1], -up)])


def sphere(radius_m: float) -> Mesh:
    """Return a sphere centred at the origin."""
    count = _corners(radius_m)
    rows = count // 2
    latitude = np.pi * (np.arange(rows + 1) / rows - 0.5)
    ring = _ring(count)
    grid = np.stack([np.column_stack([np.cos(a) * ring, np.full(count, np.sin(a))]) for a in latitude])
    faces = []
    for r in range(rows):
        for i in range(count):
            j = (i + 1) % count
            n = np.array([grid[r, i], grid[r, j], grid[r + 1, j], grid[r + 1, i]])
            faces.append(_fan(radius_m * n, n))
    return merge(faces)


def _corners(radius_m: float) -> int:
    # The arm is large, but appears only as a shadow at the edge of a picture.
    return MANY if FINE_M < radius_m < 0.04 else FEW


def flat(size_m: tuple[float, float], *, is_round: bool) -> Mesh:
    """Return a flat picture in z = 0 facing +z; a rectangle or the disc inside it."""
    corners = _ring(DISC) if is_round else np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    points = np.column_stack([corners * np.asarray(size_m) / 2.0, np.zeros(len(corners))])
    return _fan(points, np.tile([0.0, 0.0, 1.0], (len(corners), 1)), (corners + 1.0) / 2.0)


def _ring(count: int) -> Array:
    angles = 2.0 * np.pi * np.arange(count) / count
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _fan(corners: Array, normals: Array, uv: Array | None = None) -> Mesh:
    """Return the triangles of a convex polygon."""
    uv = np.zeros((len(corners), 2)) if uv is None else uv
    index = np.array([[0, i, i + 1] for i in range(1, len(corners) - 1)])
    return Mesh(points_m=corners[index], normals=normals[index], uv=uv[index])
