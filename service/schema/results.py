"""Answers of the verbs, as in a task's `result`, in reports and in the API document.

Lengths are metres, angles radians, forces newtons. A covariance is 6x6 over (dx, dy, dz, rx, ry, rz) in the parent's axes.
A field is null if it does not apply to the request.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from hal.calibration import CalibrationRecord
from hal.geometry import UncertainPose, to_json


def _plain(value: Any) -> Any:
    """Convert arrays and tuples of arrays to lists."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


Numbers = Annotated[list[float], BeforeValidator(_plain)]
Rows = Annotated[list[list[float]], BeforeValidator(_plain)]
Pictures = Annotated[list[str], Field(description="addresses of the task's pictures (PNG)")]


class Result(BaseModel):
    """Base class of every answer."""

    model_config = ConfigDict(frozen=True, from_attributes=True)


class Placement(Result):
    """A pose: translation and unit quaternion."""

    translation_m: Numbers
    quaternion_xyzw: Numbers


class EstimatedPose(Placement):
    """A pose with its covariance, and with the standard deviation of each axis."""

    covariance: Rows
    sigma_m: Numbers
    sigma_rad: Numbers


def estimated(pose: UncertainPose) -> EstimatedPose:
    """Convert a pose to the form of an answer."""
    sigma = np.sqrt(np.diag(pose.covariance))
    place = to_json(pose.parent_from_child)
    return EstimatedPose.model_validate(
        {**place, "covariance": pose.covariance, "sigma_m": sigma[:3], "sigma_rad": sigma[3:]}
    )


def fields_of(result: Result) -> dict[str, Any]:
    """Return the fields of an answer, for a model that extends it."""
    return {name: getattr(result, name) for name in type(result).model_fields}


PanelBy = Literal["lights", "tags", "outline", "looks"]

# -- panel-pose -------------------------------------------------------------------------------------------------------


class PlateInScanner(Result):
    """The plane of the plate in the scanner's frame."""

    point_m: Numbers
    normal: Numbers


class FittedPlate(PlateInScanner):
    """The plane of the plate with the scatter of the fitted points."""

    rms_m: float


class PanelCheck(Result):
    """What another way of finding the panel says in the same image."""

    way: PanelBy
    position_m: Annotated[
        float | None, Field(description="distance of its pose; null if it did not find the panel")
    ] = None
    angle_rad: float | None = None
    chi_square: Annotated[float | None, Field(description="of the difference, with 6 degrees of freedom")] = None
    contradicts: Annotated[bool, Field(description="the difference is too large for the stated errors of both")]
    finding: str


class FoundBy(Result):
    """The pose of the panel from the camera alone: how it was found, and what the other ways say."""

    way: PanelBy
    base_from_panel: EstimatedPose
    checks: list[PanelCheck]


class PanelPoseResult(FoundBy):
    """The pose of the panel from one pose of the camera."""

    chi_square: float
    degrees_of_freedom: int
    ambiguous: bool
    alternatives: int
    points_px: Annotated[dict[str, Numbers], Field(description="the lights, corners or rims that gave the pose")]
    plate_in_scanner: Annotated[PlateInScanner | None, Field(description="with `scan`")] = None


# -- recognise, inspect, learn ----------------------------------------------------------------------------------------


class PossibleNumber(Result):
    """A number that a refused display may show, with its probability."""

    text: str
    value: float
    probability: float


class ObjectResult(Result):
    """The reading of one object. A refused reading has a `reason` and neither value, state nor text."""

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
    """A possible object found by blind recognition; `reason` says why it was refused."""

    kind: str
    confidence: float
    centre_px: Numbers
    centre_m: Annotated[Numbers, Field(description="x, y on the plate, from its middle, y up")]
    place_m: Annotated[Numbers, Field(description="place of the object's most distinct part")]
    box_px: Rows
    distance: Annotated[float, Field(description="distance to the nearest look of this kind")]
    rival: Annotated[tuple[str, float], Field(description="the second nearest kind and its distance")]
    reason: str | None


class SurfaceResult(Result):
    """A surface of the range image."""

    label: int
    type: str
    primitive: Annotated[dict[str, Any] | None, Field(description="parameters of the surface, by its type")]
    pixels: int
    rms_m: float


class SurfaceSighting(Result):
    """The result of looking for an object by its surfaces; `why` says why it was not found."""

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
    surfaces: Annotated[dict[str, int] | None, Field(description="labels of its surfaces in the range image")] = None


