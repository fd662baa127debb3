"""Tests of `stream:camera`: ours and FFmpeg as senders of MJPEG, FFmpeg as sender of RTSP, and an ONVIF device of ours."""

from __future__ import annotations

import shutil
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest

from drivers.stream.camera import Freshness, StreamCamera, StreamCameraOptions
from drivers.stream.onvif import stream_address
from drivers.stream.sources import MjpegSource, PartParser, Picture
from drivers.transport.link import LinkLost, NoAnswer, now_s
from hal.conformance import CameraContract, Rig
from hal.errors import DeviceTimeout, DeviceUnavailable
from hal.readings import Quality
from hal.registry import Context, connect
from hal.simulated import Fault
from tests.drivers.far_cameras import ADDRESS, free_port
from tests.drivers.rigs import CLOCK, soon, until

PERIOD_S = 0.02
H264 = ("-c:v", "libx264", "-preset", "ultrafast", "-tune", "zerolatency", "-g", "5", "-pix_fmt", "yuv420p")
OPTIONS = {"rate_hz": 50.0, "latency_s": 0.01}


def jpeg(number: int) -> bytes:
    """Return a picture whose grey value is its number."""
    return bytes(cv2.imencode(".jpg", np.full((24, 32, 3), number % 200, np.uint8))[1])


class Sender(ThreadingHTTPServer):
    """Sends MJPEG to each client, one new picture per period, and can hold or damage it."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, port: int, *, has_stamps: bool = False) -> None:
        super().__init__((ADDRESS, port), Handler)
        self.has_stamps = has_stamps
        self.is_silent = False
        self.is_up = True
        self.cut_every = 0  # each so manyth picture lacks a byte of those that its length counts
        self.status = 200
        self.login: str | None = None  # what Basic authentication must carry
        self.closing = threading.Event()
        threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://{ADDRESS}:{self.server_address[1]}/video"

    def inject(self, fault: Fault | None) -> None:
        self.is_silent = fault is Fault.SILENT
        self.is_up = fault is not Fault.DISCONNECTED

    def end(self) -> None:
        self.closing.set()
        self.shutdown()
        self.server_close()


class Handler(BaseHTTPRequestHandler):
    server: Sender

    def do_GET(self) -> None:
        sender = self.server
        if not sender.is_up:
            return
        if sender.login is not None and self.headers.get("Authorization") != sender.login:
            self.send_response(401)
            self.send_header("WWW-Authenticate", 'Basic realm="camera"')
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(sender.status)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        number = 0
        while sender.is_up and not sender.closing.wait(PERIOD_S):
            if sender.is_silent:
                continue
            number += 1
            stamp = f"X-Timestamp: {1000.0 + now_s():.6f}\r\n" if sender.has_stamps else ""
            picture = jpeg(number)
            is_cut = sender.cut_every and number % sender.cut_every == 0
            cut = len(picture) - 4 if is_cut else len(picture)
            head = f"--frame\r\nContent-Type: image/jpeg\r\n{stamp}Content-Length: {len(picture)}\r\n\r\n"
            try:
                self.wfile.write(head.encode() + picture[:cut] + picture[cut + 1 :] + b"\r\n")
            except OSError:
                return

    def log_message(self, format: str, *args: Any) -> None:  # the name is that of the base class
        pass


@contextmanager
def sending(**options: Any) -> Iterator[Sender]:
    sender = Sender(0, **options)
    try:
        yield sender
    finally:
        sender.end()


class TestStreamCamera(CameraContract):
    @pytest.fixture(params=[False, True], ids=["by arrival", "by stamps"])
    def rig(self, request: pytest.FixtureRequest) -> Iterator[Rig[Any]]:
        with sending(has_stamps=request.param) as sender:
            device = connect(Context(name="eye"), "stream:camera", {"url": sender.url, **OPTIONS})
            yield Rig(device=device, clock=CLOCK, sample_period_s=0.03, inject=sender.inject)
            device.close()


@pytest.mark.parametrize("has_stamps", [False, True])
def test_the_latency_is_subtracted_and_stated(has_stamps: bool) -> None:
    with sending(has_stamps=has_stamps) as sender:
        device = connect(Context(name="eye"), "stream:camera", {"url": sender.url, **OPTIONS, "latency_s": 0.2})
        sample = device.read_image(deadline=soon())
        settings = device.capabilities().settings
        device.close()
    assert CLOCK.now_s() - sample.host_time_s >= 0.2
    assert settings.latency_s == 0.2 and settings.stamped_by == ("device" if has_stamps else "arrival")
    assert sample.quality is (Quality.VALID if has_stamps else Quality.DEGRADED)
    assert "minus 0.2 s" in device.health().detail


def test_a_refusal_and_an_ordinary_page_are_told() -> None:
    with sending() as sender:
        sender.status = 401
        with pytest.raises(DeviceUnavailable, match="HTTP status 401"):
            connect(Context(name="eye"), "stream:camera", {"url": sender.url})
    with pytest.raises(NoAnswer, match="no MJPEG stream"):
        list(PartParser().feed(b"<html>\r\n\r\n"))


def test_user_and_password_are_sent_and_not_shown() -> None:
    with sending() as sender:
        sender.login = "Basic YWRtaW46cEBzcw=="
        options = {"url": sender.url, **OPTIONS, "user": "admin", "password": "p@ss"}
        device = connect(Context(name="eye"), "stream:camera", options)
        device.read_image(deadline=soon())
        assert "p@ss" not in device.health().detail
        device.close()


@contextmanager
def ffmpeg(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run FFmpeg with a moving test picture, or skip the test where it is not installed."""
    program = shutil.which("ffmpeg")
    if program is None:
        pytest.skip("ffmpeg is not installed")
    pattern = ["-f", "lavfi", "-i", "testsrc=size=160x120:rate=25"]
    sender = subprocess.Popen([program, "-loglevel", "error", "-nostdin", "-re", *pattern, *arguments])
    try:
        yield sender
    finally:
        sender.kill()
        sender.wait()


