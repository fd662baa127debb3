"""Bodies of the verbs, with units in the names; unknown keys and numbers that are not finite are refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from hal.geometry import UncertainPose, from_json
from hal.strict import Strict

if TYPE_CHECKING:
    from fusion import PoseTolerance

Vector3 = tuple[float, float, float]


def _of_a_length(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if sum(q * q for q in quaternion) < 1e-12:
        raise ValueError("a quaternion of zero length is not a rotation")
    return quaternion


Quaternion = Annotated[tuple[float, float, float, float], AfterValidator(_of_a_length)]
Row3 = tuple[Vector3, Vector3, Vector3]
Length = Annotated[float, Field(ge=-100.0, le=100.0)]
Point = tuple[Length, Length, Length]
ObjectName = Annotated[str, Field(min_length=1, max_length=41)]
ImageId = Annotated[str, Field(pattern=r"^[0-9a-f]{24}$")]
Side = Annotated[float, Field(gt=0.0, le=10.0)]
PlateSize = tuple[Side, Side]
LeastConfidence = Annotated[
    float,
    Field(
        ge=0.0,
        le=1.0,
        description="readings with a lower confidence are refused with a reason; 0 returns the best guess for every object",
        examples=[0.0, 0.9],
    ),
]
PixelNumber = Annotated[float, Field(ge=-1e5, le=1e5)]
Pixel = tuple[PixelNumber, PixelNumber]
PlateCorners = Annotated[
    tuple[Pixel, ...],
    Field(
        min_length=4,
        max_length=4,
        description="corners of the upright plate, in any order; if null, its border is looked for",
    ),
]
ANSWER_AT = 0.5  # the default of the readers
Distortion = Annotated[float, Field(ge=-100.0, le=100.0)]


class PoseBody(Strict):
    """A pose with its 6x6 covariance (list of rows) over (dx, dy, dz, rx, ry, rz), m and rad, parent axes."""

    translation_m: Point
    quaternion_xyzw: Quaternion
    covariance: Annotated[
        list[Annotated[list[float], Field(min_length=6, max_length=6)]], Field(min_length=6, max_length=6)
    ]

    def pose(self) -> UncertainPose:
        """Convert to an `UncertainPose`."""
        import numpy as np

        return UncertainPose(parent_from_child=from_json(self.model_dump()), covariance=np.array(self.covariance))


class PanelPoseRequest(Strict):
    """Locate the panel by its border lights; without lights by printed tags, its outline, or its objects' looks."""

    move: Annotated[
        bool, Field(description="drive to a view of the whole panel first; if false, the arm stays where it is")
    ] = True
    by: Annotated[
        Literal["lights", "tags", "outline", "looks"] | None,
        Field(description="only this way; if null, the lights, or else the first of the others that finds it"),
    ] = None
    scan: Annotated[bool, Field(description="also fit the plate's plane to a range image")] = False


class LensBody(Strict):
    """A camera's lens: pinhole with radial and tangential distortion (k1, k2, p1, p2, k3, as in OpenCV)."""

    fx_px: Annotated[float, Field(gt=0.0, le=1e6)]
    fy_px: Annotated[float, Field(gt=0.0, le=1e6)]
    cx_px: Annotated[float, Field(ge=-1e5, le=1e5)]
    cy_px: Annotated[float, Field(ge=-1e5, le=1e5)]
    distortion: tuple[Distortion, Distortion, Distortion, Distortion, Distortion] = (0.0, 0.0, 0.0, 0.0, 0.0)


class StoredLook(Strict):
    """Options for a stored image, which is used instead of a live camera; nothing moves then."""

    image: Annotated[
        ImageId | None, Field(description="id of a stored image (POST /v1/images); if null, the camera takes an image")
    ] = None
    panel: Annotated[ObjectName | None, Field(description="name of a taught panel; if null, the cell's own panel")] = (
        None
    )
    plate_m: Annotated[
        PlateSize | None, Field(description="width and height of the plate; if null, those of the panel")
    ] = None
    corners_px: PlateCorners | None = None
    camera: Annotated[
        ObjectName | None, Field(description="camera that takes the image, or that took the stored one")
    ] = None
    lens: Annotated[LensBody | None, Field(description="lens that took the stored image")] = None
    camera_from_panel: Annotated[
        PoseBody | None, Field(description="pose of the panel; if null, the panel's border is looked for")
    ] = None

    @model_validator(mode="after")
    def _is_of_one_kind(self) -> StoredLook:
        if self.image is None and (
            self.panel or self.plate_m or self.corners_px or self.lens or self.camera_from_panel
        ):
            raise ValueError("panel, plate_m, corners_px, lens and camera_from_panel need a stored `image`")
        if self.corners_px is not None and self.camera_from_panel is not None:
            raise ValueError("corners_px and camera_from_panel both say where the panel is: give one")
        if self.lens is not None and self.camera is not None:
            raise ValueError("give a lens or a camera's name, not both")
        if self.camera_from_panel is not None and self.lens is None and self.camera is None:
            raise ValueError("a pose needs the lens: give `lens` or `camera`")
        return self


