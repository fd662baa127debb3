"""The answer of `fuse`: the pose, and the agreement of each measurement with it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field
from scipy.spatial.transform import RigidTransform

from hal.geometry import UncertainPose, to_json
from service.schema.results import EstimatedPose, Numbers, Placement, Result, Rows, estimated, fields_of

if TYPE_CHECKING:
    from fusion import FusedPose, Measurement, ShapeEstimate


def _placed(value: Any) -> Any:
    return to_json(value) if isinstance(value, RigidTransform) else value


PlacementField = Annotated[Placement, BeforeValidator(_placed)]


class MeasurementResult(Result):
    """The agreement of one measurement with the pose; `value` is chi-square with `dof` degrees of freedom."""

    label: str
    sensor: str
    sensing: str
    value: float
    dof: int
    rejected: bool
    reason: str | None


class RejectedMeasurement(Result):
    """A measurement that was not used; index -1 is the prior pose."""

    index: int
    label: str
    value: float
    reason: str


class AlternativePose(EstimatedPose):
    """Another pose that the measurements allow; `odds` is its probability relative to the answer."""

    odds: float
    rejected: list[int]


class CertificateResult(Result):
    """The result of the relaxation; `tight` means proof that no other pose fits the same measurements better."""

    tight: bool
    gap: float
    lower_bound: float
    value: float
    distance_sigmas: float
    base_from_object: PlacementField


class ProvenSetResult(Result):
    """The best set of measurements by branch and bound; `gap` is the difference of the bounds at the deadline."""

    believed: list[int]
    cost: float
    lower_bound: float
    gap: float
    proven: bool
    agrees: bool
    nodes: int
    base_from_object: PlacementField


class ShapeResult(Result):
    """The object's dimensions, which were estimated together with its pose, m."""

    names: list[str]
    values: Numbers
    sigma: Numbers
    covariance: Rows


class TouchResult(Result):
    """The expected and the real gain of a touched place.

    Attributes:
        spot_m: the place, panel frame.
        error_before, error_expected, error_after: mean square error of the pose in units of the wanted accuracy:
            before the touch, as expected after it, and with the readings of the touch.
        words: the same as text.
    """

    spot_m: Numbers
    error_before: float
    error_expected: float
    error_after: float
    words: str


class TouchingResult(Result):
    """The touched places in order, those that could not be touched and why, and why touching ended."""

    touches: list[TouchResult]
    skipped: list[str]
    ended: str


class FuseResult(EstimatedPose):
    """The fused pose (`base_from_object`), and the agreement of each measurement with it."""

    chi_square: float
    dof: int
    warnings: list[str]
    ambiguous: bool
    unobservable: Annotated[
        list[str], Field(description="motions of the object that the measurements do not determine, in words")
    ]
    measurements: list[MeasurementResult]
    rejected: list[RejectedMeasurement]
    alternatives: list[AlternativePose]
    certificate: CertificateResult | None
    proven_set: ProvenSetResult | None
    shape: ShapeResult | None
    touching: Annotated[
        TouchingResult | None, Field(description="the touches, if the cell collected the measurements itself")
    ] = None


def answer_of(pose: UncertainPose, fused: FusedPose, measurements: Sequence[Measurement]) -> FuseResult:
    """Return the fused pose in the form of reports and the API; `pose` is that pose in the caller's frames."""
    rejected = {r.index: r for r in fused.rejected}
    return FuseResult(
        **fields_of(estimated(pose)),
        chi_square=fused.chi_square,
        dof=fused.dof,
        warnings=_warnings(fused),
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


def _warnings(fused: FusedPose) -> list[str]:
    """Return warnings about a result that is probably wrong."""
    if not fused.agrees_too_well:
        return []
    return [
        f"the measurements agree far better than their covariances say (chi-square {fused.chi_square:.2g} with {fused.dof} "
        "degrees of freedom): check that they are in m^2 and not in mm^2, and that they describe single readings"
    ]


def _shape_result(shape: ShapeEstimate) -> ShapeResult:
    return ShapeResult(
        names=list(shape.names),
        values=shape.values.tolist(),
        sigma=np.sqrt(np.diag(shape.covariance)).tolist(),
        covariance=shape.covariance.tolist(),
    )
