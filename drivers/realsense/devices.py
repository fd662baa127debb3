"""RealSense depth and colour as a range scanner and a camera; each has its own thread and may have its own process."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Annotated, Any, Protocol, TypeVar

import numpy as np
from pydantic import Field

from drivers.kinds.cameras import ExposureSetter, to_pixels
from drivers.realsense.stream import RealsenseFrame, RealsenseOptions, RealsenseStream, StreamFacts
from drivers.transport.device import SLICE_S, PortDevice
from drivers.transport.link import LinkLost, NoAnswer, RecordingEnded, now_s
from drivers.transport.mailbox import IMAGES_RING
from drivers.transport.options import read_options
from drivers.transport.port import Port
from drivers.transport.timebase import HostTime
from hal.clock import Deadline
from hal.devices import CameraCapabilities, DeviceKind, Image, RangeImage, RangeScannerCapabilities
from hal.errors import DeviceUnavailable, Unsupported
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes

T = TypeVar("T")
SILENCE_S = 1.0
CONNECT_S = 6.0
DEFAULT_RATE_HZ = 30.0
IN_WORK = 3  # frames that the camera and the library may hold with the exposure before


class DepthOptions(RealsenseOptions):
    """Options of `realsense:depth`."""

    emitter: Annotated[bool | None, Field(description="switch the pattern projector on or off")] = None
    laser_power_mw: Annotated[
        Annotated[float, Field(ge=0, le=1000)] | None, Field(description="power of the pattern projector")
    ] = None
    min_range_m: Annotated[float, Field(ge=0, description="nearer readings are left out")] = 0.1
    max_range_m: Annotated[float, Field(gt=0, description="farther readings are left out")] = 4.0
    sigma_m: Annotated[float, Field(gt=0, description="noise of one reading at the working distance, one sigma")] = (
        0.003
    )

    def stream_name(self) -> str:
        """Return `depth`."""
        return "depth"


class ColourOptions(RealsenseOptions):
    """Options of `realsense:camera`."""

    is_colour: Annotated[bool, Field(description="false gives grey images")] = True

    def stream_name(self) -> str:
        """Return `color`."""
        return "color"


class FrameStream(Protocol):
    """The part of `RealsenseStream` that the drivers use."""

    facts: StreamFacts

    def wait(self, timeout_s: float) -> RealsenseFrame | None:
        """Return the next frame, or None when none comes in time."""
        ...

    def set_exposure(self, exposure_s: float) -> None:
        """Set the exposure of the frames to come."""
        ...

    def check(self) -> None:
        """Raise `LinkLost` if the camera is gone."""
        ...

    def close(self) -> None:
        """Stop the stream."""
        ...


class RealsenseDevice(PortDevice[T]):
    """What both drivers share: numbers, stamps and silence of the frames."""

    ring = IMAGES_RING

    def __init__(
        self, context: Context, options: RealsenseOptions, open_stream: Callable[[], FrameStream] | None = None
    ) -> None:
        rate_hz = float(options.rate_hz or DEFAULT_RATE_HZ)
        super().__init__(context, max_age_s=3.0 / rate_hz + (options.latency_s or 1.0 / rate_hz))
        self._stream_options = options
        self._facts: StreamFacts | None = None
        self._time = HostTime()
        self._last_number: int | None = None
        self._heard_s = now_s()
        self._has_ended = False
        self.setter = ExposureSetter()
        self._in_work = 0  # frames to come that were exposed as before
        self._open_stream = open_stream or (lambda: RealsenseStream(options, context.name))
        self.port: Port[FrameStream] = Port(context.name, open_link=self._open, tenant=self)

    @abstractmethod
    def give(self, frame: RealsenseFrame, valid_s: float, missed: int) -> None:
        """Publish a frame that is new."""

    def facts(self) -> StreamFacts:
        """Return what the camera says about its stream.

        Raises:
            DeviceUnavailable: it has never been connected.
        """
        if self._facts is None:
            raise DeviceUnavailable(f"{self.name} is not connected yet", hint="plug the camera in", device=self.name)
        return self._facts

    def set_up(self, link: FrameStream) -> None:
        """Take over what the camera says (owner thread)."""
        self._facts = link.facts
        self._time.reset()
        self._last_number = None
        self._heard_s = now_s()

    def serve(self, link: FrameStream) -> None:
        """Wait for one frame and publish it (owner thread)."""
        if (wanted_s := self.setter.wanted_s()) is not None:
            link.set_exposure(wanted_s)
            self._facts, self._in_work = link.facts, IN_WORK
            self.setter.confirm()
        frame = link.wait(SLICE_S)
        if frame is None:
            self._bear_silence(link)
            return
        self._heard_s = now_s()
        missed = self._missed(frame.number)
        if missed is None:
            self.errors += 1
            return
        if self._in_work > 0:
            self._in_work -= 1
            return
        left_s = self._time.host_s(device_s=frame.device_s, arrived_s=frame.arrived_s)
        settings = self.facts().settings
        latency_s = max(settings.latency_s, frame.exposure_s or 0.0)
        lens = self.facts().intrinsics
        if frame.data.shape[:2] != (lens.height_px, lens.width_px):
            raise NoAnswer(f"a frame has shape {frame.data.shape} instead of {lens.height_px}x{lens.width_px}")
        self.give(frame, left_s - latency_s, missed)

    def _bear_silence(self, link: FrameStream) -> None:
        if now_s() - self._heard_s <= SILENCE_S:
            return
        link.check()
        options = self._stream_options
        if options.recording is not None and not options.repeat:
            self._has_ended = True
            raise self._ended()
        raise NoAnswer("the camera is connected, but sends no frames: use a USB 3 port and cable")

    def _open(self) -> FrameStream:
        if self._has_ended:
            raise self._ended()
        return self._open_stream()

    def _ended(self) -> RecordingEnded:
        return RecordingEnded(f"all of {self._stream_options.recording} has been shown")

    def _missed(self, number: int) -> int | None:
        """Return how many frames are missing before this one; None for a repeated frame."""
        last, self._last_number = self._last_number, number
        if last is None:
            return 0
        if number == last:
            return None
        if number < last:  # the camera or the recording begins again, and its clock with it
            self._time = HostTime()
            return 0
        return number - last - 1

    def link_name(self) -> str:
        """Return the camera's serial number, or the recording."""
        options = self._stream_options
        if options.recording is not None:
            return f"recording {options.recording}"
        return f"RealSense {self._facts.serial if self._facts else options.serial or ''}".rstrip()


