"""Feeling for the panel with every sense, and fusing it all into one pose."""

from __future__ import annotations

from collections.abc import Sequence

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
    SensingClass,
    Shape,
    ShapeEstimate,
    fuse,
    fuse_observations,
    unit,
)
from hal.geometry import UncertainPose
from service.operations.inspect import ensure_located
from service.operations.locate import Located, go_to_overview, locate, scan_plate
from service.operations.session import Session
from service.operations.touches import Felt, feel, mounts_of
from service.schema.fuse_request import BoxBody, CylinderBody, FeatureSetBody, FuseRequest, MeasurementBody
from service.schema.fuse_results import (
    AlternativePose,
    CertificateResult,
    FuseResult,
    MeasurementResult,
    ProvenSetResult,
    RejectedMeasurement,
    ShapeResult,
)
from service.schema.results import estimated, fields_of

ONE_IN = 1e5
NO_NOISE = 1e-9  # a chi-square a degree of freedom that no sensor's noise gives, in whatever unit


def fuse_and_remember(session: Session, observations: Sequence[Observation]) -> FusedObservations:
    """One pose from all observations; the cell believes it from now on."""
    fused = fuse_observations(
        observations,
        mounts_of(session, observations),
        lenses=session.one_sigma_lenses(),
        prior=session.believed_panel(),
    )
    session.world.believe_panel(fused.base_from_panel)
    return fused


def fused_result(answer: FusedObservations, felt: Felt) -> FuseResult:
    """The fused pose as reports and the API give it."""
    result = _answer(answer.base_from_panel, answer.fused, answer.measurements)
    return result.model_copy(update={"touching": felt.account})


def run_fuse(session: Session, request: FuseRequest) -> FuseResult:
    """The verb `fuse`: measurements that are given, or collected."""
    if request.collect:
        observations, felt = collect(session, request)
        return fused_result(fuse_and_remember(session, observations), felt)
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


def collect(session: Session, request: FuseRequest) -> tuple[tuple[Observation, ...], Felt]:
    """Look, scan, hover and touch: all observations, and what was felt."""
    ensure_located(session.part(0.0, 0.2))
    go_to_overview(session)
    found: Located = locate(session.part(0.2, 0.3))
    session.progress(0.3, "scan the plate")
    known: tuple[Observation, ...] = (*found.observations, scan_plate(session).observation)
    felt = feel(session.part(0.35, 1.0), request.touches, known, request.wanted.tolerance())
    return (*known, *felt.observations), felt


def light_observations(located: Sequence[Located]) -> tuple[PixelObservation, ...]:
    """The rays of several looks together."""
    return tuple(ray for found in located for ray in found.observations)


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
