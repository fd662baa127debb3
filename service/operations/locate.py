"""The verb `panel-pose`, the plate's plane in a range image, rims of objects, a panel that has moved, and what is before it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import RigidTransform

from fusion import PixelObservation, PlaneObservation, depth_before, triangulate, with_common_errors
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.devices import DeviceKind, RangeScannerCapabilities
from hal.errors import DeviceError, NotFound, PerceptionError, Unreachable, Unsupported
from hal.geometry import UncertainPose, compose, difference
from hal.panel import Panel, PanelObject, Rim
from manipulation import CollisionBox, SkillContext
from perception.range import PlaneFit, find_obstacles, fit_plane_near
from perception.vision import ObjectReading, PanelWay, RimView, find_rims, viewpoints
from service.operations.acquisition import Look, Scan, device_of_kind, has_range_camera, scan, settle
from service.operations.find_panel import Located, locate
from service.operations.session import Session
from service.operations.travel import go_to_camera_view, go_to_first, leave_the_panel, skill_context
from service.schema.mission_results import ObjectDepth
from service.schema.requests import PanelPoseRequest
from service.schema.results import PanelPoseResult, PlateInScanner, estimated

FAR_SLACK_RATIO = 1.6  # a panel that is turned and nearer than expected needs more than its tolerance
OFF_PLACE_M = 0.004  # of the panel along its plate in a close-up; a larger one is a reason to locate it again
MOVED_M = 0.0025
MOVED_CHI_SQUARE = 25.0  # of the difference of two poses, 6 degrees of freedom; by chance in one case of 3,000
# A pose from the lights alone, and a fused one, err by more than their covariances state: 1.1 mm and 0.1 degrees.
FLOOR_M, FLOOR_RAD = 0.0008, 0.0015
VIEW_SLACK_M = 0.0  # around the panel, in a view of all of it
FLOOR_SLACK_M, HAND_M = 0.03, 0.05  # what is so near to the floor or the finger tips is the floor or the hand
TURN_ARM_M = 0.3  # a turn of the scanner counts as the way of a point at this distance
EDGE_PX = 2
ARM_SLACK_M = 0.03  # what is so near to the model of the arm is the arm, which a folded arm's scanner sees


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScannedPlane:
    """The plane of the plate from a range image."""

    fit: PlaneFit
    scan: Scan
    observation: PlaneObservation


def go_to_overview(session: Session, *, slack_ratio: float = 0.6) -> None:
    """Drive the camera to a pose from which it sees the whole panel.

    Args:
        slack_ratio: free space around a panel that is not located, as a share of the tolerance of its position. A panel
            is rarely at the edge of its tolerance, and nearer images are sharper.
    """
    known = session.world.base_from_panel
    if known is None:
        leave_the_panel(session)
    slack_m = 0.01 if known is not None else slack_ratio * session.cell.file.workspace.position_tolerance_m
    pose = session.believed_panel().parent_from_child
    lens = session.lens()
    go_to_camera_view(session, viewpoints.overview_poses(pose, session.panel, lens, slack_m), name="overview")


def locate_from_overview(session: Session, by: PanelWay | None = None) -> Located:
    """Find the panel from the overview, and once more from farther away if a part of it may be outside of the image.

    Raises:
        NotFound, Ambiguous, PerceptionError: see `locate`.
    """
    try:
        return locate(session, by)
    except NotFound as lost:
        if session.world.base_from_panel is not None:
            raise
        session.progress(0.3, "look from farther away", lost.what)
        try:
            go_to_overview(session, slack_ratio=FAR_SLACK_RATIO)
        except Unreachable:
            raise lost from None
        return locate(session, by)


def scan_plate(session: Session) -> ScannedPlane:
    """Scan from the present pose of the arm and fit the plane of the plate."""
    return plate_in(session, scan(session))


def plate_in(session: Session, image: Scan) -> ScannedPlane:
    """Fit the plane of the plate to a range image.

    Raises:
        NotFound: there is no plane near the estimated pose of the panel, or the image is not a pinhole projection.
    """
    believed = session.believed_panel()
    scanner_from_panel = compose(image.base_from_scanner.inverse(), believed)
    c = image.capabilities
    if c.projection != "pinhole":
        raise NotFound(
            f"{image.scanner} has {c.projection} projection; the plate is fitted to pinhole range images",
            hint="use a range camera, or a line scanner, which is swept with the wrist",
        )
    mount = session.mount(image.scanner)
    pose = scanner_from_panel.parent_from_child
    sigma = np.sqrt(np.diag(scanner_from_panel.covariance))
    fit = fit_plane_near(
        image.depth_m,
        image.pinhole(),
        point_m=pose.translation,
        normal=pose.rotation.apply([0.0, 0.0, 1.0]),
        sigma_offset_m=float(max(sigma[:3].max(), 0.005)),
        sigma_angle_rad=float(max(sigma[3:].max(), 0.01)),
        swept=image.swept_errors(mount),
    )
    observation = PlaneObservation(
        sensor=image.scanner,
        base_from_flange=image.base_from_scanner.parent_from_child * mount.parent_from_child.inv(),
        point_m=fit.feature.point_m,
        normal=fit.feature.direction,
        point_covariance=fit.feature.point_covariance,
        normal_covariance=fit.feature.direction_covariance,
    )
    return ScannedPlane(fit=fit, scan=image, observation=observation)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenRim:
    """The rim of an object in one image; the covariance of `ray` is that of the image alone."""

    view: RimView
    ray: PixelObservation


def rims_in(session: Session, looks: Iterable[Look]) -> tuple[SeenRim, ...]:
    """Find the rims of the panel's objects in images that were taken for reading them."""
    panel = session.known_panel()
    return tuple(
        SeenRim(
            view=view,
            ray=PixelObservation(
                sensor=look.camera,
                base_from_flange=look.base_from_flange,
                name=view.name,
                point_m=view.point_m,
                pixel_px=view.pixel_px,
                covariance_px=view.covariance_px,
                intrinsics=look.intrinsics,
            ),
        )
        for look in looks
        for view in find_rims(
            look.pixels, look.intrinsics, compose(look.base_from_camera.inverse(), panel), session.panel
        )
    )


