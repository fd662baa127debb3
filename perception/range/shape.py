"""The visible shape of each region: where its middle is, how large it is, how long, and what of its rim is its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.range.analyse import RangeScene
from perception.range.claim import bucket
from perception.range.primitives import Plane

Array = NDArray[np.float64]

OCCLUDED_SHARE = 0.1
NEARER_PITCHES = 2.0  # a neighbour nearer by more than this many pixel pitches hides the rest of the region
LEAST_RIM = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegionShape:
    """Visible part of one surface, sensor frame, metres.

    Attributes:
        centre_m: (3,) mean of its points.
        area_m2: visible area, slant corrected for planes.
        long_axis: (3,) unit direction of largest extent; `elongation` its extent over the next.
        rim_m: (N, 3) points of the region's own rim, without those beside something nearer.
        occluded: whether a noteworthy part of the rim is somebody else's edge.
    """

    centre_m: Array
    area_m2: float
    long_axis: Array
    elongation: float
    rim_m: Array
    occluded: bool

    def long_axis_angle(self, anchor_direction: Array | None = None) -> float:
        """Angle of the long axis in the x-y plane, modulo half a turn; towards `anchor_direction` when given."""
        axis = self.long_axis
        if anchor_direction is not None and axis @ anchor_direction < 0:
            axis = -axis
        return float(np.arctan2(axis[1], axis[0]))


def shapes_of(scene: RangeScene, depth_m: Array) -> dict[int, RegionShape]:
    """The shape of every surface of the scene, by label."""
    depth = np.where(np.isfinite(depth_m), depth_m, np.nan)
    points = scene.sensor.points(depth)
    count = len(scene.surfaces)
    starts, indices = bucket(scene.labels, count)
    rim, hidden = _rims(scene.labels, depth, NEARER_PITCHES * scene.sensor.pitch_m(float(np.nanmedian(depth))))
    out = {}
    for surface in scene.surfaces:
        mine = indices[starts[surface.label] : starts[surface.label + 1]]
        out[surface.label] = _shape(surface.primitive, points, mine, rim, hidden, scene)
    return out


def _shape(
    primitive: object,
    points: Array,
    mine: NDArray[np.int32],
    rim: NDArray[np.bool_],
    hidden: NDArray[np.bool_],
    scene: RangeScene,
) -> RegionShape:
    P = points.reshape(-1, 3)[mine]
    P = P[np.isfinite(P[:, 2])]
    centre = np.median(P, axis=0) if len(P) < 3 else P.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov(P.T) if len(P) > 3 else np.eye(3) * 1e-12)
    own = mine[rim.ravel()[mine] & ~hidden.ravel()[mine]]
    rim_count = max(int(rim.ravel()[mine].sum()), 1)
    pitch = scene.sensor.pitch_m(float(centre[2]))
    facing = 1.0
    if isinstance(primitive, Plane):
        ray = centre / np.linalg.norm(centre) if scene.sensor.packed()[0] > 0 else np.array([0.0, 0.0, 1.0])
        facing = max(abs(float(primitive.normal @ ray)), 0.1)
        centre = (
            primitive.point_m
            + (centre - primitive.point_m)
            - primitive.normal * (primitive.normal @ (centre - primitive.point_m))
        )
    return RegionShape(
        centre_m=centre,
        area_m2=len(mine) * pitch**2 / facing,
        long_axis=vectors[:, 2],
        elongation=float(np.sqrt(max(values[2], 1e-18) / max(values[1], 1e-18))),
        rim_m=points.reshape(-1, 3)[own],
        occluded=len(own) < (1.0 - OCCLUDED_SHARE) * rim_count,
    )


def _rims(labels: NDArray[np.int32], depth: Array, nearer_m: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(H, W) pixels beside another label, and those beside something clearly nearer."""
    rim, hidden = np.zeros(labels.shape, bool), np.zeros(labels.shape, bool)
    for axis in (0, 1):
        for shift in (1, -1):
            other = np.roll(labels, shift, axis)
            rim |= other != labels
            # Two pixels away, because the pixel between may be a mixed one.
            beyond = np.roll(depth, 2 * shift, axis)
            with np.errstate(invalid="ignore"):
                hidden |= beyond < depth - nearer_m
    return rim, hidden


def disc_centre(shape: RegionShape, radius_m: float) -> Array | None:
    """Centre (3,) of a disc from its own rim, however much of it is hidden; None when the rim is too short.

    Circle of free radius by algebraic least squares in the plane of the points, then a robust refit; the radius is
    held near `radius_m` when the rim spans little of the circle.
    """
    P = shape.rim_m[np.isfinite(shape.rim_m[:, 2])] if len(shape.rim_m) else shape.rim_m
    if len(P) < LEAST_RIM:
        return None
    mean = P.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((P - mean).T))
    u, v = vectors[:, 2], vectors[:, 1]
    a, b = (P - mean) @ u, (P - mean) @ v
    weight = np.ones(len(P))
    x = np.array([(shape.centre_m - mean) @ u, (shape.centre_m - mean) @ v, radius_m])
    for _ in range(12):
        d = np.hypot(a - x[0], b - x[1]) + 1e-12
        e = d - x[2]
        scale = max(1.4826 * float(np.median(np.abs(e))), 1e-5)
        weight = 1.0 / (1.0 + (e / (2.0 * scale)) ** 2)
        J = np.stack([-(a - x[0]) / d, -(b - x[1]) / d, -np.ones_like(d)], axis=1)
        H = (J * weight[:, None]).T @ J + np.diag([1e-9, 1e-9, PRIOR_WEIGHT])
        g = (J * weight[:, None]).T @ e + np.array([0.0, 0.0, PRIOR_WEIGHT * (x[2] - radius_m)])
        x = x - np.linalg.solve(H, g)
    if abs(x[2] - radius_m) > 0.35 * radius_m:
        return None
    return np.asarray(mean + x[0] * u + x[1] * v)


PRIOR_WEIGHT = 1.0  # of the known radius, in rim points
