"""Frames as they come from a GenICam camera, complete or not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STATUS = {
    0: "complete",
    2: "packets came too late",
    3: "packets are missing",
    4: "a packet has a wrong number",
    5: "the size is wrong",
    7: "it was cut off",
    8: "its payload type is unknown",
}
COMPLETE = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One frame as it came from the camera.

    Attributes:
        fault: why the frame cannot be used, or None.
        frame_id: number that the camera counts; 0 where it does not count.
        device_s: the camera's time stamp in seconds; None where it has no clock.
        arrived_s: when the first packet arrived, on the clock of `time.monotonic`.
        pixel_format: code of the GenICam Pixel Format Naming Convention.
    """

    fault: str | None
    frame_id: int
    device_s: float | None
    arrived_s: float
    width_px: int
    height_px: int
    pixel_format: int
    data: NDArray[np.uint8]