def rim_observations(rims: Sequence[SeenRim]) -> tuple[PixelObservation, ...]:
    """Return rays to the rims' places in the panel file, for fusing the panel's pose."""
    return with_common_errors([rim.ray for rim in rims], [rim.view.built_covariance_px for rim in rims])


def object_depths(session: Session, rims: Sequence[SeenRim]) -> list[ObjectDepth]:
    """Compare how far each object with a rim stands out of the plate with what the panel file says."""
    return [
        _depth_of(session, one, one.rim, [rim.ray for rim in rims if rim.view.name == one.name])
        for one in session.panel.objects
        if one.rim is not None
    ]


def _depth_of(session: Session, panel_object: PanelObject, rim: Rim, rays: Sequence[PixelObservation]) -> ObjectDepth:
    mounts = {ray.sensor: session.mount(ray.sensor) for ray in rays}
    stated_m = rim.above_plate_m
    answer = ObjectDepth(
        name=panel_object.name,
        kind=panel_object.kind,
        views=len(rays),
        stated_m=stated_m,
        finding="not measured: fewer than two images show its rim",
    )
    if len(rays) < 2:
        return answer
    try:
        point = triangulate(rays, mounts, lenses=session.one_sigma_lenses())
    except PerceptionError as error:
        return answer.model_copy(update={"finding": f"not measured: {error.what}"})
    depth = depth_before(session.known_panel(), point, expected_m=stated_m, expected_sigma_m=rim.above_sigma_m)
    finding = f"its rim stands {1e3 * depth.depth_m:.1f} mm out of the plate (1 sigma {1e3 * depth.sigma_m:.1f} mm)"
    if depth.contradicts:
        finding = (
            f"{panel_object.name}: {finding}, and {1e3 * stated_m:.1f} mm by the panel file: is it loose, or"
            " mounted otherwise than the file has it?"
        )
    return answer.model_copy(
        update={
            "parallax_rad": point.parallax_rad,
            "depth_m": depth.depth_m,
            "sigma_m": depth.sigma_m,
            "chi_square": depth.chi_square,
            "contradicts": depth.contradicts,
            "finding": finding,
        }
    )


