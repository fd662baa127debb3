"""Feeling for the panel with every sense, and fusing it all into one pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from fusion import (
    Box,
    Cylinder,
    Feature,
    FeatureSet,
    FusedObservations,
    FusedPose,
    Kind,
    Measurement,
    MovingPart,
    Observation,
    PixelObservation,
    ProximityObservation,
    SensingClass,
    Shape,
    ShapeEstimate,
    TouchObservation,
    fuse,
    fuse_observations,
    unit,
)
from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import MotionError, NotFound, Stopped
from hal.geometry import UncertainPose
from manipulation import SkillFailure, proximity_probe, touch_probe
from service.operations.acquisition import settle
from service.operations.doubted_proximity import DoubtedProximity
from service.operations.inspect import ensure_located
from service.operations.locate import Located, go_to_overview, locate, scan_plate
from service.operations.session import Session
from service.operations.spots import bare_spots
from service.operations.tours import short_tour
from service.operations.travel import skill_context
from service.schema.requests import BoxBody, CylinderBody, FeatureSetBody, FuseRequest, MeasurementBody
from service.schema.results import (
    AlternativePose,
    CertificateResult,
    FuseResult,
    MeasurementResult,
    ProvenSetResult,
    RejectedMeasurement,
    ShapeResult,
    estimated,
    fields_of,
)

HOVER_M = 0.05  # of the finger tips above the plate while the proximity sensors look
LEAST_TOUCHES = 3
ONE_IN = 1e5
NO_NOISE = 1e-9  # a chi-square a degree of freedom that no sensor's noise gives, in whatever unit
REST_S = 0.02  # two readings of a proximity sensor
SPARE_SPOTS = 2  # a spot that the arm cannot reach is replaced


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Felt:
    """What the fingers found: observations, and the spots (panel frame, m) that gave it."""

    observations: tuple[Observation, ...]
    spots: tuple[Array, ...]
    skipped: tuple[str, ...]


def feel(session: Session, touches: int) -> Felt:
    """Hover over and touch bare places of the plate.

    Raises:
        NotFound: fewer than three places could be touched; says why.
        Stopped: somebody stopped the cell.
    """
    observations: list[Observation] = []
    spots: list[Array] = []
    skipped: list[str] = []
    doubted = DoubtedProximity(session.panel)
    wanted = bare_spots(session.panel, touches + SPARE_SPOTS)
    first = short_tour(_fingers_over_panel(session), wanted[:touches])
    for spot in wanted[[*first, *range(touches, len(wanted))]]:
        if len(spots) == touches:
            break
        session.progress(len(spots) / touches, "touch the plate", f"at ({spot[0]:.3f}, {spot[1]:.3f}) m")
        try:
            observations += _feel_at(session, spot, doubted)
            spots.append(spot)
        except Stopped:
            raise  # no spot is at fault
        except (SkillFailure, MotionError) as failure:
            skipped.append(f"({spot[0]:.3f}, {spot[1]:.3f}) m: {failure}")
    if len(spots) < LEAST_TOUCHES:
        raise NotFound(
            f"only {len(spots)} of {touches} places of the plate could be touched: {'; '.join(skipped)}",
            hint="is the panel where the lights say? is something in the way?",
        )
    return Felt(observations=tuple(observations), spots=tuple(spots), skipped=tuple(skipped))


def mounts_of(session: Session, observations: Sequence[Observation]) -> dict[str, UncertainPose]:
    """`flange_from_sensor` of every sensor that gave observations."""
    return {sensor: session.mount(sensor) for sensor in sorted({o.sensor for o in observations})}


def fuse_and_remember(session: Session, observations: Sequence[Observation]) -> FusedObservations:
    """One pose from all observations; the cell believes it from now on."""
    lenses = {
        camera: record.one_sigma_lenses()
        for camera in session.cell.names_of(DeviceKind.CAMERA)
        if (record := session.cell.calibration_of(camera).intrinsics) is not None
    }
    fused = fuse_observations(
        observations, mounts_of(session, observations), lenses=lenses, prior=session.believed_panel()
    )
    session.world.believe_panel(fused.base_from_panel)
    return fused


def fused_result(answer: FusedObservations) -> FuseResult:
    """The fused pose as reports and the API give it."""
    return _answer(answer.base_from_panel, answer.fused, answer.measurements)


def run_fuse(session: Session, request: FuseRequest) -> FuseResult:
    """The verb `fuse`: measurements that are given, or collected."""
    if request.collect:
        observations = collect(session, request.touches)
        return fused_result(fuse_and_remember(session, observations))
    measurements = [_measurement(body) for body in request.measurements]
    prior = request.prior.pose() if request.prior is not None else None
    fused = fuse(
        measurements,
        prior=prior,
        shape=shape_of(request.shape) if request.shape is not None else None,
        certify=request.certify,
        prove_set_within_s=request.prove_set_within_s,
    )
    return _answer(fused.base_from_object, fused, measurements)


def collect(session: Session, touches: int) -> tuple[Observation, ...]:
    """Look, scan, hover and touch."""
    ensure_located(session.part(0.0, 0.2))
    go_to_overview(session)
    found: Located = locate(session.part(0.2, 0.3))
    session.progress(0.3, "scan the plate")
    plane = scan_plate(session)
    felt = feel(session.part(0.35, 1.0), touches)
    return (*found.observations, plane.observation, *felt.observations)


def light_observations(located: Sequence[Located]) -> tuple[PixelObservation, ...]:
    """The rays of several looks together."""
    return tuple(ray for found in located for ray in found.observations)


def _fingers_over_panel(session: Session) -> Array:
    """(2,) panel point that the finger tips are over."""
    context = skill_context(session)
    tip = context.mover.state().base_from_flange * context.flange_from_grip
    return np.asarray(context.panel_pose.inv().apply(tip.translation)[:2])


def _feel_at(session: Session, spot: Array, doubted: DoubtedProximity) -> list[Observation]:
    context = skill_context(session)
    place = (float(spot[0]), float(spot[1]), 0.0)
    observations: list[Observation] = []
    proximities = session.cell.names_of(DeviceKind.PROXIMITY)
    names = [name for name in proximities if session.has_mount(name)]
    of = {name: session.connection.device(name).capabilities() for name in names}
    mounts = [session.mount(name).parent_from_child for name in names]
    hovered = context.mover.state()
    if names:
        sigma_m = max(each.sigma_m for each in of.values())
        points = proximity_probe(
            context, place, flange_from_sensors=mounts, distance_m=HOVER_M, samples=5, sigma_m=sigma_m
        )
        hovered = context.mover.state()
        flange = hovered.base_from_flange
        for point in points:
            name = _whose(names, mounts, flange, point.base_from_sensor)
            observations.append(
                ProximityObservation(
                    sensor=name,
                    base_from_flange=flange,
                    distance_m=point.distance_m,
                    sigma_m=point.sigma_m,
                    label=f"{name} at ({spot[0]:.3f}, {spot[1]:.3f})",
                )
            )
    touched = touch_probe(context, place)
    settle(session, REST_S)
    for name, mount in zip(names, mounts, strict=True):
        k = proximities.index(name)
        doubted.check(
            name,
            of[name],
            [(state.base_from_flange * mount, state.proximity_m[k]) for state in (hovered, context.mover.state())],
            base_from_panel=context.panel_pose,
            touched_m=touched.point_m,
        )
    base_from_grip = touched.report.base_from_tool
    tip = base_from_grip.inv().apply(touched.point_m)
    normal_sigma = float(np.sqrt(touched.normal @ touched.covariance @ touched.normal))
    observations.append(
        TouchObservation(
            sensor=session.first(DeviceKind.GRIPPER),
            base_from_flange=base_from_grip * context.flange_from_grip.inv(),
            tip_m=tip,
            sigma_m=normal_sigma,
            label=f"touch at ({spot[0]:.3f}, {spot[1]:.3f})",
        )
    )
    return observations


def _whose(names: Sequence[str], mounts: Sequence[Any], flange: Any, base_from_sensor: Any) -> str:
    """Which sensor stood there: the probe leaves out sensors that saw nothing."""
    gaps = [np.linalg.norm((flange * mount).translation - base_from_sensor.translation) for mount in mounts]
    return names[int(np.argmin(gaps))]


def _measurement(body: MeasurementBody) -> Measurement:
    """What fusion takes, from a request's measurement."""
    cls = SensingClass.named(body.sensing)
    kinds = list(Kind)
    feature = Feature(kind=kinds[(cls - 1) % 3], point_m=np.array(body.x_m), direction=np.array(body.u), name="")
    return Measurement(
        cls=cls,
        x_m=feature.point_m,
        u=feature.direction,
        mu_m=np.array(body.mu_m),
        C_m2=np.array(body.c_m2),
        M=np.array(body.m_per_rad2),
        label=body.label,
        sensor=body.sensor,
        part=body.part,
    )


