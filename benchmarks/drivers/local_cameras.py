"""Test setups of cameras that need a device of their own machine: V4L2 by a scripted grabber, RealSense by recordings.

There is neither a V4L2 device nor a USB camera here. The grabber stands in for OpenCV's capture, so the kernel and the
camera are not part of the measurement. The recordings are written and played by librealsense itself; what applies of the
faults is a frame that is missing, one that comes twice, and a pause of all frames.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from benchmarks.drivers.bench import Bench
from benchmarks.drivers.camera_benches import NumberedPictures
from drivers.camera_v4l2 import CameraV4l2, CameraV4l2Options
from drivers.emulators.faults import FaultOptions, FaultPlan, WireFault
from drivers.realsense.stream import library
from hal.camera_settings import CameraSettings
from hal.devices import Image, RangeImage
from hal.errors import DeviceUnavailable
from hal.registry import Context
from hal.strict import validate

RATE_HZ = 50.0
SIZE_PX = NumberedPictures.drawn(0).shape[::-1]
WITHOUT_WIRE = tuple(f for f in WireFault if f not in (WireFault.ECHO, WireFault.SPLIT, WireFault.GARBAGE))


class GrabberOptions(FaultOptions):
    """Fault options, and whether the kernel's stamps are passed on."""

    has_stamps: Annotated[bool, Field(description="frames have the time at which they were captured")] = True


class ScriptedGrabbers:
    """Camera of which the driver opens one grabber after the other."""

    def __init__(self, backing: NumberedPictures, options: dict[str, Any]) -> None:
        self.o = validate(options, GrabberOptions, source="far side")
        self.plan, self.backing = FaultPlan(self.o), backing
        self.away_until_s = 0.0
        self.address: dict[str, Any] = {}
        self.closing = threading.Event()

    def open(self) -> ScriptedGrabber:
        """Return a grabber, as OpenCV would."""
        if time.monotonic() < self.away_until_s:
            raise DeviceUnavailable("the camera is not there", hint="plug it in", device="dut")
        return ScriptedGrabber(self)

    def unplug(self, *, away_s: float) -> None:
        """Take the camera away for a while."""
        self.away_until_s = time.monotonic() + away_s
        self.closing.wait(away_s)

    def close(self) -> None:
        """End all waiting."""
        self.closing.set()


class ScriptedGrabber:
    """Opened camera, whose frames are taken at its rate; what nobody fetches is replaced by the next frame."""

    size_px = SIZE_PX
    rate_hz = RATE_HZ
    settings = CameraSettings(pixel_format="MJPG")

    def __init__(self, camera: ScriptedGrabbers) -> None:
        self._camera = camera
        self._next_s = time.monotonic()
        self._captured_s: float | None = None
        self._again: tuple[float, NDArray[np.uint8]] | None = None

    def captured_s(self) -> float | None:
        """Return when the last frame was captured."""
        return self._captured_s

    def set_exposure(self, exposure_s: float) -> float | None:
        """Take no exposure: this camera tells none."""
        del exposure_s
        return None

    def read(self) -> tuple[bool, NDArray[Any]]:
        """Wait for the next frame."""
        camera, nothing = self._camera, np.empty((0, 0), np.uint8)
        frame, self._again = self._again, None
        if frame is None:
            frame = self._taken()
        match None if frame is None else camera.plan.next():
            case WireFault.CRC | WireFault.STATUS:  # of a damaged picture OpenCV makes no frame
                frame = None
            case WireFault.DROP:
                frame = self._taken()
            case WireFault.DUP:
                self._again = frame
            case WireFault.DELAY:
                camera.closing.wait(camera.o.delay_s)
            case WireFault.SILENT:
                camera.closing.wait(camera.o.silent_s)
                frame = self._taken()
            case WireFault.DISCONNECT:
                camera.away_until_s = time.monotonic() + camera.o.away_s
                frame = None
            case _:
                pass
        if frame is None:
            return False, nothing
        self._captured_s = frame[0] if camera.o.has_stamps else None
        return True, np.repeat(frame[1][:, :, np.newaxis], 3, axis=2)

    def _taken(self) -> tuple[float, NDArray[np.uint8]] | None:
        self._next_s = max(self._next_s + 1.0 / RATE_HZ, time.monotonic())
        self._camera.closing.wait(max(0.0, self._next_s - time.monotonic()))
        is_there = time.monotonic() >= self._camera.away_until_s and not self._camera.closing.is_set()
        return self._camera.backing.take() if is_there else None

    def close(self) -> None:
        """Do nothing: nobody else wants the camera."""


def v4l2_of(context: Context, far_side: ScriptedGrabbers) -> CameraV4l2:
    """Return the driver with the scripted camera."""
    options = CameraV4l2Options(width_px=SIZE_PX[0], height_px=SIZE_PX[1], rate_hz=RATE_HZ)
    device = CameraV4l2(context, options, far_side.open)
    device.port.start()
    device.await_first()
    return device


