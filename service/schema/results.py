"""Answers of the verbs, as they stand in a task's `result`, in reports and in the API document.

Lengths are metres, angles radians, forces newtons. A covariance is 6x6 over (dx, dy, dz, rx, ry, rz) in the parent's axes.
A field is null where it does not apply to what was asked.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field
from scipy.spatial.transform import RigidTransform

from hal.calibration import CalibrationRecord
from hal.geometry import UncertainPose, to_json


def _plain(value: Any) -> Any:
    """Lists for arrays and tuples of arrays."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


Numbers = Annotated[list[float], BeforeValidator(_plain)]
Rows = Annotated[list[list[float]], BeforeValidator(_plain)]
Pictures = Annotated[list[str], Field(description="addresses of the task's pictures (PNG)")]


class Result(BaseModel):
    """Base of every answer."""

    model_config = ConfigDict(frozen=True, from_attributes=True)


class Placement(Result):
    """Where something is: translation and unit quaternion."""

    translation_m: Numbers
    quaternion_xyzw: Numbers


def _placed(value: Any) -> Any:
    return to_json(value) if isinstance(value, RigidTransform) else value


PlacementField = Annotated[Placement, BeforeValidator(_placed)]


class EstimatedPose(Placement):
    """A pose with its covariance, and one standard deviation of each axis for people."""

    covariance: Rows
    sigma_m: Numbers
    sigma_rad: Numbers


def estimated(pose: UncertainPose) -> EstimatedPose:
    """A pose as an answer has it."""
    sigma = np.sqrt(np.diag(pose.covariance))
    place = to_json(pose.parent_from_child)
    return EstimatedPose.model_validate(
        {**place, "covariance": pose.covariance, "sigma_m": sigma[:3], "sigma_rad": sigma[3:]}
    )


def fields_of(result: Result) -> dict[str, Any]:
    """The fields of an answer, for one that has them and more."""
    return {name: getattr(result, name) for name in type(result).model_fields}


# -- panel-pose -------------------------------------------------------------------------------------------------------


class PlateInScanner(Result):
    """The plate's plane in the scanner's frame."""

    point_m: Numbers
    normal: Numbers


class FittedPlate(PlateInScanner):
    """The plate's plane with the scatter of the points that it was fitted to."""

    rms_m: float


class PanelPoseResult(Result):
    """Where the panel stands, by its four lights."""

    base_from_panel: EstimatedPose
    chi_square: Annotated[float, Field(description="of the fit, on 2 degrees of freedom")]
    ambiguous: bool
    alternatives: int
    lights_px: dict[str, Numbers]
    plate_in_scanner: Annotated[PlateInScanner | None, Field(description="with `scan`")] = None


# -- recognise, inspect, learn ----------------------------------------------------------------------------------------


class PossibleNumber(Result):
    """A number that what is seen of a refused display allows, with its probability."""

    text: str
    value: float
    probability: float


class ObjectResult(Result):
    """What one object of a panel file shows. A refusal has a `reason` and neither value, state nor text."""

    name: str
    kind: str
    present: bool
    value: float | None
    unit: str
    uncertainty: Annotated[float | None, Field(description="one standard deviation of `value`")]
    state: str | None
    text: str | None
    confidence: float
    reason: str | None
    possible: list[PossibleNumber]
    centre_px: Numbers
    centre_in_panel_m: Numbers | None = None
    centre_in_base_m: Numbers | None = None


class CandidateResult(Result):
    """A place where an object of some kind may be; `reason` says why it is refused."""

    kind: str
    confidence: float
    centre_px: Numbers
    centre_m: Annotated[Numbers, Field(description="on the plate, from its middle, y up")]
    place_m: Annotated[Numbers, Field(description="the part of the object that shows best")]
    box_px: Rows
    distance: Annotated[float, Field(description="to the likeliest look")]
    rival: Annotated[tuple[str, float], Field(description="the next kind and its distance")]
    reason: str | None


class SurfaceResult(Result):
    """A surface of the range image."""

    label: int
    type: str
    primitive: Annotated[dict[str, Any] | None, Field(description="parameters of the surface, by its type")]
    pixels: int
    rms_m: float


