"""GenICam camera over GigE Vision or USB3 Vision: Aravis receives, and a thread decodes and stamps the frames."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from drivers.gige.frames import Frame
from drivers.gige.settings import GigeCameraOptions
from drivers.gige.source import FrameSource, GenicamSource, address_of
from drivers.kinds.cameras import ExposureSetter, nominal
from drivers.kinds.pixel_formats import FORMATS, decode
from drivers.transport.device import SLICE_S, PortDevice
from drivers.transport.link import NoAnswer, WireError, now_s
from drivers.transport.mailbox import IMAGES_RING
from drivers.transport.options import read_options
from drivers.transport.port import Port
from drivers.transport.timebase import HostTime
from hal.camera_settings import CameraSettings
from hal.clock import Deadline
from hal.devices import CameraCapabilities, DeviceKind, Image
from hal.errors import DeviceUnavailable
from hal.readings import Stamped
from hal.registry import Context, takes

CONNECT_S = 6.0  # a camera keeps the control of a program that was killed for 3 s
SILENCE_S = 0.3
SHORT_IDS = 1 << 16  # GigE Vision 1 counts frames from 1 to 65535 and then from 1 again
REORDERED = 16  # frames
LATE_S = 1e-3  # accuracy of stamps
IN_WORK = 2  # frames that a camera may have begun, or prepared, with the exposure before
ASK_EVERY_S = 1.0  # how often an exposure that the camera chooses is read, and a waiting camera is checked
INCOMPLETE = (
    "frame {frame} is unusable: {fault}; raise `net.core.rmem_max` and `packet_bytes`, or set a `packet_delay_ns`"
)


class GigeCamera(PortDevice[Image]):
    """Live GenICam camera."""

    kind = DeviceKind.CAMERA
    ring = IMAGES_RING

    def __init__(
        self, context: Context, options: GigeCameraOptions, open_source: Callable[[], FrameSource] | None = None
    ) -> None:
        self._is_triggered = options.trigger == "software"
        period_s = 1.0 / options.rate_hz
        super().__init__(context, max_age_s=math.inf if self._is_triggered else 3.0 * period_s + 0.1)
        self._options = options
        self._silence_s = max(SILENCE_S, 4.0 * period_s)
        self._asked = threading.Event()
        self._time = HostTime()
        self._settings = CameraSettings()
        self._exposure_s: float | None = None
        self._setter = ExposureSetter()
        self._size = (options.width_px or 1, options.height_px or 1)
        self._is_colour = options.is_colour
        self._begin_session()
        self._address: str | None = None
        self._incomplete = 0
        self.port: Port[FrameSource] = Port(context.name, open_link=open_source or self._open, tenant=self)

    def capabilities(self) -> CameraCapabilities:
        """Return the size and the settings that the camera reports."""
        o, (width_px, height_px) = self._options, self._size
        return CameraCapabilities(
            width_px=width_px,
            height_px=height_px,
            is_colour=self._is_colour,
            rate_hz=o.rate_hz,
            nominal=nominal(width_px, height_px, o),
            settings=self._settings,
        )

    def read_image(self, *, deadline: Deadline) -> Stamped[Image]:
        """Return a frame whose exposure began after this call; with a software trigger this call starts it."""
        asked_s = self.context.clock.now_s()
        self._asked.set()
        return self.newest(deadline, not_before_s=asked_s)

    def set_exposure(self, exposure_s: float, *, deadline: Deadline) -> None:
        """Set the exposure of the frames that are read after this call."""
        self._setter.set(self, self._settings, exposure_s, deadline)

    def set_up(self, link: FrameSource) -> None:
        """Take over what the camera has been set to (owner thread)."""
        self._settings = link.settings
        self._exposure_s = link.settings.exposure_s
        self._size = (link.width_px, link.height_px)
        formats = {form.name: form for form in FORMATS.values()}
        form = formats.get(link.settings.pixel_format)
        self._is_colour = self._options.is_colour and (form is None or form.is_colour)
        self._time.reset()
        self._begin_session()
        if self._is_triggered:
            self._asked.set()  # the first frame proves that the camera works

    def _begin_session(self) -> None:
        self._last_id: int | None = None
        self._lost = 0  # frames since the last good one
        self._is_exposing = not self._is_triggered
        self._waiting_since_s = self._triggered_s = now_s()
        self._asked_camera_s = now_s()
        self._in_work = 0  # frames to come that were exposed as before

    def serve(self, link: FrameSource) -> None:
        """Wait for one frame and publish it (owner thread)."""
        if (wanted_s := self._setter.wanted_s()) is not None:
            self._take_exposure(link, wanted_s)
        if not self._is_exposing and not self._expose(link):
            return
        frame = link.pop(SLICE_S)
        if frame is not None:
            self._take(link, frame)
        elif now_s() - self._waiting_since_s > self._silence_s + (self._exposure_s or 0.0):
            self._miss(link)

    def _take_exposure(self, link: FrameSource, exposure_s: float) -> None:
        link.set_exposure(exposure_s)
        self._exposure_s = link.exposure_s()
        self._settings = replace(self._settings, exposure_s=self._exposure_s)
        self._in_work = 0 if self._is_triggered else IN_WORK
        self._setter.confirm()

    def _expose(self, link: FrameSource) -> bool:
        """Start an exposure if one is asked for; return whether it was."""
        if not self._asked.wait(SLICE_S):
            if self._is_due():
                link.check()
            return False
        self._asked.clear()
        while (late := link.pop(0.0)) is not None:
            self._note(late.frame_id)
        self._triggered_s = self._waiting_since_s = now_s()
        link.trigger()
        self._is_exposing = True
        return True

    def _miss(self, link: FrameSource) -> None:
        link.check()
        raise NoAnswer(
            "the camera answers, but its frames do not arrive: a firewall may block UDP, `packet_bytes` may exceed what "
            "the network carries, or the camera waits for a trigger"
        )

    def _take(self, link: FrameSource, frame: Frame) -> None:
        skipped = self._note(frame.frame_id)
        if skipped is None:
            self.errors += 1  # repeated or late, so a newer one has been given
            return
        self._lost += skipped
        if self._in_work > 0:
            self._in_work -= 1
            self._waiting_since_s = now_s()
            return
        if frame.fault is not None:
            self._refuse(frame)
            return
        size = (frame.width_px, frame.height_px)
        if size != self._size:
            raise NoAnswer(f"the camera sends {size[0]}x{size[1]} pixels instead of {self._size[0]}x{self._size[1]}")
        pixels = decode(frame.data, frame.pixel_format, width_px=size[0], height_px=size[1], is_colour=self._is_colour)
        if self._options.exposure_s == "auto" and self._is_due():
            self._exposure_s = link.exposure_s()
        valid_s = self._exposed_s(frame)
        if valid_s is None:
            self.errors += 1
            return
        image = Image(pixels=pixels, exposure_s=self._exposure_s or 0.0)
        self.publish(image, valid_s=valid_s, device_time_s=frame.device_s, missed=self._lost)
        self._lost = 0
        self._waiting_since_s = now_s()
        self._is_exposing = not self._is_triggered

    def _refuse(self, frame: Frame) -> None:
        self._lost += 1
        self._incomplete += 1
        self._waiting_since_s = now_s()
        text = INCOMPLETE.format(frame=frame.frame_id, fault=frame.fault)
        self.mailbox.fail(self.translate(NoAnswer(text)))
        if self._is_triggered:
            self._is_exposing = False
            self._asked.set()  # for the reader that still waits

    def _note(self, frame_id: int) -> int | None:
        """Return how many frames are missing before this one; None if it is a repeated or an earlier one."""
        last, self._last_id = self._last_id, frame_id
        if last is None or frame_id == 0:
            return 0
        step = frame_id - last
        if step < -REORDERED and last < SHORT_IDS:
            step += SHORT_IDS - 1
        if step <= 0 and step >= -REORDERED:
            self._last_id = last
            return None
        return step - 1 if step > 0 else 0  # a large step back: the camera counts from the beginning

    def _exposed_s(self, frame: Frame) -> float | None:
        """Return when the exposure began at the earliest, or None for the frame of an earlier trigger.

        The clocks are compared by the frames that arrived fastest. A frame leaves after its exposure, so this already
        contains what the camera's stamp means, and the exposure began one exposure time before.
        """
        left_s = frame.arrived_s
        if frame.device_s is not None:
            left_s = self._time.host_s(device_s=frame.device_s, arrived_s=frame.arrived_s)
        if not self._is_triggered:
            return left_s - (self._exposure_s or 0.0)
        return self._triggered_s if left_s >= self._triggered_s - LATE_S else None

    def _is_due(self) -> bool:
        """Return whether the camera was last asked something a second ago, and note that it is asked now."""
        is_due = now_s() - self._asked_camera_s > ASK_EVERY_S
        if is_due:
            self._asked_camera_s = now_s()
        return is_due

    def _open(self) -> FrameSource:
        self._address = self._address or address_of(self._options.camera)
        try:
            return GenicamSource(self._options, self.name, self._address)
        except (WireError, DeviceUnavailable):
            self._address = None  # a camera that is named otherwise may come back with another address
            raise

    def link_name(self) -> str:
        """Return the camera's name and address."""
        place = f" at {self._address}" if self._address and self._address != self._options.camera else ""
        return f"camera {self._options.camera}{place}"

    def wire_counts(self) -> str:
        """Return the counters as text."""
        return f"{self.mailbox.published} frames, {self._incomplete} incomplete, {self.errors} lost or late"


@takes(GigeCameraOptions)
def connect(context: Context, options: dict[str, Any]) -> GigeCamera:
    """Entry point `gige:camera`."""
    device = GigeCamera(context, read_options(context, options, GigeCameraOptions))
    device.port.start()
    device.await_first(CONNECT_S)
    return device
