"""The verb `calibrations`: the arm drives through stations that tell most, measures, and keeps a dated record."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.calibration import CalibrationRecord
from hal.devices import DeviceKind
from hal.errors import InvalidRequest, NotObservable, Unsupported
from hal.geometry import difference, matrix_of, to_json
from hal.motion import Hold
from perception.calibration.in_hand import (
    UNKNOWN_LENS,
    Beforehand,
    InHandCalibration,
    InHandState,
    InHandView,
    calibrate_in_hand,
    propose_view,
)
from perception.calibration.records import record_of, renewed
from perception.calibration.scanner import ScannerCalibration, ScannerView, calibrate_scanner
from perception.calibration.wrench import WrenchCalibration, calibrate_wrench
from service.calibrations import Calibrations
from service.operations.beliefs import believed_panel
from service.operations.eyes import OLDEST_S, deadline, look_with_lights, settle
from service.operations.locate import go_to_overview, lights_in, locate, scan_plate
from service.operations.requests import CalibrationRequest
from service.operations.session import Session
from service.operations.stations import (
    LIGHTS_CONE_RAD,
    PLATE_CONE_RAD,
    REACH_STEPS,
    around,
    by_plate,
    in_view,
    order,
    visit,
    wrist_turns,
)
from service.operations.travel import go_to_joints, kinematics, park
from service.operations.views import overview_distance_m

Array = NDArray[np.float64]

KINDS = {
    "camera": DeviceKind.CAMERA,
    "hand-eye": DeviceKind.CAMERA,
    "scanner": DeviceKind.RANGE_SCANNER,
    "tool": DeviceKind.FORCE_TORQUE,
}
MOST_SCATTER = 9.0  # chi-square a degree: three times the stated noise is no noise any more
LEAST_LENS = (1e-5, 0.01, 1e-5)  # a record without sigmas does not mean a lens without error
SCANNER_DISTANCE_M = 0.42
SCANNER_STEPS = (1.0, 1.35)
POINTS_A_SCAN = 400
WRENCH_SAMPLES = 40
WRENCH_STEP_S = 0.01
REST_S = 0.3  # the hand swings a little after a motion


def run_calibrations(session: Session, request: CalibrationRequest) -> dict[str, Any]:
    """Measure, solve, keep the record. Nothing is written unless the result is good enough."""
    device = _device(session, request)
    if request.dry_run:
        return {"what": request.what, "device": device, "dry_run": True, "stations": _planned(session, request, device)}
    found = _measure(session, request, device)
    session.progress(0.95, "keep the record")
    current = session.cell.calibration_of(device)
    record = renewed(current, record_of(device, found, date=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())))
    path = Calibrations.of_runs(session.context.runs_dir, session.cell).write(record)
    if request.what != "tool":
        session.memory.remember("base_from_panel", None)  # it was seen through the mount of before
    session.progress(0.97, "back to the parking place")
    park(session)
    return {
        "what": request.what,
        "device": device,
        "dry_run": False,
        "record": record.model_dump(mode="json", by_alias=True, exclude_none=True),
        "path": str(path),
        "change": _change(current, record),
        "in_use_from": "the next start of the service" if request.what == "tool" else "now",
    }


def _device(session: Session, request: CalibrationRequest) -> str:
    """The device that is meant; it must sit on the flange."""
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
            f"{device} does not sit on the flange as far as the cell file says, so moving the hand tells nothing of it",
            hint='give it mount = { parent = "flange", calibration = ... } and a record with a rough [mount]',
        )
    return device


def _measure(
    session: Session, request: CalibrationRequest, device: str
) -> InHandCalibration | ScannerCalibration | WrenchCalibration:
    if request.what == "tool":
        return _tool(session, device, request.poses)
    session.progress(0.02, "find the panel")
    go_to_overview(session)
    locate(session)
    if request.what == "scanner":
        return _scanner(session, device, request.poses)
    return _camera(
        session, device, request.poses, _beforehand(session, device, is_lens_known=request.what == "hand-eye")
    )


def _planned(session: Session, request: CalibrationRequest, device: str) -> list[dict[str, Any]]:
    """The stations that would be tried first, as flange poses, from what is believed of the panel now."""
    if request.what == "tool":
        arm = kinematics(session)
        return [
            {"joints_rad": q.tolist(), **to_json(arm.flange(q))} for q in _tool_joints(session, device)[: request.poses]
        ]
    if request.what == "scanner":
        flanges = _scanner_stations(session, device, request.poses)
    else:
        known = _beforehand(session, device, is_lens_known=request.what == "hand-eye")
        flanges = _camera_stations(session, device, request.poses, known)
    return [to_json(flange) for flange in flanges[: request.poses]]


# -- camera: lens and mount by the panel's lights ---------------------------------------------------------------------


def _camera_stations(session: Session, camera: str, count: int, known: Beforehand) -> list[RigidTransform]:
    start, points_m = _nominal(session, camera), _lights_m(session)
    x, z, lens = start.flange_from_camera, start.base_from_target, start.intrinsics
    nearest_m = overview_distance_m(session.panel, lens, 0.0)
    candidates = around(z, x, nearest_m, steps=REACH_STEPS, cone_rad=LIGHTS_CONE_RAD)
    seen = [flange for flange in candidates if in_view(flange, x, z, points_m, lens)]
    return order(session, seen, lambda done, left: propose_view(done, left, points_m, start, known)[0], count=count)


def _camera(session: Session, camera: str, count: int, known: Beforehand) -> InHandCalibration:
    session.progress(0.08, "choose the stations that tell most")
    flanges = _camera_stations(session, camera, count, known)

    def measure() -> InHandView:
        pair = look_with_lights(session)
        lights = lights_in(session, pair)
        return InHandView(
            base_from_flange=session.mover.state().base_from_flange,
            pixels_px=lights.points_px,
            covariance_px=lights.covariance_px,
        )

    views = visit(session, flanges, measure, count=count, name="look")
    session.progress(0.92, "solve")
    result = calibrate_in_hand(views, _lights_m(session), _nominal(session, camera), known)
    _check_scatter(result.chi_square, result.degrees, "the panel file's light positions, the lens, and for reflections")
    return result


def _nominal(session: Session, camera: str) -> InHandState:
    return InHandState(
        flange_from_camera=session.mount(camera).parent_from_child,
        base_from_target=believed_panel(session).parent_from_child,
        intrinsics=session.lens(camera),
        point_errors_m=np.zeros((len(session.panel.lights), 3)),
    )


def _lights_m(session: Session) -> Array:
    return np.array([light.position_m for light in session.panel.lights])


def _beforehand(session: Session, camera: str, *, is_lens_known: bool) -> Beforehand:
    """What is known of the lens by its record or by nobody, of the lights, and of the arm."""
    arm = session.connection.device(session.first(DeviceKind.ARM)).capabilities()
    known, lens = UNKNOWN_LENS, session.cell.calibration_of(camera).intrinsics
    if is_lens_known and lens is not None:
        stated = (lens.sigma_focal_ratio, lens.sigma_centre_px, lens.sigma_k1)
        ratio, centre, k1 = (max(a, b) for a, b in zip(stated, LEAST_LENS, strict=True))
        known = Beforehand(focal_ratio=ratio, centre_px=centre, k1=k1)
    point_m = max(session.panel.tolerances.light_m, 1e-5)
    return replace(known, point_m=point_m, arm_rad=max(known.arm_rad, arm.resolution_rad))


# -- range scanner: the plate from several sides ----------------------------------------------------------------------


def _scanner_stations(session: Session, scanner: str, count: int) -> list[RigidTransform]:
    x, z = session.mount(scanner).parent_from_child, believed_panel(session).parent_from_child
    candidates = around(z, x, SCANNER_DISTANCE_M, steps=SCANNER_STEPS, cone_rad=PLATE_CONE_RAD)
    return order(session, candidates, by_plate(x, z), count=count)


def _scanner(session: Session, scanner: str, count: int) -> ScannerCalibration:
    flanges = _scanner_stations(session, scanner, count)

    def measure() -> ScannerView:
        seen = scan_plate(session)
        c, depth_m = seen.scan.capabilities, np.asarray(seen.scan.depth_m, float)
        v, u = np.nonzero(seen.fit.inliers & np.isfinite(depth_m))
        some = slice(None, None, max(1, len(u) // POINTS_A_SCAN))
        z = depth_m[v, u][some]
        return ScannerView(
            base_from_flange=session.mover.state().base_from_flange,
            points_m=np.column_stack([(u[some] - c.cx) / c.fx * z, (v[some] - c.cy) / c.fy * z, z]),
            sigma_m=seen.fit.noise.sigma_m(z),
        )

    views = visit(session, flanges, measure, count=count, name="scan")
    session.progress(0.92, "solve")
    result = calibrate_scanner(views, session.mount(scanner).parent_from_child, session.known_panel())
    _check_scatter(result.chi_square, result.degrees, "the plate: is it flat, and is nothing in front of it?")
    return result


# -- tool: weight and bias with the hand turned every way ---------------------------------------------------------------


def _tool_joints(session: Session, sensor: str) -> list[Array]:
    arm = kinematics(session)
    turn = matrix_of(session.mount(sensor).parent_from_child)
    return wrist_turns(arm, np.array(session.cell.file.workspace.park_rad), lambda q: matrix_of(arm.flange(q)) @ turn)


def _tool(session: Session, sensor: str, count: int) -> WrenchCalibration:
    rotations: list[Array] = []
    wrenches: list[Array] = []
    turn = matrix_of(session.mount(sensor).parent_from_child)
    for goal in _tool_joints(session, sensor):
        session.progress(0.05 + 0.85 * len(wrenches) / count, f"weigh: pose {len(wrenches) + 1} of {count}")
        if not go_to_joints(session, goal, name=f"weigh {len(wrenches) + 1}"):
            continue
        settle(session, REST_S)
        wrenches.append(_rest_wrench(session, sensor))
        rotations.append(matrix_of(session.mover.state().base_from_flange) @ turn)
        if len(wrenches) == count:
            break
    session.progress(0.92, "solve")
    return calibrate_wrench(np.array(rotations), np.array(wrenches))


def _rest_wrench(session: Session, sensor: str) -> Array:
    """(6,) mean raw reading with the hand at rest."""
    device = session.connection.device(sensor)
    readings = []
    for _ in range(WRENCH_SAMPLES):
        session.run(Hold(name="rest", duration_s=WRENCH_STEP_S))
        now_s = session.connection.clock.now_s()
        wrench = device.read_wrench(deadline=deadline()).usable(now_s=now_s, max_age_s=OLDEST_S, device=sensor)
        readings.append(np.concatenate([wrench.force_n, wrench.torque_nm]))
    return np.asarray(np.mean(readings, axis=0))


# -- what it came to ----------------------------------------------------------------------------------------------------


def _check_scatter(chi_square: float, degrees: int, what_to_check: str) -> None:
    ratio = chi_square / max(degrees, 1)
    if ratio > MOST_SCATTER:
        raise NotObservable(
            f"the measurements scatter {np.sqrt(ratio):.1f} times as far as their noise, so nothing was kept",
            hint=f"check {what_to_check}",
            chi_square_ratio=round(ratio, 2),
        )


def _change(before: CalibrationRecord, after: CalibrationRecord) -> dict[str, float]:
    """How far the new record is from the one before, for people: mm, degrees, kg."""
    change: dict[str, float] = {}
    if before.mount is not None and after.mount is not None:
        d = difference(after.mount.pose().parent_from_child, before.mount.pose().parent_from_child)
        change["moved_m"] = float(np.linalg.norm(d[:3]))
        change["turned_rad"] = float(np.linalg.norm(d[3:]))
    if before.intrinsics is not None and after.intrinsics is not None:
        change["focal_px"] = after.intrinsics.fx_px - before.intrinsics.fx_px
    if before.load is not None and after.load is not None:
        change["mass_kg"] = after.load.mass_kg - before.load.mass_kg
    return change
