"""Compares the rasteriser with ray casting: depth, position, colour, clipping, hidden surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.arrays import Array
from simbackend import meshes
from simbackend.meshes import Mesh
from simbackend.raster import rasterise

W, H = 64, 48
CAMERA = np.array([60.0, 60.0, 31.5, 23.5, 0.05])
NO_TEXTURE = (np.zeros(1, np.uint8), np.array([[0, 2, 2, 0]], np.int64))


def draw(
    points: Array, colours: Array, uv: Array | None = None, textures: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """Return image (H, W) and depth (H, W) of triangles in camera axes."""
    count = len(points)
    attributes = np.ones((count, 3, 3))
    attributes[:, :, 1:] = 0.0 if uv is None else uv
    surface = np.full(count, -1 if textures is None else 0, np.int64)
    image, near = np.zeros((H, W, 1), np.float32), np.zeros((H, W), np.float32)
    texels, table = textures or NO_TEXTURE
    rasterise(points, attributes, surface, colours.reshape(count, 1), texels, table, CAMERA, near, image)
    with np.errstate(divide="ignore"):
        return image[:, :, 0], np.where(near > 0, 1.0 / near, np.inf)


def rays() -> Array:
    """Return (H, W, 3) directions through the pixel centres, z = 1."""
    v, u = np.mgrid[0:H, 0:W]
    return np.stack([(u - CAMERA[2]) / CAMERA[0], (v - CAMERA[3]) / CAMERA[1], np.ones((H, W))], axis=-1)


def cast(triangle: Array) -> tuple[Array, Array]:
    """Return (H, W) depth by Moeller and Trumbore, inf for a miss or a back face, and a margin that is > 0 inside."""
    d = rays()
    a, e1, e2 = triangle[0], triangle[1] - triangle[0], triangle[2] - triangle[0]
    p = np.cross(d, e2)
    det = p @ e1
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        s = -a
        u = (p @ s) / det
        q = np.cross(s, e1)
        v = (d @ q) / det
        t = (q @ e2) / det
        inside = np.minimum(np.minimum(u, v), np.minimum(1.0 - u - v, t - CAMERA[4]))
        hit = (det > 1e-12) & (inside >= 0.0)
    return np.where(hit, t, np.inf), np.where(np.abs(det) > 1e-9, inside, 0.0)


corner = st.tuples(st.floats(-0.6, 0.6), st.floats(-0.5, 0.5), st.floats(-0.2, 1.5))


@settings(max_examples=150, deadline=None)
@given(st.tuples(corner, corner, corner))
def test_a_triangle_is_where_rays_meet_it(corners: tuple[tuple[float, float, float], ...]) -> None:
    triangle = np.array(corners)
    _, depth = draw(triangle[None], np.ones(1))
    expected, inside = cast(triangle)
    both = np.isfinite(depth) & np.isfinite(expected)
    np.testing.assert_allclose(depth[both], expected[both], rtol=2e-5)
    # Pixels may differ only if their centre is on an edge.
    differs = np.isfinite(depth) != np.isfinite(expected)
    assert np.all(np.abs(inside[differs]) < 1e-6)


def test_the_nearer_surface_hides_the_farther_in_any_order() -> None:
    near = meshes.flat((0.2, 0.2), is_round=False).points_m @ np.diag([1.0, -1.0, -1.0]) + [0, 0, 0.5]
    far = meshes.flat((2.0, 2.0), is_round=False).points_m @ np.diag([1.0, -1.0, -1.0]) + [0, 0, 0.9]
    for order in (1, -1):
        both = [(near, 0.25), (far, 0.75)][::order]
        points = np.concatenate([mesh for mesh, _ in both])
        image, depth = draw(points, np.concatenate([[level] * 2 for _, level in both]))
        assert image[24, 32] == pytest.approx(0.25)
        assert depth[24, 32] == pytest.approx(0.5)
        assert image[2, 2] == pytest.approx(0.75)


def test_a_ball_has_the_depth_of_a_ball() -> None:
    ball = meshes.sphere(0.03).points_m + np.array([0.02, -0.01, 0.4])
    _, depth = draw(ball, np.ones(len(ball)))
    d = rays()
    centre = np.array([0.02, -0.01, 0.4])
    b, n = d @ centre, (d * d).sum(axis=-1)
    under = b * b - n * (centre @ centre - 0.03**2)
    seen = under > 0.3 * under.max()  # without the silhouette, where the corners of the mesh are visible
    expected = (b - np.sqrt(np.where(seen, under, 0.0))) / n
    assert np.count_nonzero(seen) > 20
    np.testing.assert_allclose(depth[seen], expected[seen], atol=4e-4)


def test_a_texture_stands_upright_and_its_corners_are_its_corners() -> None:
    picture = np.array([[10, 20], [30, 40]], np.uint8).repeat(16, 0).repeat(16, 1)  # 10 upper left, 40 lower right
    mesh = meshes.flat((0.4, 0.4), is_round=False)
    points = mesh.points_m @ np.diag([1.0, -1.0, -1.0]) + [0, 0, 0.6]  # upright, faces the camera
    table = np.array([[0, 32, 32, 0]], np.int64)
    image, _ = draw(points, np.ones(2), mesh.uv, (picture.ravel(), table))
    quarters = [image[15, 22], image[15, 42], image[33, 22], image[33, 42]]
    np.testing.assert_allclose(np.array(quarters) * 255, [10, 20, 30, 40], atol=0.01)


def test_a_distant_texture_is_drawn_from_its_smaller_copy() -> None:
    """Stripes of one texel at 8 texels per pixel are gray; without the smaller copies they would flicker."""
    stripes = np.zeros((256, 256), np.uint8)
    stripes[:, ::2] = 200
    levels = [stripes, *(np.full((size, size), 100, np.uint8) for size in (128, 64, 32))]
    texels = np.concatenate([level.ravel() for level in levels])
    mesh = meshes.flat((0.3, 0.3), is_round=False)
    points = mesh.points_m @ np.diag([1.0, -1.0, -1.0]) + [0, 0, 0.6]
    image, depth = draw(points, np.ones(2), mesh.uv, (texels, np.array([[0, 256, 256, 3]], np.int64)))
    inside = image[np.isfinite(depth)] * 255
    np.testing.assert_allclose(inside, 100.0, atol=0.1)


@pytest.mark.parametrize("mesh", [meshes.box(np.array([0.1, 0.2, 0.3])), meshes.cylinder(0.1, 0.3), meshes.sphere(0.1)])
def test_closed_meshes_turn_their_faces_outwards(mesh: Mesh) -> None:
    """The signed volume is positive and every normal points away from the centre."""
    a, b, c = mesh.points_m.transpose(1, 0, 2)
    assert np.einsum("ti,ti->t", a, np.cross(b, c)).sum() / 6.0 > 0.0
    assert np.all(np.einsum("tci,tci->tc", mesh.points_m, mesh.normals) > 0.0)
    flat_normals = np.cross(b - a, c - a)
    proper = np.linalg.norm(flat_normals, axis=1) > 1e-9
    assert np.all(np.einsum("ti,ti->t", flat_normals, mesh.normals.mean(axis=1))[proper] > 0.0)
