"""Tests of `realsense:depth` and `realsense:camera` with a recording that librealsense plays, and with scripted frames."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.realsense.devices import IN_WORK, ColourOptions, DepthOptions, RealsenseColour, RealsenseDepth
from drivers.realsense.stream import RealsenseFrame, StreamFacts
from drivers.transport.link import LinkLost, now_s
from hal.calibration import CameraIntrinsics
from hal.camera_settings import CameraSettings
from hal.conformance import CameraContract, RangeScannerContract, Rig
from hal.errors import DeviceTimeout, DeviceUnavailable, Unsupported
from hal.readings import Cause, Quality
from hal.registry import Context, connect
from hal.simulated import Fault
from tests.drivers.rigs import CLOCK, soon, until

rs: Any = pytest.importorskip("pyrealsense2", reason="the extra `realsense` is not installed")
WIDTH, HEIGHT, FRAMES, PERIOD_S = 64, 48, 40, 0.01
FIRST_COUNT = 1000


def _video_stream(stream: Any, form: Any, bpp: int, uid: int) -> Any:
    lens = rs.intrinsics()
    lens.width, lens.height, lens.ppx, lens.ppy, lens.fx, lens.fy = WIDTH, HEIGHT, 31.0, 24.0, 60.0, 61.0
    lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
    video = rs.video_stream()
    video.type, video.index, video.uid, video.fps, video.bpp, video.fmt = stream, 0, uid, 30, bpp, form
    video.width, video.height, video.intrinsics = WIDTH, HEIGHT, lens
    return video


def _frame(pixels: Any, number: int, profile: Any) -> Any:
    frame = rs.software_video_frame()
    frame.pixels, frame.stride, frame.bpp = pixels, pixels.strides[0], pixels.strides[1]
    frame.timestamp, frame.domain = 5000.0 + 1e3 * PERIOD_S * number, rs.timestamp_domain.hardware_clock
    frame.frame_number, frame.profile, frame.depth_units = number, profile.as_video_stream_profile(), 0.001
    return frame


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record frames whose depth in mm and red value tell their number, with librealsense's recorder."""
    path = tmp_path_factory.mktemp("realsense") / "scene.db3"
    camera = rs.software_device()
    camera.register_info(rs.camera_info.serial_number, "12345")
    depth, colour = camera.add_sensor("Stereo Module"), camera.add_sensor("RGB Camera")
    of_depth = depth.add_video_stream(_video_stream(rs.stream.depth, rs.format.z16, 2, 0))
    of_colour = colour.add_video_stream(_video_stream(rs.stream.color, rs.format.rgb8, 3, 1))
    depth.add_read_only_option(rs.option.depth_units, 0.001)
    recorder, queue, rest = rs.recorder(str(path), camera), rs.frame_queue(100), threading.Event()
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    for number in range(1, FRAMES + 1):
        counts = np.full((HEIGHT, WIDTH), FIRST_COUNT + number, np.uint16)
        counts[0, :3] = (0, 50, 60_000)  # nothing, too near, too far
        depth.on_video_frame(_frame(counts, number, of_depth))
        colour.on_video_frame(_frame(np.full((HEIGHT, WIDTH, 3), (number, 90, 20), np.uint8), number, of_colour))
        rest.wait(PERIOD_S)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    return path


def _rig(device: Any, path: Path) -> Rig[Any]:
    away = path.with_suffix(".away")

    def inject(fault: Any) -> None:
        link = device.port.link
        if fault in (Fault.SILENT, Fault.DISCONNECTED) and link is not None:
            link._device.as_playback().pause()
        if fault is Fault.DISCONNECTED:
            path.rename(away)
        if fault is None and away.exists():
            away.rename(path)
        if fault is None and device.port.link is link and link is not None:
            link._device.as_playback().resume()

    return Rig(device=device, clock=CLOCK, sample_period_s=0.03, inject=inject)


@pytest.fixture
def scene(recorded: Path, tmp_path: Path) -> Path:
    path = tmp_path / "scene.db3"
    path.write_bytes(recorded.read_bytes())
    return path


class TestRealsenseDepth(RangeScannerContract):
    @pytest.fixture
    def rig(self, scene: Path) -> Iterator[Rig[Any]]:
        device = connect(Context(name="depth"), "realsense:depth", {"recording": str(scene)})
        yield _rig(device, scene)
        device.close()


