"""`sim:camera`: a camera on the flange; images are rendered on request at the present tick."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from hal.calibration import CameraIntrinsics
from hal.camera_settings import CameraSettings
from hal.clock import Deadline
from hal.devices import CameraCapabilities, DeviceKind, Image
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes
from simbackend.camera_sensor import CameraSensor, SensorOptions
from simbackend.client import CameraView, Frame, true_mount
from simbackend.device import VALID, SimDevice, SimOptions, parse

NEAR_M = 0.02
RATE_HZ = 20.0
EXPOSURE_RANGE_S = (1e-4, 0.2)
FOCAL_RATIO = 460.0 / 640.0  # lens of the data sheet: 70 degrees across


class CameraOptions(SimOptions):
    """Image size and what corrupts the image; see `SensorOptions`."""

    width_px: Annotated[int, Field(ge=64, le=1600, description="width of the image")] = 640
    height_px: Annotated[int, Field(ge=64, le=1200, description="height of the image")] = 480
    colour: Annotated[bool, Field(description="whether the images are RGB; else they are grey")] = False
    exposure_s: Annotated[float, Field(gt=0, le=1, description="exposure time; radiance 1 at 10 ms is full scale")] = (
        0.010
    )
    oversample: Annotated[
        float, Field(ge=1, le=3, description="rendered pixels per pixel of the image, along each axis")
    ] = 2.0
    blur_px: Annotated[float, Field(ge=0, le=10, description="blur of the lens, one sigma")] = 0.6
    vignette: Annotated[float, Field(ge=0, le=1, description="loss of light towards the corners; 0 for none")] = 0.6
    full_well_electrons: Annotated[
        float, Field(gt=0, description="electrons at full scale, which set the shot noise")
    ] = 10_000.0
    read_noise_electrons: Annotated[float, Field(ge=0, description="noise of reading one pixel, one sigma")] = 20.0


class SimCamera(SimDevice[Image]):
    """Global-shutter camera; its true lens and mount are drawn from the seed around the calibration record."""

    def __init__(self, context: Context, options: CameraOptions) -> None:
        super().__init__(context, DeviceKind.CAMERA, options)
        self._options = options
        self._nominal = nominal_lens(options.width_px, options.height_px)
        world = self._world
        record = world.cell.calibration_of(context.name).intrinsics
        recorded = self._nominal if record is None else scaled(record.intrinsics(), options.width_px, options.height_px)
        sensor_options = SensorOptions(
            oversample=options.oversample,
            blur_px=options.blur_px,
            vignette=options.vignette,
            full_well_electrons=options.full_well_electrons,
            read_noise_electrons=options.read_noise_electrons,
            is_colour=options.colour,
        )
        self._sensor = CameraSensor(world.draws.lens(context.name, recorded), sensor_options)
        width, height = self._sensor.drawn
        self._view = CameraView(
            flange_from_camera=true_mount(world.cell, world.draws, context.name),
            width=width,
            height=height,
            focal=self._sensor.focal,
            centre=self._sensor.centre,
            near_m=NEAR_M,
        )
        self._exposure_s = options.exposure_s
        self._newest: tuple[int, float, Image] | None = None

    def capabilities(self) -> CameraCapabilities:
        """Return size, colour, nominal lens and exposure."""
        return CameraCapabilities(
            width_px=self._options.width_px,
            height_px=self._options.height_px,
            is_colour=self._options.colour,
            rate_hz=RATE_HZ,
            nominal=self._nominal,
            settings=CameraSettings(exposure_s=self._exposure_s, exposure_range_s=EXPOSURE_RANGE_S),
        )

    def read_image(self, *, deadline: Deadline) -> Stamped[Image]:
        """Return the image of the present tick; rendering it does not advance time."""
        return self._sample(deadline)

    def set_exposure(self, exposure_s: float, *, deadline: Deadline) -> None:
        """Set the exposure of the images that are read from now on."""
        self._check(deadline)
        self.capabilities().settings.check_exposure(exposure_s, self._name)
        self._exposure_s = exposure_s
        self._newest = None

    def _measure(self, frame: Frame, bias: float) -> tuple[Image, Quality, Cause]:
        newest = self._newest
        if newest is None or newest[:2] != (frame.snapshot.tick, bias):
            newest = self._newest = (frame.snapshot.tick, bias, self._draw(bias))
        return newest[2], *VALID

    def _draw(self, bias: float) -> Image:
        info, radiance = self._world.radiance(self._view, is_colour=self._options.colour)
        random = self._world.draws.at_tick(self._name, info.tick)
        pixels = self._sensor.expose(info, radiance, self._exposure_s, random)
        if bias:
            pixels = np.clip(pixels.astype(float) + bias, 0, 255).astype(np.uint8)  # an offset in grey levels
        return Image(pixels=pixels, exposure_s=self._exposure_s)


def nominal_lens(width_px: int, height_px: int) -> CameraIntrinsics:
    """Return the lens of the data sheet: no distortion, axis through the centre."""
    focal_px = FOCAL_RATIO * width_px
    return CameraIntrinsics(
        width_px=width_px,
        height_px=height_px,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=(width_px - 1) / 2,
        cy_px=(height_px - 1) / 2,
    )


def scaled(lens: CameraIntrinsics, width_px: int, height_px: int) -> CameraIntrinsics:
    """Return the same lens with another pixel count."""
    sx, sy = width_px / lens.width_px, height_px / lens.height_px
    return CameraIntrinsics(
        width_px=width_px,
        height_px=height_px,
        fx_px=lens.fx_px * sx,
        fy_px=lens.fy_px * sy,
        cx_px=(lens.cx_px + 0.5) * sx - 0.5,
        cy_px=(lens.cy_px + 0.5) * sy - 0.5,
        distortion=lens.distortion,
    )


@takes(CameraOptions)
def connect(context: Context, options: dict[str, Any]) -> SimCamera:
    """Entry point `sim:camera`."""
    return SimCamera(context, parse(options, CameraOptions, context))
