"""V4L2 camera (USB webcams, MIPI) by OpenCV: one thread grabs, and readers get a frame exposed after their call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import cv2
from numpy.typing import NDArray
from pydantic import Field

from drivers.kinds.cameras import ExposureSetter, LensOptions, nominal, to_pixels
from drivers.transport.device import PortDevice
from drivers.transport.link import LinkLost, NoAnswer, now_s
from drivers.transport.mailbox import IMAGES_RING
from drivers.transport.options import read_options
from drivers.transport.port import Port
from drivers.transport.timebase import Pauses
from hal.camera_settings import UNKNOWN, CameraSettings
from hal.clock import Deadline
from hal.devices import CameraCapabilities, DeviceKind, Image
from hal.errors import DeviceUnavailable
from hal.readings import Stamped
from hal.registry import Context, takes
from hal.wires import ResourceClaim, WireOptions

GRAB_FAILURES = 3
OLDEST_S = 2.0  # a stamp farther away is of another clock
IN_WORK = 3  # frames that the camera, the kernel and OpenCV may hold with the exposure before
EXPOSURE_UNIT_S = 1e-4  # V4L2_CID_EXPOSURE_ABSOLUTE counts 100 us


class CameraV4l2Options(LensOptions, WireOptions):
    """Options of `v4l2:camera`; a name under `/dev/v4l/by-id` survives re-plugging."""

    device: Annotated[
        Path,
        Field(
            description="device file; a name under `/dev/v4l/by-id` stays the same when the camera is plugged in again"
        ),
    ] = Path("/dev/video0")
    width_px: Annotated[int, Field(ge=16, le=10_000, description="width of the image that is asked for")] = 640
    height_px: Annotated[int, Field(ge=16, le=10_000, description="height of the image that is asked for")] = 480
    rate_hz: Annotated[float, Field(gt=0, le=1000, description="images per second that are asked for")] = 30.0
    is_colour: Annotated[bool, Field(description="whether the images are RGB; else they are grey")] = True
    pixel_format: Annotated[
        str | None, Field(pattern="^[A-Z0-9]{4}$", description="how the camera sends pixels, such as `MJPG` or `YUYV`")
    ] = None
    exposure_s: Annotated[
        Annotated[float, Field(gt=0, le=1)] | None, Field(description="exposure time; automatic exposure if not given")
    ] = None
    gain: Annotated[
        Annotated[float, Field(ge=0)] | None,
        Field(description="gain in the camera's own steps; not changed if not given"),
    ] = None
    white_balance_k: Annotated[
        Annotated[float, Field(ge=1000, le=20_000)] | None,
        Field(description="colour temperature of the light, in kelvin; automatic white balance if not given"),
    ] = None

    def claims(self) -> tuple[ResourceClaim, ...]:
        """Claim the camera."""
        return (ResourceClaim(wire=f"camera {self.device}"),)


class Grabber(Protocol):
    """The part of an OpenCV capture that the driver uses; size, rate and settings are those that the camera has taken."""

    size_px: tuple[int, int]
    rate_hz: float
    settings: CameraSettings

    def captured_s(self) -> float | None:
        """Return the stamp that the kernel gave to the last frame, on the links' clock; None if there is none."""
        ...

    def set_exposure(self, exposure_s: float) -> float | None:
        """Set the exposure of the frames to come; return the one that the camera has taken, or None if it does not tell."""
        ...

    def read(self) -> tuple[bool, NDArray[Any]]:
        """Wait for the next frame; return whether it was read, and its pixels."""
        ...

    def close(self) -> None:
        """Release the camera."""
        ...


class Capture:
    """Open V4L2 device."""

    def __init__(self, options: CameraV4l2Options, name: str) -> None:
        if not options.device.exists():
            there = ", ".join(str(p) for p in sorted(Path("/dev").glob("video*"))) or "none"
            raise DeviceUnavailable(
                f"{name}: {options.device} does not exist", hint=f"plug the camera in; there are: {there}", device=name
            )
        self._video = cv2.VideoCapture(str(options.device), cv2.CAP_V4L2)
        if not self._video.isOpened():
            raise DeviceUnavailable(
                f"{name}: {options.device} cannot be opened as a camera",
                hint="another program may hold it, or your user is not in the group `video`",
                device=name,
            )
        if options.pixel_format is not None:
            self._video.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*options.pixel_format))
        self._video.set(cv2.CAP_PROP_FRAME_WIDTH, options.width_px)
        self._video.set(cv2.CAP_PROP_FRAME_HEIGHT, options.height_px)
        self._video.set(cv2.CAP_PROP_FPS, options.rate_hz)
        self._video.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._write(options)
        get = self._video.get
        self.size_px = (round(get(cv2.CAP_PROP_FRAME_WIDTH)), round(get(cv2.CAP_PROP_FRAME_HEIGHT)))
        self.rate_hz = get(cv2.CAP_PROP_FPS) or options.rate_hz
        code = round(get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True)
        self.settings = CameraSettings(
            pixel_format=code.decode("ascii", "replace"),
            exposure_s=None if options.exposure_s is None else self._known(cv2.CAP_PROP_EXPOSURE, EXPOSURE_UNIT_S),
            gain_db=self._known(cv2.CAP_PROP_GAIN, 1.0),
            exposure_range_s=None if options.exposure_s is None else (EXPOSURE_UNIT_S, 1.0 / self.rate_hz),
        )

    def _write(self, options: CameraV4l2Options) -> None:
        if options.exposure_s is not None:
            self._video.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)  # manual
            self.set_exposure(options.exposure_s)
        if options.gain is not None:
            self._video.set(cv2.CAP_PROP_GAIN, options.gain)
        if options.white_balance_k is not None:
            self._video.set(cv2.CAP_PROP_AUTO_WB, 0)
            self._video.set(cv2.CAP_PROP_WB_TEMPERATURE, options.white_balance_k)

    def set_exposure(self, exposure_s: float) -> float | None:
        """Set the exposure of the frames to come; return the one that the camera has taken, or None if it does not tell."""
        self._video.set(cv2.CAP_PROP_EXPOSURE, exposure_s / EXPOSURE_UNIT_S)
        return self._known(cv2.CAP_PROP_EXPOSURE, EXPOSURE_UNIT_S)

    def _known(self, name: int, unit: float) -> float | None:
        value = float(self._video.get(name))
        return value * unit if value > 0.0 else None  # OpenCV gives 0 or -1 for what the camera has not

    def captured_s(self) -> float | None:
        """Return the kernel's stamp of the last frame, if it is on the monotonic clock, as for all USB cameras."""
        stamp_s, here_s = 1e-3 * float(self._video.get(cv2.CAP_PROP_POS_MSEC)), now_s()
        return stamp_s if here_s - OLDEST_S < stamp_s <= here_s else None

    def read(self) -> tuple[bool, NDArray[Any]]:
        """Wait for the next frame; return whether it was read, and its pixels."""
        is_good, frame = self._video.read()
        return bool(is_good), frame

    def close(self) -> None:
        """Release the camera."""
        self._video.release()