class InspectResult(Result):
    """The readings of a panel's objects, the missing ones, and annotated pictures."""

    panel: Annotated[str | None, Field(description="name of the panel in a stored image")] = None
    objects: list[ObjectResult]
    missing: list[str]
    pictures: Pictures


class RangeFindings(Result):
    """The surfaces of a range image, and the objects that were found by their surfaces; null without `use` range."""

    surfaces: list[SurfaceResult] | None = None
    plate: Annotated[int | None, Field(description="label of the panel's plate among the surfaces")] = None
    by_surfaces: list[SurfaceSighting] | None = None
    no_plate: Annotated[str | None, Field(description="why the plate was not found")] = None
    range_picture: str | None = None


class RecogniseResult(RangeFindings):
    """Objects of the panel file or candidates of blind recognition, and surfaces of the range image."""

    panel: Annotated[str | None, Field(description="name of the panel in a stored image")] = None
    objects: list[ObjectResult] | None = None
    missing: list[str] | None = None
    candidates: Annotated[list[CandidateResult] | None, Field(description="with mode `blind`")] = None
    pictures: Pictures | None = None


class LearnResult(Result):
    """What was learned from an overview: new looks by kind, objects by name, and the changed files."""

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
    """A station of a calibration: the pose of the flange, and the joint angles if only the wrist turns."""

    joints_rad: Numbers | None = None


class CalibrationChange(Result):
    """The differences between the new record and the previous one; null for values that a record does not have."""

    moved_m: float | None = None
    turned_rad: float | None = None
    focal_px: float | None = None
    mass_kg: float | None = None


class CalibrationResult(Result):
    """The record that was measured and stored; with `dry_run` only the planned stations."""

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
    """The best guess of a refused reading."""

    value: float | None
    uncertainty: float | None
    text: str | None


class PhotographPointer(Result):
    """One of several pointers of a gauge in a photograph."""

    colour: Annotated[str, Field(description="black, white or red")]
    length: Annotated[float, Field(description="from the middle to the tip, as a share of the face's radius")]
    value: Annotated[float, Field(description="where it points, in `unit`")]


class PhotographScale(Result):
    """What was taken for the scale of a gauge in a photograph."""

    minimum: float
    maximum: float
    at_min_rad: Annotated[float, Field(description="pointer angle at the minimum, clockwise from up")]
    at_max_rad: Annotated[float, Field(description="pointer angle at the maximum, clockwise from up")]


class PhotographFace(Result):
    """Where the round face of an instrument is in a photograph, px: a circle, or an ellipse if it is seen aslant."""

    middle: tuple[float, float]
    right: Annotated[tuple[float, float], Field(description="from the middle to where a pointer to the right ends")]
    up: Annotated[tuple[float, float], Field(description="from the middle to where a pointer straight up ends")]


class PhotographMotion(Result):
    """How a reading changes over several pictures, in `unit`."""

    values: Annotated[tuple[float | None, ...], Field(description="in each picture; null where it was not read")]
    amplitude: Annotated[float, Field(description="half of their range about the trend")]
    trend: Annotated[float, Field(description="mean change from one picture to the next")]


class PhotographReading(Result):
    """The reading of an instrument in a photograph, or the reason why it cannot be read.

    `confidence` is the probability that the reading is right; for a refused reading, that its guess is right.
    """

    kind: Annotated[str | None, Field(description="gauge, dial or display; null if it was not told and none is found")]
    answered: bool
    value: Annotated[
        float | None,
        Field(description="value in `unit`, over several pictures their mean; for a display, its text as a number"),
    ]
    unit: str
    uncertainty: Annotated[float | None, Field(description="one standard deviation of `value`")]
    text: Annotated[str | None, Field(description="text of a display")]
    confidence: float
    reason: Annotated[str | None, Field(description="why there is no answer, and what would help")]
    guess: PhotographGuess | None
    pointers: Annotated[
        tuple[PhotographPointer, ...], Field(description="the pointers of a gauge that has more than one; else empty")
    ] = ()
    scale: Annotated[PhotographScale | None, Field(description="what was taken for the scale; null for a display")] = (
        None
    )
    face: Annotated[
        PhotographFace | None, Field(description="where a gauge's or a dial's face was found, in the last picture")
    ] = None
    motion: Annotated[PhotographMotion | None, Field(description="over several pictures; null for a single one")] = None
