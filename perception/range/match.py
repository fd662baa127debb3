"""Finding the components of a model library in an analysed scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from hal.geometry import UncertainPose
from perception.range.analyse import RangeScene
from perception.range.features import plane_feature
from perception.range.models import ComponentModel, ModelSurface, MotionKind
from perception.range.primitives import Cone, Cylinder, Ellipsoid, Plane, Sphere, Surface, SurfaceType
from perception.range.shape import RegionShape, disc_centre, shapes_of

Array = NDArray[np.float64]

DIRECTION_TOLERANCE_RAD = 0.15
GATE = 3.0  # deviations beyond this many tolerances refuse a pairing
ROUND_TYPES = {SurfaceType.SPHERE, SurfaceType.ELLIPSOID}  # small caps of either may be fitted as the other
UNMATCHED_COST = 2.0  # of an optional surface that the pose predicts and nothing answers
BASE_GAIN = 12.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Match:
    """A component found.

    Attributes:
        model: name of the model.
        sensor_from_object: pose and covariance; where `free` names a direction its variance is what one turn allows.
        labels: model surface name to surface label of the scene.
        state: position of the moving part along or about `motion_axis` (m or rad); None without one.
        state_sigma: its standard deviation.
        free: directions that the data do not fix, e.g. "turn about z".
        score: higher is surer; the sum of the surfaces' gains less what was predicted and not seen.
    """

    model: str
    sensor_from_object: UncertainPose
    labels: dict[str, int]
    state: float | None
    state_sigma: float | None
    free: tuple[str, ...]
    score: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Item:
    """A scene surface in the panel frame: what pairing compares."""

    surface: Surface
    shape: RegionShape
    point: Array
    direction: Array
    size: float
    size_sigma: float
    height_sigma: float


def match_models(
    scene: RangeScene, depth_m: Array, models: Sequence[ComponentModel], *, panel: Surface | None = None
) -> tuple[Match, ...]:
    """Components on a panel, best first; each scene surface belongs to at most one.

    Args:
        scene: result of `analyse`.
        depth_m: (H, W) the image that the scene came from.
        panel: the plane that components stand on; the scene's largest plane by default.

    Raises:
        NotFound: no panel is given and the scene shows no plane.
    """
    base = panel or scene.largest_plane()
    sensor_from_panel = _panel_frame(base)
    shapes = shapes_of(scene, depth_m)
    items = [_item(s, shapes[s.label], sensor_from_panel) for s in scene.surfaces if s.label != base.label]
    proposals = [p for model in models for p in _proposals(model, items)]
    proposals.sort(key=lambda p: -p.score)
    taken: set[int] = set()
    out = []
    for proposal in proposals:
        labels = {item.surface.label for _, item in proposal.pairs}
        if taken & labels:
            continue
        taken |= labels
        out.append(_finished(proposal, scene, base, sensor_from_panel))
    return tuple(out)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Proposal:
    model: ComponentModel
    origin: Array
    yaw: float
    yaw_sigma: float
    pairs: tuple[tuple[ModelSurface, _Item], ...]
    score: float
    state: float | None


def _panel_frame(base: Surface) -> RigidTransform:
    """Panel frame in the sensor: z the outward normal, x the sensor's x laid into the plane."""
    plane = base.primitive
    assert isinstance(plane, Plane)  # noqa: S101 - `largest_plane` and the caller give planes
    z = plane.normal
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    return RigidTransform.from_components(plane.point_m, Rotation.from_matrix(R))


