"""Code shared by cameras: a nominal lens, pixels of an `Image` from OpenCV's pictures, and an exposure that is set later."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.transport.device import WireDevice, wall_until
from drivers.transport.link import now_s
from hal.calibration import CameraIntrinsics
from hal.camera_settings import CameraSettings
from hal.clock import Deadline
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


class ExposureSetter:
    """Passes an exposure from a caller to the owner thread of a camera, and returns when the camera has taken it."""

    def __init__(self) -> None:
        self._one_caller = threading.Lock()
        self._taken = threading.Event()
        self._wanted_s: float | None = None

    def set(self, device: WireDevice[Any], settings: CameraSettings, exposure_s: float, deadline: Deadline) -> None:
        """Have the owner thread set an exposure, and wait for it; errors as of `AdjustableExposure.set_exposure`."""
        device.require_open()
        settings.check_exposure(exposure_s, device.name)
        began_s = now_s()
        with self._one_caller:
            self._taken.clear()
            self._wanted_s = exposure_s
            if not self._taken.wait(wall_until(deadline) - began_s):
                self._wanted_s = None
                raise device.timeout(now_s() - began_s)

    def wanted_s(self) -> float | None:
        """Return the exposure that is asked for, which counts as seen; None if there is none (owner thread)."""
        wanted_s, self._wanted_s = self._wanted_s, None
        return wanted_s

    def confirm(self) -> None:
        """Let the caller go on, because the next frame has the exposure (owner thread)."""
        self._taken.set()


def release_in_background(work: Callable[[], object], wait_s: float) -> None:
    """Run the release of a camera, and wait for it for `wait_s` at most: a library may hang when its camera is gone."""

    def run() -> None:
        with contextlib.suppress(Exception):  # a camera that is gone cannot be stopped
            work()

    thread = threading.Thread(target=run, name="release camera", daemon=True)
    thread.start()
    thread.join(wait_s)
