"""Errors of every simulated range scanner: options, noise, mixed and lost pixels."""

from __future__ import annotations

from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from simbackend.device import SimOptions

Depth = NDArray[np.float32]

MIN_RANGE_M, MAX_RANGE_M = 0.10, 1.50
JUMP_M = 0.008  # neighbours further apart than this share a beam


class RangeOptions(SimOptions):
    """Size, field of view and corruption.

    `model = "polar"` is a line scanner of `width` beams that turns `line_rate_hz` times per second, to be swept by the
    wrist. `sigma_m`: noise at 0.5 m, growing with the square of the distance. `bits` = 8 quantises the range from 0.10
    to 1.50 m to 256 steps as the paper's scanner did. `mixed_ratio` of the pixels at a jump report a depth between the
    two surfaces, and `loss_ratio` of all pixels have no value.
    """

    model: Annotated[
        Literal["pinhole", "polar"], Field(description="a range camera, or a line scanner that the wrist sweeps")
    ] = "pinhole"
    line_rate_hz: Annotated[float, Field(ge=1, le=100, description="lines per second of a line scanner")] = 25.0
    width: Annotated[int, Field(ge=16, le=512, description="columns of the image, or beams of a line")] = 128
    height: Annotated[int, Field(ge=16, le=512, description="rows of the image")] = 128
    field_of_view_rad: Annotated[float, Field(gt=0.1, lt=2.0, description="field of view along the rows")] = (
        0.96  # wider, and the finger tips come into view
    )
    sigma_m: Annotated[
        float,
        Field(
            ge=0,
            le=0.1,
            description="noise of one distance at 0.5 m, one sigma; it grows with the square of the distance",
        ),
    ] = 0.0006
    bits: Annotated[
        int, Field(ge=6, le=24, description="resolution of the range from 0.10 to 1.50 m; 8 as the paper's scanner")
    ] = 16
    mixed_ratio: Annotated[
        float,
        Field(ge=0, le=1, description="share of the pixels at a jump that report a depth between the two surfaces"),
    ] = 0.5
    loss_ratio: Annotated[float, Field(ge=0, le=1, description="share of all pixels that have no value")] = 0.003


def corrupt(depth_m: Depth, options: RangeOptions, random: np.random.Generator) -> Depth:
    """Return the depth with mixed pixels at jumps, noise, lost pixels, range limits and quantisation."""
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
