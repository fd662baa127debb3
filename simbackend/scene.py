"""Everything visible, as triangles per moving part, and pictures of it.

The shapes are read back from the engine, so what is rendered is what was loaded; printed faces are added.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.geometry import matrix_of
from simbackend import meshes
from simbackend.canvas import Pixels
from simbackend.meshes import Mesh
from simbackend.raster import rasterise

Float32 = NDArray[np.float32]
Pose = tuple[tuple[float, ...], tuple[float, ...]]  # position and quaternion, as the engine gives them

TO_LIGHT = np.array([-0.50, 0.30, 0.81])  # base axes: the room lamps are above and behind the arm
AMBIENT, DIFFUSE = 0.55, 0.50
BACKGROUND = 0.16
HALVINGS = 3
LUMA = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Part:
    """Triangles that move together: one link of one body (link -1: the base), or a printed face (body -1)."""

    body: int
    link: int
    rows: slice


class Scene:
    """Collects triangles once and renders them at their present poses."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine
        self._meshes: list[Mesh] = []
        self._parts: list[_Part] = []
        self._colours: list[Array] = []
        self._surface: list[NDArray[np.int64]] = []
        self._pictures: list[Pixels] = []
        self._rows = 0
        self._compiled: dict[int, _Compiled] = {}

    def add_body(self, body: int) -> None:
        """Add all visual shapes of a body of the engine."""
        for entry in self._engine.getVisualShapeData(body):
            _, link, kind, size, _, position, quaternion, rgba = entry[:8]
            mesh = self._shape(kind, size)
            turn = Rotation.from_quat(quaternion).as_matrix()
            self._add(body, link, meshes.placed(mesh, turn, np.asarray(position)), np.asarray(rgba[:3]), -1)

    def add_picture(
        self, pixels: Pixels, size_m: tuple[float, float], base_from_picture: RigidTransform, *, is_round: bool
    ) -> None:
        """Add a printed face that never moves."""
        mesh = meshes.flat(size_m, is_round=is_round)
        turn = matrix_of(base_from_picture)
        self._pictures.append(pixels)
        self._add(-1, -1, meshes.placed(mesh, turn, base_from_picture.translation), np.ones(3), len(self._pictures) - 1)

    def _shape(self, kind: int, size: tuple[float, float, float]) -> Mesh:
        engine = self._engine
        if kind == engine.GEOM_BOX:
            return meshes.box(np.asarray(size))
        if kind == engine.GEOM_SPHERE:
            return meshes.sphere(size[0])
        if kind == engine.GEOM_CYLINDER:
            return meshes.cylinder(size[1], size[0])
        raise ValueError(f"no mesh for the engine's shape {kind}")

    def _add(self, body: int, link: int, mesh: Mesh, colour: Array, surface: int) -> None:
        count = len(mesh.points_m)
        self._meshes.append(mesh)
        self._colours.append(np.tile(colour, (count, 1)))
        self._surface.append(np.full(count, surface, np.int64))
        self._parts.append(_Part(body=body, link=link, rows=slice(self._rows, self._rows + count)))
        self._rows += count

    def compile(self) -> None:
        """Freeze the shapes; call once, after the last `add_*`."""
        self._mesh = meshes.merge(self._meshes)
        self._albedo = np.concatenate(self._colours)
        self._surfaces = np.concatenate(self._surface)
        self._glow = np.zeros(self._rows, bool)
        self._points = self._mesh.points_m.copy()
        self._shade = _shade(self._mesh.normals)
        self._links: dict[tuple[int, int], list[slice]] = {}
        for part in self._parts:
            if part.body >= 0:
                self._links.setdefault((part.body, part.link), []).append(part.rows)
        self._last: dict[tuple[int, int], Pose] = {}
        for channels in (0, 1, 3):
            self._compiled[channels] = _Compiled(self._albedo, self._pictures, channels)

    def reprint(self, number: int, pixels: Pixels) -> None:
        """Replace the printed face that was added as this one (from 0); its size stays."""
        self._pictures[number] = pixels
        for compiled in self._compiled.values():
            compiled.print(self._pictures)

    def paint(self, body: int, link: int, colour: tuple[float, float, float]) -> None:
        """Give a link (-1: the base) another colour; values above 1 shine."""
        for part in self._parts:
            if (part.body, part.link) == (body, link):
                for compiled in self._compiled.values():
                    compiled.albedo[part.rows] = compiled.mix(np.asarray(colour))

    def shift_prints(self, moved: RigidTransform) -> None:
        """Move all printed faces by a displacement in the base frame."""
        turn = matrix_of(moved)
        for part in self._parts:
            if part.body < 0:
                self._points[part.rows] = self._points[part.rows] @ turn.T + moved.translation
                self._mesh.normals[part.rows] = self._mesh.normals[part.rows] @ turn.T
                self._shade[part.rows] = _shade(self._mesh.normals[part.rows])

    def shine(self, body: int, link: int, *, on: bool) -> None:
        """Set whether a link shines; a shining link is equally bright from all sides."""
        for part in self._parts:
            if (part.body, part.link) == (body, link):
                self._glow[part.rows] = on
                self._last.pop((body, link), None)

    def draw(
        self,
        base_from_camera: RigidTransform,
        *,
        width: int,
        height: int,
        focal: tuple[float, float],
        centre: tuple[float, float],
        near_m: float,
        channels: int,
    ) -> tuple[Float32, Float32]:
        """Return radiance (H, W, channels), white = 1, and 1/depth (H, W) in 1/m, 0 where there is no surface.

        `channels`: 3 for RGB, 1 for grey, 0 for depth alone.
        """
        self._follow()
        seen = (self._points - base_from_camera.translation) @ matrix_of(base_from_camera)
        attributes = np.concatenate([self._shade[:, :, None], self._mesh.uv], axis=2)
        compiled = self._compiled[channels]
        inverse_depth = np.zeros((height, width), np.float32)
        image = np.full((height, width, channels), BACKGROUND, np.float32)
        camera = np.array([*focal, *centre, near_m])
        rasterise(
            seen,
            attributes,
            self._surfaces,
            compiled.albedo,
            compiled.texels,
            compiled.table,
            camera,
            inverse_depth,
            image,
        )
        return image, inverse_depth

    def _follow(self) -> None:
        """Update the triangles of every link that has moved since the last picture."""
        for key, all_rows in self._links.items():
            pose = self._pose(*key)
            if self._last.get(key) == pose:
                continue
            self._last[key] = pose
            position, quaternion = pose
            turn = np.array(self._engine.getMatrixFromQuaternion(quaternion)).reshape(3, 3).T
            for rows in all_rows:
                self._points[rows] = self._mesh.points_m[rows] @ turn + position
                shade = _shade(self._mesh.normals[rows] @ turn)
                self._shade[rows] = np.where(self._glow[rows, None], 1.0, shade)

    def _pose(self, body: int, link: int) -> Pose:
        if link < 0:
            position, quaternion = self._engine.getBasePositionAndOrientation(body)
        else:
            position, quaternion = self._engine.getLinkState(body, link, computeForwardKinematics=1)[4:6]
        return position, quaternion


