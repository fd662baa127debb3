"""Draws the outlines of an object at one or more poses as a camera would see it (paper, Fig. 13)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from fusion.sensing import Pinhole
from hal.arrays import Array
from hal.geometry import transform

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NEAREST_M = 0.02  # near clipping plane
CIRCLE_POINTS = 24


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drawing:
    """Object at one pose, drawn in one style.

    Attributes:
        base_from_object: the pose.
        outlines_m: polylines, each (K, 3) in the object frame.
        colour: any colour of matplotlib, for example `#1f77b4`.
        label: text in the legend.
        dashed: whether lines are dashed, for example for the true pose.
    """

    base_from_object: RigidTransform
    outlines_m: Sequence[Array]
    colour: str = "black"
    label: str = ""
    dashed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """Camera that the drawing is seen by; axes x right, y down, z forward."""

    base_from_camera: RigidTransform
    camera: Pinhole
    width_px: int = 640
    height_px: int = 480


def sight_of(
    base_from_object: RigidTransform,
    middle_m: ArrayLike,
    *,
    distance_m: float,
    width_px: int = 640,
    height_px: int = 480,
) -> Sight:
    """Return a camera on the object's +z side, slightly above and to the right, that looks at its centre.

    Args:
        base_from_object: pose of the object.
        middle_m: (3,) point to look at, object frame.
        distance_m: distance of the camera from that point.
    """
    focal = 1.1 * width_px
    toward = np.array([0.25, 0.3, 1.0]) / np.linalg.norm([0.25, 0.3, 1.0])
    z = -toward
    x = np.cross([0.0, -1.0, 0.0], z)
    x /= np.linalg.norm(x)
    lens = transform(np.column_stack([x, np.cross(z, x), z]), np.asarray(middle_m, float) + distance_m * toward)
    camera = Pinhole(fx_px=focal, fy_px=focal, cx_px=width_px / 2, cy_px=height_px / 2)
    return Sight(base_from_camera=base_from_object * lens, camera=camera, width_px=width_px, height_px=height_px)


def box_outlines(low_m: ArrayLike, high_m: ArrayLike) -> list[Array]:
    """Return the edges of an axis-aligned box as 6 polylines: bottom, top, four uprights."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low_m, float), np.asarray(high_m, float)
    ring = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
    bottom, top = (np.column_stack([ring, np.full(5, z)]) for z in (z0, z1))
    return [bottom, top, *(np.array([bottom[k], top[k]]) for k in range(4))]


def circle_outline(centre_m: ArrayLike, radius_m: float) -> Array:
    """Return a circle in a plane z = constant as a polyline (K, 3)."""
    angle = np.linspace(0.0, 2.0 * math.pi, CIRCLE_POINTS + 1)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    return np.asarray(np.asarray(centre_m, float) + radius_m * ring)


def seen(drawing: Drawing, sight: Sight) -> list[Array]:
    """Return the visible polylines of a drawing in the image, each (K, 2) px; parts behind the camera are cut off."""
    camera_from_object = sight.base_from_camera.inv() * drawing.base_from_object
    lines: list[Array] = []
    for outline in drawing.outlines_m:
        points = np.atleast_2d(camera_from_object.apply(outline))
        lines += [_projected(piece, sight.camera) for piece in _before_lens(points)]
    return lines


def _before_lens(points: Array) -> list[Array]:
    """Return the pieces of a polyline (K, 3) in front of the plane z = NEAREST_M."""
    pieces: list[list[Array]] = [[]]
    for a, b in pairwise(points):
        depths = np.array([a[2], b[2]]) - NEAREST_M
        if (depths < 0).all():
            continue
        cut = a + (b - a) * np.clip(-depths[0] / (b[2] - a[2]), 0.0, 1.0) if (depths < 0).any() else a
        first, last = (cut, b) if depths[0] < 0 else (a, cut if depths[1] < 0 else b)
        if not pieces[-1] or not np.array_equal(pieces[-1][-1], first):
            pieces.append([first])
        pieces[-1].append(last)
    return [np.array(piece) for piece in pieces if len(piece) > 1]


def _projected(points: Array, camera: Pinhole) -> Array:
    z = np.maximum(points[:, 2], NEAREST_M)
    return np.column_stack([
        camera.cx_px + camera.fx_px * points[:, 0] / z, camera.cy_px + camera.fy_px * points[:, 1] / z
    ])  # fmt: skip


def axes(ax: Axes, drawings: Sequence[Drawing], sight: Sight, *, title: str = "") -> None:
    """Draw on matplotlib axes, in pixels with y down."""
    for drawing in drawings:
        for k, line in enumerate(seen(drawing, sight)):
            ax.plot(
                line[:, 0], line[:, 1], color=drawing.colour, linewidth=1.0,
                linestyle="--" if drawing.dashed else "-", label=drawing.label if k == 0 else None,
            )  # fmt: skip
    ax.set_xlim(0, sight.width_px)
    ax.set_ylim(sight.height_px, 0)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    if title:
        ax.set_title(title, fontsize=9)
