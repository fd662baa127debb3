"""Initial pose hypotheses: each piece of the scene that stands out of the panel is paired with each model surface."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hal.arrays import Array, Mask
from perception.range.analysis import RangeScene
from perception.range.matching.models import ComponentModel, Form, ModelSurface, MotionKind
from perception.range.matching.solids import boxes_of, solid_of
from perception.range.matching.verify import Solid, View
from perception.range.primitives import Cylinder, Plane, Sphere, Surface

LEAST_HEIGHT_M = 0.002
LEAST_PIXELS = 12
LEAST_SHARE = 0.3  # of a surface's pixels must stand out; of the panel itself fewer do, because of noise and relief
HEIGHT_SLACK_M = 0.004  # accepted difference between the heights of a piece and of a model surface
LYING = 0.15  # least length of a direction's projection on the panel that determines a heading
ELONGATED = 1.5  # least ratio of length to width of a shape whose longer side determines a heading
SAME_TURN_RAD = 0.09  # angles that differ by less are tried only once
BLIND_TURNS = 8  # headings tried per period of symmetry if the data do not give one
STATES = 7  # positions that are tried of a part that slides along the panel
NORMAL_SLACK_RAD = 0.35  # accepted angle between the normals of a plane in the scene and in the model
LEAST_FACING = 0.3  # least z of the normal of a face that suggests poses


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Piece:
    """Something that stands out of the panel, in the panel's frame: a region of the segmentation or of the relief.

    Attributes:
        middle_m: (3,) centre along the panel (for a sphere, the sphere's), and median height.
        axis: (3,) normal of a plane, axis of a cylinder; zeros otherwise.
        is_plane: whether the segmentation classified it as a plane.
        heading_rad: direction of its longer side in the panel; `half_m` (2,) is half its extent along and across that.
        label: label of its surface in the scene, 0 for pixels that no surface explains.
    """

    middle_m: Array
    axis: Array
    is_plane: bool
    heading_rad: float
    half_m: Array
    label: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A model prepared for matching; `travel` (S, 2, 3) are boxes that hold its surfaces in every state."""

    model: ComponentModel
    travel: Array
    solid: Solid


def candidate_of(model: ComponentModel) -> Candidate:
    """Prepare a model for matching: its rows, bounding boxes and tolerances."""
    slide = model.motion_axis if model.motion == MotionKind.SLIDE else np.zeros(3)
    tolerance = np.array([s.tolerance_m for s in model.surfaces])
    return Candidate(
        model=model,
        travel=boxes_of(model, with_travel=True),
        solid=Solid(rows=solid_of(model), boxes=boxes_of(model), tolerance_m=tolerance, slide=slide.copy()),
    )


def pieces_of(scene: RangeScene, view: View) -> list[Piece]:
    """Return every surface that stands out of the panel, and every patch above it that no surface explains."""
    points = scene.sensor.points(view.depth_m) - view.p
    in_panel = points @ view.R
    stands_out = np.isfinite(view.depth_m) & (in_panel[..., 2] > LEAST_HEIGHT_M + 3.0 * view.sigma_m)
    out = []
    for surface in scene.surfaces:
        mine = stands_out & (scene.labels == surface.label)
        if mine.sum() < max(LEAST_PIXELS, LEAST_SHARE * surface.pixels):
            continue
        out += [_piece(in_panel[part], view, surface) for part in _and_its_patches(mine)]
    loose = stands_out & (scene.labels == 0)
    return out + [_piece(in_panel[patch], view, None) for patch in _patches(loose)]


def _and_its_patches(mine: Mask) -> list[Mask]:
    """Return the mask of a surface and, if it is not connected, of each of its patches.

    The caps of two buttons at the same height are one surface, so each of them must be tried on its own.
    """
    patches = _patches(mine)
    return [mine, *patches] if len(patches) > 1 else [mine]


def _patches(mask: Mask) -> list[Mask]:
    """Return the 4-connected patches of a mask that have at least `LEAST_PIXELS` pixels."""
    count, patch, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return [patch == k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= LEAST_PIXELS]


def _piece(points: Array, view: View, surface: Surface | None) -> Piece:
    """Measure a piece from its points (N, 3) in the panel's frame and the surface that explains them, if any."""
    axis, centre, is_plane = np.zeros(3), None, False
    match None if surface is None else surface.primitive:
        case Plane(normal=normal):
            axis, is_plane = view.R.T @ normal, True
        case Cylinder(axis=direction):
            axis = view.R.T @ direction
        case Sphere(centre_m=ball):
            centre = view.R.T @ (ball - view.p)
    middle = np.median(points, axis=0)
    xy = points[:, :2] - points[:, :2].mean(axis=0)
    _, vectors = np.linalg.eigh(xy.T @ xy)
    along, across = vectors[:, 1], vectors[:, 0]
    half, offset = np.empty(2), np.empty(2)
    for k, direction in enumerate((along, across)):
        low, high = np.quantile(xy @ direction, [0.02, 0.98])
        half[k], offset[k] = 0.5 * (high - low), 0.5 * (high + low)
    place = points[:, :2].mean(axis=0) + offset[0] * along + offset[1] * across
    if centre is not None and np.hypot(*(centre[:2] - place)) < 0.05:
        place = centre[:2]
    middle[:2] = place
    return Piece(
        middle_m=middle,
        axis=axis,
        is_plane=is_plane,
        heading_rad=float(np.arctan2(along[1], along[0])),
        half_m=half,
        label=0 if surface is None else surface.label,
    )


def hypotheses(candidate: Candidate, piece: Piece) -> list[Array]:
    """Return hypotheses (x, y, yaw, state) in the panel's frame that place a surface of the model on the piece."""
    model = candidate.model
    out: list[Array] = []
    for surface, box in zip(model.surfaces, candidate.travel, strict=True):
        if surface.type == Form.PLANE and surface.direction[2] < LEAST_FACING:
            continue  # walls are seen at grazing angles; other surfaces of the same height give a better position
        if not box[0, 2] - HEIGHT_SLACK_M <= piece.middle_m[2] <= box[1, 2] + HEIGHT_SLACK_M:
            continue
        for yaw in _yaws(model, surface, piece):
            if not _faces_alike(surface, piece, yaw):
                continue
            c, s = np.cos(yaw), np.sin(yaw)
            turn = np.array([[c, -s], [s, c]])
            for state in _states(model):
                middle = surface.point_m[:2].copy()
                if surface.moves and model.motion == MotionKind.SLIDE:
                    middle += state * model.motion_axis[:2]
                origin = piece.middle_m[:2] - turn @ middle
                for shift in _shifts(surface, piece, turn):
                    out.append(np.array([*(origin + shift), yaw, state]))
    return out


def _faces_alike(surface: ModelSurface, piece: Piece, yaw: float) -> bool:
    """Return whether the normals of two planes agree after a rotation by `yaw`; True if either is not a plane."""
    if surface.type != Form.PLANE or not piece.is_plane:
        return True
    c, s = np.cos(yaw), np.sin(yaw)
    d = surface.direction
    turned = np.array([c * d[0] - s * d[1], s * d[0] + c * d[1], d[2]])
    return bool(turned @ piece.axis > np.cos(NORMAL_SLACK_RAD))


def _long_side(surface: ModelSurface) -> tuple[Array, float, float]:
    """Return the direction (2,) of a surface's longer side in the panel, and its half lengths along and across it."""
    if surface.sides_m is not None:
        a, b = 0.5 * surface.sides_m[0], 0.5 * surface.sides_m[1]
        if a >= b:
            return surface.along[:2], a, b
        return np.cross(surface.direction, surface.along)[:2], b, a
    if surface.type == Form.CYLINDER:
        return surface.direction[:2], 0.5 * surface.length_m, surface.size_m
    return np.zeros(2), surface.size_m, surface.size_m


def _yaws(model: ComponentModel, surface: ModelSurface, piece: Piece) -> list[float]:
    """Return the rotations about the panel's normal to try, reduced to one period of the model's symmetry."""
    if model.turns == 0:
        return [0.0]
    out: list[float] = []
    d = surface.direction
    if np.hypot(d[0], d[1]) > LYING and np.hypot(piece.axis[0], piece.axis[1]) > LYING:
        turn = float(np.arctan2(piece.axis[1], piece.axis[0]) - np.arctan2(d[1], d[0]))
        if (surface.type == Form.PLANE) == piece.is_plane:
            out += [turn] if piece.is_plane else [turn, turn + np.pi]
    side, a, b = _long_side(surface)
    if np.hypot(*side) > 0.5 and not out:
        turn = piece.heading_rad - float(np.arctan2(side[1], side[0]))
        out += [turn, turn + np.pi]
        if a < ELONGATED * b or piece.half_m[0] < ELONGATED * piece.half_m[1]:
            out += [turn + 0.5 * np.pi, turn - 0.5 * np.pi]
    if not out:
        out = [model.period_rad * k / BLIND_TURNS for k in range(BLIND_TURNS)]
    return _different(out, model.period_rad)


def _different(turns: list[float], period_rad: float) -> list[float]:
    """Reduce angles to one period and drop those closer than `SAME_TURN_RAD` to an earlier one."""
    kept: list[float] = []
    for turn in turns:
        if all(abs((turn - t + 0.5 * period_rad) % period_rad - 0.5 * period_rad) > SAME_TURN_RAD for t in kept):
            kept.append(turn % period_rad)
    return kept


def _states(model: ComponentModel) -> list[float]:
    """Return the states to try: several for a part that slides along the panel, else one."""
    if model.motion != MotionKind.SLIDE:
        return [0.0]
    if abs(model.motion_axis[2]) > 0.5:
        return [float(np.clip(0.0, model.low, model.high))]
    return [float(s) for s in np.linspace(model.low, model.high, STATES)]


def _shifts(surface: ModelSurface, piece: Piece, turn: Array) -> list[Array]:
    """Return shifts (2,) to try: if only part of a long surface is visible, that may be either end or the middle."""
    side, a, b = _long_side(surface)
    spare = a - piece.half_m[0]
    if np.hypot(*side) < 0.5 or a < ELONGATED * b or spare < 0.15 * a:
        return [np.zeros(2)]
    direction = turn @ side
    return [k * spare * direction for k in (-1.0, 0.0, 1.0)]