@pytest.mark.third_party("ffmpeg", "stream:camera")
def test_mjpeg_of_ffmpeg_is_read_and_a_pause_never_gives_an_old_picture() -> None:
    url = f"http://{ADDRESS}:{free_port()}/video"
    with ffmpeg("-f", "mpjpeg", "-listen", "1", url) as sender:
        device = StreamCamera(Context(name="eye"), StreamCameraOptions(url=url, latency_s=0.0))
        device.port.start()
        until(lambda: device.mailbox.published > 5, within_s=20.0)
        assert device.read_image(deadline=soon(2.0)).value.pixels.shape == (120, 160, 3)
        sender.send_signal(signal.SIGSTOP)
        with pytest.raises(DeviceTimeout, match="eye"):
            device.read_image(deadline=soon(0.3))
        sender.send_signal(signal.SIGCONT)
        before = device._buffered
        device.read_image(deadline=soon(4.0))
        assert device._buffered > before, "the picture after the pause was given"
        device.close()


@pytest.mark.third_party("ffmpeg", "stream:camera")
def test_rtsp_of_ffmpeg_is_read_with_the_stamps_of_rtp() -> None:
    url = f"rtsp://{ADDRESS}:{free_port()}/video"
    options = {"url": url, "latency_s": 0.0, "ffmpeg": {"rtsp_flags": "listen", "listen_timeout": "10"}}
    camera = StreamCamera(Context(name="eye"), StreamCameraOptions(**options))
    camera.port.start()
    again = threading.Event()
    while camera.mailbox.published == 0:  # FFmpeg ends when nobody listens yet
        with ffmpeg(*H264, "-f", "rtsp", "-rtsp_transport", "tcp", url) as sender:
            while sender.poll() is None and camera.mailbox.published < 5:
                again.wait(0.01)
            if camera.mailbox.published:
                sample = camera.read_image(deadline=soon(2.0))
    camera.close()
    assert sample.device_time_s is not None and sample.quality is Quality.VALID
    assert sample.value.pixels.shape == (120, 160, 3)


