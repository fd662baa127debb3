"""Code shared by cameras: a nominal lens, and conversion of OpenCV pictures to the pixels of an `Image`."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hal.calibration import CameraIntrinsics
from hal.strict import Strict

Pixels = NDArray[np.uint8]


class LensOptions(Strict):
    """Nominal lens of a camera that does not know its own; the calibration record has the true one."""

    fx_px: Annotated[
        Annotated[float, Field(gt=0)] | None,
        Field(
            description="focal length along the rows until the camera is calibrated; the width of the image if not given"
        ),
    ] = None
    fy_px: Annotated[
        Annotated[float, Field(gt=0)] | None, Field(description="focal length along the columns; `fx_px` if not given")
    ] = None


def nominal(width_px: int, height_px: int, lens: LensOptions) -> CameraIntrinsics:
    """Return the lens of the options, or a centred one with a 53 degree horizontal field of view."""
    fx_px = lens.fx_px or float(width_px)
    return CameraIntrinsics(
        width_px=width_px,
        height_px=height_px,
        fx_px=fx_px,
        fy_px=lens.fy_px or fx_px,
        cx_px=(width_px - 1) / 2.0,
        cy_px=(height_px - 1) / 2.0,
    )


def to_pixels(bgr: NDArray[Any], *, is_colour: bool) -> Pixels:
    """Return OpenCV's picture as RGB or grey bytes."""
    if bgr.ndim == 2:
        bgr = cv2.cvtColor(bgr, cv2.COLOR_GRAY2BGR)
    code = cv2.COLOR_BGR2RGB if is_colour else cv2.COLOR_BGR2GRAY
    return np.ascontiguousarray(cv2.cvtColor(bgr, code), dtype=np.uint8)


def release_in_background(work: Callable[[], object], wait_s: float) -> None:
    """Run the release of a camera, and wait for it for `wait_s` at most: a library may hang when its camera is gone."""

    def run() -> None:
        with contextlib.suppress(Exception):  # a camera that is gone cannot be stopped
            work()

    thread = threading.Thread(target=run, name="release camera", daemon=True)
    thread.start()
    thread.join(wait_s)
