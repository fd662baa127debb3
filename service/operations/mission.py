"""Runs a mission: locates the panel, then does the steps of its mission, reports what was found, and parks."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from fusion import Observation, PoseTolerance
from hal.devices import DeviceKind
from hal.errors import CellError, DeviceError, InvalidRequest, PerceptionError, Unreachable
from hal.geometry import compose
from perception.vision import PanelWay
from service.errors import Defect
from service.evaluate import AFTER
from service.feasibility import other_than_shown, usual_actions
from service.missions.conditions import Seen
from service.missions.files import mission_of
from service.missions.interpreter import Interpreter, leaves_of
from service.missions.progress import FILE, Progress, load_progress
from service.operations.acquisition import Look, Scan, settle
from service.operations.find_panel import Located, locate, panel_observations, ways_of
from service.operations.inspect import (
    Inspection,
    inspect_close,
    inspect_exposed,
    need_all_present,
    places_in,
    reading_result,
    tell,
)
from service.operations.locate import (
    ScannedPlane,
    SeenRim,
    go_to_overview,
    locate_from_overview,
    object_depths,
    rim_observations,
    rims_in,
    scan_plate,
)
from service.operations.manipulate import refused_action, work
from service.operations.range_detection import SurfaceView, check_surfaces, need_its_place, surfaces_of_mission
from service.operations.sense import feel, fuse_and_remember, fused_result, pose_error
from service.operations.session import OperationContext, Session, panel_object_or_all
from service.operations.travel import leave_the_panel, park, plan_mission
from service.problem import problem_of
from service.report.drawing import panel_drawing
from service.report.origin import origin_of
from service.report.plots import lights_picture, png_of, points_picture, residual_picture
from service.report.record import MissionRecord, Picture
from service.report.write import write_report
from service.schema.mission_file import FeelStep, InspectStep, SetStep
from service.schema.mission_request import MissionRequest
from service.schema.mission_results import REPORTING, MissionResult, StepResult, SurfaceCheck
from service.schema.requests import ActionBody, WantedPose
from service.schema.results import FittedPlate, FoundBy, estimated

log = logging.getLogger(__name__)
BEFORE = "before the actions"
FOUND, WORKED = 0.22, 0.96  # share of the progress at which the panel is found, and at which the steps are done


def run_mission(context: OperationContext, request: MissionRequest) -> MissionResult:
    """Run the verb `missions`.

    After any error the arm is parked, unless it has failed itself or does not obey, and the report is written with
    everything that is known.

    Raises:
        InvalidRequest, ConfigError: the mission does not fit the panel, or cannot be taken up; nothing has moved.
        CellError: the error that ended the mission early; the report is written first.
    """
    cell = context.connection.cell
    progress = _progress_of(context, request)
    if request.dry_run:
        return plan_mission(Session(context=context), progress)
    begun_s = context.observer.now_s()
    name = time.strftime("%Y%m%dT%H%M%S", time.gmtime(begun_s)) + f"-{context.task.id}"
    record = MissionRecord(
        mission=name,
        cell=cell.name,
        panel=cell.panel.name,
        mode=cell.file.cell.mode,
        seed=cell.file.cell.seed,
        title=progress.mission.title,
        origin=origin_of(cell, asked_by=context.observer.asked_by, newest=context.observer.newest()),
        now_s=context.connection.clock.now_s,
        started_wall=begun_s,
    )
    progress.path = context.runs_dir / name / FILE
    progress.save()
    session = Session(context=replace(context, limits=progress.limits()), record=record)
    worker = _Worker(session=session, record=record, leaves=leaves_of(progress))
    interpreter = Interpreter(hands=worker, progress=progress)
    try:
        _run(worker, interpreter)
    except CellError as error:
        record.problem = problem_of(error)
        _park_after(session, record, error)
        raise
    except Exception as defect:  # the arm is parked, and the task reports the defect
        what = f"{type(defect).__name__}: {defect}"
        record.problem = problem_of(Defect(what, hint="the log has the traceback; please report it"))
        _park_after(session, record, defect)
        raise
    finally:
        record.alarms = list(context.observer.alarms())
        record.outcomes = [StepResult.model_validate(asdict(one)) for one in interpreter.outcomes]
        is_reported = _report(record, context.runs_dir / name)
    return MissionResult(
        mission=name,
        succeeded=record.succeeded,
        report=f"/v1/missions/{name}/report.html" if is_reported else None,
        actions=record.actions,
        fused=record.fused,
        depths=record.depths or [],
        steps=record.outcomes,
        cell_s=sum(step.cell_s for step in record.steps),
        wall_s=sum(step.wall_s for step in record.steps),
    )


def _progress_of(context: OperationContext, request: MissionRequest) -> Progress:
    """Return the mission that is asked for, with what an earlier mission has done of it."""
    cell = context.connection.cell
    if request.resume is not None:
        progress = load_progress(context.runs_dir / request.resume, cell=cell.name, panel=cell.panel.name)
        checked = mission_of(MissionRequest(mission=progress.mission), cell)  # the panel file may have changed since
        return replace(progress, library={**progress.library, **checked.library})
    checked = mission_of(request, cell)
    return Progress(mission=checked.mission, library=checked.library, cell=cell.name, panel=cell.panel.name)


def _report(record: MissionRecord, folder: Path) -> bool:
    """Write the report; returns False and logs the reason when that fails, because the task's result still counts."""
    try:
        write_report(record, folder)
    except OSError as error:
        log.warning("the report %s cannot be written: %s; free disk space", folder, error.strerror or error)
        return False
    return True


