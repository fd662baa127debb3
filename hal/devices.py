"""The eight device kinds. Synchronous; every call that touches the device takes a deadline.

Common promises (checked by `hal.conformance`):
- a read returns the newest sample with its stamps and never an old one as new; the stamp and sequence tell;
- silence raises `DeviceTimeout` before the deadline plus 50 ms; a broken device raises `DeviceFault`; a lost one
  `DeviceUnavailable`;
- `health` never blocks on the device; `close` is idempotent and bounded; after it every call raises
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
from hal.clock import Deadline
from hal.readings import Cause, Quality, Stamped


class DeviceKind(StrEnum):
    """The eight kinds."""

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
    """What a device's owner knows about it without asking the wire."""

    connected: bool
    quality: Quality
    cause: Cause
    detail: str = ""
    samples: int = 0
    errors: int = 0
    reconnects: int = 0
    last_sample_s: float | None = None


class Device(Protocol):
    """What all kinds share."""

    @property
    def name(self) -> str:
        """Name in the cell file."""
        ...

    @property
    def kind(self) -> DeviceKind:
        """Which of the eight interfaces this is."""
        ...

    def health(self) -> Health:
        """State of the link and the newest sample; returns at once."""
        ...

    def close(self) -> None:
        """Release port and thread; a second call does nothing."""
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
    """Kinematics and limits; `flange` is the frame after the last link.

    `link_radius_m` gives, per link, the radius of a capsule round the segment from joint i to joint i + 1, for
    collision checks. `resolution_rad` is the least step of a joint, measured and commanded, where it matters: an arm
    with 1.5 mrad moves its tip in steps of a millimetre, and the hand's inertia makes newtons of each.
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
    """Measured joints, (n,) each. `is_enabled`: drives follow commands."""

    position_rad: Array
    velocity_rad_per_s: Array
    is_enabled: bool = True
    is_moving: bool = False


@runtime_checkable
class Arm(Device, Protocol):
    """A position-controlled serial arm that follows streamed set-points at `command_rate_hz`."""

    def capabilities(self) -> ArmCapabilities:
        """Kinematics and limits."""
        ...

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Newest measured joints."""
        ...

    def command_position(self, position_rad: Array, *, deadline: Deadline) -> Array:
        """Stream one set-point, (n,) rad; returns what was really sent (clipped to limits).

        When set-points stop coming for `watchdog_s`, the drive stops the arm by itself.
        """
        ...

    def enable(self, *, deadline: Deadline) -> None:
        """Let the drives follow commands; the first set-point is the measured position, so nothing moves."""
        ...

    def stop(self, *, deadline: Deadline) -> None:
        """Decelerate at the limit and refuse commands until `enable`. Allowed from any thread at any time."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperCapabilities:
    """Opening between the pads, from closed to open. `tip_from_flange` geometry is a calibration record."""

    min_width_m: float
    max_width_m: float
    max_force_n: float
    max_speed_m_per_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperState:
    """Pad opening and grip."""

    width_m: float
    force_n: float
    is_moving: bool
    is_holding: bool


@runtime_checkable
class Gripper(Device, Protocol):
    """Parallel gripper."""

    def capabilities(self) -> GripperCapabilities:
        """Range of widths, forces and speeds."""
        ...

    def read_state(self, *, deadline: Deadline) -> Stamped[GripperState]:
        """Newest width and grip."""
        ...

    def command(self, *, width_m: float, force_n: float, speed_m_per_s: float, deadline: Deadline) -> float:
        """Start to move towards `width_m` with at most `force_n`; returns the width really commanded. Does not wait."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCapabilities:
    """Image size and the maker's nominal lens; the calibration record has the true one."""

    width_px: int
    height_px: int
    is_colour: bool
    rate_hz: float
    nominal: CameraIntrinsics


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Image:
    """`pixels`: uint8, (H, W) gray or (H, W, 3) RGB."""

    pixels: NDArray[np.uint8]
    exposure_s: float


@runtime_checkable
class Camera(Device, Protocol):
    """A camera that delivers undistorted-in-time frames (global shutter)."""

    def capabilities(self) -> CameraCapabilities:
        """Size, colour and nominal lens."""
        ...

    def read_image(self, *, deadline: Deadline) -> Stamped[Image]:
        """A frame whose exposure began after this call was made."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeScannerCapabilities:
    """Geometry of the range image.

    `pinhole`: point = ((u - cx)/fx z, (v - cy)/fy z, z), z along the view. `orthographic`: fx, fy in pixels per metre,
    point = ((u - cx)/fx, (v - cy)/fy, z). `polar`: one line of `width` beams from `first_angle_rad` in steps of
    `step_angle_rad` about the sensor's y axis, distances along the beam.
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

    @property
    def needs_sweep(self) -> bool:
        """Is one reading only a line, which becomes an image when the wrist sweeps the scanner (`SweptScanner`)?"""
        return self.projection == "polar"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeImage:
    """`depth_m`: float32 (height, width), NaN where the sensor saw nothing. Axes as the camera's."""

    depth_m: NDArray[np.float32]


@runtime_checkable
class RangeScanner(Device, Protocol):
    """A range scanner."""

    def capabilities(self) -> RangeScannerCapabilities:
        """Geometry and limits."""
        ...

    def read_range(self, *, deadline: Deadline) -> Stamped[RangeImage]:
        """A range image whose scan began after this call was made."""
        ...


@runtime_checkable
class SweptScanner(RangeScanner, Protocol):
    """A line scanner, whose scans are kept one by one while the wrist sweeps it."""

    def start_recording(self, *, deadline: Deadline) -> None:
        """Keep every scan that ends from now on; what an earlier recording kept is dropped."""
        ...

    def end_recording(self, *, deadline: Deadline) -> tuple[Stamped[RangeImage], ...]:
        """Stop keeping scans; returns those kept since `start_recording`, oldest first, each stamped with its end."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ProximityCapabilities:
    """The beam leaves the sensor along +z of its mount; `sigma_m` is the maker's noise figure."""

    min_range_m: float
    max_range_m: float
    sigma_m: float
    rate_hz: float


@runtime_checkable
class Proximity(Device, Protocol):
    """Distance from a fingertip to the nearest surface along the finger axis."""

    def capabilities(self) -> ProximityCapabilities:
        """Range, noise and rate."""
        ...

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Newest distance; quality `invalid`, cause `out-of-range`, value NaN when nothing is within range."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchCapabilities:
    """One switch a pad; `channels` names them."""

    channels: tuple[str, ...]
    threshold_n: float
    rate_hz: float


@runtime_checkable
class Touch(Device, Protocol):
    """Contact switches on the finger pads and tips."""

    def capabilities(self) -> TouchCapabilities:
        """Channels and threshold."""
        ...

    def read_contacts(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Newest state of each channel."""
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
    """Force and torque that the world exerts on the tool, in sensor axes about the sensor's origin; (3,) each."""

    force_n: Array
    torque_nm: Array


@runtime_checkable
class ForceTorque(Device, Protocol):
    """Wrist force/torque sensor, raw: bias and tool weight are still inside (see `hal.calibration.ToolLoad`)."""

    def capabilities(self) -> ForceTorqueCapabilities:
        """Range, noise and rate."""
        ...

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        """Newest raw wrench."""
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
        """Channels and how long a lamp takes to settle."""
        ...

    def set_on(self, on: Sequence[bool], *, deadline: Deadline) -> tuple[bool, ...]:
        """Switch all channels; returns what was really commanded."""
        ...

    def read_on(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Newest feedback of each channel."""
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
