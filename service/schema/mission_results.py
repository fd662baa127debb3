"""Answers of `manipulate`, `missions` and `judge`, which reports keep, too."""

from __future__ import annotations

from service.schema.fuse_results import FuseResult
from service.schema.results import Numbers, Pictures, Result


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
