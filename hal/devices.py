"""Interfaces of the eight device kinds. They are synchronous, and every call that reaches the device takes a deadline.

All devices guarantee (checked by `hal.conformance`):
- a read returns the newest sample; its stamp and sequence show whether it is new;
- a silent device raises `DeviceTimeout` at the latest 50 ms after the deadline, a broken one `DeviceFault`, and a
  disconnected one `DeviceUnavailable`;
- `health` never waits for the device; `close` ends in bounded time, may be called twice, and after it every call raises
  `DeviceUnavailable`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_settings import UNKNOWN, CameraSettings
from hal.clock import Deadline
from hal.readings import Cause, Quality, Stamped


class DeviceKind(StrEnum):
    """The eight device kinds."""

    ARM = "arm"
    GRIPPER = "gripper"
    CAMERA = "camera"
    RANGE_SCANNER = "range_scanner"
    PROXIMITY = "proximity"
    TOUCH = "touch"
    FORCE_TORQUE = "force_torque"
    LIGHTS = "lights"


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """State of a device as its driver knows it, without communicating with the device."""

    connected: bool
    quality: Quality
    cause: Cause
    detail: str = ""
    samples: int = 0
    errors: int = 0
    reconnects: int = 0
    last_sample_s: float | None = None


class Device(Protocol):
    """Interface that all kinds share."""

    @property
    def name(self) -> str:
        """Name in the cell file."""
        ...

    @property
    def kind(self) -> DeviceKind:
        """Kind of the device, which states the interface that it implements."""
        ...

    def health(self) -> Health:
        """Return the state of the link and of the newest sample, at once."""
        ...

    def close(self) -> None:
        """Release the port and the thread; a second call does nothing."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DhLink:
    """One joint of a standard Denavit-Hartenberg chain: Rz(theta + offset) Tz(d) Tx(a) Rx(alpha)."""

    d_m: float
    a_m: float
    alpha_rad: float
    offset_rad: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArmCapabilities:
    """Kinematics and limits of an arm; `flange` is the frame after the last link.

    `link_radius_m` gives, per link, the radius of a capsule around the segment from joint i to joint i + 1, for
    collision checks. `watchdog_s` is the time without set-points after which the drive stops the arm. `resolution_rad`
    is the smallest step of a joint, measured and commanded, if it matters: steps of 1.5 mrad move the tip by a
    millimetre each, and the inertia of the hand turns each step into a force of some newtons.
    """

    model: str
    links: tuple[DhLink, ...]
    lower_rad: tuple[float, ...]
    upper_rad: tuple[float, ...]
    velocity_rad_per_s: tuple[float, ...]
    acceleration_rad_per_s2: tuple[float, ...]
    tip_speed_m_per_s: float
    command_rate_hz: float
    link_radius_m: tuple[float, ...]
    watchdog_s: float | None = None
    resolution_rad: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointState:
    """Measured joint positions and velocities, (n,) each; `is_enabled` tells whether the drives follow commands."""

    position_rad: Array
    velocity_rad_per_s: Array
    is_enabled: bool = True
    is_moving: bool = False


@runtime_checkable
class Arm(Device, Protocol):
    """Position-controlled serial arm that follows set-points streamed at `command_rate_hz`."""

    def capabilities(self) -> ArmCapabilities:
        """Return kinematics and limits."""
        ...

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Return the newest measured joint state."""
        ...

    def command_position(self, position_rad: Array, *, deadline: Deadline) -> Array:
        """Send one set-point, (n,) rad, and return what was really sent, which is clipped to the limits.

        If no set-point arrives for `watchdog_s`, the drive stops the arm by itself.
        """
        ...

    def enable(self, *, deadline: Deadline) -> None:
        """Make the drives follow commands; the first set-point is the measured position, so the arm does not move."""
        ...

    def stop(self, *, deadline: Deadline) -> None:
        """Decelerate at the limit and refuse commands until `enable`; any thread may call this at any time."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperCapabilities:
    """Limits of a gripper; its width is the opening between the pads. Its mounting is a calibration record."""

    min_width_m: float
    max_width_m: float
    max_force_n: float
    max_speed_m_per_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperState:
    """Opening between the pads, grip force and motion."""

    width_m: float
    force_n: float
    is_moving: bool
    is_holding: bool