def _item(surface: Surface, shape: RegionShape, sensor_from_panel: RigidTransform) -> _Item:
    p = surface.primitive
    direction = np.zeros(3)
    if isinstance(p, Plane):
        point, direction, size = shape.centre_m, p.normal, float(np.sqrt(shape.area_m2 / np.pi))
    elif isinstance(p, Sphere):
        point, size = p.centre_m, p.radius_m
    elif isinstance(p, Ellipsoid):
        point, size = p.centre_m, float(np.cbrt(np.prod(p.radii_m)))
    elif isinstance(p, Cylinder):
        # The middle of what is seen, moved onto the axis.
        point, direction, size = p.point_m + p.axis * (p.axis @ (shape.centre_m - p.point_m)), p.axis, p.radius_m
    else:
        point, direction, size = p.apex_m, p.axis, 0.0
    panel_from_sensor = sensor_from_panel.inv()
    up = sensor_from_panel.rotation.as_matrix()[:, 2]
    C = surface.covariance
    round_one = isinstance(p, Sphere | Ellipsoid)
    size_sigma = float(np.sqrt(np.max(np.diag(C)[3:]))) if round_one else 0.0
    height_sigma = float(np.sqrt(up @ C[:3, :3] @ up)) if round_one else 0.0
    return _Item(
        surface=surface,
        shape=shape,
        point=panel_from_sensor.apply(point),
        direction=panel_from_sensor.rotation.apply(direction),
        size=size,
        size_sigma=size_sigma,
        height_sigma=height_sigma,
    )


def _proposals(model: ComponentModel, items: list[_Item]) -> list[_Proposal]:
    out = []
    for item in items:
        gain = _likeness(model, model.anchor, item)
        if gain is None:
            continue
        best = None
        for yaw, sigma in _yaws(model, item, items):
            proposal = _completed(model, item, items, yaw=yaw, yaw_sigma=sigma, anchor_gain=gain)
            if proposal is not None and (best is None or proposal.score > best.score):
                best = proposal
        if best is not None:
            out.append(best)
    return out


def _likeness(model: ComponentModel, want: ModelSurface, item: _Item) -> float | None:
    """Gain of taking `item` for `want` judged by what no pose changes: type, size, height, tilt; None if refused."""
    have = item.surface.type
    if have != want.type and not {have, want.type} <= ROUND_TYPES:
        return None
    cost = 0.0
    if want.type == SurfaceType.CONE:
        shape = item.surface.primitive
        assert isinstance(shape, Cone)  # noqa: S101 - the type was compared above
        cost += (abs(shape.half_angle_rad - want.half_angle_rad) / DIRECTION_TOLERANCE_RAD) ** 2
    else:
        short = item.shape.occluded and want.type == SurfaceType.PLANE and item.size < want.size_m
        size_tolerance = float(np.hypot(want.tolerance_m, item.size_sigma))
        if short:
            size_tolerance = max(size_tolerance, 0.4 * want.size_m)
        if have != want.type:
            size_tolerance = max(size_tolerance, 0.6 * want.size_m)  # a shallow cap fits a larger ball than it is
        cost += ((item.size - want.size_m) / size_tolerance) ** 2
    if want.type != SurfaceType.CONE:
        low, high = _height_range(model, want)
        outside = max(low - item.point[2], item.point[2] - high, 0.0)
        height_tolerance = float(np.hypot(want.tolerance_m, item.height_sigma))
        if have != want.type:
            height_tolerance = max(height_tolerance, 0.6 * want.size_m)
        cost += (outside / height_tolerance) ** 2
    if np.any(want.direction):
        tilt = np.arccos(np.clip(abs(want.direction[2]), 0.0, 1.0))
        found = np.arccos(np.clip(abs(item.direction[2]), 0.0, 1.0))
        cost += ((found - tilt) / DIRECTION_TOLERANCE_RAD) ** 2
    return None if cost > GATE**2 else BASE_GAIN - cost


def _height_range(model: ComponentModel, want: ModelSurface) -> tuple[float, float]:
    height = float(want.point_m[2])
    if not want.moves or model.motion != MotionKind.SLIDE:
        return height, height
    rise = float(model.motion_axis[2])
    ends = sorted((height + rise * model.low, height + rise * model.high))
    return ends[0], ends[1]


