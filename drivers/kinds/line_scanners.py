"""Code shared by line scanners: one row of beams in a plane, as a range image one pixel high, recorded during a sweep."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from drivers.transport.stream import StreamDevice
from hal.arrays import Array
from hal.clock import Deadline
from hal.devices import DeviceKind, RangeImage, RangeScannerCapabilities
from hal.errors import DeviceUnavailable
from hal.readings import Cause, Quality, Stamped

Bias = Annotated[
    float,
    Field(
        ge=0, description="error that all distances have in common, one sigma: the systematic error in the data sheet"
    ),
]
MOST_KEPT = 4000  # scans kept per sweep: 50 s of the fastest scanner


@dataclass(frozen=True, slots=True, kw_only=True)
class Beams:
    """Geometry of a line scanner, as reported by the device."""

    count: int
    first_rad: float
    step_rad: float
    min_range_m: float
    max_range_m: float
    scan_s: float


class LineScanner(StreamDevice[RangeImage]):
    """Scanner that streams lines; the subclass parses them and sets `beams` during set-up."""

    kind = DeviceKind.RANGE_SCANNER
    beams: Beams | None = None
    sigma_m = 0.01
    bias_sigma_m = 0.0
    line_s = 0.0  # time that one scan takes on a slow line
    _kept: deque[Stamped[RangeImage]] | None = None

    def capabilities(self) -> RangeScannerCapabilities:
        """Return the geometry that the device reported at its last set-up.

        Raises:
            DeviceUnavailable: the device has not been set up yet.
        """
        b = self.beams
        if b is None:
            raise DeviceUnavailable(f"{self.name} is not set up yet", hint="wait until it connects", device=self.name)
        return RangeScannerCapabilities(
            projection="polar",
            width=b.count,
            height=1,
            fx=1.0 / b.step_rad,
            fy=1.0,
            cx=-b.first_rad / b.step_rad,
            cy=0.0,
            min_range_m=b.min_range_m,
            max_range_m=b.max_range_m,
            sigma_m=self.sigma_m,
            rate_hz=1.0 / max(b.scan_s, self.line_s),
            first_angle_rad=b.first_rad,
            step_angle_rad=b.step_rad,
            bias_sigma_m=self.bias_sigma_m,
        )

    def read_range(self, *, deadline: Deadline) -> Stamped[RangeImage]:
        """Return a scan that began after this call, so it ends at least one turn later."""
        scan_s = self.beams.scan_s if self.beams is not None else 0.0
        return self.newest(deadline, not_before_s=self.context.clock.now_s() + scan_s)

    def start_recording(self, *, deadline: Deadline) -> None:
        """Keep every scan that ends from now on, at most the newest 4000."""
        self.newest(deadline)  # a silent scanner is reported before the arm moves
        self._kept = deque(maxlen=MOST_KEPT)

    def end_recording(self, *, deadline: Deadline) -> tuple[Stamped[RangeImage], ...]:
        """Return the scans since `start_recording`, oldest first.

        Raises:
            DeviceTimeout, DeviceUnavailable, DeviceFault: the scanner failed meanwhile.
        """
        self.newest(deadline)
        kept, self._kept = self._kept, None
        return tuple(kept or ())

    def publish_scan(
        self,
        range_m: Array,
        *,
        valid_s: float,
        device_time_s: float | None = None,
        missed: int = 0,
        quality: Quality = Quality.VALID,
        lacking_rad: float = 0.0,
    ) -> None:
        """Publish one scan, beam by beam, NaN where nothing was seen; `valid_s` is the time of its end.

        Args:
            quality: as reported by the device; a scan in which no beam saw anything is always invalid.
            lacking_rad: angle of which no measurement arrived; such a scan is degraded at best.
        """
        cause, detail = Cause.NONE if quality is Quality.VALID else Cause.DEVICE, ""
        if lacking_rad > 0.0:
            detail = f"{math.degrees(lacking_rad):.0f} degrees of the scan were lost on the link"
            quality, cause = (Quality.DEGRADED, Cause.COMM) if quality is Quality.VALID else (quality, cause)
        if not np.any(np.isfinite(range_m)) and quality is not Quality.INVALID:
            quality, cause = Quality.INVALID, Cause.OUT_OF_RANGE
        self.publish(
            RangeImage(depth_m=range_m.astype(np.float32)[np.newaxis, :]),
            valid_s=valid_s,
            device_time_s=device_time_s,
            quality=quality,
            cause=cause,
            detail=detail,
            missed=missed,
        )
        kept, newest = self._kept, self.mailbox.peek()
        if kept is not None and newest is not None:
            kept.append(newest)


def within(range_m: Array, beams: Beams) -> Array:
    """Return the ranges, with values outside the sensor's limits as NaN."""
    return np.where((range_m >= beams.min_range_m) & (range_m <= beams.max_range_m), range_m, math.nan)
