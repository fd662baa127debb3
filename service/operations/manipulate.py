"""The verb `manipulate`: determines the target of an action, runs the skill of the kind, and reads the result back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import (
    CellError,
    DeviceError,
    MotionError,
    NotFound,
    PerceptionError,
    Stopped,
    Unreachable,
)
from hal.panel import PanelObject, Shown
from manipulation import ObjectState, Outcome, SkillReport, Verify, free_hand, operate
from perception.vision import ObjectReading, said
from service.feasibility import target_of, text_of
from service.operations.acquisition import camera_over_panel
from service.operations.inspect import ensure_located, look_close, look_past, tell
from service.operations.locate import OFF_PLACE_M, ensure_space_is_known, look_again
from service.operations.session import Session
from service.operations.travel import park, skill_context
from service.report.plots import png_of
from service.report.record import Picture
from service.schema.mission_results import ActionResult, ManipulateResult
from service.schema.requests import ActionBody, ManipulateRequest

SAME_PLACE_M = 0.002  # a camera that is nearer to the axis of a control looks at it
BESIDE_M = 0.05  # from the place of a first look to that of a second one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Deed:
    """A control that was operated: the skill's report, and the readings before and after."""

    action: ActionResult
    report: SkillReport
    before: ObjectReading | None
    after: ObjectReading | None
    picture: Picture | None


