"""Answers of the verbs, as they stand in a task's `result`, in reports and in the API document.

Lengths are metres, angles radians, forces newtons. A covariance is 6x6 over (dx, dy, dz, rx, ry, rz) in the parent's axes.
A field is null where it does not apply to what was asked.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

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


# -- photographs -------------------------------------------------------------------------------------------------------


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
