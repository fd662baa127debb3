"""`sim:gripper`: the simulated parallel gripper."""

from __future__ import annotations

import math
from typing import Any

from hal.clock import Deadline
from hal.devices import DeviceKind, GripperCapabilities, GripperState
from hal.errors import InvalidRequest
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes
from simbackend.client import Frame
from simbackend.device import VALID, SimDevice, SimOptions, parse
from simbackend.tool_model import MAX_FORCE_N, MAX_SPEED_M_PER_S, MAX_WIDTH_M

RESOLUTION_M = 1e-5


class SimGripper(SimDevice[GripperState]):
    """Parallel gripper with a self-locking screw; in a cell with one rigid finger it stays closed."""

    def __init__(self, context: Context, options: SimOptions) -> None:
        super().__init__(context, DeviceKind.GRIPPER, options)
        is_rigid = context.cell is not None and context.cell.file.hand.fingers == 1
        self._max_width_m = 0.0 if is_rigid else MAX_WIDTH_M

    def capabilities(self) -> GripperCapabilities:
        """Return the ranges of width, force and speed."""
        return GripperCapabilities(
            min_width_m=0.0, max_width_m=self._max_width_m, max_force_n=MAX_FORCE_N, max_speed_m_per_s=MAX_SPEED_M_PER_S
        )

    def read_state(self, *, deadline: Deadline) -> Stamped[GripperState]:
        """Return the newest width and grip."""
        return self._sample(deadline)

    def command(self, *, width_m: float, force_n: float, speed_m_per_s: float, deadline: Deadline) -> float:
        """Start a motion; return the width that was actually commanded.

        Raises:
            InvalidRequest: not finite, or force or speed not positive.
        """
        self._check(deadline)
        if (
            not all(math.isfinite(x) for x in (width_m, force_n, speed_m_per_s))
            or force_n <= 0.0
            or speed_m_per_s <= 0.0
        ):
            raise InvalidRequest(
                f"{self._name}: width, force and speed must be finite and positive",
                hint="check the skill",
                device=self._name,
            )
        width_m = min(max(width_m, 0.0), self._max_width_m)
        self._world.aim_gripper(width_m, min(force_n, MAX_FORCE_N), min(speed_m_per_s, MAX_SPEED_M_PER_S))
        return width_m

    def _measure(self, frame: Frame, bias: float) -> tuple[GripperState, Quality, Cause]:
        snapshot = frame.snapshot
        state = GripperState(
            width_m=round(snapshot.width_m / RESOLUTION_M) * RESOLUTION_M + bias,
            force_n=0.5 * float(snapshot.pad_force_n[0] + snapshot.pad_force_n[1]),
            is_moving=snapshot.is_gripper_moving,
            is_holding=snapshot.is_holding,
        )
        return state, *VALID


@takes(SimOptions)
def connect(context: Context, options: dict[str, Any]) -> SimGripper:
    """Entry point `sim:gripper`."""
    return SimGripper(context, parse(options, SimOptions, context))