def test_a_picture_that_lacks_one_byte_is_not_filled_up_by_the_line_break_behind_it() -> None:
    with sending() as sender:
        sender.cut_every = 4
        source = MjpegSource(sender.url, None, 1.0)
        faults = [source.next().fault for _ in range(11)]
        source.close()
    assert faults[3] is not None and faults[7] is not None
    assert [faults[n] for n in (0, 1, 2, 5, 6, 9, 10)] == 7 * [None]


@pytest.mark.parametrize("has_stamp", [False, True])
def test_a_second_picture_that_was_held_up_does_not_set_the_measure_for_itself(has_stamp: bool) -> None:
    """A sender's stamps tell how late a picture is only after one that was not late."""
    fresh = Freshness(0.02)
    assert [fresh.is_fresh(at_s, has_stamp=has_stamp) for at_s in (0.0, 0.17, 0.19, 0.21)] == [False, False, True, True]


class Script:
    """Source of pictures that a test writes."""

    def __init__(self) -> None:
        self.pictures: deque[Picture | Exception] = deque()
        self._rest = threading.Event()

    def next(self) -> Picture:
        while not self.pictures:
            self._rest.wait(0.002)
        picture = self.pictures.popleft()
        if isinstance(picture, Exception):
            raise picture
        return picture

    def close(self) -> None:
        self.pictures.append(LinkLost("closed"))


def picture(arrived_s: float, value: int = 1, **more: Any) -> Picture:
    bgr = np.full(more.pop("shape", (2, 4, 3)), value, np.uint8)
    return Picture(**{"fault": None, "bgr": bgr, "arrived_s": arrived_s, **more})


def scripted(script: Script) -> StreamCamera:
    device = StreamCamera(Context(name="eye"), StreamCameraOptions(url="http://script", **OPTIONS), lambda: script)
    device.port.start()
    return device


def values(device: StreamCamera) -> list[int]:
    return [int(sample.value.pixels[0, 0, 0]) for sample in device.mailbox.since(0)[0]]


def test_repeated_damaged_and_resized_pictures_are_not_given() -> None:
    script, here_s = Script(), now_s()
    device = scripted(script)
    script.pictures.append(picture(here_s - 0.2))
    script.pictures.extend(picture(here_s - 0.18 + 0.02 * n, 10 + n) for n in range(2))
    script.pictures.append(picture(here_s - 0.14, 20, is_repeated=True))
    script.pictures.append(picture(here_s - 0.12, 30, fault="a picture is no JPEG"))
    until(lambda: "no JPEG" in str(device.mailbox.error()))
    assert values(device) == [10, 11] and device.errors == 2
    script.pictures.append(picture(here_s - 0.10, 40, shape=(3, 4, 3)))
    until(lambda: "4x3 pixels instead of 4x2" in str(device.mailbox.error()))
    device.close()


def test_a_late_picture_with_a_stamp_is_stamped_late() -> None:
    script, here_s = Script(), now_s()
    device = scripted(script)
    script.pictures.extend(picture(here_s - 1.0 + 0.02 * n, n, device_s=5.0 + 0.02 * n) for n in range(10))
    script.pictures.append(picture(here_s - 0.3, 99, device_s=5.2))
    until(lambda: device.mailbox.published == 10)
    newest = device.mailbox.peek()
    device.close()
    assert newest is not None and newest.host_time_s == pytest.approx(here_s - 0.8 - 0.01, abs=1e-3)


def test_only_pictures_that_were_waited_for_are_fresh() -> None:
    fresh = Freshness(0.04)
    backlog = [fresh.is_fresh(0.001 * n, has_stamp=False) for n in range(5)]
    live = [fresh.is_fresh(0.04 + 0.04 * n, has_stamp=False) for n in range(5)]
    held = [fresh.is_fresh(1.0 + 0.001 * n, has_stamp=False) for n in range(5)]
    again = [fresh.is_fresh(1.04 + 0.04 * n, has_stamp=False) for n in range(3)]
    assert (backlog, live, held, again) == ([False] * 5, [True] * 5, [False] * 5, [True] * 3)


