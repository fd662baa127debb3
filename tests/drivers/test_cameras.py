"""Tests of cameras and depth cameras that play files, and of the V4L2 driver with a fake grabber."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks.drivers.camera_benches import NumberedPictures
from benchmarks.drivers.local_cameras import ScriptedGrabbers, v4l2_of
from drivers.camera_v4l2 import IN_WORK, CameraV4l2, CameraV4l2Options
from drivers.kinds.file_player import undamaged_png
from hal.camera_settings import CameraSettings
from hal.conformance import CameraContract, RangeScannerContract, Rig
from hal.errors import DeviceFault, DeviceTimeout, DeviceUnavailable
from hal.registry import Context, connect
from tests.drivers.rigs import CLOCK, soon, until


def picture(index: int) -> np.ndarray[Any, Any]:
    return np.full((24, 32, 3), (10, 20, index), np.uint8)  # BGR


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i:03d}.png"), picture(100 + i))
    return tmp_path


class TestCameraFiles(CameraContract):
    @pytest.fixture
    def rig(self, folder: Path) -> Iterator[Rig[Any]]:
        device = connect(Context(name="camera"), "files:camera", {"path": str(folder), "rate_hz": 100.0})
        yield Rig(device=device, clock=CLOCK, sample_period_s=0.02)
        device.close()


class TestDepthCamera(RangeScannerContract):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[Rig[Any]]:
        np.save(tmp_path / "a.npy", np.full((6, 8), 1.5))
        options = {"path": str(tmp_path), "fx": 8.0, "fy": 8.0, "cx": 3.5, "cy": 2.5, "rate_hz": 100.0}
        device = connect(Context(name="depth"), "files:depth", options)
        yield Rig(device=device, clock=CLOCK, sample_period_s=0.02)
        device.close()


class FakeGrabber:
    """Returns numbered frames until told to fail or to block."""

    size_px = (32, 24)
    rate_hz = 100.0
    settings = CameraSettings(pixel_format="MJPG", exposure_s=0.004, gain_db=7.0, exposure_range_s=(1e-4, 0.01))
    stamp_s: float | None = None

    def captured_s(self) -> float | None:
        return self.stamp_s

    def __init__(self) -> None:
        self.frames = 0
        self.is_broken = False
        self.is_silent = False
        self.rest = threading.Event()
        self.exposures_s: list[float] = []

    def set_exposure(self, exposure_s: float) -> float | None:
        self.exposures_s.append(exposure_s)
        return 1e-4 * round(exposure_s / 1e-4)

    def read(self) -> tuple[bool, np.ndarray[Any, Any]]:
        self.rest.wait(0.01)
        while self.is_silent and not self.is_broken:
            self.rest.wait(0.005)
        self.frames += 1
        return not self.is_broken, picture(self.frames % 256)

    def close(self) -> None:
        self.is_silent = False


def v4l2(grabber: FakeGrabber) -> CameraV4l2:
    options = CameraV4l2Options(width_px=32, height_px=24, rate_hz=100.0)
    device = CameraV4l2(Context(name="camera"), options, lambda: grabber)
    device.port.start()
    device.await_first()
    return device


class TestCameraV4l2(CameraContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        grabber = FakeGrabber()
        device = v4l2(grabber)

        def inject(fault: Any) -> None:
            grabber.is_broken = fault == "disconnected"
            grabber.is_silent = fault == "silent"

        yield Rig(device=device, clock=CLOCK, sample_period_s=0.05, inject=inject)
        grabber.is_silent = False
        device.close()


def test_pictures_come_in_order_as_rgb_and_start_over(folder: Path) -> None:
    device = connect(Context(name="camera"), "files:camera", {"path": str(folder), "rate_hz": 1000.0})
    reds = [int(device.read_image(deadline=soon()).value.pixels[0, 0, 0]) for _ in range(4)]
    assert reds == [100, 101, 102, 100]
    device.close()


def test_without_repeat_the_end_is_said(folder: Path) -> None:
    options = {"path": str(folder), "rate_hz": 1000.0, "repeat": False, "is_colour": False}
    device = connect(Context(name="camera"), "files:camera", options)
    for _ in range(3):
        assert device.read_image(deadline=soon()).value.pixels.shape == (24, 32)
    with pytest.raises(DeviceUnavailable, match="have been shown"):
        device.read_image(deadline=soon())


def test_a_picture_that_is_not_due_before_the_deadline_is_a_timeout(folder: Path) -> None:
    device = connect(Context(name="camera"), "files:camera", {"path": str(folder), "rate_hz": 0.1})
    device.read_image(deadline=soon())
    with pytest.raises(DeviceTimeout):
        device.read_image(deadline=soon(0.02))


def test_a_video_is_a_camera(tmp_path: Path) -> None:
    path = tmp_path / "scene.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (32, 24))
    for i in range(4):
        writer.write(picture(60 * i))
    writer.release()
    device = connect(Context(name="camera"), "files:camera", {"path": str(path), "rate_hz": 1000.0})
    reds = [float(device.read_image(deadline=soon()).value.pixels[..., 0].mean()) for _ in range(4)]
    np.testing.assert_allclose(reds, [0, 60, 120, 180], atol=8)


@pytest.mark.parametrize("driver", ["files:camera", "files:depth"])
def test_an_empty_or_missing_folder_is_named(driver: str, tmp_path: Path) -> None:
    lens = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0} if driver == "files:depth" else {}
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(DeviceUnavailable, match=path.name):
            connect(Context(name="eye"), driver, {"path": str(path), **lens})


def test_a_broken_or_odd_picture_is_a_fault_that_names_it(folder: Path) -> None:
    device = connect(Context(name="camera"), "files:camera", {"path": str(folder), "rate_hz": 1000.0})
    (folder / "000.png").write_bytes(b"no picture")
    with pytest.raises(DeviceFault, match=r"000\.png"):
        device.read_image(deadline=soon())
    device.read_image(deadline=soon())  # the next one
    cv2.imwrite(str(folder / "000.png"), picture(1)[:10])
    with pytest.raises(DeviceFault, match="32x10"):
        device._index = 3
        device.read_image(deadline=soon())


@pytest.mark.parametrize("name", ["a.png", "a.npy", "a.npz"])
@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no archive", b"\x93NUMPY\x01\x00"])
def test_a_damaged_depth_picture_is_a_fault_that_names_the_file(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    lens = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}
    with pytest.raises(DeviceFault, match=rf"{name} is not a depth picture"):
        connect(Context(name="depth"), "files:depth", {"path": str(tmp_path), **lens})


def test_a_png_with_one_wrong_bit_or_without_its_end_is_refused_before_it_is_decoded() -> None:
    """One wrong bit in the header may make a small picture gigabytes large."""
    content = bytes(cv2.imencode(".png", np.full((16, 32), 1200, np.uint16))[1])
    assert undamaged_png(content) == content
    for bit in range(8 * len(content)):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ValueError, match="damaged"):
            undamaged_png(bytes(damaged))
    for end in range(len(content)):
        with pytest.raises(ValueError, match="damaged"):
            undamaged_png(content[:end])


def test_depth_formats_agree_and_limits_cut(tmp_path: Path) -> None:
    depth_m = np.array([[0.0, 0.05, 1.234], [2.0, 9.0, 20.0]])
    cv2.imwrite(str(tmp_path / "a.png"), np.round(depth_m * 1000).astype(np.uint16))
    np.save(tmp_path / "b.npy", depth_m)
    np.savez(tmp_path / "c.npz", depth_m)
    options = {"path": str(tmp_path), "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "rate_hz": 1000.0}
    device = connect(Context(name="depth"), "files:depth", options)
    for _ in range(3):
        got = device.read_range(deadline=soon()).value.depth_m
        np.testing.assert_allclose(got, [[np.nan, np.nan, 1.234], [2.0, 9.0, np.nan]], rtol=1e-6)


def test_a_live_frame_began_after_the_call() -> None:
    grabber = FakeGrabber()
    device = v4l2(grabber)
    asked_s = CLOCK.now_s()
    assert device.read_image(deadline=soon()).host_time_s >= asked_s
    device.close()


@pytest.mark.parametrize("has_stamps", [False, True])
def test_a_frame_that_was_held_up_is_given_only_with_the_kernel_s_stamp(has_stamps: bool) -> None:
    far_side = ScriptedGrabbers(
        pictures := NumberedPictures(), {"has_stamps": has_stamps, "fault": "delay", "every": 20}
    )
    device = v4l2_of(Context(name="camera"), far_side)
    ages_s: dict[int, float] = {}

    def is_over() -> bool:
        for sample in device.mailbox.since(0)[0]:
            ages_s[sample.sequence] = sample.host_time_s - pictures.taken_s(sample.value)
        return far_side.plan.injected >= 2 and far_side.plan.frames % 20 > 5

    until(is_over)
    device.close()
    far_side.close()
    assert len(ages_s) >= 20 and max(ages_s.values()) < 0.1, "dated long after it was taken"


def test_a_frame_that_lay_in_a_buffer_is_not_given_as_fresh_and_settings_are_reported() -> None:
    grabber = FakeGrabber()
    device = v4l2(grabber)
    assert device.capabilities().settings == FakeGrabber.settings
    grabber.stamp_s = CLOCK.now_s() - 0.5
    with pytest.raises(DeviceTimeout):
        device.read_image(deadline=soon(0.1))
    assert device.capabilities().settings.stamped_by == "device"
    grabber.stamp_s = None
    assert device.read_image(deadline=soon()).value.exposure_s == 0.004
    device.close()


def test_frames_that_were_in_work_when_the_exposure_was_set_are_left_out_and_a_silent_camera_is_told() -> None:
    grabber = FakeGrabber()
    device = v4l2(grabber)
    device.set_exposure(0.00123, deadline=soon())
    frames = grabber.frames
    sample = device.read_image(deadline=soon()).value
    assert grabber.exposures_s == [0.00123] and sample.exposure_s == pytest.approx(0.0012)
    assert grabber.frames - frames >= IN_WORK, "the first frames may have been begun before"
    grabber.is_silent = True
    with pytest.raises(DeviceTimeout, match="camera"):
        device.set_exposure(0.002, deadline=soon(0.05))
    grabber.is_silent = False
    assert device.read_image(deadline=soon()).value.exposure_s == pytest.approx(0.0012), "nobody waits for it any more"
    device.close()


def test_a_live_camera_is_opened_again_after_it_fails() -> None:
    grabber = FakeGrabber()
    device = v4l2(grabber)
    grabber.is_broken = True
    until(lambda: device.mailbox.error() is not None)
    grabber.is_broken = False
    until(lambda: device.health().reconnects >= 1 and device.mailbox.error() is None)
    device.close()


def test_a_camera_that_is_not_there_is_told() -> None:
    with pytest.raises(DeviceUnavailable, match="does not exist"):
        connect(Context(name="camera"), "v4l2:camera", {"device": "/dev/video99"})


def test_frames_of_another_size_are_refused() -> None:
    options = CameraV4l2Options(width_px=64, height_px=48, rate_hz=100.0)
    device = CameraV4l2(Context(name="camera"), options, FakeGrabber)
    device.port.start()
    with pytest.raises(DeviceUnavailable, match="32x24 instead of 64x48"):
        device.await_first(0.3)