def _run(worker: _Worker, interpreter: Interpreter) -> None:
    session, record = worker.session, worker.record
    wanted = [step.wanted for step in interpreter.progress.all_steps() if isinstance(step, FeelStep)] or [WantedPose()]
    worker.found = _find(session, record, wanted[0].tolerance())
    with _step(session, "recognise", 0.19, FOUND) as part:
        part.progress(0.0, "recognise the objects")
        settle(part)  # until the border lights are out
        overview = inspect_exposed(part, [panel_object.name for panel_object in session.panel.objects])
        _note_pictures(record, overview, "recognised")
        need_all_present(overview, session)
        record.objects = places_in(session, overview)
        worker.looks += [view.look for view in overview.pictures]
        is_touching = any(isinstance(step, SetStep | FeelStep) for step in interpreter.progress.all_steps())
        worker.surfaces = surfaces_of_mission(part, worker.found.plane, is_touching=is_touching)
    interpreter.run()
    if record.depths is None:
        _note_depths(session, record, rims_in(session, worker.looks))
    with _step(session, "retreat", WORKED, 1.0) as part:
        part.progress(0.0, "park")
        park(part)
    session.progress(1.0, REPORTING)


@dataclass(slots=True, kw_only=True, eq=False)
class _Worker:
    """The hands and eyes of a mission on the cell; see `service.missions.interpreter.Hands`.

    Attributes:
        leaves: number of steps without steps of their own, by which the progress is shared out.
        found: the panel as it was located.
        surfaces: the objects with a relief in a range image; None without a range scanner.
        looks, scans: images in which objects were read, whose rims are fused, and range images from the same places.
        checks: comparison of the objects with their surfaces.
    """

    session: Session
    record: MissionRecord
    leaves: int
    found: _Found = field(init=False)
    surfaces: SurfaceView | None = None
    looks: list[Look] = field(default_factory=list)
    scans: list[Scan] = field(default_factory=list)
    checks: list[SurfaceCheck] = field(default_factory=list)
    _begun: int = 0
    _inspections: int = 0

    def begins(self, path: str, kind: str) -> None:
        self._begun += kind not in ("choose", "repeat", "call")
        self.session.part(*self._span(0.0, 0.0)).begin_step(path)

    def now_s(self) -> float:
        return self.session.connection.clock.now_s()

    def wait(self, duration_s: float) -> None:
        end_s = self.now_s() + duration_s
        while (left_s := end_s - self.now_s()) > 0.0:
            self.session.part(*self._span(0.0, 0.0)).progress(0.0, "wait", f"{left_s:.0f} s")
            settle(self.session, min(1.0, left_s))

    def look(self, names: Collection[str]) -> Mapping[str, Seen]:
        with _step(self.session, "look", *self._span(0.0, 0.3)) as part:
            seen = inspect_close(part, panel_object_or_all(self.session.panel, names))
            self._keep(seen, "look")
        return {name: Seen.of(reading) for name, reading in seen.readings.items()}

    def inspect(self, step: InspectStep) -> None:
        with _step(self.session, "read", *self._span(0.0, 1.0)) as part:
            read = inspect_close(part, panel_object_or_all(self.session.panel, step.objects))
            self._inspections += 1
            self._keep(read, "read" if self._inspections == 1 else f"read{self._inspections}")

    def feel(self, step: FeelStep) -> None:
        rims = rims_in(self.session, self.looks)
        with _step(self.session, "touch", *self._span(0.3, 0.9)) as part:
            known = (*self.found.observations, *rim_observations(rims))
            felt = feel(part, step.touches, known, step.wanted.tolerance())
        with _step(self.session, "fuse", *self._span(0.9, 0.95)) as part:
            part.progress(0.0, "fuse rays, range plane, distances and touches")
            answer = fuse_and_remember(part, (*known, *felt.observations))
            self.record.fused = fused_result(answer, felt)
            self.record.pictures.append(_drawing(self.session, self.found.views[-1]))
            _note_depths(part, self.record, rims)
        self._check_surfaces(*self._span(0.95, 1.0))

    def _check_surfaces(self, low: float, high: float) -> None:
        """Compare the objects with their surfaces, once."""
        if self.surfaces is None or self.record.by_surfaces is not None:
            return
        with _step(self.session, "check by surfaces", low, high) as part:
            part.progress(0.0, "compare mushrooms and handwheels with panel file and vision")
            self.checks, pictures = check_surfaces(part, self.surfaces, self.scans)
            self.record.by_surfaces = self.checks
            self.record.pictures += pictures

    def set(self, step: SetStep) -> str:
        self._check_surfaces(*self._span(0.0, 0.0))
        panel, readings = self.session.panel, self.session.world.readings
        bodies = usual_actions(panel, readings) if step.each_kind else (self._action(step),)
        told = []
        for k, body in enumerate(bodies):
            with _step(
                self.session, f"work {body.object}", *self._span(k / len(bodies), (k + 1) / len(bodies))
            ) as part:
                told.append(self._work(part, body))
        return "; ".join(why for why in told if why)

    def _action(self, step: SetStep) -> ActionBody:
        action = step.action()
        if not step.other:
            return action
        other = other_than_shown(self.session.panel.object(action.object), self.session.world.readings)
        return other.model_copy(update={"confirm": step.confirm})

    def _work(self, part: Session, body: ActionBody) -> str:
        """Operate one control; returns why it was not confirmed, empty if it was."""
        part.progress(0.0, f"work {body.object}")
        try:
            need_its_place(self.checks, body.object)
            deed = work(part, body)
        except (InvalidRequest, PerceptionError, Unreachable) as refusal:  # the other controls can still be operated
            part.progress(1.0, f"{body.object} is not operated", refusal.what)
            self.record.actions.append(refused_action(part.panel.object(body.object), body, refusal))
            return refusal.what
        self.record.actions.append(deed.action)
        if deed.after is not None:
            self.record.readings.append(reading_result(deed.after, AFTER))
        if deed.picture is not None:
            self.record.pictures.append(deed.picture)
        return "" if deed.action.confirmed else f"{body.object} was not confirmed: {deed.action.detail}"

    def _keep(self, read: Inspection, name: str) -> None:
        """Store readings and pictures; those after a deed say so, because the evaluation compares them with what is then."""
        phase = AFTER if self.record.actions else BEFORE
        tell(self.session, read.readings.values(), read, mission=self.record.mission, phase=phase)
        _note_pictures(self.record, read, name)
        self.record.readings += [reading_result(reading, phase) for reading in read.readings.values()]
        self.looks += [view.look for view in read.pictures]
        self.scans += read.scans

    def _span(self, low: float, high: float) -> tuple[float, float]:
        """Return a part of the progress of the present step, as a range of the mission's."""
        width = (WORKED - FOUND) / max(self.leaves, 1)
        begin = min(FOUND + width * max(self._begun - 1, 0), WORKED - width)
        return begin + low * width, begin + high * width


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """The panel from one or two views, and with a range scanner its plate."""

    views: tuple[Located, ...]
    plane: ScannedPlane | None = None

    @property
    def observations(self) -> tuple[Observation, ...]:
        rays = panel_observations(self.views)
        return rays if self.plane is None else (*rays, self.plane.observation)