class TestRealsenseColour(CameraContract):
    @pytest.fixture
    def rig(self, scene: Path) -> Iterator[Rig[Any]]:
        device = connect(Context(name="eye"), "realsense:camera", {"recording": str(scene)})
        yield _rig(device, scene)
        device.close()


@pytest.mark.third_party("pyrealsense2", "realsense:depth")
def test_depths_are_metres_with_the_recorded_numbers_and_lens(scene: Path) -> None:
    device = connect(Context(name="depth"), "realsense:depth", {"recording": str(scene)})
    c, sample = device.capabilities(), device.read_range(deadline=soon())
    device.close()
    assert (c.fx, c.fy, c.cx, c.cy, c.rate_hz, c.projection) == (60.0, 61.0, 31.0, 24.0, 30.0, "pinhole")
    number = round((sample.device_time_s - 5.0) / PERIOD_S)
    assert sample.value.depth_m[5, 5] == pytest.approx(1e-3 * (FIRST_COUNT + number))
    assert np.isnan(sample.value.depth_m[0, :3]).all() and np.isfinite(sample.value.depth_m).sum() == WIDTH * HEIGHT - 3


@pytest.mark.third_party("pyrealsense2", "realsense:camera")
def test_images_carry_the_recorded_numbers_and_the_lens_of_the_camera(scene: Path) -> None:
    device = connect(Context(name="eye"), "realsense:camera", {"recording": str(scene)})
    c, sample = device.capabilities(), device.read_image(deadline=soon())
    device.close()
    assert (c.nominal.fx_px, c.nominal.cy_px, c.settings.stamped_by) == (60.0, 24.0, "device")
    assert c.settings.pixel_format == "RGB8" and c.settings.latency_s == pytest.approx(1 / 30)
    number = round((sample.device_time_s - 5.0) / PERIOD_S)
    assert sample.value.pixels[3, 3].tolist() == [number, 90, 20]


def test_the_end_of_a_recording_is_told(scene: Path) -> None:
    device = connect(Context(name="eye"), "realsense:camera", {"recording": str(scene), "repeat": False})
    until(lambda: isinstance(device.mailbox.error(), DeviceUnavailable))
    with pytest.raises(DeviceUnavailable, match="has been shown"):
        device.read_image(deadline=soon())
    device.close()


