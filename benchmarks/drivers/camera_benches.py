"""Test setups of cameras: an MJPEG sender of ours and folders of pictures, all of which carry their number.

TCP neither loses nor changes bytes, so `drop` is a picture that the camera itself has cut short, and `crc` a damaged line
between two pictures; a flipped bit within a JPEG picture shows in nothing. Of a folder some pictures are damaged, cut
short, there twice or missing.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from benchmarks.drivers.bench import WITHOUT_ECHO, Bench
from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions, FaultPlan, WireFault
from drivers.emulators.ports import Peer, TcpPort
from hal.devices import Image, RangeImage
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
        return self._taken_s[-1], self.drawn(self._count)

    @staticmethod
    def drawn(number: int) -> NDArray[np.uint8]:
        """Return the picture of a number."""
        bits = number >> np.arange(BITS) & 1
        squares = np.stack([bits, 1 - bits]) * 255
        return np.kron(squares, np.ones((BLOCK_PX, BLOCK_PX))).astype(np.uint8)

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


PICTURES, PLAYED_HZ = 100, 200.0
OF_FILES = (WireFault.CRC, WireFault.DROP, WireFault.DUP, WireFault.DISCONNECT)
FIRST_MM = 1000  # depth of the first picture of a folder, and one more for each that follows
LENS = {"fx": 30.0, "fy": 30.0, "cx": 16.0, "cy": 8.0}


class Folder:
    """Folder of numbered PNG pictures, in which a fault concerns every so manyth."""

    def __init__(self, picture: Callable[[int], NDArray[Any]], more: dict[str, Any], options: dict[str, Any]) -> None:
        self._path = Path(tempfile.mkdtemp(prefix="panelwright-"))
        self.address = {"path": str(self._path), "rate_hz": PLAYED_HZ, **more}
        plan = FaultPlan(validate(options, FaultOptions, source="far side"))
        for number in range(PICTURES):
            content = bytes(cv2.imencode(".png", picture(number))[1])
            path = self._path / f"{number:06d}.png"
            match plan.next() if number else None:  # the first one gives the size
                case WireFault.CRC:
                    path.write_bytes(plan.flip_bit(content, slice(None)))
                case WireFault.DROP:
                    path.write_bytes(plan.lose_bytes(content))
                case WireFault.DISCONNECT:
                    path.symlink_to("away")
                case WireFault.DUP:
                    path.write_bytes((self._path / f"{number - 1:06d}.png").read_bytes() if number else content)
                case _:
                    path.write_bytes(content)

    def close(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self._path, ignore_errors=True)


def _depth_of(number: int) -> NDArray[np.uint16]:
    return np.full((16, 32), FIRST_MM + number, np.uint16)


def _picture_of(number: int) -> NDArray[np.uint8]:
    return NumberedPictures.drawn(number)


def start_folder(
    picture: Callable[[int], NDArray[Any]], more: dict[str, Any], _: None, options: dict[str, Any]
) -> Folder:
    """Write a folder of pictures."""
    return Folder(picture, more, options)


def _is_picture(value: Image, _: None) -> bool:
    number = _number(value)
    return number is not None and number < PICTURES


def _is_depth(value: RangeImage, _: None) -> bool:
    counts = np.round(value.depth_m * 1000.0)
    return bool(np.all(counts == counts[0, 0]) and FIRST_MM <= counts[0, 0] < FIRST_MM + PICTURES)


def _is_true(value: Image, backing: NumberedPictures) -> bool:
    return backing.is_true(value)


def _taken_s(value: Image, backing: NumberedPictures) -> float:
    return backing.taken_s(value)


CAMERA_BENCHES = (
    *(
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
    ),
    *(
        Bench(
            name=name,
            start=partial(start_folder, picture, more),
            backing=lambda: None,
            driver=driver,
            is_true=is_true,
            faults=OF_FILES,
            read=lambda device, deadline: device.play(deadline),
            stamps=None,
            is_plugged=False,
        )
        for name, driver, picture, more, is_true in (
            ("pictures", "files:camera", _picture_of, {"repeat": True}, _is_picture),
            ("depth pictures", "files:depth", _depth_of, LENS, _is_depth),
        )
    ),
)
