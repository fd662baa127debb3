"""Answers of `manipulate`, `missions` and `judge`, which are also part of reports."""

from __future__ import annotations

from typing import Literal

from service.schema.fuse_results import FuseResult
from service.schema.results import Numbers, Pictures, Result

REPORTING = "write the report"
"""The step of a mission's task from which on nothing moves any more."""


class ReadingResult(Result):
    """One reading of an object during a mission; `shows` is the same as text."""

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
    """One control that was operated: the target, the report of the skill, and the readings before and after.

    `peak_force_n` is the largest contact force over the whole deed, `impulse_n_s` its integral over the time in contact,
    and `chatter_n` the root mean square of its change from one control tick to the next while in contact. `detail` says
    why a deed was not done, and whether the panel has moved.
    """

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
    impulse_n_s: float = 0.0
    chatter_n: float = 0.0
    cell_s: float


class ManipulateResult(Result):
    """The action, and a picture of the read-back."""

    action: ActionResult
    pictures: Pictures


class ObjectDepth(Result):
    """Distance of an object's rim from the plate by two or more images, in comparison with the panel file.

    Attributes:
        views: how many images show its rim; `parallax_rad` is the largest angle between two lines of sight.
        depth_m: of the middle of the rim, along the panel's normal, with the standard deviation `sigma_m`; null if it could
            not be measured. `stated_m` is the value of the panel file.
        chi_square: of the difference, with one degree of freedom.
        contradicts: whether such a difference arises by chance in less than one case of 10,000.
        finding: the result as a sentence.
    """

    name: str
    kind: str
    views: int
    parallax_rad: float | None = None
    depth_m: float | None = None
    sigma_m: float | None = None
    stated_m: float
    chi_square: float | None = None
    contradicts: bool = False
    finding: str


class StepResult(Result):
    """How a step of a mission ended; `path` is its name, after those of the steps that it belongs to.

    `taken over` is a step that the mission before had finished.
    """

    path: str
    kind: str
    outcome: Literal["done", "taken over", "skipped", "failed"]
    detail: str = ""


class PlannedStation(Result):
    """A place to which a planned mission drives, the time of the way there, and why there is none; from the place before.

    `problem` is null where there is a way that is free of collisions; `flange_m` has points of it, those of the flange from
    the arm's base, in order.
    """

    step: str
    what: str
    way_s: float | None
    problem: str | None
    flange_m: list[list[float]] = []


class MissionPlan(Result):
    """What a mission would do: its stations in order, and the time on the cell's clock.

    `contact_s` is an estimate for the work at the controls, whose length depends on what the hand feels. Conditions are
    taken as met, and a step that may run several times is planned once; `located` says whether the panel's pose has been
    measured, or is the one that the cell file expects.
    """

    stations: list[PlannedStation]
    is_possible: bool
    located: bool
    ways_s: float
    contact_s: float
    expected_s: float


class MissionResult(Result):
    """The result of a mission; `report` is the address of its report, null when it could not be written.

    `depths` compares the objects' depths with the panel file; an entry that `contradicts` is a warning. `plan` is the answer
    to a dry run, which does nothing else.
    """

    mission: str
    succeeded: bool
    report: str | None
    actions: list[ActionResult]
    fused: FuseResult | None
    depths: list[ObjectDepth]
    steps: list[StepResult] = []
    plan: MissionPlan | None = None
    cell_s: float
    wall_s: float


class ObjectPlace(Result):
    """The position of an object: its middle in the base frame, m."""

    name: str
    kind: str
    centre_in_base_m: Numbers


class SurfaceCheck(Result):
    """Comparison of one object's surfaces with the panel file and with vision.

    Attributes:
        agrees: whether place and state agree; null when the object was not found.
        centre_in_base_m: (3,) the object's middle on the plate, base frame.
        off_m: distance along the plate from the place in the panel file, with the panel's newest pose; null when the
            object was not found.
        sigma_m, chi_square: one standard deviation of `off_m`, and chi-square with two degrees of freedom.
        off_vision_m: distance along the plate from the place in the newest image.
        shows, vision_shows: the state by surfaces, and by vision.
        finding: all of this as text.
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
    """A reading in a report, and the truth."""

    name: str
    what: str
    claimed: str
    truth: str
    right: bool


class ActionClaim(ReadingClaim):
    """An action in a report, and the truth; `reached` means that the control truly reached its target."""

    reached: bool


class UnaskedMotion(Result):
    """An object whose state changed although it was not operated."""

    name: str
    truth: str


class EvaluateResult(Result):
    """Comparison of a mission's report with the simulator's truth."""

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
