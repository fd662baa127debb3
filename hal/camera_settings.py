"""Settings that a camera has really taken, as its driver reads them back, and the one that may change while it runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from hal.clock import Deadline
from hal.errors import InvalidRequest, Unsupported


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
        exposure_range_s: the least and the longest time that `AdjustableExposure.set_exposure` takes; None where the
            exposure cannot be set, or the camera chooses it.
    """

    pixel_format: str = ""
    trigger: Literal["free-run", "software"] = "free-run"
    exposure_s: float | None = None
    gain_db: float | None = None
    white_balance: tuple[float, float] | None = None
    latency_s: float = 0.0
    stamped_by: Literal["device", "arrival"] = "arrival"
    exposure_range_s: tuple[float, float] | None = None

    def check_exposure(self, exposure_s: float, device: str) -> None:
        """Check that an exposure may be set.

        Raises:
            Unsupported: the exposure of this camera cannot be set. InvalidRequest: it is out of range.
        """
        if self.exposure_range_s is None:
            raise Unsupported(
                f"{device}: the exposure of this camera cannot be set",
                hint=f"give devices.{device}.options.exposure_s a number, so that the camera does not choose it",
            )
        least_s, longest_s = self.exposure_range_s
        if not least_s <= exposure_s <= longest_s:
            raise InvalidRequest(
                f"{device}: an exposure of {exposure_s:g} s is out of range",
                hint=f"give {least_s:g} to {longest_s:g} s",
            )


@runtime_checkable
class AdjustableExposure(Protocol):
    """Camera whose exposure can be set while it sends frames."""

    def set_exposure(self, exposure_s: float, *, deadline: Deadline) -> None:
        """Set the exposure of the frames that are read after this call; each of them states the one that the camera took.

        A camera that is connected again has the exposure of the cell file.

        Raises:
            Unsupported, InvalidRequest: see `CameraSettings.check_exposure`.
            DeviceTimeout: the camera did not take it in time.
        """
        ...


UNKNOWN = CameraSettings()