FRAMES, PERIOD_S, FIRST_MM, SHAPE = 24, 0.01, 1000, (48, 64)
OF_RECORDINGS = (WireFault.DROP, WireFault.DUP, WireFault.SILENT)


class Recording:
    """Recording of frames whose depth in mm, or whose red value, is their number, in which some are missing or twice."""

    def __init__(self, _: None, options: dict[str, Any]) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="panelwright-"))
        self.address = {"recording": str(self._folder / "scene.db3")}
        o = validate(options, FaultOptions, source="far side")
        write_recording(self._folder / "scene.db3", FaultPlan(o), pause_s=o.silent_s)

    def close(self) -> None:
        """Remove the recording."""
        shutil.rmtree(self._folder, ignore_errors=True)


def write_recording(path: Path, plan: FaultPlan, *, pause_s: float) -> None:
    """Let librealsense record depth and colour of a software device."""
    rs, rest, late_s = library(), threading.Event(), 0.0
    camera, queue = rs.software_device(), rs.frame_queue(100)
    depth, colour = camera.add_sensor("Stereo Module"), camera.add_sensor("RGB Camera")
    of_depth = depth.add_video_stream(_stream(rs, rs.stream.depth, rs.format.z16, 2))
    of_colour = colour.add_video_stream(_stream(rs, rs.stream.color, rs.format.rgb8, 3))
    depth.add_read_only_option(rs.option.depth_units, 0.001)
    recorder = rs.recorder(str(path), camera)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    for number in range(1, FRAMES + 1):
        fault = plan.next()
        if fault is WireFault.SILENT:
            late_s += pause_s
            rest.wait(pause_s)
        stamp_s = 5.0 + PERIOD_S * number + late_s
        for _ in range({WireFault.DROP: 0, WireFault.DUP: 2}.get(fault or WireFault.ECHO, 1)):
            counts = np.full(SHAPE, FIRST_MM + number, np.uint16)
            red = np.full((*SHAPE, 3), (number, 90, 20), np.uint8)
            depth.on_video_frame(_frame(rs, counts, number, stamp_s, of_depth))
            colour.on_video_frame(_frame(rs, red, number, stamp_s, of_colour))
        rest.wait(PERIOD_S)
    for sensor in sensors:
        sensor.stop()
        sensor.close()


def _stream(rs: Any, stream: Any, form: Any, bpp: int) -> Any:
    lens, video = rs.intrinsics(), rs.video_stream()
    lens.height, lens.width = SHAPE
    lens.ppx, lens.ppy, lens.fx, lens.fy = 31.0, 24.0, 60.0, 61.0
    lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
    video.type, video.index, video.uid, video.fps, video.bpp, video.fmt = stream, 0, bpp, 30, bpp, form
    video.height, video.width = SHAPE
    video.intrinsics = lens
    return video


def _frame(rs: Any, pixels: NDArray[Any], number: int, stamp_s: float, profile: Any) -> Any:
    frame = rs.software_video_frame()
    frame.pixels, frame.stride, frame.bpp = pixels, pixels.strides[0], pixels.strides[1]
    frame.timestamp, frame.domain = 1e3 * stamp_s, rs.timestamp_domain.hardware_clock
    frame.frame_number, frame.profile, frame.depth_units = number, profile.as_video_stream_profile(), 0.001
    return frame


def _is_depth(value: RangeImage, _: None) -> bool:
    counts = np.round(value.depth_m * 1000.0)
    return bool(np.all(counts == counts[0, 0]) and FIRST_MM < counts[0, 0] <= FIRST_MM + FRAMES)


def _is_colour(value: Image, _: None) -> bool:
    first = value.pixels[0, 0]
    return bool(np.all(value.pixels == first) and 0 < first[0] <= FRAMES and first[1:].tolist() == [90, 20])


def _is_picture(value: Image, backing: NumberedPictures) -> bool:
    return backing.is_true(value)


def _taken_s(value: Image, backing: NumberedPictures) -> float:
    """Return when the exposure may have begun at the earliest, which is what the driver dates: a period before the capture."""
    return backing.taken_s(value) - 1.0 / RATE_HZ


LOCAL_BENCHES = (
    *(
        Bench(
            name=f"v4l2 {word}, scripted grabber",
            start=ScriptedGrabbers,
            backing=NumberedPictures,
            driver="v4l2:camera",
            is_true=_is_picture,
            taken_s=_taken_s,
            stamps="taken",
            far_options={"has_stamps": has_stamps},
            faults=WITHOUT_WIRE,
            make=v4l2_of,
        )
        for word, has_stamps in (("by stamps", True), ("by arrival", False))
    ),
    *(
        Bench(
            name=f"realsense {word}, recording",
            start=Recording,
            backing=lambda: None,
            driver=driver,
            is_true=is_true,
            faults=OF_RECORDINGS,
            stamps=None,
            is_plugged=False,
        )
        for word, driver, is_true in (
            ("depth", "realsense:depth", _is_depth),
            ("colour", "realsense:camera", _is_colour),
        )
    ),
)
