"""Settings that a camera has really taken, as its driver reads them back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSettings:
    """Settings of a connected camera; None where the camera has no such setting or does not tell it.

    Attributes:
        pixel_format: how the camera sends pixels, such as `BayerRG8` or `MJPG`.
        trigger: `free-run`, or `software` when each read starts an exposure.
        gain_db: amplification in decibels, or in the camera's own unit where it states no other.
        white_balance: amplification of red and of blue relative to green; None also while the camera adjusts it.
        latency_s: time from the exposure to the arrival that no stamp of the device reveals, and that is subtracted.
        stamped_by: `device` when frames carry the camera's own time, else `arrival`.
    """

    pixel_format: str = ""
    trigger: Literal["free-run", "software"] = "free-run"
    exposure_s: float | None = None
    gain_db: float | None = None
    white_balance: tuple[float, float] | None = None
    latency_s: float = 0.0
    stamped_by: Literal["device", "arrival"] = "arrival"


UNKNOWN = CameraSettings()
