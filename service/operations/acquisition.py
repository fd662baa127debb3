"""Acquires images and range scans together with the pose of the sensor.

A line scanner is swept by the wrist, and its lines become the depth image that a range camera would have taken.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.clock import Deadline, WallClock
from hal.config import Cell
from hal.devices import DeviceKind, RangeImage, RangeScannerCapabilities
from hal.errors import NotFound, StaleReading, Unsupported
from hal.frames import frame_tree
from hal.geometry import UncertainPose
from hal.motion import CartesianPath, Hold, MotionOutcome
from hal.readings import Cause, Quality, Stamped
from manipulation import plan_sweep, plausibility
from perception.range import PinholeSensor, SweepPass, SweptErrors, image_from_sweep
from service.operations.session import Session
from service.operations.travel import kinematics, skill_context

READ_S = 5.0  # wall seconds for one device call; a software renderer on a busy machine takes up to 0.5 s
OLDEST_S = 0.2  # a frame may have been taken this long before the call; its time of arrival does not matter
SETTLE_S = 0.06  # time in which lamps and arm come to rest
SWEPT_RAD = 0.96  # angle that the lines of a sweep are spread over
LEAST_LINES, MOST_LINES = 96, 160  # of a swept image; the lines may be closer to each other than the beams of a line
LONGEST_PASS_S = 20.0  # of the two passes of a sweep
# What cannot be read is looked at with another exposure if its bright parts, the gray level that 5 % of it exceed, are far
# from BRIGHT, or if more than GLARED of it is saturated, which does not say by how much.
BRIGHT, BRIGHT_QUANTILE, SATURATED, GLARED, GLARE_FACTOR = 180.0, 95.0, 250, 0.05, 0.3
FURTHER = 2  # looks with another exposure
LEAST_CHANGE, MOST_CHANGE = 1.5, 8.0  # of an exposure, as a factor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """One image, uint8 (H, W) or (H, W, 3), and the pose of the camera."""

    pixels: NDArray[np.uint8]
    stamp_s: float
    camera: str
    intrinsics: CameraIntrinsics
    base_from_flange: RigidTransform
    base_from_camera: UncertainPose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightPair:
    """Two images from the same pose, with the border lights off and on."""

    off: Look
    on: Look


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """One range image (float32 metres, NaN where nothing was measured), perhaps swept, and where the scanner stood.

    `position_rad` (n,) are the joints of the arm that carried it.
    """

    depth_m: NDArray[np.float32]
    stamp_s: float
    scanner: str
    capabilities: RangeScannerCapabilities
    base_from_scanner: UncertainPose
    position_rad: Array
    swept: SweptImage | None = None

    def swept_errors(self, mount: UncertainPose) -> SweptErrors | None:
        """Return the errors of the sweep with a scanner on this mount; None if nothing was swept."""
        if self.swept is None:
            return None
        return SweptErrors.of(
            mount,
            apart_m=self.swept.apart_m,
            rate_rad_per_s=self.swept.rate_rad_per_s,
            sigma_range_m=self.capabilities.bias_sigma_m,
        )

    def pinhole(self) -> PinholeSensor:
        """Return the scanner's model.

        Raises:
            Unsupported: the image is not a pinhole projection.
        """
        c = self.capabilities
        if c.projection != "pinhole":
            raise Unsupported(f"{self.scanner} has {c.projection} projection", hint="use a pinhole range scanner")
        return PinholeSensor(width_px=c.width, height_px=c.height, fx_px=c.fx, fy_px=c.fy, cx_px=c.cx, cy_px=c.cy)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SweptImage:
    """The result of a sweep.

    Attributes:
        depth_m: (H, W) as from a range camera in the pose before the sweep; NaN where nothing was measured.
        capabilities: of that camera.
        newest: the last scan.
        apart_m: (H, W) difference of the depths by the two passes.
        rate_rad_per_s: speed of the sweep.
    """

    depth_m: NDArray[np.float32]
    capabilities: RangeScannerCapabilities
    newest: Stamped[RangeImage]
    apart_m: NDArray[np.float64] | None
    rate_rad_per_s: float


def device_of_kind(session: Session, kind: DeviceKind, name: str | None = None) -> tuple[str, Any]:
    """Return name and device of a kind: the named device, or the first one in the cell file.

    Raises:
        ConfigError: the cell has none.
        InvalidRequest: no device of that name.
    """
    if name is not None:
        return name, session.connection.device(name)
    first = session.first(kind)
    return first, session.connection.device(first)


def deadline(duration_s: float = READ_S) -> Deadline:
    """Return a deadline for one device call, on the wall clock of this process."""
    return Deadline.after(WallClock(), duration_s)


def settle(session: Session, duration_s: float = SETTLE_S) -> None:
    """Hold the arm still until lamps and arm are at rest."""
    session.run(Hold(name="settle", duration_s=duration_s), expect=(MotionOutcome.COMPLETED,))


def look(session: Session, camera: str | None = None) -> Look:
    """Return one image from the present pose of the arm, which must be at rest.

    Raises:
        StaleReading: the camera repeats an old frame.
        DeviceError: the camera does not deliver.
    """
    name, device = device_of_kind(session, DeviceKind.CAMERA, camera)
    asked_s = session.connection.clock.now_s()
    sample = device.read_image(deadline=deadline())
    pixels = sample.usable(now_s=asked_s, max_age_s=OLDEST_S, device=name).pixels
    _refuse_frozen(session, name, sample, pixels)
    flange = session.connection.mover.state().base_from_flange
    return Look(
        pixels=pixels,
        stamp_s=sample.host_time_s,
        camera=name,
        intrinsics=session.lens(name),
        base_from_flange=flange,
        base_from_camera=frame_tree(session.cell, flange).base_from(name),
    )


def look_with_lights(session: Session) -> LightPair:
    """Return an image with the border lights off and one with them on; they are switched off again afterwards."""
    name, lights = device_of_kind(session, DeviceKind.LIGHTS)
    channels = len(lights.capabilities().channels)
    wait_s = max(SETTLE_S, lights.capabilities().settle_s)
    _switch(session, name, lights, (False,) * channels, wait_s)
    off = look(session)
    try:
        _switch(session, name, lights, (True,) * channels, wait_s)
        on = look(session)
    finally:
        lights.set_on((False,) * channels, deadline=deadline())
    return LightPair(off=off, on=on)


def better_exposure_s(session: Session, seen: Look, boxes_px: Sequence[Array]) -> float | None:
    """Return an exposure at which what is in some boxes is neither dark nor saturated.

    Args:
        boxes_px: points (N, 2) around each of the objects that cannot be read; without any, the whole image counts.

    Returns:
        The exposure in seconds; None if the present one is right, or the camera's cannot be set.
    """
    settings = session.connection.device(seen.camera).capabilities().settings
    if settings.exposure_range_s is None or settings.exposure_s is None:
        return None
    least_s, longest_s = settings.exposure_range_s
    better_s = min(max(settings.exposure_s * _light_factor(seen.pixels, boxes_px), least_s), longest_s)
    change = better_s / settings.exposure_s
    return better_s if max(change, 1.0 / change) > LEAST_CHANGE else None


def _light_factor(pixels: NDArray[np.uint8], boxes_px: Sequence[Array]) -> float:
    """Return by what the light on some boxes of an image should be multiplied."""
    is_meant = np.zeros(pixels.shape[:2], bool)
    for points in boxes_px:
        seen = np.clip(np.nan_to_num(points), 0, is_meant.shape[::-1])  # what lies behind the camera has no pixel
        (left, top), (right, bottom) = seen.min(axis=0).astype(int), np.ceil(seen.max(axis=0)).astype(int)
        is_meant[top:bottom, left:right] = True
    meant = pixels[is_meant if is_meant.any() else ~is_meant]
    if np.mean(meant >= SATURATED) > GLARED:
        return GLARE_FACTOR
    bright = max(float(np.percentile(meant, BRIGHT_QUANTILE)), 1.0)
    return min(max(BRIGHT / bright, 1.0 / MOST_CHANGE), MOST_CHANGE)


def in_better_light(
    session: Session, seen: Look, boxes_px: Sequence[Array] = ()
) -> AbstractContextManager[None] | None:
    """Return a context in which the camera has `better_exposure_s`; None if there is no better one."""
    exposure_s = better_exposure_s(session, seen, boxes_px)
    return None if exposure_s is None else exposed(session, seen.camera, exposure_s)


@contextmanager
def exposed(session: Session, camera: str, exposure_s: float) -> Iterator[None]:
    """Set the exposure of a camera, which must be an `AdjustableExposure`, within a block."""
    device = session.connection.device(camera)
    before_s = device.capabilities().settings.exposure_s
    device.set_exposure(exposure_s, deadline=deadline())
    try:
        yield
    finally:
        device.set_exposure(before_s, deadline=deadline())


def scan(session: Session) -> Scan:
    """Return one range image from the present pose of the arm, which must be at rest; a line scanner is swept."""
    name, device = device_of_kind(session, DeviceKind.RANGE_SCANNER)
    capabilities = device.capabilities()
    if capabilities.needs_sweep:
        swept = sweep_scanner(session, name, device)
        _refuse_frozen(session, name, swept.newest, swept.newest.value.depth_m)
        return Scan(
            depth_m=swept.depth_m,
            stamp_s=swept.newest.host_time_s,
            scanner=name,
            capabilities=swept.capabilities,
            base_from_scanner=base_from(session, name),
            position_rad=session.mover.state().position_rad,
            swept=swept,
        )
    asked_s = session.connection.clock.now_s()
    sample = device.read_range(deadline=deadline())
    depth_m = sample.usable(now_s=asked_s, max_age_s=OLDEST_S, device=name).depth_m
    _refuse_frozen(session, name, sample, depth_m)
    bend = session.cell.calibration_of(name).depth_bend
    return Scan(
        depth_m=depth_m if bend is None else bend.straightened(depth_m),
        stamp_s=sample.host_time_s,
        scanner=name,
        capabilities=capabilities,
        base_from_scanner=base_from(session, name),
        position_rad=session.mover.state().position_rad,
    )


def has_range_camera(session: Session) -> bool:
    """Return whether the cell has a range scanner that takes a whole image at once."""
    names = session.cell.names_of(DeviceKind.RANGE_SCANNER)
    return bool(names) and not session.connection.device(names[0]).capabilities().needs_sweep


def base_from(session: Session, device: str) -> UncertainPose:
    """Return the present pose of a mounted device, with the covariance of its calibration."""
    cell: Cell = session.connection.cell
    return frame_tree(cell, session.connection.mover.state().base_from_flange).base_from(device)


def camera_over_panel(session: Session) -> Array:
    """Return the panel point (3,) in front of which the camera is."""
    camera = base_from(session, session.first(DeviceKind.CAMERA)).parent_from_child
    x, y, _ = session.known_panel().parent_from_child.inv().apply(camera.translation)
    return np.array([x, y, 0.0])


def _switch(session: Session, name: str, lights: Any, on: tuple[bool, ...], wait_s: float) -> None:
    lights.set_on(on, deadline=deadline())
    settle(session, wait_s)
    feedback = lights.read_on(deadline=deadline())
    seen = feedback.usable(now_s=session.connection.clock.now_s(), max_age_s=1.0, device=name)
    if tuple(seen) != on:
        dead = [channel for channel, a, b in zip(lights.capabilities().channels, seen, on, strict=True) if a != b]
        raise StaleReading(
            f"{name}: {', '.join(dead)} did not follow the command", hint="check lamp, fuse and wiring", device=name
        )


def _refuse_frozen(session: Session, name: str, sample: Stamped[Any], array: NDArray[Any]) -> None:
    """Raise `StaleReading` if a camera or scanner repeats a frame under a new time stamp."""
    newest = plausibility.FrameDigest.of(array, stamp_s=sample.host_time_s)
    finding = plausibility.repeated_frame(name, session.world.note_frame(name, newest), newest)
    if finding is not None:
        raise finding.error()


def sweep_scanner(session: Session, name: str, device: Any) -> SweptImage:
    """Sweep the line scanner `name` to and fro about the pose in which the arm stands, and return to it.

    Raises:
        Unsupported: its driver cannot record scans.
        Unreachable: the wrist has no room to sweep.
        NotFound: no scan came during the sweep.
    """
    if not hasattr(device, "start_recording"):
        raise Unsupported(
            f"{name} is a line scanner whose driver keeps no scans for a sweep",
            hint="its driver needs start_recording and end_recording (hal.devices.SweptScanner)",
            device=name,
        )
    c: RangeScannerCapabilities = device.capabilities()
    state, mount = session.mover.state(), session.mount(name).parent_from_child
    rate_rad_per_s = sweep_rate_rad_per_s(c)
    sweep = plan_sweep(
        skill_context(session),
        mount,
        rate_rad_per_s=rate_rad_per_s,
        start_rad=state.position_rad,
        width_m=state.gripper_width_m,
    )
    session.run(sweep.out)
    passes = [_record(session, name, device, motion) for motion in (sweep.across, sweep.again)]
    session.run(sweep.back)
    image = image_from_sweep(
        passes,
        c,
        base_from_view=kinematics(session).tool(state.position_rad, mount),
        half_height_rad=max(sweep.up_rad, sweep.down_rad),
        swept_rad=sweep.up_rad + sweep.down_rad,
    )
    view = image.view
    as_camera = replace(
        c,
        projection="pinhole",
        width=view.width_px,
        height=view.height_px,
        fx=view.fx_px,
        fy=view.fy_px,
        cx=view.cx_px,
        cy=view.cy_px,
    )
    return SweptImage(
        depth_m=image.depth_m.astype(np.float32),
        capabilities=as_camera,
        newest=passes[-1].scans[-1],
        apart_m=image.apart_m,
        rate_rad_per_s=rate_rad_per_s,
    )


def _record(session: Session, name: str, device: Any, motion: CartesianPath) -> SweepPass:
    """Run one motion over all lines and return the valid scans of the line scanner `name` during it.

    Raises:
        NotFound: no valid scan came.
    """
    device.start_recording(deadline=deadline())
    report = session.run(motion)
    scans = device.end_recording(deadline=deadline())
    _refuse_frozen_lines(name, scans)
    good = [scan for scan in scans if scan.quality is not Quality.INVALID]
    if not good:
        what = f"{name} gave no valid line in a sweep of {report.duration_s:.1f} s"
        raise NotFound(what, hint=_rate_hint(device.capabilities()))
    arm, mount = kinematics(session), session.mount(name).parent_from_child
    return SweepPass(
        scans=good,
        times_s=tuple(report.log.started_s + report.log.times_s),
        base_from_scanner=tuple(arm.tool(q, mount) for q in report.log.positions_rad),
    )


def sweep_rate_rad_per_s(c: RangeScannerCapabilities) -> float:
    """Return the speed of the wrist: one angular step of the beams per line, within limits on lines and duration."""
    line_rad = np.clip(abs(c.step_angle_rad), SWEPT_RAD / MOST_LINES, SWEPT_RAD / LEAST_LINES)
    return float(max(line_rad * c.rate_hz, SWEPT_RAD / LONGEST_PASS_S))


def _refuse_frozen_lines(name: str, scans: Sequence[Stamped[RangeImage]]) -> None:
    """Raise `StaleReading` if all lines are equal to the last bit, which the noise of a working scanner rules out."""
    lines = {np.nan_to_num(scan.value.depth_m).tobytes() for scan in scans if np.isfinite(scan.value.depth_m).any()}
    if len(scans) > 1 and len(lines) == 1:
        raise StaleReading(
            f"{name} repeats the same line during a sweep",
            hint=f"{name} is frozen: power-cycle it; nothing was measured with the old line",
            device=name,
            cause=str(Cause.FROZEN),
        )


def _rate_hint(c: RangeScannerCapabilities) -> str:
    return f"it should give {c.rate_hz:.0f} lines per second: see GET /v1/devices, and check that it faces the panel"