def test_a_slower_camera_than_configured_is_read() -> None:
    fresh = Freshness(0.04)
    assert [fresh.is_fresh(0.5 * n, has_stamp=False) for n in range(6)][-3:] == [True] * 3


@pytest.mark.parametrize("has_length", [False, True])
@pytest.mark.parametrize("size", [1, 7, 1000, 100_000])
def test_parts_are_the_same_for_any_chunks(size: int, has_length: bool) -> None:
    pictures = [jpeg(n) for n in range(4)]
    stream = b""
    for one in pictures:
        length = f"Content-Length: {len(one)}\r\n" if has_length else ""
        stream += f"--frame\r\nContent-Type: image/jpeg\r\n{length}\r\n".encode() + one + b"\r\n"
    stream += b"--frame\r\nContent-Type: image/jpeg\r\n\r\n"
    parser = PartParser()
    parts = [part for i in range(0, len(stream), size) for _, part in parser.feed(stream[i : i + size])]
    assert parts == pictures


class OnvifDevice(BaseHTTPRequestHandler):
    """Answers the three questions as the ONVIF specification shows them."""

    address: ClassVar[str] = ""
    asked: ClassVar[list[bytes]] = []
    head: ClassVar[str] = ""
    encoding: ClassVar[str] = "utf-8"

    def do_POST(self) -> None:
        question = self.rfile.read(int(self.headers["Content-Length"]))
        self.asked.append(question)
        body = {
            b"GetCapabilities": f"<c:Media xmlns:c='http://s'><c:XAddr>{self.address}/onvif/media</c:XAddr></c:Media>",
            b"GetProfiles": "<p:Profiles xmlns:p='http://m' token='main&amp;1'/><p:Profiles xmlns:p='http://m' token='2'/>",
            b"GetStreamUri": "<u:Uri xmlns:u='http://s'> rtsp://10.0.0.9:554/main </u:Uri>",
        }[next(name for name in (b"GetStreamUri", b"GetProfiles", b"GetCapabilities") if name in question)]
        answer = f"{self.head}<s:Envelope xmlns:s='http://e'><s:Body><a>{body}</a></s:Body></s:Envelope>".encode(
            self.encoding
        )
        self.send_response(200)
        self.send_header("Content-Length", str(len(answer)))
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, format: str, *args: Any) -> None:  # the name is that of the base class
        pass


@contextmanager
def onvif(head: str = "", encoding: str = "utf-8") -> Iterator[str]:
    """Serve an ONVIF device whose answers begin with `head`; yields its address."""
    server = ThreadingHTTPServer((ADDRESS, 0), OnvifDevice)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    place = f"{ADDRESS}:{server.server_address[1]}"
    OnvifDevice.address, OnvifDevice.asked = f"http://{place}", []
    OnvifDevice.head, OnvifDevice.encoding = head, encoding
    try:
        yield f"onvif://{place}"
    finally:
        server.shutdown()
        server.server_close()


def test_an_onvif_device_tells_its_stream() -> None:
    with onvif() as place:
        assert stream_address(place, ("admin", "secret")) == "rtsp://10.0.0.9:554/main"
    assert b"main&amp;1" in OnvifDevice.asked[-1] and b"PasswordDigest" in OnvifDevice.asked[-1]
    assert not any(b"secret" in question for question in OnvifDevice.asked)
    with pytest.raises(LinkLost, match="ONVIF"):
        stream_address(place, None)


@pytest.mark.parametrize(
    ("declared", "encoding"),
    [("utf-8", "utf-8"), ("utf-16", "utf-16"), ("utf-16", "utf-16-be"), ("utf-16", "utf-16-le")],
)
def test_an_onvif_answer_that_declares_entities_is_refused_in_any_encoding(declared: str, encoding: str) -> None:
    head = f"<?xml version='1.0' encoding='{declared}'?><!DOCTYPE a [<!ENTITY b 'ha'>]>"
    with onvif(head, encoding) as place, pytest.raises(NoAnswer, match="not"):
        stream_address(place, None)