def run_panel_pose(session: Session, request: PanelPoseRequest) -> PanelPoseResult:
    """Run the verb `panel-pose`."""
    if request.move:
        session.progress(0.05, "drive to the overview")
        go_to_overview(session)
    by = None if request.by is None else PanelWay(request.by)
    found = locate_from_overview(session, by) if request.move else locate(session, by)
    plate = None
    if request.scan:
        session.progress(0.9, "scan the plate")
        feature = scan_plate(session).fit.feature
        plate = PlateInScanner(point_m=feature.point_m.tolist(), normal=feature.direction.tolist())
    seen = found.seen
    return PanelPoseResult(
        way=seen.way.value,
        base_from_panel=estimated(found.base_from_panel),
        checks=list(found.checks),
        chi_square=seen.chi_square,
        degrees_of_freedom=seen.degrees_of_freedom,
        ambiguous=seen.ambiguous,
        alternatives=seen.alternatives,
        points_px={name: pixel.tolist() for name, pixel in zip(seen.names, seen.points_px, strict=True)},
        plate_in_scanner=plate,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PanelShift:
    """How far the panel has moved since it was located, at one of its objects."""

    moved_m: float
    turned_rad: float

    @property
    def finding(self) -> str:
        """The movement as a sentence."""
        return (
            f"the panel has moved by {1e3 * self.moved_m:.1f} mm and {np.degrees(self.turned_rad):.1f} degrees"
            " since it was located"
        )


def offset_m(seen: Look, readings: Iterable[ObjectReading], base_from_panel: RigidTransform, panel: Panel) -> float:
    """Return how far an image shows the panel from its estimated pose, across the line of sight, at the objects read.

    The reader aligns the panel's edges with the image, over at most 8 px; beyond that it finds no panel there.
    """
    camera_from_panel = seen.base_from_camera.parent_from_child.inv() * base_from_panel
    off = [
        np.linalg.norm(reading.centre_px - expected_px) * point[2] / seen.intrinsics.fx_px
        for reading in readings
        if reading.present
        for point in (camera_from_panel.apply(np.asarray(panel.object(reading.name).point_m)),)
        for expected_px in (project(point[None], seen.intrinsics)[0],)
    ]
    return float(np.median(off)) if off else 0.0


def look_again(session: Session, panel_object: PanelObject) -> PanelShift | None:
    """Locate the panel again from the overview; returns how far it has moved, or None if it stands where it was.

    The pose of a panel that has not moved is kept, because it may be more accurate than the new one.

    Raises:
        PerceptionError: the panel is not found; its pose is forgotten.
        Unreachable: there is no path to the overview.
    """
    before = session.known_panel()
    session.progress(1.0, "locate the panel again", panel_object.name)
    try:
        go_to_overview(session)
        locate(session)
    except PerceptionError:
        session.world.forget_panel()  # it may have moved out of this view
        go_to_overview(session)
        locate_from_overview(session)
    after = session.known_panel()
    shift = shift_between(before, after, panel_object)
    if shift is None:
        session.world.believe_panel(before)
    else:
        session.world.note_obstacles(None)
    return shift


def shift_between(before: UncertainPose, after: UncertainPose, panel_object: PanelObject) -> PanelShift | None:
    """Return how far an object has moved between two estimates of the panel's pose; None if they agree."""
    delta = difference(before.parent_from_child, after.parent_from_child)
    floor = np.diag([FLOOR_M**2] * 3 + [FLOOR_RAD**2] * 3)
    chi_square = float(delta @ np.linalg.solve(before.covariance + after.covariance + floor, delta))
    point = np.asarray(panel_object.point_m)
    moved = after.parent_from_child.apply(point) - before.parent_from_child.apply(point)
    moved_m = float(np.linalg.norm(moved))
    if moved_m < MOVED_M or chi_square < MOVED_CHI_SQUARE:
        return None
    return PanelShift(moved_m=moved_m, turned_rad=float(np.linalg.norm(delta[3:])))


def ensure_space_is_known(session: Session) -> Scan | None:
    """Look with the range camera for what stands before the panel, unless that was done since it was located.

    Returns the range image, which shows the whole panel; None if there is none.

    A line scanner is not swept for it. Where the camera does not get to see the whole panel, or fails, that is told as
    progress, and the paths are planned among what the panel file describes.

    Raises:
        NotFound: the panel has not been located.
        Stopped, MotionError, Cancelled: the cell cannot go on.
    """
    if session.world.obstacles is not None or not has_range_camera(session):
        return None
    session.world.note_obstacles(())
    session.progress(0.0, "look for what stands before the panel")
    try:
        name, device = device_of_kind(session, DeviceKind.RANGE_SCANNER)
        views = viewpoints.overview_poses(
            session.known_panel().parent_from_child, session.panel, _as_lens(device.capabilities()), VIEW_SLACK_M
        )
        back = session.mount(name).parent_from_child.inv()
        context = skill_context(session)
        here = context.kinematics.flange(session.mover.state().position_rad)
        near = sorted((view * back for view in views), key=lambda flange: _way_m(here, flange))
        go_to_first(session, near, name="face the panel with the scanner", thorough=False)
        settle(session)
        image = scan(session)
        session.world.note_obstacles(obstacles_in(session, image))
    except (DeviceError, PerceptionError, Unreachable, Unsupported) as error:
        session.progress(1.0, "what stands before the panel is not known", error.what)
        return None
    return image


def _way_m(one: RigidTransform, other: RigidTransform) -> float:
    """Return how far the flange moves between two poses, with a turn counted as the way of a point at `TURN_ARM_M`."""
    step = one.inv() * other
    return float(np.linalg.norm(step.translation) + TURN_ARM_M * step.rotation.magnitude())


def obstacles_in(session: Session, image: Scan) -> tuple[CollisionBox, ...]:
    """Return boxes in the base frame around what a range image shows before the panel; see `find_obstacles`."""
    context, sensor = skill_context(session), image.pinhole()
    base_from_scanner, base_from_panel = image.base_from_scanner.parent_from_child, context.panel_pose
    in_scanner = sensor.points(np.asarray(image.depth_m, float))
    is_measured = np.isfinite(in_scanner).all(axis=-1)
    points = base_from_scanner.apply(in_scanner[is_measured])
    is_own = np.zeros(is_measured.shape, bool)
    is_own[is_measured] = _is_arm_or_hand(session, context, image, points)
    # A pixel beside the arm may show a mean of the arm and what is behind it, which stands nowhere.
    is_strange = (points[:, 2] > context.floor_z_m + FLOOR_SLACK_M) & ~binary_dilation(is_own, iterations=EDGE_PX)[
        is_measured
    ]
    found = find_obstacles(
        base_from_panel.inv().apply(points[is_strange]),
        session.panel,
        pitch_m=sensor.pitch_m(float(np.linalg.norm(base_from_scanner.translation - base_from_panel.translation))),
        sigma_m=image.capabilities.sigma_m,
    )
    return tuple(
        CollisionBox(
            name="what stands before the panel", parent_from_box=base_from_panel * one.panel_from_box, half_m=one.half_m
        )
        for one in found
    )


def _is_arm_or_hand(session: Session, context: SkillContext, image: Scan, points_m: Array) -> NDArray[np.bool_]:
    """Return which points (N, 3) of the base frame belong to the arm, or to the hand and what is between its fingers."""
    base_from_flange = image.base_from_scanner.parent_from_child * session.mount(image.scanner).parent_from_child.inv()
    x, y, z = (base_from_flange * context.flange_from_grip).inv().apply(points_m).T
    arm = context.collision(width_m=session.mover.state().gripper_width_m)
    is_arm = arm.distances_m(image.position_rad, points_m) < ARM_SLACK_M
    return np.asarray(is_arm | ((z <= HAND_M) & (np.hypot(x, y) <= 2 * HAND_M)))


def _as_lens(c: RangeScannerCapabilities) -> CameraIntrinsics:
    return CameraIntrinsics(fx_px=c.fx, fy_px=c.fy, cx_px=c.cx, cy_px=c.cy, width_px=c.width, height_px=c.height)