class SurfaceSighting(Result):
    """An object of the panel file that was looked for by its surfaces; `why` says why it was not found."""

    name: str
    kind: str
    found: bool
    why: str | None = None
    base_from_object: EstimatedPose | None = None
    off_panel_file_m: float | None = None
    state: float | None = None
    state_sigma: float | None = None
    seen: Annotated[float | None, Field(description="share of its pixels where the range image agrees with it")] = None
    score: float | None = None
    surfaces: Annotated[dict[str, int] | None, Field(description="its surfaces among those of the image")] = None


class InspectResult(Result):
    """What the objects of a panel show, which of them are not there, and annotated pictures."""

    panel: Annotated[str | None, Field(description="of a stored image")] = None
    objects: list[ObjectResult]
    missing: list[str]
    pictures: Pictures


class RecogniseResult(Result):
    """Objects of the panel file, or candidates of a blind look, and surfaces of the range image, as asked."""

    panel: Annotated[str | None, Field(description="of a stored image")] = None
    objects: list[ObjectResult] | None = None
    missing: list[str] | None = None
    candidates: Annotated[list[CandidateResult] | None, Field(description="of mode `blind`")] = None
    pictures: Pictures | None = None
    surfaces: Annotated[list[SurfaceResult] | None, Field(description="with `use` range")] = None
    plate: Annotated[int | None, Field(description="label of the panel's plate among the surfaces")] = None
    by_surfaces: list[SurfaceSighting] | None = None
    no_plate: Annotated[str | None, Field(description="why the plate was not found")] = None
    range_picture: str | None = None


class LearnResult(Result):
    """What an overview taught: looks by kind, objects by name, and the files of the kinds that changed."""

    panel: str
    added: dict[str, int]
    taught_by: list[str]
    left_out: dict[str, str]
    known_before: list[str]
    known_now: list[str]
    files: list[str]
    pictures: Pictures = []


# -- fuse -------------------------------------------------------------------------------------------------------------


class MeasurementResult(Result):
    """How one measurement agrees with the answer; `value` is its squared distance in sigmas on `dof`."""

    label: str
    sensor: str
    sensing: str
    value: float
    dof: int
    rejected: bool
    reason: str | None


class RejectedMeasurement(Result):
    """A measurement that was not used; index -1 is the prior."""

    index: int
    label: str
    value: float
    reason: str


class AlternativePose(EstimatedPose):
    """Another pose that the measurements allow; `odds` relative to the answer."""

    odds: float
    rejected: list[int]


class CertificateResult(Result):
    """What the relaxation proves: `tight` means that no other pose fits the same measurements better."""

    tight: bool
    gap: float
    lower_bound: float
    value: float
    distance_sigmas: float
    base_from_object: PlacementField


class ProvenSetResult(Result):
    """Which measurements to believe, by branch and bound; `gap` is what the deadline left undecided."""

    believed: list[int]
    cost: float
    lower_bound: float
    gap: float
    proven: bool
    agrees: bool
    nodes: int
    base_from_object: PlacementField


class ShapeResult(Result):
    """The object's own measures, which were estimated with its pose, m."""

    names: list[str]
    values: Numbers
    sigma: Numbers
    covariance: Rows


class TouchResult(Result):
    """What a touched place was expected to bring, and what it brought.

    Attributes:
        spot_m: the place, panel frame.
        error_before, error_expected, error_after: mean square error of the pose in units of the wanted one: before the
            touch, as expected after it, and after it with the readings that really came.
        words: the same as a sentence.
    """

    spot_m: Numbers
    error_before: float
    error_expected: float
    error_after: float
    words: str


class TouchingResult(Result):
    """The places touched in order, those that could not be touched and why, and why touching ended."""

    touches: list[TouchResult]
    skipped: list[str]
    ended: str


class FuseResult(EstimatedPose):
    """The fused pose (`base_from_object`), and how each measurement agrees with it."""

    chi_square: float
    dof: int
    warnings: list[str]
    ambiguous: bool
    unobservable: Annotated[list[str], Field(description="motions that the measurements leave free, in words")]
    measurements: list[MeasurementResult]
    rejected: list[RejectedMeasurement]
    alternatives: list[AlternativePose]
    certificate: CertificateResult | None
    proven_set: ProvenSetResult | None
    shape: ShapeResult | None
    touching: Annotated[TouchingResult | None, Field(description="when the cell collected the measurements itself")] = (
        None
    )


# -- manipulate, missions ---------------------------------------------------------------------------------------------