@pytest.mark.parametrize("content", [b"", b"no recording", b"SQLite format 3\x00" + b"\x00" * 100])
def test_a_damaged_recording_is_named(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "broken.db3"
    path.write_bytes(content)
    with pytest.raises(DeviceUnavailable, match=r"broken\.db3"):
        connect(Context(name="eye"), "realsense:camera", {"recording": str(path)})


def test_a_camera_that_is_not_connected_is_told_at_once() -> None:
    with pytest.raises(DeviceUnavailable, match="no RealSense camera with serial number 999 is connected"):
        connect(Context(name="eye"), "realsense:depth", {"serial": "999"})


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(DeviceUnavailable, match="pyrealsense2") as caught:
        connect(Context(name="eye"), "realsense:camera", {})
    assert "panelwright[realsense]" in caught.value.hint


class Script:
    """Stream of frames that a test writes."""

    def __init__(self, *, is_rectified: bool = True) -> None:
        lens = CameraIntrinsics(width_px=4, height_px=2, fx_px=4.0, fy_px=4.0, cx_px=1.5, cy_px=0.5)
        settings = CameraSettings(latency_s=0.01, stamped_by="device", exposure_s=0.01, exposure_range_s=(1e-4, 0.1))
        self.facts = StreamFacts(
            intrinsics=lens, is_rectified=is_rectified, rate_hz=100.0, settings=settings, serial="7"
        )
        self.frames: deque[RealsenseFrame] = deque()
        self.is_gone = False
        self._rest = threading.Event()

    def wait(self, timeout_s: float) -> RealsenseFrame | None:
        if self.frames:
            return self.frames.popleft()
        self._rest.wait(min(timeout_s, 0.002))
        return None

    def set_exposure(self, exposure_s: float) -> None:
        self.facts = replace(self.facts, settings=replace(self.facts.settings, exposure_s=exposure_s))

    def check(self) -> None:
        if self.is_gone:
            raise LinkLost("the camera was unplugged")

    def close(self) -> None:
        pass


def frame(number: int, counts: int = 1500, *, shape: tuple[int, int] = (2, 4), unit_m: float = 0.001) -> RealsenseFrame:
    data = np.full(shape, counts, np.uint16)
    return RealsenseFrame(number=number, device_s=now_s(), arrived_s=now_s(), data=data, unit_m=unit_m)


def scripted(script: Script) -> RealsenseDepth:
    device = RealsenseDepth(Context(name="depth"), DepthOptions(rate_hz=100), lambda: script)
    device.port.start()
    return device


def test_gaps_are_counted_and_repeated_frames_dropped() -> None:
    script = Script()
    script.frames.extend(frame(n) for n in (5, 5, 8, 9, 1, 2))
    device = scripted(script)
    until(lambda: device.mailbox.published == 5)
    assert [s.sequence for s in device.mailbox.since(0)[0]] == [1, 4, 5, 6, 7]
    device.close()


def test_an_empty_depth_image_is_invalid() -> None:
    script = Script()
    script.frames.append(frame(1, counts=0))
    device = scripted(script)
    until(lambda: device.mailbox.published == 1)
    sample = device.mailbox.peek()
    assert sample is not None and (sample.quality, sample.cause) == (Quality.INVALID, Cause.OUT_OF_RANGE)
    device.close()


@pytest.mark.parametrize(
    ("bad", "why"), [(frame(2, shape=(1, 4)), "shape"), (frame(2, unit_m=0.0), "does not tell its depth unit")]
)
def test_a_frame_of_another_shape_or_without_unit_is_an_error(bad: RealsenseFrame, why: str) -> None:
    script = Script()
    script.frames.extend([frame(1), bad])
    device = scripted(script)
    until(lambda: why in str(device.mailbox.error()))
    assert device.mailbox.published == 1
    with pytest.raises((DeviceTimeout, DeviceUnavailable), match="depth"):
        device.read_range(deadline=soon(0.02))
    device.close()


def test_an_unplugged_camera_is_told_and_a_silent_one_too() -> None:
    script = Script()
    script.frames.append(frame(1))
    device = scripted(script)
    until(lambda: "sends no frames" in str(device.mailbox.error()))
    script.is_gone = True
    until(lambda: "unplugged" in str(device.mailbox.error()))
    script.is_gone = False
    script.frames.extend([frame(1), frame(2)])
    until(lambda: device.mailbox.published == 3)
    device.close()


def test_a_lens_that_a_range_image_cannot_have_is_refused() -> None:
    device = scripted(Script(is_rectified=False))
    until(lambda: isinstance(device.mailbox.error(), Unsupported))
    device.close()


def test_frames_in_work_when_the_exposure_was_set_are_left_out() -> None:
    script = Script()
    device = RealsenseColour(Context(name="eye"), ColourOptions(rate_hz=100), lambda: script)
    device.port.start()
    until(lambda: device.port.link is not None)
    device.set_exposure(0.004, deadline=soon())
    assert device.capabilities().settings.exposure_s == 0.004
    script.frames.extend(
        RealsenseFrame(number=n, device_s=now_s(), arrived_s=now_s(), data=np.full((2, 4, 3), n, np.uint8))
        for n in range(1, 6)
    )
    until(lambda: device.mailbox.published == 5 - IN_WORK)
    first = device.mailbox.since(0)[0][0].value
    assert (int(first.pixels[0, 0, 0]), first.exposure_s) == (1 + IN_WORK, 0.004)
    device.close()


def test_grey_is_made_of_colour() -> None:
    script = Script()
    script.frames.append(
        RealsenseFrame(number=1, device_s=1.0, arrived_s=now_s(), data=np.full((2, 4, 3), (255, 0, 0), np.uint8))
    )
    device = RealsenseColour(Context(name="eye"), ColourOptions(is_colour=False, rate_hz=100), lambda: script)
    device.port.start()
    until(lambda: device.mailbox.published == 1)
    sample = device.mailbox.peek()
    assert sample is not None and sample.value.pixels.tolist() == [[76] * 4] * 2
    device.close()
