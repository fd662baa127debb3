"""Camera on a network stream: a thread takes every picture at once, so that a buffered one is never given as fresh."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Callable
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlsplit

from pydantic import Field

from drivers.kinds.cameras import LensOptions, nominal, to_pixels
from drivers.stream.onvif import stream_address
from drivers.stream.sources import FfmpegSource, MjpegSource, Picture, PictureSource
from drivers.transport.device import PortDevice
from drivers.transport.link import NoAnswer
from drivers.transport.mailbox import IMAGES_RING
from drivers.transport.options import read_options
from drivers.transport.port import Port
from drivers.transport.timebase import HostTime
from hal.camera_settings import CameraSettings
from hal.clock import Deadline
from hal.devices import CameraCapabilities, DeviceKind, Image
from hal.readings import Quality, Stamped
from hal.registry import Context, takes
from hal.wires import ResourceClaim, WireOptions

PAUSE_S, PAUSE_PERIODS = 0.1, 3.0
WAITED_PERIODS = 0.5  # a picture that had to be waited for this long was not lying in a buffer
GAPS, LEAST_GAPS = 15, 2
SILENCE_S = 1.0
CONNECT_S = 10.0  # FFmpeg looks at some seconds of a stream
LOW_DELAY = {"fflags": "nobuffer", "flags": "low_delay", "analyzeduration": "500000", "probesize": "500000"}


class StreamCameraOptions(LensOptions, WireOptions):
    """Options of `stream:camera`."""

    url: Annotated[
        str,
        Field(
            pattern=r"^(http|https|rtsp|rtsps|onvif)://.+",
            description="`http://` for MJPEG, `rtsp://`, or `onvif://HOST[:PORT]` for a device that tells its stream",
        ),
    ]
    user: Annotated[str | None, Field(description="user name, if the camera asks for one")] = None
    password: Annotated[str, Field(description="password of that user")] = ""
    rate_hz: Annotated[float, Field(gt=0, le=1000, description="pictures per second that the camera sends")] = 25.0
    latency_s: Annotated[
        float,
        Field(
            ge=0,
            le=5,
            description="time from the exposure to the arrival: film a clock on a screen beside its picture to measure it",
        ),
    ] = 0.1
    is_colour: Annotated[bool, Field(description="false gives grey images")] = True
    transport: Annotated[
        Literal["tcp", "udp"], Field(description="how RTSP carries pictures; `udp` may lose parts of them")
    ] = "tcp"
    ffmpeg: Annotated[dict[str, str], Field(description="further options of FFmpeg's reader")] = {}

    def claims(self) -> tuple[ResourceClaim, ...]:
        """Claim nothing: a network camera serves several clients."""
        return ()


class Freshness:
    """Tells pictures that were waited for from pictures that lay in a buffer, by their arrival alone.

    At the beginning and after a pause, pictures arrive faster than the camera takes them until the buffers on the way are
    empty. The first one that had to be waited for is fresh again.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._last_s = -math.inf
        self._is_draining = True
        self._gaps_s: deque[float] = deque(maxlen=GAPS)

    def is_fresh(self, arrived_s: float, *, has_stamp: bool) -> bool:
        """Return whether this picture was taken just before its arrival.

        Args:
            has_stamp: the sender's stamps tell how late it is, once the buffers have been empty.
        """
        gap_s, self._last_s = arrived_s - self._last_s, arrived_s
        if math.isinf(gap_s):
            return False
        usual_s = (
            statistics.median_low(self._gaps_s) if len(self._gaps_s) >= LEAST_GAPS else 0.0
        )  # not by this gap itself
        self._gaps_s.append(gap_s)
        period_s = max(self._period_s, usual_s)
        if gap_s > max(PAUSE_S, PAUSE_PERIODS * period_s) and (self._is_draining or not has_stamp):
            self._is_draining = True
            return False
        if self._is_draining:
            self._is_draining = gap_s < WAITED_PERIODS * period_s
        return not self._is_draining