class RealsenseDepth(RealsenseDevice[RangeImage]):
    """Depth images, in the axes of the camera's depth sensor (the left imager of a D400); not aligned to the colour."""

    kind = DeviceKind.RANGE_SCANNER

    def __init__(
        self, context: Context, options: DepthOptions, open_stream: Callable[[], FrameStream] | None = None
    ) -> None:
        super().__init__(context, options, open_stream)
        self._options = options

    def capabilities(self) -> RangeScannerCapabilities:
        """Return the lens that is stored in the camera, and limits and noise from the options."""
        o, facts = self._options, self.facts()
        lens = facts.intrinsics
        return RangeScannerCapabilities(
            projection="pinhole",
            width=lens.width_px,
            height=lens.height_px,
            fx=lens.fx_px,
            fy=lens.fy_px,
            cx=lens.cx_px,
            cy=lens.cy_px,
            min_range_m=o.min_range_m,
            max_range_m=o.max_range_m,
            sigma_m=o.sigma_m,
            rate_hz=facts.rate_hz,
        )

    def read_range(self, *, deadline: Deadline) -> Stamped[RangeImage]:
        """Return a depth image whose exposure began after this call."""
        return self.newest(deadline, not_before_s=self.context.clock.now_s())

    def set_up(self, link: FrameStream) -> None:
        """Take over what the camera says, and refuse a lens that a range image cannot have (owner thread)."""
        if not link.facts.is_rectified:
            raise Unsupported(
                f"{self.name}: the depth images of this camera are not rectified",
                hint="use a camera of the D400 family, which rectifies them",
            )
        super().set_up(link)

    def give(self, frame: RealsenseFrame, valid_s: float, missed: int) -> None:
        """Publish the depths in metres; 0 is librealsense's code for no reading."""
        o, unit_m = self._options, np.float32(frame.unit_m)
        if frame.unit_m <= 0.0:
            raise LinkLost("the camera does not tell its depth unit")
        depth_m = frame.data.astype(np.float32) * unit_m
        depth_m[(frame.data == 0) | (depth_m < o.min_range_m) | (depth_m > o.max_range_m)] = np.nan
        is_seen = bool(np.isfinite(depth_m).any())
        self.publish(
            RangeImage(depth_m=depth_m),
            valid_s=valid_s,
            device_time_s=frame.device_s,
            quality=Quality.VALID if is_seen else Quality.INVALID,
            cause=Cause.NONE if is_seen else Cause.OUT_OF_RANGE,
            missed=missed,
        )


class RealsenseColour(RealsenseDevice[Image]):
    """Images of the colour sensor, whose rows a rolling shutter exposes one after the other on most models."""

    kind = DeviceKind.CAMERA

    def __init__(
        self, context: Context, options: ColourOptions, open_stream: Callable[[], FrameStream] | None = None
    ) -> None:
        super().__init__(context, options, open_stream)
        self._options = options

    def capabilities(self) -> CameraCapabilities:
        """Return size, lens and settings as the camera tells them."""
        facts = self.facts()
        return CameraCapabilities(
            width_px=facts.intrinsics.width_px,
            height_px=facts.intrinsics.height_px,
            is_colour=self._options.is_colour,
            rate_hz=facts.rate_hz,
            nominal=facts.intrinsics,
            settings=facts.settings,
        )

    def read_image(self, *, deadline: Deadline) -> Stamped[Image]:
        """Return an image whose exposure began after this call."""
        return self.newest(deadline, not_before_s=self.context.clock.now_s())

    def set_exposure(self, exposure_s: float, *, deadline: Deadline) -> None:
        """Set the exposure of the images that are read after this call."""
        self.setter.set(self, self.facts().settings, exposure_s, deadline)

    def give(self, frame: RealsenseFrame, valid_s: float, missed: int) -> None:
        """Publish the image."""
        pixels = to_pixels(np.ascontiguousarray(frame.data[..., ::-1]), is_colour=self._options.is_colour)
        exposure_s = frame.exposure_s or self.facts().settings.exposure_s or 0.0
        image = Image(pixels=pixels, exposure_s=exposure_s)
        self.publish(image, valid_s=valid_s, device_time_s=frame.device_s, missed=missed)


@takes(DepthOptions)
def connect_depth(context: Context, options: dict[str, Any]) -> RealsenseDepth:
    """Entry point `realsense:depth`."""
    return _connected(RealsenseDepth(context, read_options(context, options, DepthOptions)))


@takes(ColourOptions)
def connect_colour(context: Context, options: dict[str, Any]) -> RealsenseColour:
    """Entry point `realsense:camera`."""
    return _connected(RealsenseColour(context, read_options(context, options, ColourOptions)))


D = TypeVar("D", bound=RealsenseDevice[Any])


def _connected(device: D) -> D:
    device.port.start()
    device.await_first(CONNECT_S)
    return device
