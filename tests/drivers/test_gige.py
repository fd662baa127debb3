"""Tests of `gige:camera` against Aravis' fake camera, and of its frame rules with scripted frames."""

from __future__ import annotations

import ctypes.util
import os
import socket
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import psutil
import pytest

from drivers.gige.aravis import AravisCamera, library
from drivers.gige.camera import IN_WORK, GigeCamera
from drivers.gige.frames import Frame
from drivers.gige.settings import GigeCameraOptions
from drivers.kinds.pixel_formats import FORMATS, decode
from drivers.transport.link import BadAnswer, now_s
from hal.camera_settings import CameraSettings
from hal.conformance import CameraContract, Rig
from hal.errors import DeviceTimeout, DeviceUnavailable, Unsupported
from hal.registry import Context, connect
from tests.drivers.far_cameras import ADDRESS, FakeGigeCamera, fake_gige
from tests.drivers.rigs import CLOCK, soon, until

OPTIONS = {
    "camera": ADDRESS,
    "width_px": 128,
    "height_px": 96,
    "rate_hz": 100.0,
    "exposure_s": 0.002,
    "packet_bytes": 4000,
}


@pytest.fixture
def far_side() -> Iterator[FakeGigeCamera]:
    with fake_gige() as camera:
        yield camera


def gige(**options: Any) -> Any:
    return connect(Context(name="eye"), "gige:camera", {**OPTIONS, **options})


class TestGigeCamera(CameraContract):
    @pytest.fixture
    def rig(self, far_side: FakeGigeCamera) -> Iterator[Rig[Any]]:
        device = gige()
        yield Rig(device=device, clock=CLOCK, sample_period_s=0.02, inject=far_side.inject)
        device.close()


def test_settings_are_written_and_read_back(far_side: FakeGigeCamera) -> None:
    device = gige(offset_x_px=16, gain_db=3.0, pixel_format="RGB8", features={"BinningHorizontal": 1})
    c = device.capabilities()
    assert (c.width_px, c.height_px, c.is_colour) == (128, 96, True)
    assert c.settings.exposure_range_s == pytest.approx((1e-5, 10.0), rel=1.0)
    expected = CameraSettings(pixel_format="RGB8", exposure_s=0.002, gain_db=3.0, stamped_by="device")
    assert replace(c.settings, exposure_range_s=None) == expected
    image = device.read_image(deadline=soon()).value
    assert image.pixels.shape == (96, 128, 3) and image.exposure_s == 0.002
    device.close()


@pytest.mark.parametrize(("name", "is_colour"), [("Mono8", False), ("Mono16", False), ("BayerRG8", True)])
def test_formats_of_the_fake_camera_are_decoded(far_side: FakeGigeCamera, name: str, is_colour: bool) -> None:
    device = gige(pixel_format=name)
    pixels = device.read_image(deadline=soon()).value.pixels
    assert pixels.shape == ((96, 128, 3) if is_colour else (96, 128)) and pixels.std() > 1.0
    device.close()


def test_a_setting_that_the_camera_refuses_is_told(far_side: FakeGigeCamera) -> None:
    with pytest.raises(DeviceUnavailable, match=r"refuses its settings: .*NoSuchFeature") as caught:
        gige(features={"NoSuchFeature": 1})
    assert "data sheet" in caught.value.hint


@pytest.mark.third_party("aravis-tools", "gige:camera")
def test_numbers_are_whole_and_stamps_even(far_side: FakeGigeCamera) -> None:
    device = gige()
    samples = [device.read_image(deadline=soon()) for _ in range(30)]
    assert device.mailbox.peek().sequence == device.mailbox.published, "a frame is missing"
    errors_s = np.array([s.host_time_s - s.device_time_s for s in samples])
    assert np.ptp(errors_s[10:]) < 0.05
    device.close()


def test_the_receive_buffer_is_enlarged_before_the_first_frame(
    far_side: FakeGigeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    do, sizes = AravisCamera.do, set[int]()

    def noted(camera: AravisCamera, function: str, *arguments: Any) -> Any:
        if function == "start_acquisition":
            for opened in psutil.Process().net_connections("udp"):
                with socket.socket(fileno=os.dup(opened.fd)) as copy:
                    sizes.add(copy.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF))
        return do(camera, function, *arguments)

    monkeypatch.setattr(AravisCamera, "do", noted)
    gige(socket_buffer_bytes=70_000).close()
    assert 140_000 in sizes, "Linux doubles the size for its own needs"


@pytest.mark.third_party("aravis-tools", "gige:camera")
def test_frames_with_lost_packets_are_refused_and_counted() -> None:
    with fake_gige("-r", "20"):
        device = gige(packet_bytes=1400)
        until(lambda: device.mailbox.published > 20 and device._incomplete > 2)
        device.close()
    assert device.mailbox.peek().sequence > device.mailbox.published, "lost frames leave no gap"
    assert "incomplete" in device.health().detail