class ReadingResult(Result):
    """What one object showed at one look of a mission; `shows` is the same in words."""

    name: str
    kind: str
    present: bool
    shows: str
    value: float | None
    unit: str
    uncertainty: float | None
    state: str | None
    text: str | None
    confidence: float
    reason: str | None
    when: str


class ActionResult(Result):
    """One control that was worked: what was asked, what the skill reports, and what a second look showed."""

    object: str
    skill: str
    target: str
    outcome: str
    detail: str
    before: str
    after: str
    confirmed: bool
    attempts: int
    peak_force_n: float
    cell_s: float


class ManipulateResult(Result):
    """The action, and a picture of the second look."""

    action: ActionResult
    pictures: Pictures


class MissionResult(Result):
    """How a mission ended; `report` is the address of its report, null when it could not be written."""

    mission: str
    succeeded: bool
    report: str | None
    actions: list[ActionResult]
    fused: FuseResult | None
    cell_s: float
    wall_s: float


class ObjectPlace(Result):
    """An object in 3-D: its middle in the base frame, m."""

    name: str
    kind: str
    centre_in_base_m: Numbers


class SurfaceCheck(Result):
    """What the surfaces of one object say beside layout and vision.

    Attributes:
        agrees: place and state agree; null when it was not found.
        centre_in_base_m: (3,) its middle on the plate, base frame.
        off_m: along the plate, from its place in the panel file under the panel's newest pose; `sigma_m` one standard
            deviation of that, `chi_square` its square in sigmas on two degrees of freedom. Null when it was not found.
        off_vision_m: along the plate, from where the newest image has it.
        shows, vision_shows: its state by surfaces, and by vision.
        finding: all that as a sentence.
    """

    name: str
    kind: str
    seen_from: str
    found: bool
    agrees: bool | None
    centre_in_base_m: tuple[float, float, float] | None
    off_m: float | None
    sigma_m: float | None
    chi_square: float | None
    off_vision_m: float | None
    shows: str | None
    vision_shows: str | None
    stands_elsewhere: bool
    finding: str


# -- calibrations -----------------------------------------------------------------------------------------------------


class StationResult(Placement):
    """A pose of the flange that a calibration would measure from; joint angles where the wrist is turned in place."""

    joints_rad: Numbers | None = None


class CalibrationChange(Result):
    """How far the new record is from the one before; null for what a record does not hold."""

    moved_m: float | None = None
    turned_rad: float | None = None
    focal_px: float | None = None
    mass_kg: float | None = None


class CalibrationResult(Result):
    """The record that was measured and kept; with `dry_run` only the stations that would be measured from."""

    what: str
    device: str
    dry_run: bool
    stations: list[StationResult] | None = None
    record: CalibrationRecord | None = None
    path: str | None = None
    change: CalibrationChange | None = None
    pictures: Pictures | None = None
    in_use_from: str | None = None


# -- judge ------------------------------------------------------------------------------------------------------------


class ReadingClaim(Result):
    """What a report says of a reading, and what was true."""

    name: str
    what: str
    claimed: str
    truth: str
    right: bool


class ActionClaim(ReadingClaim):
    """The same of an action; `reached`: the control really stands where it was asked to."""

    reached: bool


class UnaskedMotion(Result):
    """Something that moved although nobody worked it."""

    name: str
    truth: str


class EvaluateResult(Result):
    """A mission's report against the simulator's truth."""

    pose_error_m: float | None
    pose_error_rad: float | None
    pose_error: Numbers | None = None
    mahalanobis: float | None
    inside_95: bool | None
    claims: list[ActionClaim | ReadingClaim]
    readings_right: int
    readings_given: int
    actions_confirmed: int
    agrees: bool
    moved_unasked: list[UnaskedMotion]
    peak_force_n: float
    sim_time_s: float


class PhotographGuess(Result):
    """What a refusal would have said."""

    value: float | None
    uncertainty: float | None
    text: str | None


class PhotographReading(Result):
    """What an instrument in a photograph shows, or why that cannot be told.

    `confidence` is the expected share of right answers among such readings; of a refusal, that its guess is right.
    """

    kind: str
    answered: bool
    value: Annotated[float | None, Field(description="in `unit`; of a display, the number that its text is")]
    unit: str
    uncertainty: Annotated[float | None, Field(description="one standard deviation of `value`")]
    text: Annotated[str | None, Field(description="what a display shows")]
    confidence: float
    reason: Annotated[str | None, Field(description="why there is no answer, and what would help")]
    guess: PhotographGuess | None