def work(session: Session, body: ActionBody, *, verify: bool = True) -> Deed:
    """Operate one control and read back whether it reached its target.

    Raises:
        InvalidRequest: the object cannot be operated, or has no such state or value.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    panel_object = session.panel.object(body.object)
    target = target_of(panel_object, body)
    ensure_located(session)  # a panel that was not found after the deed before is looked for once more
    free_hand(skill_context(session))
    ensure_space_is_known(session)
    eye = _Eye(session, panel_object, verify)
    before, findings = _look_first(session, eye, panel_object)
    session.observer.told(eye.witness.name, text_of(panel_object, target))
    report = _operate(session, eye, panel_object, target, before)
    if not report.is_done or eye.is_off_its_place or report.was_missed:
        report, found = _after_doubt(session, eye, panel_object, target, report)
        findings += found
    return Deed(
        action=ActionResult(
            object=panel_object.name,
            skill=report.skill,
            target=text_of(panel_object, target),
            outcome=str(report.outcome),
            detail="; ".join([*findings, *([] if report.is_done else [report.cause])]),
            before="not read" if before is None else said(before),
            after=_after(report) if eye.last is None else said(eye.last),
            confirmed=report.is_done,
            attempts=report.attempts,
            peak_force_n=report.peak_force_n,
            impulse_n_s=report.force.impulse_n_s,
            chatter_n=report.force.chatter_n,
            cell_s=report.duration_s,
        ),
        report=report,
        before=before,
        after=eye.last,
        picture=eye.picture,
    )


def refused_action(panel_object: PanelObject, body: ActionBody, refusal: CellError) -> ActionResult:
    """Return the account of an action that was not begun; its outcome is the type of the error."""
    return ActionResult(
        object=panel_object.name,
        skill=panel_object.kind,
        target=text_of(panel_object, target_of(panel_object, body)),
        outcome=refusal.type_name,
        detail=f"{refusal.what}; {refusal.hint}",
        before="not read",
        after="not read",
        confirmed=False,
        attempts=0,
        peak_force_n=0.0,
        cell_s=0.0,
    )


def _after(report: SkillReport) -> str:
    """Return what is known of a control that was not looked at afterwards."""
    seen = report.seen
    return "not read" if seen is None or seen.state is None else f"{seen.state} (felt)"


def _operate(
    session: Session, eye: _Eye, panel_object: PanelObject, target: str | float, now: ObjectReading | None
) -> SkillReport:
    current = None if now is None else object_state(now, eye.witness)
    if current is not None:
        current = replace(current, turned_rad=session.world.turned_rad.get(panel_object.name))
    context = replace(skill_context(session), is_in_place=lambda: not eye.is_off_its_place)
    eye.forget()  # from now on the control may stand anywhere, also after a device that fails in the stroke
    report = operate(context, panel_object, target, current=current, verify=eye.verify())
    if panel_object.turns_round and report.reached is not None:
        session.world.note_turned(panel_object.name, report.reached)
    return report


def _look_first(session: Session, eye: _Eye, panel_object: PanelObject) -> tuple[ObjectReading | None, list[str]]:
    """Return what the control shows before the deed, and whether the panel has moved since it was located.

    Raises:
        NotFound: the panel, or the control on it, is not where it should be.
    """
    before = eye.before(is_fresh=session.record is None)
    if not eye.is_off_its_place:
        return before, []
    shift = look_again(session, panel_object)
    if shift is not None:
        before = eye.before(is_fresh=True)
    if eye.is_missing:
        raise NotFound(
            f"{eye.witness.name} is not where the file of panel {session.panel.name!r} says",
            hint="check the panel file, and that nothing hides the object",
            objects=[eye.witness.name],
        )
    return before, [] if shift is None else [shift.finding]


def _after_doubt(
    session: Session, eye: _Eye, panel_object: PanelObject, target: str | float, report: SkillReport
) -> tuple[SkillReport, list[str]]:
    """Look whether the panel has moved; if so, name it, and try a deed that has not succeeded once more.

    A control whose state is not known is tried again only if the hand has missed it, because a second stroke might undo
    the first. What was seen of a panel that has moved was seen where it stood before, so it is looked at again.
    """
    if report.outcome is Outcome.UNREACHABLE:
        return report, []
    try:
        shift = look_again(session, panel_object)
    except (PerceptionError, Unreachable) as error:
        return report, [f"the panel was not found again afterwards: {error.what}"]
    if shift is None or (report.is_done and eye.last is None):  # what was felt holds wherever the panel stands
        return report, [] if shift is None else [shift.finding]
    now = eye.before(is_fresh=True)
    if report.is_done and now is not None and _shows(eye.witness, now, target):
        return report, [shift.finding]
    if report.is_done:
        cause = f"the panel has moved, and a look at its new place does not show {text_of(panel_object, target)}"
        return replace(report, outcome=Outcome.UNVERIFIED, cause=cause), [shift.finding]
    is_unknown = report.outcome is Outcome.UNVERIFIED and report.seen is None
    if report.outcome is not Outcome.MISSED and (now is None or is_unknown):
        return report, [shift.finding]
    ensure_space_is_known(session)
    again = _operate(session, eye, panel_object, target, now)
    both = replace(
        again,
        attempts=report.attempts + again.attempts,
        started_s=report.started_s,
        peak_force_n=max(report.peak_force_n, again.peak_force_n),
        motions=(*report.motions, *again.motions),
    )
    return both, [shift.finding]


def _shows(witness: PanelObject, reading: ObjectReading, target: str | float) -> bool:
    goal = Shown(state=target) if isinstance(target, str) else Shown(value=target)
    return witness.is_right(Shown(value=reading.value, state=reading.state), goal)


def run_manipulate(session: Session, request: ManipulateRequest) -> ManipulateResult:
    """Run the verb `manipulate`."""
    ensure_located(session.part(0.0, 0.3))
    session.progress(0.3, f"work {request.object}")
    try:
        deed = work(session.part(0.3, 1.0), request, verify=request.verify)
    except (DeviceError, MotionError) as error:
        _leave_after(session, error)
        raise
    pictures = []
    if deed.picture is not None:
        pictures.append(session.context.task.artefact("after.png", deed.picture.png, "image/png"))
    return ManipulateResult(action=deed.action, pictures=pictures)


def _leave_after(session: Session, error: CellError) -> None:
    """Park the arm after an error of a deed, and add to the error why it could not be parked.

    An arm that has failed itself is not moved, and neither is one that was stopped.
    """
    if isinstance(error, Stopped) or error.details.get("device") in session.cell.names_of(DeviceKind.ARM):
        return
    try:
        park(session)
    except CellError as second:
        error.details["not_parked"] = second.what


class _Eye:
    """Reads one control back through its witness, the object that shows its state; keeps the last reading."""

    def __init__(self, session: Session, panel_object: PanelObject, is_open: bool) -> None:
        self._session = session
        self._panel_object = panel_object
        self._is_open = is_open
        self.witness = session.panel.object(panel_object.shown_by)
        self.last: ObjectReading | None = None
        self.picture: Picture | None = None
        self.is_off_its_place = False  # the last look did not show the panel where its pose has it
        self.is_missing = False  # the last look did not show the witness
        self._at = f"before {panel_object.name}"  # which part of the work a look belongs to

    def before(self, *, is_fresh: bool) -> ObjectReading | None:
        """Return what the witness shows before the action: the newest reading, or a new one if wanted or needed."""
        known = self._session.world.readings.get(self.witness.name)
        if not self._is_open or (known is not None and not is_fresh):
            return known
        return self._look() or known

    def verify(self) -> Verify | None:
        """Return the skill's read-back function; None when no read-back is wanted."""
        return self._verify if self._is_open else None

    def forget(self) -> None:
        """Forget what was read before the action."""
        self._session.world.forget_reading(self.witness.name)
        self._session.world.forget_reading(self._panel_object.name)

    def _verify(self) -> ObjectState | None:
        self.forget()
        self._at = f"after {self._panel_object.name}"
        self.last = self._look()
        return None if self.last is None else object_state(self.last, self.witness)

    def _station_m(self) -> Array:
        """Return the panel point to look at: the witness, or a point beside it where the camera looks at the witness already.

        A second look has errors of its own only from another place. That place is nearer to the middle of the panel, where
        the arm reaches it.
        """
        at_m = np.array(self.witness.point_m)
        if np.linalg.norm((camera_over_panel(self._session) - at_m)[:2]) > SAME_PLACE_M:
            return at_m
        angle_rad = np.arctan2(-at_m[1], -at_m[0])
        return at_m + BESIDE_M * np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])

    def _look(self) -> ObjectReading | None:
        self.is_off_its_place = self.is_missing = False
        try:
            straight = look_close(self._session, self._station_m(), (self.witness.name,))
            self.is_missing = not straight.readings[self.witness.name].present
            self.is_off_its_place = self.is_missing or straight.offset_m > OFF_PLACE_M
            found = look_past(self._session, straight)
        except PerceptionError:
            self.is_off_its_place = True
            return None  # an inconclusive read-back makes the outcome `unverified`
        except Unreachable:
            return None
        self.picture = Picture(
            name=f"after-{self._panel_object.name}",
            title=f"read-back of {self.witness.name}",
            png=png_of(found.pictures[-1].pixels),
        )
        reading = found.readings[self.witness.name]
        record = self._session.record
        mission = "" if record is None else record.mission
        if record is not None:
            record.crops |= found.crops()
        tell(self._session, [reading], found, mission=mission, phase=self._at)
        return reading if reading.present and reading.answered else None


def object_state(reading: ObjectReading, panel_object: PanelObject) -> ObjectState:
    """Convert a reading to the object state that skills use."""
    angle_rad = panel_object.angle_of(Shown(value=reading.value, state=reading.state))
    sigma = 0.0 if reading.uncertainty is None else reading.uncertainty
    return ObjectState(name=reading.name, state=reading.state, value=reading.value, angle_rad=angle_rad, sigma=sigma)
