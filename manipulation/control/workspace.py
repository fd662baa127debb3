"""Keeps the tool's tip inside the boxes of the cell file, whatever a motion asks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hal.arrays import Array
from hal.config import BoxSection
from manipulation.arm.kernels import frames
from manipulation.arm.kinematics import Kinematics
from manipulation.control.sensing import DeviceFailure

SLACK_M = 1e-6


class Workspace:
    """The places where the tip may be: inside any of the boxes, and everywhere without boxes.

    Args:
        boxes: in the base frame.
        flange_from_tool: (4, 4) of the tool whose tip is kept inside.
        dt_s: time between two set-points.
    """

    def __init__(
        self, boxes: Sequence[BoxSection], kinematics: Kinematics, flange_from_tool: Array, dt_s: float
    ) -> None:
        self._boxes = [(np.array(box.lower_m), np.array(box.upper_m)) for box in boxes]
        self._kinematics = kinematics
        self._tool = flange_from_tool
        self._most = kinematics.acceleration_rad_per_s2 * dt_s * dt_s

    def outside_m(self, tip_m: Array) -> float:
        """Return how far a place (3,), m, in the base frame is from the nearest box; zero inside of one."""
        if not self._boxes:
            return 0.0
        ways = (np.maximum(np.maximum(lower - tip_m, tip_m - upper), 0.0) for lower, upper in self._boxes)
        return min(float(np.linalg.norm(way)) for way in ways)

    def tip_m(self, joints_rad: Array) -> Array:
        """Return the place (3,) of the tip in the base frame, m."""
        tip: Array = (frames(self._kinematics.dh, joints_rad)[-1] @ self._tool)[:3, 3]
        return tip

    def check(self, last_rad: Array, next_rad: Array) -> None:
        """Refuse a set-point after which the arm could not come to rest inside.

        An arm that stands outside may move, as long as that brings it nearer.

        Raises:
            DeviceFailure: the tip would leave the workspace.
        """
        if not self._boxes:
            return
        step = next_rad - last_rad
        ticks = np.floor(np.abs(step) / self._most)
        braking = np.sign(step) * (ticks * np.abs(step) - 0.5 * ticks * (ticks + 1.0) * self._most)
        left_m = self.outside_m(self.tip_m(next_rad + braking))
        if left_m > self.outside_m(self.tip_m(last_rad)) + SLACK_M:
            raise DeviceFailure("controller", f"the tip would leave the workspace by {1e3 * left_m:.0f} mm")