def _find(session: Session, record: MissionRecord, tolerance: PoseTolerance) -> _Found:
    """Find the panel and scan its plate; find it again from a square view unless its pose is as good as wanted."""
    with _step(session, "overview", 0.0, 0.06) as part:
        part.progress(0.0, "drive to the overview")
        leave_the_panel(part)
        session.world.forget()  # a mission uses only its own observations, because the panel may have been exchanged
        go_to_overview(part)
    with _step(session, "lights" if PanelWay.LIGHTS in ways_of(session) else "find the panel", 0.06, 0.10) as part:
        found = _Found(views=(locate_from_overview(part),))
    if session.cell.names_of(DeviceKind.RANGE_SCANNER):
        with _step(session, "scan", 0.10, 0.13) as part:
            part.progress(0.0, "scan the plate")
            plane = scan_plate(part)
            _note_plane(record, plane)
            found = replace(found, plane=plane)
    if pose_error(session, found.observations, tolerance) > 1.0:
        with _step(session, "square view", 0.13, 0.19) as part:
            part.progress(0.0, "drive to the square view")
            go_to_overview(part)
            found = replace(found, views=(*found.views, locate(part)))
    _note_found(record, found.views[-1])
    return found


@contextmanager
def _step(session: Session, name: str, low: float, high: float) -> Iterator[Session]:
    assert session.record is not None  # noqa: S101 - narrowing: a mission has a record
    with session.record.step(name):
        yield session.part(low, high)


