"""Calibrates one sensor of the hand: chooses its stations, measures at each of them, and solves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import Ambiguous, NotFound, NotObservable, Unreachable
from hal.geometry import matrix_of
from hal.motion import Hold
from perception.calibration import (
    UNKNOWN_LENS,
    Beforehand,
    InHandCalibration,
    InHandState,
    InHandView,
    ScannerCalibration,
    ScannerView,
    WrenchCalibration,
    calibrate_in_hand,
    calibrate_scanner,
    calibrate_wrench,
    calibration_poses,
    propose_view,
)
from perception.vision import PanelWay, viewpoints
from service.operations.acquisition import OLDEST_S, deadline, settle
from service.operations.find_panel import reference_in_view, reference_points_m, ways_of
from service.operations.locate import scan_plate
from service.operations.session import Session
from service.operations.travel import go_to_first, go_to_joints, kinematics, reachable

MOST_SCATTER = 9.0  # chi-square per degree of freedom, that is, residuals of three times the stated noise
LEAST_LENS = (1e-5, 0.01, 1e-5)  # lower limits of the sigmas, because a record without sigmas does not mean no error
SCANNER_DISTANCE_M = 0.42
SCANNER_STEPS = (1.0, 1.35)
POINTS_A_SCAN = 400
WRENCH_SAMPLES = 40
WRENCH_STEP_S = 0.01
WEIGH_REST_S = 0.3  # time in which the hand stops swinging after a motion
REST_S = 0.2  # longer than the lag of the servos, which is tens of milliseconds

T = TypeVar("T")


# -- camera: lens and mount by the panel's lights ---------------------------------------------------------------------


def camera_stations(session: Session, camera: str, count: int, known: Beforehand) -> list[RigidTransform]:
    """Return flange poses with all reference points in view; the `count` that are most informative together come first."""
    start, points_m = _nominal(session, camera), reference_points_m(session)
    x, z, lens = start.flange_from_camera, start.base_from_target, start.intrinsics
    nearest_m = viewpoints.overview_distance_m(session.panel, lens, 0.0)
    candidates = calibration_poses.around(
        z, x, nearest_m, steps=calibration_poses.REACH_STEPS, cone_rad=calibration_poses.LIGHTS_CONE_RAD
    )
    seen = [flange for flange in candidates if calibration_poses.in_view(flange, x, z, points_m, lens)]
    return order(session, seen, lambda done, left: propose_view(done, left, points_m, start, known)[0], count=count)


def measure_camera(session: Session, camera: str, count: int, known: Beforehand) -> InHandCalibration:
    """Drive through the stations, measure the reference points in each view, and solve for mount, panel and lens.

    Raises:
        Unreachable: there are too few stations.
        NotObservable: the mount remains too uncertain, or the measurements scatter too much.
    """
    session.progress(0.08, "choose the most informative stations")
    flanges = camera_stations(session, camera, count, known)

    def measure() -> InHandView:
        points_px, covariance_px = reference_in_view(session)
        return InHandView(
            base_from_flange=session.mover.state().base_from_flange,
            pixels_px=points_px,
            covariance_px=covariance_px,
        )

    views = visit(session, flanges, measure, count=count, name="look")
    session.progress(0.92, "solve")
    result = calibrate_in_hand(views, reference_points_m(session), _nominal(session, camera), known)
    _check_scatter(
        result.chi_square,
        result.degrees,
        "the panel file's lights, tags or plate, the lens, and whether there are reflections",
    )
    return result


def _nominal(session: Session, camera: str) -> InHandState:
    return InHandState(
        flange_from_camera=session.mount(camera).parent_from_child,
        base_from_target=session.believed_panel().parent_from_child,
        intrinsics=session.lens(camera),
        point_errors_m=np.zeros((len(reference_points_m(session)), 3)),
    )


def beforehand(session: Session, camera: str, *, is_lens_known: bool) -> Beforehand:
    """Return the prior uncertainties of lens, lights and arm; a lens counts as unknown unless `is_lens_known`."""
    arm = session.connection.device(session.first(DeviceKind.ARM)).capabilities()
    known, lens = UNKNOWN_LENS, session.cell.calibration_of(camera).intrinsics
    if is_lens_known and lens is not None:
        stated = (lens.sigma_focal_ratio, lens.sigma_centre_px, lens.sigma_k1)
        ratio, centre, k1 = (max(a, b) for a, b in zip(stated, LEAST_LENS, strict=True))
        known = Beforehand(focal_ratio=ratio, centre_px=centre, k1=k1)
    built, way = session.panel.tolerances, ways_of(session)[0]
    is_discs = way is PanelWay.LIGHTS
    built_m = built.light_m if is_discs else built.tag_m
    disc_m = float(np.mean([light.radius_m for light in session.panel.lights])) if is_discs else 0.0
    return replace(known, point_m=max(built_m, 1e-5), disc_m=disc_m, arm_rad=max(known.arm_rad, arm.resolution_rad))


# -- range scanner: the plate from several sides ----------------------------------------------------------------------


def scanner_stations(session: Session, scanner: str, count: int) -> list[RigidTransform]:
    """Return flange poses that look at the plate; the `count` that are most informative together come first."""
    x, z = session.mount(scanner).parent_from_child, session.believed_panel().parent_from_child
    candidates = calibration_poses.around(
        z, x, SCANNER_DISTANCE_M, steps=SCANNER_STEPS, cone_rad=calibration_poses.PLATE_CONE_RAD
    )
    return order(session, candidates, calibration_poses.by_plate(x, z), count=count)


def measure_scanner(session: Session, scanner: str, count: int) -> ScannerCalibration:
    """Drive through the stations, scan the plate, and solve for the mount; the panel must be located.

    Errors as for `measure_camera`.
    """
    flanges = scanner_stations(session, scanner, count)

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
    _check_scatter(result.chi_square, result.degrees, "that the plate is flat and that nothing is in front of it")
    return result


# -- tool: weight and bias with the hand turned into many directions ----------------------------------------------------


def tool_joints(session: Session, sensor: str) -> list[Array]:
    """Return joint vectors about the parking position; those that turn gravity furthest in sensor axes come first."""
    arm = kinematics(session)
    turn = matrix_of(session.mount(sensor).parent_from_child)
    return calibration_poses.wrist_turns(
        np.array(session.cell.file.workspace.park_rad),
        (np.array(arm.capabilities.lower_rad), np.array(arm.capabilities.upper_rad)),
        lambda q: matrix_of(arm.flange(q)) @ turn,
    )


def measure_tool(session: Session, sensor: str, count: int) -> WrenchCalibration:
    """Turn the hand into many directions, read the raw wrench at rest, and solve for weight, centre and bias.

    Raises:
        NotObservable: gravity came from too few directions.
    """
    rotations: list[Array] = []
    wrenches: list[Array] = []
    turn = matrix_of(session.mount(sensor).parent_from_child)
    for goal in tool_joints(session, sensor):
        session.progress(0.05 + 0.85 * len(wrenches) / count, f"weigh: pose {len(wrenches) + 1} of {count}")
        if not go_to_joints(session, goal, name=f"weigh {len(wrenches) + 1}"):
            continue
        settle(session, WEIGH_REST_S)
        wrenches.append(_rest_wrench(session, sensor))
        rotations.append(matrix_of(session.mover.state().base_from_flange) @ turn)
        if len(wrenches) == count:
            break
    session.progress(0.92, "solve")
    return calibrate_wrench(np.array(rotations), np.array(wrenches))


def _rest_wrench(session: Session, sensor: str) -> Array:
    """Return the mean raw wrench (6,) with the hand at rest."""
    device = session.connection.device(sensor)
    readings = []
    for _ in range(WRENCH_SAMPLES):
        session.run(Hold(name="rest", duration_s=WRENCH_STEP_S))
        now_s = session.connection.clock.now_s()
        wrench = device.read_wrench(deadline=deadline()).usable(now_s=now_s, max_age_s=OLDEST_S, device=sensor)
        readings.append(np.concatenate([wrench.force_n, wrench.torque_nm]))
    return np.asarray(np.mean(readings, axis=0))


# -- driving through the poses ----------------------------------------------------------------------------------------


def order(
    session: Session, candidates: Sequence[RigidTransform], propose: calibration_poses.Propose, *, count: int
) -> list[RigidTransform]:
    """Return all candidates that the arm can reach; the `count` that are most informative together come first.

    Raises:
        Unreachable: fewer than `count` are left.
    """
    free = [candidates[k] for k in reachable(session, candidates)]
    if len(free) < count:
        raise Unreachable(
            f"the arm reaches {len(free)} of {len(candidates)} stations in front of the panel, but {count} are wanted",
            hint="ask for fewer poses, or put the panel where the arm can look at it from several sides",
        )
    chosen: list[RigidTransform] = []
    while len(chosen) < count:
        chosen.append(free.pop(propose(chosen, free)))
    return chosen + free


def visit(
    session: Session, flanges: Sequence[RigidTransform], measure: Callable[[], T], *, count: int, name: str
) -> list[T]:
    """Drive to one station after the other and measure at each; stations that cannot be reached or used are left out.

    Raises:
        Unreachable: fewer than `count` stations could be used; the error says why the last one could not.
    """
    found: list[T] = []
    why = ""
    for flange in flanges:
        session.progress(0.1 + 0.8 * len(found) / count, f"{name}: station {len(found) + 1} of {count}", why)
        try:
            go_to_first(session, [flange], name=f"{name} {len(found) + 1}", thorough=False)
            settle(session, REST_S)
            found.append(measure())
        except (Unreachable, NotFound, Ambiguous) as error:
            why = f"one left out: {error.what}"
            continue
        if len(found) == count:
            return found
    raise Unreachable(
        f"only {len(found)} of {count} stations could be measured from; {why or 'no other is left'}",
        hint="ask for fewer poses, or give the arm more space in front of the panel",
    )


def _check_scatter(chi_square: float, degrees: int, what_to_check: str) -> None:
    ratio = chi_square / max(degrees, 1)
    if ratio > MOST_SCATTER:
        raise NotObservable(
            f"the measurements scatter {np.sqrt(ratio):.1f} times as far as their noise, so nothing was kept",
            hint=f"check {what_to_check}",
            chi_square_ratio=round(ratio, 2),
        )
