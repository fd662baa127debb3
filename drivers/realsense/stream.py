"""Opens one stream of a RealSense camera, or of a recording, and returns its frames; the options are set and read back."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.kinds.cameras import release_in_background
from drivers.transport.link import LinkLost, NoAnswer, now_s
from hal.calibration import CameraIntrinsics
from hal.camera_settings import CameraSettings
from hal.errors import ConfigError, DeviceUnavailable
from hal.wires import ResourceClaim, WireOptions

COARSE_EXPOSURE_TO = 10_000  # an option with a smaller range than this counts 100 us, else 1 us
POLITE_S = 1.0
BROWN = ("brown_conrady",)  # the model of `hal.camera_model`; the inverse one is left to the calibration


class RealsenseOptions(WireOptions):
    """Options of `realsense:depth` and `realsense:camera`; what is left out stays as it is set in the camera."""

    serial: Annotated[str | None, Field(description="serial number; may be left out if one camera is connected")] = None
    recording: Annotated[
        Path | None,
        Field(description="recording of librealsense (`.db3`, before 2.59 `.bag`), played instead of a camera"),
    ] = None
    repeat: Annotated[bool, Field(description="play the recording in a loop")] = True
    width_px: Annotated[Annotated[int, Field(ge=1, le=10_000)] | None, Field(description="width of the stream")] = None
    height_px: Annotated[Annotated[int, Field(ge=1, le=10_000)] | None, Field(description="height of the stream")] = (
        None
    )
    rate_hz: Annotated[
        Annotated[int, Field(ge=1, le=300)] | None, Field(description="frames per second, one that the camera offers")
    ] = None
    exposure_s: Annotated[
        Annotated[float, Field(gt=0, le=1)] | Literal["auto"] | None,
        Field(description="exposure time; `auto` lets the camera choose"),
    ] = None
    gain: Annotated[Annotated[float, Field(ge=0)] | None, Field(description="gain in the camera's own steps")] = None
    latency_s: Annotated[
        Annotated[float, Field(ge=0, le=1)] | None,
        Field(description="time from the exposure to the arrival; one period if left out"),
    ] = None
    features: Annotated[
        dict[str, float],
        Field(description="further options by their name in librealsense, such as `visual_preset` or `white_balance`"),
    ] = {}

    def claims(self) -> tuple[ResourceClaim, ...]:
        """Claim this stream of the camera; a recording belongs to nobody."""
        if self.recording is not None:
            return ()
        return (ResourceClaim(wire=f"realsense {self.serial or 'camera'} {self.stream_name()}"),)

    @abstractmethod
    def stream_name(self) -> str:
        """Return `depth` or `color`, librealsense's names of streams."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RealsenseFrame:
    """One frame; `number` and `device_s` are the camera's, `unit_m` is the depth of one count."""

    number: int
    device_s: float
    arrived_s: float
    data: NDArray[Any]
    exposure_s: float | None = None
    unit_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreamFacts:
    """What the camera says about its stream; `has_own_clock` is false for stamps of the host."""

    intrinsics: CameraIntrinsics
    is_rectified: bool
    rate_hz: float
    settings: CameraSettings
    serial: str


