"""The whole mission: locates and reads the panel, touches it, operates its controls, reads them back, and parks."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusion import Observation, PoseTolerance, error_budget
from hal.devices import DeviceKind
from hal.errors import CellError, DeviceError, InvalidRequest, PerceptionError, Unreachable
from hal.geometry import compose
from hal.panel import PanelObject, Shown
from perception.vision import ObjectReading, PanelWay
from service.evaluate import AFTER
from service.operations.acquisition import settle
from service.operations.find_panel import Located, locate, panel_observations, ways_of
from service.operations.inspect import Inspection, inspect_close, inspect_here, need_all_present, reading_result
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
from service.operations.range_detection import (
    OVERVIEW,
    SurfaceView,
    check_surfaces,
    need_its_place,
    view_surfaces,
)
from service.operations.sense import feel, fuse_and_remember, fused_result, mounts_of
from service.operations.session import OperationContext, Session
from service.operations.travel import leave_the_panel, park
from service.problem import problem_of
from service.report.drawing import panel_drawing
from service.report.plots import (
    joints_picture,
    lights_picture,
    png_of,
    points_picture,
    range_picture,
    wrench_picture,
)
from service.report.record import MissionRecord, Picture
from service.report.write import write_report
from service.schema.mission_results import MissionResult, ObjectPlace, SurfaceCheck
from service.schema.requests import ActionBody, MissionRequest
from service.schema.results import FittedPlate, FoundBy, estimated

log = logging.getLogger(__name__)
BEFORE = "before the actions"


def run_mission(context: OperationContext, request: MissionRequest) -> MissionResult:
    """Run the verb `missions`.

    After any error the arm is parked, unless it has failed itself or does not obey, and the report is written with
    everything that is known.

    Raises:
        CellError: the error that ended the mission early; the report is written first.
    """
    connection = context.connection
    name = time.strftime("%Y%m%dT%H%M%S", time.gmtime()) + f"-{context.task.id}"
    record = MissionRecord(
        mission=name,
        cell=connection.cell.name,
        panel=connection.cell.panel.name,
        mode=connection.cell.file.cell.mode,
        seed=connection.cell.file.cell.seed,
        now_s=connection.clock.now_s,
    )
    session = Session(context=context, record=record)
    try:
        _run(session, record, request)
    except CellError as error:
        record.problem = problem_of(error)
        _park_after(session, record, error)
        raise
    except Exception as defect:
        # Park the arm also after a defect of this program; the task then reports the defect.
        record.problem = {
            "title": "Defect",
            "detail": f"{type(defect).__name__}: {defect}",
            "hint": "the log has the traceback; please report it",
            "retry": "never",
        }
        _park_after(session, record, defect)
        raise
    finally:
        _finish(record)
        is_reported = _report(record, context.runs_dir / name)
    return MissionResult(
        mission=name,
        succeeded=record.succeeded,
        report=f"/v1/missions/{name}/report.html" if is_reported else None,
        actions=record.actions,
        fused=record.fused,
        depths=record.depths or [],
        cell_s=sum(step.cell_s for step in record.steps),
        wall_s=sum(step.wall_s for step in record.steps),
    )


def _report(record: MissionRecord, folder: Path) -> bool:
    """Write the report; returns False and logs the reason when that fails, because the task's result still counts."""
    try:
        write_report(record, folder)
    except OSError as error:
        log.warning("the report %s cannot be written: %s; free disk space", folder, error.strerror or error)
        return False
    return True


def _run(session: Session, record: MissionRecord, request: MissionRequest) -> None:
    tolerance = request.wanted.tolerance()
    found = _find(session, record, tolerance)
    with _step(session, "recognise", 0.19, 0.22) as part:
        part.progress(0.0, "recognise the objects")
        settle(part)  # until the border lights are out
        overview = inspect_here(part, [panel_object.name for panel_object in session.panel.objects])
        _note_pictures(record, overview, "recognised")
        need_all_present(overview, session)
        record.objects = _places(session, overview)
    with _step(session, "read", 0.22, 0.38) as part:
        read = inspect_close(part, [panel_object.name for panel_object in session.panel.objects])
        _note_pictures(record, read, "read")
        part.observer.saw(read.readings.values(), read.crops(), mission=record.mission, phase=BEFORE)
        record.readings += [reading_result(reading, BEFORE) for reading in read.readings.values()]
        rims = rims_in(part, [view.look for view in (*overview.pictures, *read.pictures)])
    with _step(session, "touch", 0.38, 0.55) as part:
        known = (*found.observations, *rim_observations(rims))
        felt = feel(part, request.touches, known, tolerance)
    with _step(session, "fuse", 0.55, 0.57) as part:
        part.progress(0.0, "fuse rays, range plane, distances and touches")
        answer = fuse_and_remember(part, (*known, *felt.observations))
        record.fused = fused_result(answer, felt)
        record.pictures.append(_drawing(session, found.views[-1]))
        _note_depths(part, record, rims)
    checks: list[SurfaceCheck] = []
    if found.surfaces is not None:
        with _step(session, "check by surfaces", 0.57, 0.58) as part:
            part.progress(0.0, "compare mushrooms and handwheels with panel file and vision")
            checks, pictures = check_surfaces(part, found.surfaces)
            record.by_surfaces = checks
            record.pictures += pictures
    _work_all(session, record, request, checks)
    with _step(session, "retreat", 0.96, 1.0) as part:
        part.progress(0.0, "park")
        park(part)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """The panel from one or two views, and with a range scanner its plate and the objects with a relief."""

    views: tuple[Located, ...]
    plane: ScannedPlane | None = None
    surfaces: SurfaceView | None = None

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
            found = replace(found, plane=plane, surfaces=view_surfaces(part, plane, OVERVIEW))
    if _pose_error(session, found.observations, tolerance) > 1.0:
        with _step(session, "square view", 0.13, 0.19) as part:
            part.progress(0.0, "drive to the square view")
            go_to_overview(part)
            found = replace(found, views=(*found.views, locate(part)))
    _note_found(record, found.views[-1])
    return found


