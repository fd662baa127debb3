"""Looking: images and range scans together with where the sensor stood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.calibration import CameraIntrinsics
from hal.clock import Deadline, WallClock
from hal.config import Cell
from hal.devices import DeviceKind, RangeScannerCapabilities
from hal.errors import StaleReading
from hal.frames import frame_tree
from hal.geometry import UncertainPose
from hal.motion import Hold, MotionOutcome
from hal.readings import Stamped
from manipulation import plausibility
from service.operations.session import Session
from service.operations.sweep import sweep_scanner

READ_S = 5.0  # wall seconds for one device call; a software renderer on a busy machine takes up to 0.5 s
OLDEST_S = 0.2  # before the call: a frame must be of the present, however long it takes to arrive
SETTLE_S = 0.06  # lamps and arm come to rest


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """One image: uint8 pixels, (H, W) or (H, W, 3), and where the camera stood."""

    pixels: NDArray[np.uint8]
    stamp_s: float
    camera: str
    intrinsics: CameraIntrinsics
    base_from_camera: UncertainPose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightPair:
    """The same view with the border lights off and on."""

    off: Look
    on: Look


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """One range image (float32 metres, NaN where nothing) and where the scanner stood."""

    depth_m: NDArray[np.float32]
    stamp_s: float
    scanner: str
    capabilities: RangeScannerCapabilities
    base_from_scanner: UncertainPose


def only_device(session: Session, kind: DeviceKind, name: str | None = None) -> tuple[str, Any]:
    """The device of a kind: the named one, or the first in the cell file.

    Raises:
        ConfigError: the cell has none.
        InvalidRequest: no device of that name.
    """
    if name is not None:
        return name, session.connection.device(name)
    first = session.first(kind)
    return first, session.connection.device(first)


def deadline(duration_s: float = READ_S) -> Deadline:
    """A deadline for one device call of this process."""
    return Deadline.after(WallClock(), duration_s)


def settle(session: Session, duration_s: float = SETTLE_S) -> None:
    """Stand still until lamps and arm are at rest."""
    session.run(Hold(name="settle", duration_s=duration_s), expect=(MotionOutcome.COMPLETED,))


def look(session: Session, camera: str | None = None) -> Look:
    """One image from where the arm stands now; the arm must be at rest.

    Raises:
        StaleReading: the camera repeats an old frame.
        DeviceError: the camera does not deliver.
    """
    name, device = only_device(session, DeviceKind.CAMERA, camera)
    asked_s = session.connection.clock.now_s()
    sample = device.read_image(deadline=deadline())
    pixels = sample.usable(now_s=asked_s, max_age_s=OLDEST_S, device=name).pixels
    _refuse_frozen(session, name, sample, pixels)
    return Look(
        pixels=pixels,
        stamp_s=sample.host_time_s,
        camera=name,
        intrinsics=session.lens(name),
        base_from_camera=base_from(session, name),
    )


def look_with_lights(session: Session) -> LightPair:
    """The panel with its border lights off, then on; they are off again afterwards."""
    name, lights = only_device(session, DeviceKind.LIGHTS)
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


def scan(session: Session) -> Scan:
    """One range image from where the arm stands now; the arm must be at rest. A line scanner is swept for it."""
    name, device = only_device(session, DeviceKind.RANGE_SCANNER)
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
        )
    asked_s = session.connection.clock.now_s()
    sample = device.read_range(deadline=deadline())
    depth_m = sample.usable(now_s=asked_s, max_age_s=OLDEST_S, device=name).depth_m
    _refuse_frozen(session, name, sample, depth_m)
    return Scan(
        depth_m=depth_m,
        stamp_s=sample.host_time_s,
        scanner=name,
        capabilities=capabilities,
        base_from_scanner=base_from(session, name),
    )


def base_from(session: Session, device: str) -> UncertainPose:
    """Where a mounted device stands now, with the covariance of its calibration."""
    cell: Cell = session.connection.cell
    return frame_tree(cell, session.connection.mover.state().base_from_flange).base_from(device)


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
    """Raise `StaleReading` where a camera or scanner repeats a frame under a new stamp."""
    newest = plausibility.Frame.of(array, stamp_s=sample.host_time_s)
    finding = plausibility.repeated_frame(name, session.world.note_frame(name, newest), newest)
    if finding is not None:
        raise finding.error()