def _shade(normals: Array) -> Array:
    """Return the (T, 3) light on each corner: ambient light, plus a distant lamp by the cosine law."""
    towards = TO_LIGHT / np.linalg.norm(TO_LIGHT)
    return np.asarray(AMBIENT + DIFFUSE * np.maximum(normals @ towards, 0.0))


class _Compiled:
    """Colours and textures for a number of channels; each texture is stored with its reduced copies."""

    def __init__(self, albedo: Array, pictures: list[Pixels], channels: int) -> None:
        self._channels = channels
        self.albedo = np.stack([self.mix(colour) for colour in albedo]) if channels else np.zeros((len(albedo), 0))
        self.print(pictures)

    def print(self, pictures: list[Pixels]) -> None:
        """Store the textures of all printed faces."""
        texels: list[NDArray[np.uint8]] = []
        table: list[tuple[int, int, int, int]] = []
        offset = 0
        for picture in pictures if self._channels else []:
            level = picture if self._channels == 3 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
            table.append((offset, level.shape[1], level.shape[0], HALVINGS))
            for _ in range(HALVINGS + 1):
                texels.append(np.ascontiguousarray(level).ravel())
                offset += texels[-1].size
                half = (level.shape[1] // 2, level.shape[0] // 2)
                level = np.asarray(cv2.resize(level, half, interpolation=cv2.INTER_AREA), np.uint8)
        self.texels = np.concatenate(texels) if texels else np.zeros(1, np.uint8)
        # A depth picture needs no texture, but the rows that its triangles refer to must exist.
        self.table = np.array(table or [(0, 2, 2, 0)] * max(1, len(pictures)), np.int64)

    def mix(self, colour: Array) -> Array:
        """Return an RGB colour in this number of channels."""
        return colour if self._channels == 3 else np.array([float(colour @ LUMA)])[: self._channels]