class RecogniseRequest(StoredLook):
    """Find the objects of a panel file (`taught`) or of any panel (`blind`) in an image, or surfaces in a range image."""

    use: Annotated[tuple[Literal["vision", "range"], ...], Field(min_length=1)] = ("vision",)
    mode: Literal["taught", "blind"] = "taught"
    objects: Annotated[tuple[ObjectName, ...], Field(max_length=200)] | None = None
    move: bool = True
    least_confidence: LeastConfidence = ANSWER_AT

    @model_validator(mode="after")
    def _sees_what_it_uses(self) -> RecogniseRequest:
        if self.mode == "blind" and "least_confidence" in self.model_fields_set:
            raise ValueError("a blind answer lists every candidate with its confidence: leave out least_confidence")
        if self.image is not None and "range" in self.use:
            raise ValueError("a stored image has no range: use vision")
        return self


class InspectRequest(StoredLook):
    """Read instruments, lamps, switches and valves from close up, or in a stored image."""

    objects: Annotated[tuple[ObjectName, ...], Field(max_length=200)] | None = None
    close_up: Annotated[
        bool,
        Field(
            description="drive to close-ups, and to side views of unreadable objects; if false, read the overview only"
        ),
    ] = True
    least_confidence: LeastConfidence = ANSWER_AT


class LearnRequest(StoredLook):
    """Learn what the panel's objects look like, from a new or a stored overview."""

    move: Annotated[bool, Field(description="locate the panel and drive to the overview first")] = True


Touches = Annotated[
    int, Field(ge=0, le=12, description="largest number of touches; fewer are made when the pose is accurate enough")
]


class WantedPose(Strict):
    """The wanted accuracy of the panel's pose: one standard deviation over all axes. Touching ends when it is reached."""

    position_m: Annotated[float, Field(gt=0.0, le=1.0)] = 0.0015
    angle_rad: Annotated[float, Field(gt=0.0, le=1.0)] = 0.002

    def tolerance(self) -> PoseTolerance:
        """Convert to a `fusion.PoseTolerance`."""
        from fusion import PoseTolerance

        return PoseTolerance(position_m=self.position_m, angle_rad=self.angle_rad)


class ActionBody(Strict):
    """One action: `state` for levers, toggles, rotaries and buttons, `value` for sliders, `angle_rad` for handwheels."""

    object: ObjectName
    confirm: Annotated[
        ObjectName | None,
        Field(description="the object's name again, for a control that asks for it, such as an emergency mushroom"),
    ] = None
    state: Annotated[str, Field(max_length=41)] | None = None
    value: float | None = None
    angle_rad: Annotated[float, Field(ge=-100.0, le=100.0)] | None = None

    @model_validator(mode="after")
    def _has_at_most_one_target(self) -> ActionBody:
        if sum(target is not None for target in (self.state, self.value, self.angle_rad)) > 1:
            raise ValueError("give one of state, value and angle_rad")
        return self


class ManipulateRequest(ActionBody):
    """Operate one control and read back whether it reached its target."""

    verify: Annotated[
        bool, Field(description="look at the control afterwards; if false, only what the fingers feel can confirm it")
    ] = True


class CalibrationRequest(Strict):
    """Measure a sensor's mount, a lens, or the weight of the tool; the arm drives through the poses by itself."""

    what: Annotated[
        Literal["camera", "hand-eye", "scanner", "tool"],
        Field(
            description="`camera`: lens and mount; `hand-eye`: mount of a camera with a known lens; `scanner`: mount of the range "
            "scanner; `tool`: bias of the force/torque sensor, weight and centre of the tool"
        ),
    ]
    device: Annotated[ObjectName | None, Field(description="device to calibrate; if null, the first of its kind")] = (
        None
    )
    poses: Annotated[int, Field(ge=4, le=40, description="number of stations")] = 12
    dry_run: Annotated[bool, Field(description="only plan the stations; nothing moves and nothing is written")] = False


class EvaluateRequest(Strict):
    """Compare a finished mission's report with the simulator's truth (simulated cells only)."""

    mission: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,80}$")]


InstrumentKind = Literal["gauge", "dial", "display"]
MOST_PICTURES = 50


class ReadPhotographRequest(Strict):
    """Read one instrument in a stored photograph, or in several; kind, place and scale are found if they are not told."""

    image: Annotated[ImageId, Field(description="id of a stored image (POST /v1/images)")]
    further: Annotated[
        tuple[ImageId, ...],
        Field(
            max_length=MOST_PICTURES - 1,
            description="later pictures of the same instrument, oldest first; the answer is their mean, with the motion",
        ),
    ] = ()
    kind: Annotated[
        InstrumentKind | None,
        Field(
            description="gauge: scale over part of a turn; dial: full turn from straight up; display: seven segments; "
            "null: whichever is found anywhere in the picture"
        ),
    ] = None
    scale: Annotated[
        tuple[float, float] | None,
        Field(
            description="values at the ends of a gauge's or dial's scale, clockwise: the greater one first if they fall; "
            "null: a gauge's numerals tell them"
        ),
    ] = None
    ends_rad: Annotated[
        tuple[float, float] | None,
        Field(
            description="a gauge's pointer angles at the ends of the scale, clockwise from up; if null, read from its ticks"
        ),
    ] = None
    pointer: Annotated[
        Literal["black", "red"] | None,
        Field(
            description="which pointer is read if a red one stands beside another one; black is the one that is not red"
        ),
    ] = None
    unit: Annotated[
        str,
        Field(
            max_length=40,
            description="unit of the scale, repeated in the answer; if empty, the only legible one on a gauge's face",
        ),
    ] = ""
    is_scene: Annotated[bool, Field(description="the picture is not cropped to an instrument whose kind is told")] = (
        False
    )
    least_confidence: LeastConfidence = ANSWER_AT
