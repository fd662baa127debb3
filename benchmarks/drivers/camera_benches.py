"""Test setups of cameras: an MJPEG sender of ours whose pictures carry their number.

TCP neither loses nor changes bytes, so `drop` is a picture that the camera itself has cut short, and `crc` a damaged line
between two pictures; a flipped bit within a JPEG picture shows in nothing.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from benchmarks.drivers.bench import WITHOUT_ECHO, Bench
from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, TcpPort
from hal.devices import Image
from hal.strict import validate

RATE_HZ = 50.0
BITS, BLOCK_PX = 16, 8
BOUNDARY = b"--frame\r\n"
HELLO = b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"
PLACEHOLDER = BOUNDARY + b"Content-Type: text/plain\r\nContent-Length: 9\r\n\r\nno signal\r\n"


class NumberedPictures:
    """Pictures that show their number as light and dark squares, with its complement below, and when each was taken."""

    def __init__(self) -> None:
        self._taken_s: deque[float] = deque(maxlen=4096)
        self._count = 0

    def take(self) -> tuple[float, NDArray[np.uint8]]:
        """Return the time and the next picture."""
        self._count += 1
        self._taken_s.append(time.monotonic())
        bits = self._count >> np.arange(BITS) & 1
        squares = np.stack([bits, 1 - bits]) * 255
        return self._taken_s[-1], np.kron(squares, np.ones((BLOCK_PX, BLOCK_PX))).astype(np.uint8)

    def is_true(self, value: Image) -> bool:
        """Return whether a picture is whole and one of the last ones."""
        number = _number(value)
        return number is not None and 0 <= self._count - number < len(self._taken_s)

    def taken_s(self, value: Image) -> float:
        """Return when a picture was taken, on the monotonic clock."""
        return self._taken_s[(_number(value) or 0) - self._count - 1]


def _number(value: Image) -> int | None:
    grey = value.pixels if value.pixels.ndim == 2 else value.pixels.mean(axis=2)
    if grey.shape != (2 * BLOCK_PX, BITS * BLOCK_PX):
        return None
    bits, others = grey.reshape(2, BLOCK_PX, BITS, BLOCK_PX).mean(axis=(1, 3)) > 127.5
    return int(bits @ (1 << np.arange(BITS))) if np.all(bits != others) else None


class MjpegOptions(FaultOptions):
    """Fault options, and whether each picture has the header `X-Timestamp`."""

    has_stamps: Annotated[bool, Field(description="the sender states when it took each picture")] = False


class MjpegSender(WireEmulator):
    """Camera that sends MJPEG to each client."""

    period_s = 1.0 / RATE_HZ

    def __init__(self, backing: NumberedPictures, options: MjpegOptions) -> None:
        self._port = TcpPort()
        super().__init__(self._port, options, name="mjpeg")
        self._backing, self._has_stamps = backing, options.has_stamps
        self._viewers: list[Peer] = []

    @property
    def address(self) -> dict[str, Any]:
        """Return the address as a URL."""
        at = self._port.address
        return {"url": f"http://{at['host']}:{at['port']}/video"}

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Begin to send to a client that asks."""
        if data.startswith(b"GET "):
            self.reply(peer, HELLO)
            self._viewers.append(peer)

    def on_tick(self) -> None:
        """Send the next picture."""
        self._viewers = [peer for peer in self._viewers if peer in self._port.peers]
        if not self._viewers:
            return
        taken_s, pixels = self._backing.take()
        picture = bytes(cv2.imencode(".jpg", pixels)[1])
        stamp = f"X-Timestamp: {1000.0 + taken_s:.6f}\r\n" if self._has_stamps else ""
        head = f"Content-Type: image/jpeg\r\n{stamp}Content-Length: {len(picture)}\r\n\r\n"
        frame = BOUNDARY + head.encode() + picture + b"\r\n"
        for viewer in self._viewers:
            self.send(viewer, frame, protected=slice(len(BOUNDARY)))

    def status_frame(self) -> bytes | None:
        """Return a part that is no picture."""
        return PLACEHOLDER


def start(backing: NumberedPictures, options: dict[str, Any]) -> MjpegSender:
    """Start the sender."""
    sender = MjpegSender(backing, validate(options, MjpegOptions, source="far side"))
    sender.begin()
    return sender


def _is_true(value: Image, backing: NumberedPictures) -> bool:
    return backing.is_true(value)


def _taken_s(value: Image, backing: NumberedPictures) -> float:
    return backing.taken_s(value)


CAMERA_BENCHES = tuple(
    Bench(
        name=f"mjpeg {word}",
        start=start,
        backing=NumberedPictures,
        driver="stream:camera",
        is_true=_is_true,
        taken_s=_taken_s,
        stamps="taken",
        options={"rate_hz": RATE_HZ, "latency_s": 0.0},
        far_options={"has_stamps": has_stamps},
        faults=WITHOUT_ECHO,
    )
    for word, has_stamps in (("by arrival", False), ("by stamps", True))
)