def _yaws(model: ComponentModel, anchor: _Item, items: list[_Item]) -> list[tuple[float, float]]:
    """Turns about the panel normal worth trying, with their standard deviation."""
    if model.symmetric:
        return [(0.0, np.pi / np.sqrt(3.0))]
    out = []
    for want in model.surfaces:
        lying = float(np.hypot(want.direction[0], want.direction[1]))
        for item in items:
            if float(np.hypot(*(item.point - anchor.point)[:2])) > _reach(model):
                continue
            if _likeness(model, want, item) is None:
                continue
            if lying > 0.2:
                found = np.arctan2(item.direction[1], item.direction[0])
                turn = found - np.arctan2(want.direction[1], want.direction[0])
                out += [(float(turn), 0.02), (float(turn + np.pi), 0.02)]
            elif want.type == SurfaceType.PLANE and item.shape.elongation > 1.5:
                out.append((item.shape.long_axis_angle(anchor_direction=None), 0.03))
    return [(_wrapped(t), s) for t, s in out] or [(0.0, np.pi / np.sqrt(3.0))]


def _reach(model: ComponentModel) -> float:
    travel = max(abs(model.low), abs(model.high)) if model.motion == MotionKind.SLIDE else 0.0
    return 0.03 + travel + max(float(np.linalg.norm(s.point_m[:2])) for s in model.surfaces)


def _wrapped(angle: float) -> float:
    return float(np.arctan2(np.sin(angle), np.cos(angle)))