def shape_of(body: CylinderBody | BoxBody | FeatureSetBody) -> Shape:
    """The family of objects that a request describes.

    Raises:
        InvalidRequest: a line or plane without direction.
    """
    match body:
        case CylinderBody():
            return Cylinder(radius_m=body.radius_m, length_m=body.length_m, sigma_m=body.sigma_m)
        case BoxBody():
            return Box(size_m=body.size_m, sigma_m=body.sigma_m)
    names = tuple(p.name for p in body.parameters)
    return FeatureSet(
        names=names,
        start=np.array([p.start_m for p in body.parameters]),
        sigma=np.array([p.sigma_m for p in body.parameters]),
        moving={
            part.name: MovingPart(
                feature=Feature(
                    kind=Kind(part.feature),
                    point_m=np.array(part.point_m),
                    direction=unit(part.direction),
                    name=part.name,
                ),
                slopes=np.array([part.slopes.get(name, (0.0, 0.0, 0.0)) for name in names]),
            )
            for part in body.parts
        },
    )


def _answer(pose: UncertainPose, fused: FusedPose, measurements: Sequence[Measurement]) -> FuseResult:
    rejected = {r.index: r for r in fused.rejected}
    return FuseResult(
        **fields_of(estimated(pose)),
        chi_square=fused.chi_square,
        dof=fused.dof,
        warnings=warnings_of(fused.chi_square, fused.dof),
        ambiguous=fused.is_ambiguous,
        unobservable=[direction.words for direction in fused.unobservable],
        measurements=[
            MeasurementResult(
                label=m.label,
                sensor=m.sensor,
                sensing=m.cls.words,
                value=float(fused.values[i]),
                dof=m.dof,
                rejected=i in rejected,
                reason=rejected[i].reason if i in rejected else None,
            )
            for i, m in enumerate(measurements)
        ],
        rejected=[RejectedMeasurement.model_validate(r) for r in fused.rejected],
        alternatives=[
            AlternativePose(
                **fields_of(estimated(UncertainPose(parent_from_child=a.pose, covariance=a.covariance))),
                odds=a.odds,
                rejected=list(a.rejected),
            )
            for a in fused.alternatives
        ],
        certificate=None if fused.certificate is None else CertificateResult.model_validate(fused.certificate),
        proven_set=None if fused.proven_set is None else ProvenSetResult.model_validate(fused.proven_set),
        shape=None if fused.shape is None else _shape_result(fused.shape),
    )


def warnings_of(chi_square: float, dof: int) -> list[str]:
    """What a caller should look at although there is an answer.

    Noise of the stated size agrees so well less than once in `ONE_IN` times; variances in mm^2 that are taken for m^2 make
    the chi-square a million times too small. Examples drawn by hand agree exactly and are not meant.
    """
    if dof < 1 or chi_square < NO_NOISE * dof or chi2.cdf(chi_square, dof) * ONE_IN > 1.0:
        return []
    return [
        f"the measurements agree far better than their covariances say (chi-square {chi_square:.2g} with {dof} degrees of "
        "freedom): are these in m^2, not in mm^2, and of one reading?"
    ]


def _shape_result(shape: ShapeEstimate) -> ShapeResult:
    return ShapeResult(
        names=list(shape.names),
        values=shape.values.tolist(),
        sigma=np.sqrt(np.diag(shape.covariance)).tolist(),
        covariance=shape.covariance.tolist(),
    )