def test_a_camera_in_use_is_not_taken_and_can_be_had_afterwards(far_side: FakeGigeCamera) -> None:
    first = gige()
    device = GigeCamera(Context(name="second"), GigeCameraOptions(camera=ADDRESS))
    device.port.start()
    until(lambda: "controls" in str(device.mailbox.error()))
    first.read_image(deadline=soon())
    first.close()
    until(lambda: device.mailbox.published > 0)
    device.close()


def test_a_camera_that_is_not_there_is_named() -> None:
    with fake_gige() as camera:
        camera.close()
        with pytest.raises(DeviceUnavailable, match=r"no camera at 127\.0\.0\.1"):
            gige()


def test_without_the_library_its_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes.util, "find_library", lambda _name: None)
    library.cache_clear()
    with pytest.raises(DeviceUnavailable, match="Aravis") as caught:
        gige(camera="Vendor-Model-1")
    assert "libaravis-0.8-0" in caught.value.hint


class Script:
    """Source of frames that a test writes; `trigger` calls what the test gives."""

    width_px, height_px = 4, 2
    settings = CameraSettings(
        pixel_format="Mono8", exposure_s=0.001, stamped_by="device", exposure_range_s=(1e-5, 0.1)
    )  # fmt: skip
    exposed_s = 0.001

    def __init__(self) -> None:
        self.frames: deque[Frame] = deque()
        self.triggers = 0
        self.on_trigger: list[Frame | None] = []
        self._rest = threading.Event()

    def pop(self, timeout_s: float) -> Frame | None:
        if self.frames:
            return self.frames.popleft()
        self._rest.wait(min(timeout_s, 0.002))
        return None

    def trigger(self) -> None:
        self.triggers += 1
        answer = self.on_trigger.pop(0) if self.on_trigger else None
        self.frames.append(answer or frame(self.triggers))

    def exposure_s(self) -> float | None:
        return self.exposed_s

    def set_exposure(self, exposure_s: float) -> None:
        self.exposed_s = exposure_s

    def check(self) -> None:
        pass

    def close(self) -> None:
        pass


def frame(
    number: int, *, value: int = 7, fault: str | None = None, device_s: float | None = None, **more: Any
) -> Frame:
    here_s = now_s()
    data = np.full(8, value, np.uint8)
    fields = {"width_px": 4, "height_px": 2, "pixel_format": 0x01080001, "data": data, "arrived_s": here_s, **more}
    return Frame(fault=fault, frame_id=number, device_s=here_s if device_s is None else device_s, **fields)


def scripted(script: Script, **options: Any) -> GigeCamera:
    device = GigeCamera(Context(name="eye"), GigeCameraOptions(camera="script", **options), lambda: script)
    device.port.start()
    return device


def test_gaps_are_counted_repeated_and_late_frames_are_dropped_and_numbers_wrap() -> None:
    script = Script()
    script.frames.extend(frame(n, value=n % 256) for n in (65530, 65533, 65533, 65532, 65535, 1, 2))
    device = scripted(script)
    until(lambda: device.mailbox.published == 5)
    samples, _ = device.mailbox.since(0)
    device.close()
    assert [int(s.value.pixels[0, 0]) for s in samples] == [n % 256 for n in (65530, 65533, 65535, 1, 2)]
    assert [s.sequence for s in samples] == [1, 4, 6, 7, 8]


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ({"fault": "packets are missing"}, "packets are missing"),
        ({"data": np.zeros(5, np.uint8)}, "5 of 8 bytes"),
        ({"width_px": 2}, "2x2 pixels instead of 4x2"),
        ({"pixel_format": 0x7FFFFFFF}, "is not known"),
    ],
)
def test_a_damaged_frame_is_a_typed_error_and_never_a_value(bad: dict[str, Any], why: str) -> None:
    script = Script()
    script.frames.append(frame(1))
    device = scripted(script)
    until(lambda: device.mailbox.published == 1)
    script.frames.append(frame(2, **bad))
    until(lambda: why in str(device.mailbox.error()))
    with pytest.raises(DeviceTimeout, match="eye"):
        device.read_image(deadline=soon(0.05))
    assert device.mailbox.published == 1
    script.frames.extend([frame(3), frame(4)])
    until(lambda: device.mailbox.published >= 2)
    device.close()


