"""Open video streams: MJPEG over HTTP, parsed here, and everything else by OpenCV's FFmpeg."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import httpx2
import numpy as np
from numpy.typing import NDArray

from drivers.transport.link import LinkLost, NoAnswer, now_s

MOST_BYTES = 64 << 20  # of one picture
MOST_DIGITS = 12  # of a length
START, END = b"\xff\xd8", b"\xff\xd9"  # of a JPEG
_opening = threading.Lock()  # OpenCV takes FFmpeg's options from the environment


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture:
    """One picture of a stream.

    Attributes:
        fault: why the picture cannot be used, or None.
        bgr: pixels as OpenCV gives them.
        device_s: the sender's time stamp, or None.
        is_repeated: whether it is the same as the one before, bit for bit.
    """

    fault: str | None
    bgr: NDArray[Any]
    arrived_s: float
    device_s: float | None = None
    is_repeated: bool = False


class PictureSource(Protocol):
    """An open stream."""

    def next(self) -> Picture:
        """Wait for the next picture.

        Raises:
            LinkLost, NoAnswer: there is none.
        """
        ...

    def close(self) -> None:
        """Close the stream."""
        ...


class PartParser:
    """Cuts `multipart/x-mixed-replace` into parts, from chunks of any size; the boundary is the stream's first line."""

    def __init__(self) -> None:
        self._buffer = b""
        self._boundary = b""

    def feed(self, chunk: bytes) -> Iterator[tuple[dict[str, str], bytes]]:
        """Take in a chunk and return the headers and content of each part that it completes.

        Raises:
            NoAnswer: this is no such stream.
        """
        self._buffer += chunk
        if len(self._buffer) > MOST_BYTES:
            raise NoAnswer("the stream has no end of a picture within 64 MiB")
        while (part := self._cut()) is not None:
            yield part

    def _cut(self) -> tuple[dict[str, str], bytes] | None:
        head, mark, rest = self._buffer.partition(b"\r\n\r\n")
        if not mark:
            return None
        lines = head.strip().split(b"\r\n")
        if not self._boundary:
            self._boundary = lines[0].strip()
            if not self._boundary.startswith(b"--"):
                raise NoAnswer("the address gives no MJPEG stream (multipart/x-mixed-replace)")
        if lines[0].strip() != self._boundary:
            raise NoAnswer("the stream lost its boundary")
        pairs = (line.decode("latin-1").partition(":") for line in lines[1:])
        headers = {name.strip().lower(): value.strip() for name, _, value in pairs}
        length = headers.get("content-length", "")
        is_number = length.isascii() and length.isdigit() and len(length) < MOST_DIGITS  # "²" is a digit, too
        end = int(length) if is_number else rest.find(b"\r\n" + self._boundary)
        if end < 0 or len(rest) < end:
            return None
        self._buffer = rest[end:].lstrip(b"\r\n")
        return headers, rest[:end]


class MjpegSource:
    """MJPEG stream over HTTP."""

    def __init__(self, url: str, login: tuple[str, str] | None, silence_s: float) -> None:
        self._parser = PartParser()
        self._waiting: deque[tuple[dict[str, str], bytes, float]] = deque()
        self._last = b""
        self._ends_a_line: bool | None = None  # whether pictures end with a line break, which some senders count in
        self._stack = contextlib.ExitStack()
        limits = httpx2.Timeout(silence_s, connect=1.0)
        try:
            client = self._stack.enter_context(httpx2.Client(timeout=limits, trust_env=False))
            response = self._get(client, url, httpx2.DigestAuth(*login) if login else None)
            if login and "basic" in response.headers.get("www-authenticate", "").lower():
                response = self._get(client, url, httpx2.BasicAuth(*login))
        except httpx2.HTTPError as error:
            self._stack.close()
            raise _lost(error) from error
        if response.status_code != httpx2.codes.OK:
            self._stack.close()
            raise LinkLost(f"the camera answers with HTTP status {response.status_code} {response.reason_phrase}")
        self._chunks = response.iter_bytes()

    def next(self) -> Picture:
        """Wait for the next picture; its stamp is the header `X-Timestamp`, if there is one."""
        while not self._waiting:
            try:
                chunk = next(self._chunks)
            except StopIteration:
                raise LinkLost("the camera ended the stream") from None
            except httpx2.HTTPError as error:
                raise _lost(error) from error
            arrived_s = now_s()
            self._waiting.extend((headers, jpeg, arrived_s) for headers, jpeg in self._parser.feed(chunk))
        return self._picture(*self._waiting.popleft())

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(httpx2.HTTPError):
            self._stack.close()

    def _get(self, client: httpx2.Client, url: str, auth: httpx2.Auth | None) -> httpx2.Response:
        return self._stack.enter_context(client.stream("GET", url, auth=auth))

    def _picture(self, headers: dict[str, str], jpeg: bytes, arrived_s: float) -> Picture:
        is_repeated, self._last = jpeg == self._last, jpeg
        # A picture that lacks a byte or two is filled up by the line break that follows it.
        ended, self._ends_a_line = self._ends_a_line, jpeg.endswith((b"\r", b"\n"))
        fault, bgr = None, None
        if ended not in (None, self._ends_a_line):
            fault = f"a picture of {len(jpeg)} bytes does not end as the one before"
        elif not (jpeg.startswith(START) and jpeg.rstrip(b"\r\n\x00").endswith(END)):
            fault = f"a picture of {len(jpeg)} bytes is cut off"
        else:
            bgr = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
            fault = "a picture is no JPEG" if bgr is None else None
        device_s = None
        with contextlib.suppress(ValueError):
            device_s = float(headers.get("x-timestamp", ""))
        pixels = np.empty((0, 0, 3), np.uint8) if bgr is None else bgr
        return Picture(fault=fault, bgr=pixels, arrived_s=arrived_s, device_s=device_s, is_repeated=is_repeated)


class FfmpegSource:
    """Stream that OpenCV's FFmpeg opens, such as RTSP; the stamp is that of the stream (RTP)."""

    def __init__(self, url: str, options: dict[str, str], silence_s: float) -> None:
        self._pts_s = -1.0
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 5000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(1e3 * silence_s)]
        with _opening:
            os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = "|".join(f"{key};{value}" for key, value in options.items())
            self._video = cv2.VideoCapture(url, cv2.CAP_FFMPEG, limits)
        if not self._video.isOpened():
            raise LinkLost("the stream cannot be opened: check address, user name and password")

    def next(self) -> Picture:
        """Wait for the next picture."""
        is_good, bgr = self._video.read()
        arrived_s = now_s()
        if not is_good:
            raise NoAnswer("the stream has stopped")
        pts_s = 1e-3 * float(self._video.get(cv2.CAP_PROP_POS_MSEC))
        is_stamped, self._pts_s = pts_s > self._pts_s, pts_s
        return Picture(fault=None, bgr=bgr, arrived_s=arrived_s, device_s=pts_s if is_stamped else None)

    def close(self) -> None:
        """Close the stream."""
        self._video.release()


def _lost(error: httpx2.HTTPError) -> LinkLost | NoAnswer:
    if isinstance(error, httpx2.TimeoutException):
        return NoAnswer("the camera sends nothing")
    return LinkLost(f"{type(error).__name__}: {error}".rstrip(": "))
