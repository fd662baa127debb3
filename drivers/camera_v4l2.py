"""V4L2 camera (USB webcams, MIPI) by OpenCV: one thread grabs, and readers get a frame exposed after their call."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Protocol

import cv2
from numpy.typing import NDArray
from pydantic import Field

from drivers.kinds.cameras import LensOptions, nominal, to_pixels
from drivers.transport.device import PortDevice
from drivers.transport.link import LinkLost, NoAnswer, now_s
from drivers.transport.mailbox import IMAGES_RING
from drivers.transport.options import read_options
from drivers.transport.port import Port
from hal.clock import Deadline
from hal.devices import CameraCapabilities, DeviceKind, Image
from hal.errors import DeviceUnavailable
from hal.readings import Stamped
from hal.registry import Context, takes
from hal.wires import ResourceClaim, WireOptions

GRAB_FAILURES = 3
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
    exposure_s: Annotated[
        Annotated[float, Field(gt=0, le=1)] | None, Field(description="exposure time; automatic exposure if not given")
    ] = None

    def claims(self) -> tuple[ResourceClaim, ...]:
        """Claim the camera."""
        return (ResourceClaim(wire=f"camera {self.device}"),)


class Grabber(Protocol):
    """The part of an OpenCV capture that the driver uses."""

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
        self._video.set(cv2.CAP_PROP_FRAME_WIDTH, options.width_px)
        self._video.set(cv2.CAP_PROP_FRAME_HEIGHT, options.height_px)
        self._video.set(cv2.CAP_PROP_FPS, options.rate_hz)
        self._video.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if options.exposure_s is not None:
            self._video.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)  # manual
            self._video.set(cv2.CAP_PROP_EXPOSURE, options.exposure_s / EXPOSURE_UNIT_S)

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
        opener = open_grabber or (lambda: Capture(options, context.name))
        self.port: Port[Grabber] = Port(context.name, open_link=opener, tenant=self)

    def capabilities(self) -> CameraCapabilities:
        """Return the requested size and lens; frames of another size are rejected."""
        o = self._options
        return CameraCapabilities(
            width_px=o.width_px,
            height_px=o.height_px,
            is_colour=o.is_colour,
            rate_hz=o.rate_hz,
            nominal=nominal(o.width_px, o.height_px, o),
        )

    def read_image(self, *, deadline: Deadline) -> Stamped[Image]:
        """Return a frame whose exposure began after this call.

        Its stamp is one period before arrival, the earliest possible.
        """
        return self.newest(deadline, not_before_s=self.context.clock.now_s())

    def set_up(self, link: Grabber) -> None:  # noqa: ARG002  # there is nothing to configure
        """Do nothing: the grabber is configured when it is opened."""
        self._failures = 0

    def serve(self, link: Grabber) -> None:
        """Grab and publish one frame."""
        is_good, frame = link.read()
        arrived_s = now_s()
        if not is_good:
            self._failures += 1
            self.errors += 1
            if self._failures >= GRAB_FAILURES:
                raise LinkLost(f"{self.link_name()} delivers no more frames")
            return
        self._failures = 0
        o = self._options
        if frame.shape[:2] != (o.height_px, o.width_px):
            raise NoAnswer(
                f"the camera delivers {frame.shape[1]}x{frame.shape[0]} instead of {o.width_px}x{o.height_px}"
            )
        image = Image(pixels=to_pixels(frame, is_colour=o.is_colour), exposure_s=o.exposure_s or 1.0 / o.rate_hz)
        self.publish(image, valid_s=arrived_s - 1.0 / o.rate_hz)

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