def _park_after(session: Session, record: MissionRecord, error: Exception) -> None:
    """Park the arm after an error, if the cell still obeys; a second error is recorded too.

    An arm that has failed itself is not moved, because a person may be near it.
    """
    if isinstance(error, DeviceError) and error.details.get("device") in session.cell.names_of(DeviceKind.ARM):
        record.not_parked = f"{error.what}: the arm was not parked; look at it, then reset the stop"
        return
    try:
        with record.step("park after the error"):
            settle(session)
            park(session)
    except CellError as second:
        record.not_parked = f"after {error}: {second.what}"


def _note_found(record: MissionRecord, found: Located) -> None:
    record.found_by = FoundBy(
        way=found.seen.way.value, base_from_panel=estimated(found.base_from_panel), checks=list(found.checks)
    )
    seen = found.seen
    if found.lit is not None:
        png = lights_picture(found.look.pixels, found.lit.pixels, seen.points_px, seen.names)
        record.pictures.append(Picture(name="lights", title="lights off, lights on, and their difference", png=png))
        return
    png = points_picture(found.look.pixels, seen.points_px, seen.names)
    record.pictures.append(Picture(name="found", title=f"the points that show the panel by its {seen.way}", png=png))


def _note_plane(record: MissionRecord, plane: ScannedPlane) -> None:
    c, feature = plane.scan.capabilities, plane.fit.feature
    png = residual_picture(plane.scan.depth_m, (c.fx, c.fy, c.cx, c.cy), feature.point_m, feature.direction)
    record.pictures.append(Picture(name="range", title="range image and what stands out of the fitted plate", png=png))
    record.plate_in_scanner = FittedPlate(
        point_m=feature.point_m.tolist(),
        normal=feature.direction.tolist(),
        rms_m=float(np.sqrt(np.trace(feature.point_covariance))),
    )


def _note_depths(session: Session, record: MissionRecord, rims: Sequence[SeenRim]) -> None:
    record.depths = object_depths(session, rims)
    wrong = [depth.finding for depth in record.depths if depth.contradicts]
    if wrong:
        session.progress(1.0, "the panel file contradicts the camera", "; ".join(wrong))


def _note_pictures(record: MissionRecord, found: Inspection, name: str) -> None:
    for k, picture in enumerate(found.pictures):
        record.pictures.append(Picture(name=f"{name}-{k}", title=picture.title, png=png_of(picture.pixels)))
    record.crops |= found.crops()


def _drawing(session: Session, located: Located) -> Picture:
    """Draw the panel's outlines in the fused pose over the image, as in the paper's Fig. 13."""
    look = located.look
    camera_from_panel = compose(look.base_from_camera.inverse(), session.known_panel())
    png = panel_drawing(session.panel, camera_from_panel.parent_from_child, look.intrinsics, look.pixels)
    return Picture(name="pose", title="line drawing of the panel in its fused pose over the camera's image", png=png)