def _pose_error(session: Session, known: Sequence[Observation], tolerance: PoseTolerance) -> float:
    """Return the mean square error of the pose that the observations give, in units of the tolerance."""
    base_from_panel = session.known_panel().parent_from_child
    budget = error_budget(known, mounts_of(session, known), base_from_panel, lenses=session.one_sigma_lenses())
    return tolerance.error_of(budget.covariance, base_from_panel)


def _work_all(session: Session, record: MissionRecord, request: MissionRequest, checks: Sequence[SurfaceCheck]) -> None:
    actions = request.actions if request.actions is not None else usual_actions(session)
    width = (0.96 - 0.58) / max(len(actions), 1)
    for k, body in enumerate(actions):
        with _step(session, f"work {body.object}", 0.58 + k * width, 0.58 + (k + 1) * width) as part:
            part.progress(0.0, f"work {body.object}")
            try:
                need_its_place(checks, body.object)
                deed = work(part, body)
            except (
                InvalidRequest,
                PerceptionError,
                Unreachable,
            ) as refusal:  # the other controls can still be operated
                part.progress(1.0, f"{body.object} is not operated", refusal.what)
                record.actions.append(refused_action(part.panel.object(body.object), body, refusal))
                continue
            record.actions.append(deed.action)
            if deed.after is not None:
                record.readings.append(reading_result(deed.after, AFTER))
            if deed.picture is not None:
                record.pictures.append(deed.picture)


def usual_actions(session: Session) -> tuple[ActionBody, ...]:
    """Return one action for each kind with a mission rank: change the state or value of its best-ranked object."""
    readings = session.world.readings
    ranked = [(one.mission_rank, one) for one in session.panel.objects if one.mission_rank is not None]
    first: dict[str, PanelObject] = {}
    for _, panel_object in sorted(ranked, key=lambda pair: pair[0]):
        first.setdefault(panel_object.kind, panel_object)
    return tuple(_other(panel_object, readings) for panel_object in first.values())


def _other(panel_object: PanelObject, readings: Mapping[str, ObjectReading]) -> ActionBody:
    """Return the action that changes the present state or value of the object, or of the object that shows it."""
    reading, goal = readings.get(panel_object.shown_by), panel_object.goal
    if goal is None:
        raise InvalidRequest(f"{panel_object.name} is read only", hint="leave it out of the mission")
    shown = Shown() if reading is None else Shown(value=reading.value, state=reading.state, text=reading.text)
    return ActionBody.model_validate({"object": panel_object.name, goal.key: goal.other_than(shown)})


@contextmanager
def _step(session: Session, name: str, low: float, high: float) -> Iterator[Session]:
    if session.record is None:
        yield session.part(low, high)
        return
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


def _finish(record: MissionRecord) -> None:
    if record.motions:
        record.pictures.append(
            Picture(name="wrench", title="contact wrench over the mission", png=wrench_picture(record.motions))
        )
        record.pictures.append(
            Picture(name="joints", title="joint angles over the mission", png=joints_picture(record.motions))
        )


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
    c, depth = plane.scan.capabilities, plane.scan.depth_m
    v, u = np.mgrid[: c.height, : c.width]
    points = np.stack([(u - c.cx) / c.fx * depth, (v - c.cy) / c.fy * depth, depth], axis=-1)
    feature = plane.fit.feature
    record.pictures.append(
        Picture(
            name="range",
            title="range image and what stands out of the fitted plate",
            png=range_picture(depth, -(points - feature.point_m) @ (-feature.direction)),
        )
    )
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


def _places(session: Session, found: Inspection) -> list[ObjectPlace]:
    """Return the position of every object in the base frame, m."""
    pose = session.known_panel().parent_from_child
    return [
        ObjectPlace(name=r.name, kind=r.kind, centre_in_base_m=pose.apply(r.centre_m))
        for r in found.readings.values()
        if r.centre_m is not None
    ]


def _drawing(session: Session, located: Located) -> Picture:
    """Draw the panel's outlines in the fused pose over the image, as in the paper's Fig. 13."""
    look = located.look
    camera_from_panel = compose(look.base_from_camera.inverse(), session.known_panel())
    png = panel_drawing(session.panel, camera_from_panel.parent_from_child, look.intrinsics, look.pixels)
    return Picture(name="pose", title="line drawing of the panel in its fused pose over the camera's image", png=png)