class StreamCamera(PortDevice[Image]):
    """Live network camera."""

    kind = DeviceKind.CAMERA
    ring = IMAGES_RING

    def __init__(
        self, context: Context, options: StreamCameraOptions, open_source: Callable[[], PictureSource] | None = None
    ) -> None:
        super().__init__(context, max_age_s=options.latency_s + max(4.0 / options.rate_hz, 0.2))
        self._options = options
        self._silence_s = max(SILENCE_S, 4.0 / options.rate_hz)
        self._size: tuple[int, int] | None = None
        self._begin_session()
        self._is_stamped = False
        self._buffered = 0
        self.port: Port[PictureSource] = Port(context.name, open_link=open_source or self._open, tenant=self)

    def capabilities(self) -> CameraCapabilities:
        """Return the size of the first picture; others are refused."""
        o, (width_px, height_px) = self._options, self._size or (1, 1)
        return CameraCapabilities(
            width_px=width_px,
            height_px=height_px,
            is_colour=o.is_colour,
            rate_hz=o.rate_hz,
            nominal=nominal(width_px, height_px, o),
            settings=CameraSettings(latency_s=o.latency_s, stamped_by="device" if self._is_stamped else "arrival"),
        )

    def read_image(self, *, deadline: Deadline) -> Stamped[Image]:
        """Return a picture whose exposure began after this call, by its stamp: that is, at least `latency_s` later."""
        return self.newest(deadline, not_before_s=self.context.clock.now_s())

    def set_up(self, link: PictureSource) -> None:  # noqa: ARG002  # nothing is configured
        """Begin to empty the buffers of a new connection (owner thread)."""
        self._begin_session()

    def _begin_session(self) -> None:
        self._fresh = Freshness(1.0 / self._options.rate_hz)
        self._time = HostTime()  # each connection counts its time from another beginning

    def serve(self, link: PictureSource) -> None:
        """Wait for one picture and publish it (owner thread)."""
        picture = link.next()
        has_stamp = picture.device_s is not None
        if not self._fresh.is_fresh(picture.arrived_s, has_stamp=has_stamp):
            self._buffered += 1
            return
        if picture.is_repeated and not has_stamp:
            self.errors += 1  # a live picture has noise: this one was sent twice, or the camera is frozen
            return
        if picture.fault is not None:
            self.fail(NoAnswer(picture.fault))
            return
        self._give(picture)

    def _give(self, picture: Picture) -> None:
        height_px, width_px = picture.bgr.shape[:2]
        self._size = self._size or (width_px, height_px)
        if (width_px, height_px) != self._size:
            raise NoAnswer(f"the camera sends {width_px}x{height_px} pixels instead of {self._size[0]}x{self._size[1]}")
        sent_s = picture.arrived_s
        self._is_stamped = picture.device_s is not None
        if picture.device_s is not None:
            sent_s = self._time.host_s(device_s=picture.device_s, arrived_s=picture.arrived_s)
        image = Image(pixels=to_pixels(picture.bgr, is_colour=self._options.is_colour), exposure_s=0.0)
        self.publish(
            image,
            valid_s=sent_s - self._options.latency_s,
            device_time_s=picture.device_s,
            quality=Quality.VALID if self._is_stamped else Quality.DEGRADED,
        )

    def _open(self) -> PictureSource:
        o = self._options
        login = (o.user, o.password) if o.user is not None else None
        url = stream_address(o.url, login) if o.url.startswith("onvif:") else o.url
        if url.startswith("http"):
            return MjpegSource(url, login, self._silence_s)
        if login is not None:
            scheme, _, rest = url.partition("://")
            url = f"{scheme}://{quote(login[0], safe='')}:{quote(login[1], safe='')}@{rest.rpartition('@')[2]}"
        return FfmpegSource(url, {**LOW_DELAY, "rtsp_transport": o.transport, **o.ffmpeg}, self._silence_s)

    def link_name(self) -> str:
        """Return the address without user and password."""
        parts = urlsplit(self._options.url)
        return f"stream {parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"

    def wire_counts(self) -> str:
        """Return the counters and the latency that is assumed, as text."""
        by = "the sender's stamps" if self._is_stamped else "arrival"
        return (
            f"{self.mailbox.published} pictures, {self._buffered} buffered ones left out, {self.errors} errors; "
            f"stamped by {by} minus {self._options.latency_s:g} s"
        )


@takes(StreamCameraOptions)
def connect(context: Context, options: dict[str, Any]) -> StreamCamera:
    """Entry point `stream:camera`."""
    device = StreamCamera(context, read_options(context, options, StreamCameraOptions))
    device.port.start()
    device.await_first(CONNECT_S)
    return device