@pytest.mark.parametrize(("trigger", "left_out"), [("free-run", IN_WORK), ("software", 0)])
def test_frames_in_work_when_the_exposure_was_set_are_left_out(trigger: str, left_out: int) -> None:
    script = Script()
    if trigger == "free-run":
        script.frames.append(frame(1, value=1))
    device = scripted(script, trigger=trigger)
    until(lambda: device.mailbox.published == 1)
    device.set_exposure(0.004, deadline=soon())
    assert device.capabilities().settings.exposure_s == script.exposed_s == 0.004
    if trigger == "software":
        script.on_trigger = [frame(n, value=n) for n in (2, 3)]
    else:
        script.frames.extend(frame(n, value=n, arrived_s=now_s() + 0.1, device_s=now_s() + 0.1) for n in (2, 3, 4))
    sample = device.read_image(deadline=soon()).value
    device.close()
    assert (int(sample.pixels[0, 0]), sample.exposure_s) == (2 + left_out, 0.004)
    published = [int(one.value.pixels[0, 0]) for one in device.mailbox.since(0)[0]]
    assert published[1:] == [2 + left_out], "what was in work is not given to anybody"


def test_a_camera_that_chooses_its_exposure_is_left_alone() -> None:
    script = Script()
    script.settings = replace(Script.settings, exposure_range_s=None)
    script.frames.append(frame(1))
    device = scripted(script)
    until(lambda: device.mailbox.published == 1)
    with pytest.raises(Unsupported, match="eye") as caught:
        device.set_exposure(0.004, deadline=soon())
    assert "devices.eye.options.exposure_s" in caught.value.hint
    device.close()


def test_a_triggered_read_starts_the_exposure_and_refuses_the_frame_of_an_earlier_trigger() -> None:
    script = Script()
    device = scripted(script, trigger="software")
    until(lambda: device.mailbox.published == 1)
    assert script.triggers == 1, "an idle camera exposes by itself"
    late = frame(2, value=99)
    script.on_trigger = [Frame(**{k: getattr(late, k) for k in Frame.__slots__} | {"device_s": late.device_s - 0.5})]  # type: ignore[operator]
    reader = threading.Thread(target=lambda: results.append(device.read_image(deadline=soon())))
    results: list[Any] = []
    asked_s = now_s()
    reader.start()
    until(lambda: device.errors == 1)
    script.frames.append(frame(3, value=5))
    reader.join()
    device.close()
    assert int(results[0].value.pixels[0, 0]) == 5 and results[0].host_time_s >= asked_s


def test_an_incomplete_triggered_frame_is_exposed_again() -> None:
    script = Script()
    device = scripted(script, trigger="software")
    until(lambda: device.mailbox.published == 1)
    script.on_trigger = [frame(2, fault="packets are missing")]
    assert device.read_image(deadline=soon()).value.pixels[0, 0] == 7
    assert script.triggers == 3
    device.close()


def grey(code: int, values: list[int]) -> list[int]:
    """Pack 4 samples as the format says and decode them."""
    form = FORMATS[code]
    if form.is_packed:
        bits = "".join(format(v, f"0{form.bits}b")[::-1] for v in values)
        raw = bytes(int(bits[i : i + 8].ljust(8, "0")[::-1], 2) for i in range(0, len(bits), 8))
    else:
        raw = np.array(values, "<u2" if form.bits == 16 else "u1").tobytes()
    data = np.frombuffer(raw, np.uint8)
    return [int(v) for v in decode(data, code, width_px=4, height_px=1, is_colour=False)[0]]


@pytest.mark.parametrize("code", [c for c, f in FORMATS.items() if f.name.startswith("Mono")])
def test_grey_formats_keep_the_high_bits(code: int) -> None:
    depth = FORMATS[code].depth
    values = [0, (1 << depth) - 1, 0x5A << (depth - 8), 0x81 << (depth - 8)]
    assert grey(code, values) == [0, 255, 0x5A, 0x81]


@pytest.mark.parametrize("name", ["RG", "GR", "GB", "BG"])
@pytest.mark.parametrize("depth", [8, 10, 12, 16])
def test_a_mosaic_of_one_colour_gives_that_colour(name: str, depth: int) -> None:
    code = next(c for c, f in FORMATS.items() if f.name == f"Bayer{name}{depth}")
    rows = {"RG": ("RG", "GB"), "GR": ("GR", "BG"), "GB": ("GB", "RG"), "BG": ("BG", "GR")}[name]
    value = {"R": 200, "G": 100, "B": 50}
    tile = np.array([[value[c] for c in row] for row in rows], np.uint16) << (depth - 8)
    data = np.tile(tile, (4, 4)).astype("u1" if depth == 8 else "<u2").view(np.uint8).ravel()
    pixels = decode(data, code, width_px=8, height_px=8, is_colour=True)
    assert pixels[4, 4].tolist() == [200, 100, 50]


def test_a_short_frame_is_refused() -> None:
    with pytest.raises(BadAnswer, match="15 of 16 bytes"):
        decode(np.zeros(15, np.uint8), 0x01080001, width_px=4, height_px=4, is_colour=False)