def _completed(
    model: ComponentModel, anchor: _Item, items: list[_Item], *, yaw: float, yaw_sigma: float, anchor_gain: float
) -> _Proposal | None:
    """Pair the other surfaces with what the pose predicts; None when a required one is missing."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    first = model.anchor
    origin = anchor.point - turn @ first.point_m
    origin[2] = 0.0
    pairs, score = [(first, anchor)], anchor_gain
    used = {anchor.surface.label}
    for want in model.surfaces:
        if want is first:
            continue
        found = _best_partner(model, want, items, used, place=origin + turn @ want.point_m, turn=turn)
        if found is None:
            if want.required:
                return None
            score -= UNMATCHED_COST
            continue
        gain, item = found
        pairs.append((want, item))
        used.add(item.surface.label)
        score += gain
    return _Proposal(
        model=model,
        origin=origin,
        yaw=yaw,
        yaw_sigma=yaw_sigma,
        pairs=tuple(pairs),
        score=score,
        state=_state(model, pairs, origin, turn, yaw),
    )


def _best_partner(
    model: ComponentModel, want: ModelSurface, items: list[_Item], used: set[int], *, place: Array, turn: Array
) -> tuple[float, _Item] | None:
    best = None
    slack = 0.004 + 2.0 * want.tolerance_m
    if model.motion == MotionKind.SLIDE and model.motion_axis[2] < 0.5:
        slack += model.high - model.low
    direction = turn @ want.direction
    for item in items:
        if item.surface.label in used:
            continue
        gain = _likeness(model, want, item)
        if gain is None:
            continue
        away = item.point - place
        if want.type == SurfaceType.CYLINDER:
            away = away - direction * (direction @ away)  # where along its axis a cylinder was seen says nothing
        if want.type == SurfaceType.CONE:
            away = away * [1.0, 1.0, 0.0]  # the apex of a frustum is known well across its axis only
        if np.linalg.norm(away) > slack:
            continue
        if np.any(direction) and abs(float(direction @ item.direction)) < np.cos(3.0 * DIRECTION_TOLERANCE_RAD):
            continue
        gain -= (float(np.linalg.norm(away)) / slack) ** 2
        if best is None or gain > best[0]:
            best = (gain, item)
    return best


def _state(
    model: ComponentModel, pairs: list[tuple[ModelSurface, _Item]], origin: Array, turn: Array, yaw: float
) -> float | None:
    """Where the moving part stands: shift along the axis, or the turn itself."""
    if model.motion == MotionKind.NONE:
        return None
    if model.motion == MotionKind.TURN:
        period = model.high - model.low
        return float((yaw - model.low) % period + model.low)
    axis = turn @ model.motion_axis
    moving = [axis @ (item.point - origin - turn @ want.point_m) for want, item in pairs if want.moves]
    still = [axis @ (item.point - origin - turn @ want.point_m) for want, item in pairs if not want.moves]
    if abs(model.motion_axis[2]) > 0.5 or not still:
        return float(np.mean(moving)) if moving else None
    return float(np.mean(moving) - np.mean(still)) if moving else None


def _finished(proposal: _Proposal, scene: RangeScene, base: Surface, sensor_from_panel: RigidTransform) -> Match:
    model = proposal.model
    pose, sigma_place = _placed(proposal, scene, sensor_from_panel)
    labels = {want.name: item.surface.label for want, item in proposal.pairs}
    free = ("turn about z",) if model.symmetric else ()
    state_sigma = None
    if proposal.state is not None:
        state_sigma = proposal.yaw_sigma if model.motion == MotionKind.TURN else sigma_place
        if model.motion == MotionKind.SLIDE and abs(model.motion_axis[2]) > 0.5:
            state_sigma = float(np.hypot(0.0002, plane_feature(base).sigma_point_m))
    return Match(
        model=model.name,
        sensor_from_object=UncertainPose(
            parent_from_child=pose, covariance=_covariance(base, pose, sigma_place, proposal.yaw_sigma)
        ),
        labels=labels,
        state=proposal.state,
        state_sigma=state_sigma,
        free=free,
        score=proposal.score,
    )


def _placed(proposal: _Proposal, scene: RangeScene, sensor_from_panel: RigidTransform) -> tuple[RigidTransform, float]:
    """Pose with the in-plane place averaged over all pairs that fix it, and the standard deviation of that place."""
    pitch = scene.sensor.pitch_m(float(sensor_from_panel.translation[2]))
    turn = Rotation.from_euler("z", proposal.yaw)
    places, weights = [], []
    for want, item in proposal.pairs:
        if want.moves and proposal.model.motion == MotionKind.SLIDE and abs(proposal.model.motion_axis[2]) < 0.5:
            continue
        place, sigma = _place_of(item, want, pitch, sensor_from_panel)
        if place is None:
            continue
        places.append(place[:2] - turn.apply(want.point_m)[:2])
        weights.append(1.0 / sigma**2)
    xy = np.average(places, axis=0, weights=weights) if places else proposal.origin[:2]
    sigma = float(1.0 / np.sqrt(np.sum(weights))) if weights else pitch
    panel_from_object = RigidTransform.from_components(np.array([xy[0], xy[1], 0.0]), turn)
    return sensor_from_panel * panel_from_object, sigma


def _place_of(
    item: _Item, want: ModelSurface, pitch: float, sensor_from_panel: RigidTransform
) -> tuple[Array | None, float]:
    """Where a surface puts its own reference point in the panel, and how well it knows it; None if it does not."""
    if item.surface.type == SurfaceType.CYLINDER:
        return None, np.inf
    if item.surface.type == SurfaceType.PLANE:
        if item.shape.elongation < 1.5:
            centre = disc_centre(item.shape, want.size_m)
            if centre is not None:
                return sensor_from_panel.inv().apply(centre), 0.25 * pitch
        return item.point, 0.5 * pitch
    sigma = float(np.sqrt(np.trace(item.surface.covariance[:3, :3]) / 3.0))
    return item.point, float(np.hypot(sigma, 0.1 * pitch))


def _covariance(base: Surface, pose: RigidTransform, sigma_place: float, yaw_sigma: float) -> Array:
    """6x6 in sensor axes: place in the plane, height and tilts of the panel's plane, turn about its normal."""
    feature = plane_feature(base)
    n = feature.direction
    C = np.zeros((6, 6))
    C[:3, :3] = sigma_place**2 * (np.eye(3) - np.outer(n, n)) + feature.point_covariance
    # A tilt of the normal d = w x n is a turn w across it.
    C[3:, 3:] = np.cross(np.cross(n, feature.direction_covariance, axisb=0).T, n, axisa=1) * -1.0
    C[3:, 3:] = 0.5 * (C[3:, 3:] + C[3:, 3:].T) + yaw_sigma**2 * np.outer(n, n)
    del pose
    return C