@runtime_checkable
class Gripper(Device, Protocol):
    """Parallel gripper."""

    def capabilities(self) -> GripperCapabilities:
        """Return the limits of width, force and speed."""
        ...

    def read_state(self, *, deadline: Deadline) -> Stamped[GripperState]:
        """Return the newest width and grip."""
        ...

    def command(self, *, width_m: float, force_n: float, speed_m_per_s: float, deadline: Deadline) -> float:
        """Start to move to `width_m` with at most `force_n`, without waiting, and return the width really commanded."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCapabilities:
    """Image size, nominal intrinsics (the calibration record holds the measured ones), and the settings in force."""

    width_px: int
    height_px: int
    is_colour: bool
    rate_hz: float
    nominal: CameraIntrinsics
    settings: CameraSettings = UNKNOWN


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Image:
    """Image; `pixels` are uint8, (H, W) gray or (H, W, 3) RGB."""

    pixels: NDArray[np.uint8]
    exposure_s: float


@runtime_checkable
class Camera(Device, Protocol):
    """Camera that exposes all rows of a frame at the same time (global shutter)."""

    def capabilities(self) -> CameraCapabilities:
        """Return image size, colour and nominal intrinsics."""
        ...

    def read_image(self, *, deadline: Deadline) -> Stamped[Image]:
        """Return a frame whose exposure began after this call."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeScannerCapabilities:
    """Geometry, limits and noise of a range image.

    `pinhole`: point = ((u - cx)/fx z, (v - cy)/fy z, z), z along the view. `orthographic`: fx, fy in pixels per metre,
    point = ((u - cx)/fx, (v - cy)/fy, z). `polar`: one line of `width` beams from `first_angle_rad` in steps of
    `step_angle_rad` about the sensor's y axis, distances along the beam. `sigma_m` is the noise of one distance, and
    `bias_sigma_m` one sigma of an error that all of them have in common.
    """

    projection: Literal["pinhole", "orthographic", "polar"]
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    min_range_m: float
    max_range_m: float
    sigma_m: float
    rate_hz: float
    first_angle_rad: float = 0.0
    step_angle_rad: float = 0.0
    bias_sigma_m: float = 0.0

    @property
    def needs_sweep(self) -> bool:
        """Whether one reading is a single line, so the wrist must sweep the scanner for an image (`SweptScanner`)."""
        return self.projection == "polar"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeImage:
    """Range image; `depth_m` is float32 (height, width), NaN where nothing was measured, in the axes of a camera."""

    depth_m: NDArray[np.float32]


@runtime_checkable
class RangeScanner(Device, Protocol):
    """Range scanner: a depth camera or a line scanner."""

    def capabilities(self) -> RangeScannerCapabilities:
        """Return geometry, limits and noise."""
        ...

    def read_range(self, *, deadline: Deadline) -> Stamped[RangeImage]:
        """Return a range image whose scan began after this call."""
        ...


@runtime_checkable
class SweptScanner(RangeScanner, Protocol):
    """Line scanner that records its scans while the wrist sweeps it."""

    def start_recording(self, *, deadline: Deadline) -> None:
        """Record every scan that ends after this call; scans of an earlier recording are discarded."""
        ...

    def end_recording(self, *, deadline: Deadline) -> tuple[Stamped[RangeImage], ...]:
        """Stop recording and return the scans since `start_recording`, oldest first, each stamped with its end."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ProximityCapabilities:
    """Range and noise; the beam leaves along +z of the sensor's mount; `sigma_m` is the manufacturer's noise figure."""

    min_range_m: float
    max_range_m: float
    sigma_m: float
    rate_hz: float


@runtime_checkable
class Proximity(Device, Protocol):
    """Distance from a fingertip to the nearest surface along the finger axis."""

    def capabilities(self) -> ProximityCapabilities:
        """Return range, noise and rate."""
        ...

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Return the newest distance; NaN, quality `invalid` and cause `out-of-range` if nothing is within range."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchCapabilities:
    """Touch switches: `channels` names them, one per pad."""

    channels: tuple[str, ...]
    threshold_n: float
    rate_hz: float


@runtime_checkable
class Touch(Device, Protocol):
    """Contact switches on the finger pads and tips."""

    def capabilities(self) -> TouchCapabilities:
        """Return channels, threshold and rate."""
        ...

    def read_contacts(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Return the newest state of each channel."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceTorqueCapabilities:
    """Measuring range and noise (one sigma)."""

    force_range_n: float
    torque_range_nm: float
    force_sigma_n: float
    torque_sigma_nm: float
    rate_hz: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Wrench:
    """Force and torque that the environment exerts on the tool, in sensor axes about the sensor's origin; (3,) each."""

    force_n: Array
    torque_nm: Array


@runtime_checkable
class ForceTorque(Device, Protocol):
    """Wrist force/torque sensor; its wrench still contains bias and tool weight (see `hal.calibration.ToolLoad`)."""

    def capabilities(self) -> ForceTorqueCapabilities:
        """Return range, noise and rate."""
        ...

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        """Return the newest raw wrench."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class LightsCapabilities:
    """Switched lights; `channels` are the names of the panel's border lights, in order."""

    channels: tuple[str, ...]
    settle_s: float


@runtime_checkable
class Lights(Device, Protocol):
    """The panel's border lights."""

    def capabilities(self) -> LightsCapabilities:
        """Return the channels and the time that a lamp takes to settle."""
        ...

    def set_on(self, on: Sequence[bool], *, deadline: Deadline) -> tuple[bool, ...]:
        """Switch all channels and return what was really commanded."""
        ...

    def read_on(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Return the newest feedback of each channel."""
        ...


PROTOCOLS: dict[DeviceKind, type] = {
    DeviceKind.ARM: Arm,
    DeviceKind.GRIPPER: Gripper,
    DeviceKind.CAMERA: Camera,
    DeviceKind.RANGE_SCANNER: RangeScanner,
    DeviceKind.PROXIMITY: Proximity,
    DeviceKind.TOUCH: Touch,
    DeviceKind.FORCE_TORQUE: ForceTorque,
    DeviceKind.LIGHTS: Lights,
}