def library() -> Any:
    """Import librealsense's package.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return import_module("pyrealsense2")
    except ImportError as error:
        raise ConfigError(
            f"the package pyrealsense2, which speaks to RealSense cameras, does not import: {error}",
            hint="install it: `pip install 'panelwright[realsense]'`",
        ) from error


class RealsenseStream:
    """One running stream.

    Raises:
        ConfigError: the camera has not what the options ask for. DeviceUnavailable: there is no such camera.
    """

    def __init__(self, options: RealsenseOptions, device: str) -> None:
        self._rs = library()
        self._name = options.stream_name()
        self._pipeline = self._rs.pipeline()
        wanted = self._wanted(options, device)
        try:
            self._profile = self._pipeline.start(wanted)
        except RuntimeError as error:
            raise DeviceUnavailable(
                f"{device}: the {self._name} stream cannot be started: {error}",
                hint="another program may use the camera, or it does not offer this size and rate: see "
                "`rs-enumerate-devices`",
                device=device,
            ) from error
        try:
            self._device = self._profile.get_device()
            if options.recording is None:
                self._write(options, device)
            self.facts = self._read_back(options)
        except BaseException:
            self.close()
            raise

    def wait(self, timeout_s: float) -> RealsenseFrame | None:
        """Return the next frame, or None when none comes in time."""
        is_new, frames = self._pipeline.try_wait_for_frames(max(1, round(1e3 * timeout_s)))
        if not is_new:
            return None
        frame = frames.get_depth_frame() if self._name == "depth" else frames.get_color_frame()
        arrived_s = now_s()
        if not frame:
            return None
        told = self._rs.frame_metadata_value.actual_exposure
        return RealsenseFrame(
            number=int(frame.get_frame_number()),
            device_s=1e-3 * float(frame.get_timestamp()),
            arrived_s=arrived_s,
            data=np.array(frame.get_data()),
            exposure_s=1e-6 * frame.get_frame_metadata(told) if frame.supports_frame_metadata(told) else None,
            unit_m=float(frame.get_units()) if self._name == "depth" else 0.0,
        )

    def set_exposure(self, exposure_s: float) -> None:
        """Set the exposure of the frames to come, and read back what the camera has taken."""
        sensor, exposure = self._sensor(), self._rs.option.exposure
        unit_s = self._exposure_unit_s(sensor)
        try:
            sensor.set_option(exposure, exposure_s / unit_s)
            taken_s = sensor.get_option(exposure) * unit_s
        except RuntimeError as error:
            raise NoAnswer(f"the camera does not take an exposure of {exposure_s:g} s: {error}") from error
        self.facts = replace(self.facts, settings=replace(self.facts.settings, exposure_s=taken_s))

    def check(self) -> None:
        """Check that the camera is still connected.

        Raises:
            LinkLost: it is not.
        """
        if not self._device.is_connected():
            raise LinkLost("the camera was unplugged")

    def close(self) -> None:
        """Stop the stream; the library may hang when the camera was unplugged, so this waits a second at most."""
        release_in_background(self._pipeline.stop, POLITE_S)

    def _wanted(self, options: RealsenseOptions, device: str) -> Any:
        wanted = self._rs.config()
        if options.recording is not None:
            if not options.recording.exists():
                raise DeviceUnavailable(
                    f"{device}: {options.recording} does not exist",
                    hint="give a recording of librealsense",
                    device=device,
                )
            wanted.enable_device_from_file(str(options.recording), repeat_playback=options.repeat)
        else:
            wanted.enable_device(self._serial(options, device))
        stream = getattr(self._rs.stream, self._name)
        form = self._rs.format.z16 if self._name == "depth" else self._rs.format.rgb8
        size = (options.width_px or 0, options.height_px or 0)
        wanted.enable_stream(stream, -1, *size, form, options.rate_hz or 0)
        return wanted

    def _serial(self, options: RealsenseOptions, device: str) -> str:
        """Return the serial number of the camera; the library itself waits 15 s for one that is not there."""
        number = self._rs.camera_info.serial_number
        found = [camera.get_info(number) for camera in self._rs.context().query_devices()]
        wanted = [serial for serial in found if options.serial in (None, serial)]
        if len(wanted) == 1:
            return str(wanted[0])
        if wanted:
            raise ConfigError(
                f"{device}: {len(wanted)} RealSense cameras are connected",
                hint=f"set devices.{device}.options.serial to one of {', '.join(wanted)}",
            )
        which = f"with serial number {options.serial} " if options.serial else ""
        there = ", ".join(found) or "none"
        raise DeviceUnavailable(
            f"{device}: no RealSense camera {which}is connected",
            hint=f"plug it into a USB 3 port; connected: {there}",
            device=device,
        )

    def _sensor(self) -> Any:
        for sensor in self._device.query_sensors():
            if any(p.stream_type() == getattr(self._rs.stream, self._name) for p in sensor.get_stream_profiles()):
                return sensor
        raise LinkLost(f"the camera has no {self._name} sensor any more")

    def _write(self, options: RealsenseOptions, device: str) -> None:
        sensor, values = self._sensor(), dict[str, float]()
        if sensor.supports(self._rs.option.global_time_enabled):
            values["global_time_enabled"] = 0.0  # the camera's own clock, which is compared with the host's here
        if options.exposure_s is not None:
            values["enable_auto_exposure"] = float(options.exposure_s == "auto")
        if isinstance(options.exposure_s, float):
            values["exposure"] = options.exposure_s / self._exposure_unit_s(sensor)
        if options.gain is not None:
            values["gain"] = options.gain
        for name, value in {**values, **self.projector(options), **options.features}.items():
            option = getattr(self._rs.option, name, None)
            if option is None or not sensor.supports(option):
                raise ConfigError(
                    f"{device}: the {self._name} sensor has no option {name!r}",
                    hint=f"it has: {', '.join(str(o).split('.')[-1] for o in sensor.get_supported_options())}",
                )
            try:
                sensor.set_option(option, value)
            except RuntimeError as error:
                there = sensor.get_option_range(option)
                raise ConfigError(
                    f"{device}: the camera refuses {name} = {value:g}: {error}",
                    hint=f"give a value from {there.min:g} to {there.max:g} in steps of {there.step:g}",
                ) from error

    @staticmethod
    def projector(options: RealsenseOptions) -> dict[str, float]:
        """Return the values of the options of the pattern projector, which only the depth has."""
        emitter, power_mw = getattr(options, "emitter", None), getattr(options, "laser_power_mw", None)
        values = {} if emitter is None else {"emitter_enabled": float(emitter)}
        return values if power_mw is None else {**values, "laser_power": float(power_mw)}

    def _exposure_unit_s(self, sensor: Any) -> float:
        return 1e-4 if sensor.get_option_range(self._rs.option.exposure).max <= COARSE_EXPOSURE_TO else 1e-6

    def _exposure_range_s(self, options: RealsenseOptions, sensor: Any) -> tuple[float, float] | None:
        """Return the exposures that can be set; None if the camera may choose, or is a recording."""
        if not isinstance(options.exposure_s, float) or options.recording is not None:
            return None
        unit_s, limits = self._exposure_unit_s(sensor), sensor.get_option_range(self._rs.option.exposure)
        return limits.min * unit_s, limits.max * unit_s

    def _read_back(self, options: RealsenseOptions) -> StreamFacts:
        profile = self._profile.get_stream(getattr(self._rs.stream, self._name)).as_video_stream_profile()
        lens, sensor, rs = profile.get_intrinsics(), self._sensor(), self._rs
        rate_hz = float(profile.fps())
        exposure = rs.option.exposure
        info = rs.camera_info.serial_number
        settings = CameraSettings(
            pixel_format=str(profile.format()).rsplit(".", maxsplit=1)[-1].upper(),
            exposure_s=sensor.get_option(exposure) * self._exposure_unit_s(sensor)
            if sensor.supports(exposure)
            else None,
            gain_db=sensor.get_option(rs.option.gain) if sensor.supports(rs.option.gain) else None,
            latency_s=1.0 / rate_hz if options.latency_s is None else options.latency_s,
            stamped_by="device",
            exposure_range_s=self._exposure_range_s(options, sensor),
        )
        is_brown = str(lens.model).rsplit(".", maxsplit=1)[-1] in BROWN
        k1, k2, p1, p2, k3 = lens.coeffs if is_brown else (0.0,) * 5
        return StreamFacts(
            intrinsics=CameraIntrinsics(
                width_px=lens.width,
                height_px=lens.height,
                fx_px=lens.fx,
                fy_px=lens.fy,
                cx_px=lens.ppx,
                cy_px=lens.ppy,
                distortion=(k1, k2, p1, p2, k3),
            ),
            is_rectified=not any(lens.coeffs),
            rate_hz=rate_hz,
            settings=settings,
            serial=self._device.get_info(info) if self._device.supports(info) else "",
        )