class CameraV4l2(PortDevice[Image]):
    """Live V4L2 camera."""

    kind = DeviceKind.CAMERA
    ring = IMAGES_RING

    def __init__(
        self, context: Context, options: CameraV4l2Options, open_grabber: Callable[[], Grabber] | None = None
    ) -> None:
        super().__init__(context, max_age_s=3.0 / options.rate_hz)
        self._options = options
        self._failures = 0
        self._rate_hz = options.rate_hz
        self._settings = UNKNOWN
        self._setter = ExposureSetter()
        self._in_work = 0  # frames to come that were exposed as before
        self._pauses = Pauses(longest_s=1.0 / options.rate_hz)
        opener = open_grabber or (lambda: Capture(options, context.name))
        self.port: Port[Grabber] = Port(context.name, open_link=opener, tenant=self)

    def capabilities(self) -> CameraCapabilities:
        """Return the requested size and lens, frames of another size being rejected, and what the camera has taken."""
        o = self._options
        return CameraCapabilities(
            width_px=o.width_px,
            height_px=o.height_px,
            is_colour=o.is_colour,
            rate_hz=self._rate_hz,
            nominal=nominal(o.width_px, o.height_px, o),
            settings=self._settings,
        )

    def read_image(self, *, deadline: Deadline) -> Stamped[Image]:
        """Return a frame whose exposure began after this call.

        Its stamp is the earliest possible: one period before the kernel's stamp, or before arrival if there is none. Without
        the kernel's stamp a frame that ends a pause is left out, because it may have been held up.
        """
        return self.newest(deadline, not_before_s=self.context.clock.now_s())

    def set_exposure(self, exposure_s: float, *, deadline: Deadline) -> None:
        """Set the exposure of the frames that are read after this call."""
        self._setter.set(self, self._settings, exposure_s, deadline)

    def set_up(self, link: Grabber) -> None:
        """Take over what the camera has accepted (owner thread)."""
        self._failures = 0
        self._pauses.reset()
        self._rate_hz, self._settings = link.rate_hz, link.settings
        self._check_size(link.size_px)

    def _check_size(self, size_px: tuple[int, int]) -> None:
        o = self._options
        if size_px != (o.width_px, o.height_px):
            raise NoAnswer(f"the camera delivers {size_px[0]}x{size_px[1]} instead of {o.width_px}x{o.height_px}")

    def serve(self, link: Grabber) -> None:
        """Grab and publish one frame."""
        if (wanted_s := self._setter.wanted_s()) is not None:
            self._settings = replace(self._settings, exposure_s=link.set_exposure(wanted_s) or wanted_s)
            self._in_work = IN_WORK
            self._setter.confirm()
        is_good, frame = link.read()
        arrived_s = now_s()
        if not is_good:
            self._failures += 1
            self.errors += 1
            if self._failures >= GRAB_FAILURES:
                raise LinkLost(f"{self.link_name()} delivers no more frames")
            return
        self._failures = 0
        self._check_size((frame.shape[1], frame.shape[0]))
        if self._in_work > 0:
            self._in_work -= 1
            return
        captured_s = link.captured_s()
        if self._pauses.may_be_held_up(arrived_s, 1) and captured_s is None:
            self.errors += 1  # without the kernel's stamp nothing shows how old it is
            return
        stamped_by: Literal["device", "arrival"] = "arrival" if captured_s is None else "device"
        if stamped_by != self._settings.stamped_by:
            self._settings = replace(self._settings, stamped_by=stamped_by)
        period_s = 1.0 / self._rate_hz
        exposure_s = self._settings.exposure_s or self._options.exposure_s or period_s
        image = Image(pixels=to_pixels(frame, is_colour=self._options.is_colour), exposure_s=exposure_s)
        self.publish(image, valid_s=(captured_s or arrived_s) - period_s, device_time_s=captured_s)

    def link_name(self) -> str:
        """Return the device's path."""
        return f"v4l2 {self._options.device}"


@takes(CameraV4l2Options)
def connect(context: Context, options: dict[str, Any]) -> CameraV4l2:
    """Entry point `v4l2:camera`."""
    device = CameraV4l2(context, read_options(context, options, CameraV4l2Options))
    device.port.start()
    device.await_first()
    return device
