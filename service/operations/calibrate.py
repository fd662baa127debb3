"""The verb `calibrations`: measures from the most informative stations and stores a dated calibration record."""

from __future__ import annotations

import time

import numpy as np

from hal.calibration import CalibrationRecord
from hal.devices import DeviceKind
from hal.errors import InvalidRequest, Unsupported
from hal.geometry import difference, to_json
from perception.calibration import InHandCalibration, ScannerCalibration, WrenchCalibration, record_of, renewed
from service.knowledge.calibrations import Calibrations
from service.operations.calibrate_sensors import (
    beforehand,
    camera_stations,
    measure_camera,
    measure_scanner,
    measure_tool,
    scanner_stations,
    tool_joints,
)
from service.operations.locate import go_to_overview, locate_from_overview
from service.operations.session import Session
from service.operations.travel import kinematics, park
from service.report.plots import stations_picture
from service.schema.requests import CalibrationRequest
from service.schema.results import CalibrationChange, CalibrationResult, StationResult

KINDS = {
    "camera": DeviceKind.CAMERA,
    "hand-eye": DeviceKind.CAMERA,
    "scanner": DeviceKind.RANGE_SCANNER,
    "tool": DeviceKind.FORCE_TORQUE,
}


def run_calibrations(session: Session, request: CalibrationRequest) -> CalibrationResult:
    """Measure, solve and store the record. Nothing is written unless the result is accurate enough."""
    device = _device(session, request)
    if request.dry_run:
        stations = _planned(session, request, device)
        return CalibrationResult(what=request.what, device=device, dry_run=True, stations=stations)
    found = _measure(session, request, device)
    session.progress(0.95, "store the record")
    current = session.cell.calibration_of(device)
    record = renewed(current, record_of(device, found, date=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())))
    path = Calibrations.of_runs(session.context.runs_dir, session.cell).write(record)
    if request.what != "tool":
        session.world.forget_panel()  # its pose was measured through the previous mount
    session.progress(0.97, "return to the parking position")
    park(session)
    return CalibrationResult(
        what=request.what,
        device=device,
        dry_run=False,
        record=record,
        path=str(path),
        change=_change(current, record),
        pictures=_pictures(session, found),
        in_use_from="the next start of the service" if request.what == "tool" else "now",
    )


def _device(session: Session, request: CalibrationRequest) -> str:
    """Return the name of the device to calibrate, which must be mounted on the flange."""
    names = session.cell.names_of(KINDS[request.what])
    if request.device is not None and request.device not in names:
        raise InvalidRequest(
            f"{request.device!r} is no {KINDS[request.what]} of cell {session.cell.name!r}",
            hint=f"{KINDS[request.what]}s: {', '.join(names) or 'none'}",
        )
    device = request.device or session.first(KINDS[request.what])
    mount = session.cell.file.devices[device].mount
    if mount is None or mount.parent != "flange" or not session.has_mount(device):
        raise Unsupported(
            f"{device} is not mounted on the flange according to the cell file, so moving the hand does not calibrate it",
            hint='give it mount = { parent = "flange", calibration = ... } and a record with a rough [mount]',
        )
    return device


def _measure(
    session: Session, request: CalibrationRequest, device: str
) -> InHandCalibration | ScannerCalibration | WrenchCalibration:
    if request.what == "tool":
        return measure_tool(session, device, request.poses)
    session.progress(0.02, "find the panel")
    go_to_overview(session)
    locate_from_overview(session)
    if request.what == "scanner":
        return measure_scanner(session, device, request.poses)
    return measure_camera(
        session, device, request.poses, beforehand(session, device, is_lens_known=request.what == "hand-eye")
    )


def _planned(session: Session, request: CalibrationRequest, device: str) -> list[StationResult]:
    """Return the stations that would be tried first, as flange poses, for the present estimate of the panel's pose."""
    if request.what == "tool":
        arm = kinematics(session)
        return [
            StationResult(**to_json(arm.flange(q)), joints_rad=q.tolist())
            for q in tool_joints(session, device)[: request.poses]
        ]
    if request.what == "scanner":
        flanges = scanner_stations(session, device, request.poses)
    else:
        known = beforehand(session, device, is_lens_known=request.what == "hand-eye")
        flanges = camera_stations(session, device, request.poses, known)
    return [StationResult(**to_json(flange)) for flange in flanges[: request.poses]]


def _pictures(session: Session, found: InHandCalibration | ScannerCalibration | WrenchCalibration) -> list[str]:
    """Draw the stations and the residuals of a camera calibration; other calibrations have no picture."""
    if not isinstance(found, InHandCalibration):
        return []
    size_m = (session.panel.width_m, session.panel.height_m)
    picture = stations_picture(list(found.target_from_camera), size_m, found.residuals_px)
    return [session.context.task.artefact("stations.png", picture, "image/png")]


def _change(before: CalibrationRecord, after: CalibrationRecord) -> CalibrationChange:
    """Return the differences between the new record and the previous one."""
    moved = focal_px = mass_kg = None
    if before.mount is not None and after.mount is not None:
        moved = difference(after.mount.pose().parent_from_child, before.mount.pose().parent_from_child)
    if before.intrinsics is not None and after.intrinsics is not None:
        focal_px = after.intrinsics.fx_px - before.intrinsics.fx_px
    if before.load is not None and after.load is not None:
        mass_kg = after.load.mass_kg - before.load.mass_kg
    return CalibrationChange(
        moved_m=None if moved is None else float(np.linalg.norm(moved[:3])),
        turned_rad=None if moved is None else float(np.linalg.norm(moved[3:])),
        focal_px=focal_px,
        mass_kg=mass_kg,
    )
