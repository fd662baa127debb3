"""`sim:range_scanner`: a pinhole range image from the engine's depth buffer, with what a real scanner does to it."""

from __future__ import annotations

import math
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hal.clock import Deadline
from hal.devices import DeviceKind, RangeImage, RangeScannerCapabilities
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context
from simbackend.client import CameraView, Frame, true_mount
from simbackend.device import VALID, SimDevice, SimOptions, parse

Depth = NDArray[np.float32]

MIN_RANGE_M, MAX_RANGE_M = 0.10, 1.50
RATE_HZ = 5.0
JUMP_M = 0.008  # neighbours further apart than this share a beam


class RangeOptions(SimOptions):
    """Size, field of view and corruption.

    `sigma_m`: noise at 0.5 m, growing with the square of the distance. `bits` = 8 quantises the range from 0.10 to
    1.50 m to 256 steps as the paper's scanner did. `mixed_ratio` of the pixels at a jump report a depth between the
    two surfaces, and `loss_ratio` of all pixels see nothing.
    """

    width: Annotated[int, Field(ge=16, le=512)] = 128
    height: Annotated[int, Field(ge=16, le=512)] = 128
    field_of_view_rad: Annotated[float, Field(gt=0.1, lt=2.0)] = 0.96  # wider, and the finger tips come into view
    sigma_m: Annotated[float, Field(ge=0, le=0.1)] = 0.0006
    bits: Annotated[int, Field(ge=6, le=24)] = 16
    mixed_ratio: Annotated[float, Field(ge=0, le=1)] = 0.5
    loss_ratio: Annotated[float, Field(ge=0, le=1)] = 0.003


class SimRangeScanner(SimDevice[RangeImage]):
    """Range scanner on the flange."""

    def __init__(self, context: Context, options: RangeOptions) -> None:
        super().__init__(context, DeviceKind.RANGE_SCANNER, options)
        self._options = options
        focal = options.width / 2.0 / math.tan(options.field_of_view_rad / 2.0)
        self._view = CameraView(
            flange_from_camera=true_mount(self._world.cell, self._world.draws, context.name),
            width=options.width,
            height=options.height,
            focal=(focal, focal),
            centre=((options.width - 1) / 2.0, (options.height - 1) / 2.0),
            near_m=0.05,
        )
        self._newest: tuple[int, float, RangeImage] | None = None

    def capabilities(self) -> RangeScannerCapabilities:
        """Geometry and limits."""
        view = self._view
        return RangeScannerCapabilities(
            projection="pinhole",
            width=view.width,
            height=view.height,
            fx=view.focal[0],
            fy=view.focal[1],
            cx=view.centre[0],
            cy=view.centre[1],
            min_range_m=MIN_RANGE_M,
            max_range_m=MAX_RANGE_M,
            sigma_m=self._options.sigma_m,
            rate_hz=RATE_HZ,
        )

    def read_range(self, *, deadline: Deadline) -> Stamped[RangeImage]:
        """The range image of the present tick."""
        return self._sample(deadline)

    def _measure(self, frame: Frame, bias: float) -> tuple[RangeImage, Quality, Cause]:
        newest = self._newest
        if newest is None or newest[:2] != (frame.snapshot.tick, bias):
            info, depth_m = self._world.depth_m(self._view)
            random = self._world.draws.at_tick(self._name, info.tick)
            newest = self._newest = (
                info.tick,
                bias,
                RangeImage(depth_m=corrupt(depth_m + np.float32(bias), self._options, random)),
            )
        return newest[2], *VALID


def corrupt(depth_m: Depth, options: RangeOptions, random: np.random.Generator) -> Depth:
    """Mixed pixels at jumps, noise growing with the square of the distance, lost pixels, range limits, last digit."""
    seen = np.where(np.isfinite(depth_m), depth_m, np.float32(2.0 * MAX_RANGE_M))
    kernel = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(seen, kernel), cv2.dilate(seen, kernel)
    u = random.random((3, *depth_m.shape), np.float32)
    is_mixed = (far - near > JUMP_M) & (u[0] < options.mixed_ratio) & (far < MAX_RANGE_M)
    out = np.where(is_mixed, near + u[1] * (far - near), depth_m)
    sigma = np.float32(options.sigma_m) * (out / np.float32(0.5)) ** 2
    out = out + sigma * random.standard_normal(depth_m.shape, np.float32)
    out = np.where((u[2] < options.loss_ratio) | (out < MIN_RANGE_M) | (out > MAX_RANGE_M), np.float32(np.nan), out)
    step_m = np.float32((MAX_RANGE_M - MIN_RANGE_M) / (2**options.bits - 1))
    return (np.round((out - np.float32(MIN_RANGE_M)) / step_m) * step_m + np.float32(MIN_RANGE_M)).astype(np.float32)


def connect(context: Context, options: dict[str, Any]) -> SimRangeScanner:
    """Entry point `sim:range_scanner`."""
    return SimRangeScanner(context, parse(options, RangeOptions, context))
