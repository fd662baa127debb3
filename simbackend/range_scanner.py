"""`sim:range_scanner`: a pinhole range image from the depth buffer, with the errors of a real scanner."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hal.clock import Deadline
from hal.devices import DeviceKind, RangeImage, RangeScannerCapabilities
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes
from simbackend.client import CameraView, Frame, true_mount
from simbackend.device import VALID, SimDevice, parse
from simbackend.line_scanner import SimLineScanner
from simbackend.range_sensor import MAX_RANGE_M, MIN_RANGE_M, RangeOptions, corrupt

RATE_HZ = 5.0


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
        """Return geometry and limits."""
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
        """Return the range image of the present tick."""
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


@takes(RangeOptions)
def connect(context: Context, options: dict[str, Any]) -> SimRangeScanner | SimLineScanner:
    """Entry point `sim:range_scanner`: a range camera or, with `model = "polar"`, a line scanner."""
    parsed = parse(options, RangeOptions, context)
    return SimLineScanner(context, parsed) if parsed.model == "polar" else SimRangeScanner(context, parsed)
