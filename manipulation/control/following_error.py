"""Checks the arm's reported position, because a wrong one would make the arm jump with the next set-point."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from manipulation.arm import kernels as arm_kernels
from manipulation.arm.kinematics import Kinematics
from manipulation.control.drives import Drives
from manipulation.control.sensing import refuse
from manipulation.control.setpoint import SetPointLimiter
from manipulation.plausibility.arm import does_not_follow


class FollowingErrorMonitor:
    """Compares the position that an arm reports with the position of its drives, before anything moves.

    Args:
        arm: its name in the cell file.
        flange_from_grip: (4, 4) pose of the finger tips, where a difference of joints is measured in metres.
    """

    def __init__(self, arm: str, kinematics: Kinematics, flange_from_grip: Array, drives: Drives) -> None:
        self._arm = arm
        self._kinematics = kinematics
        self._grip = flange_from_grip
        self._drives = drives
        self._is_doubted = False  # from a failure until the arm accepts a set-point at its reported position

    def check_held(self, measured_rad: Array, held: SetPointLimiter) -> None:
        """Refuse to begin if the arm reports a position far from that of its drives, because it would jump.

        Args:
            measured_rad: (n,) joints that the arm reports.
            held: the limiter that keeps the last set-point sent.

        Raises:
            DeviceFailure: the drives are on, and the arm reports a position far from where they hold it.
        """
        if self._drives.are_on:
            self._check_near(measured_rad, held.last_rad, "{} away from its last set-point")

    def resume(self, measured_rad: Array, filter_: SetPointLimiter) -> None:
        """Switch the drives on, with the set-point where the arm reports that it is.

        Raises:
            DeviceFailure: the drives refuse, or after a failure the arm accepts a set-point far from its reported
                position.
        """
        filter_.begin_at(measured_rad)
        self._drives.switch_on()
        if self._is_doubted:
            taken_rad = self._drives.send(filter_.last_rad)
            self._check_near(measured_rad, taken_rad, "it reports a position that is {} away from that of its drives")
            self._is_doubted = False

    def give_up(self, failed: str | None) -> None:
        """Switch the drives off if it was the arm that failed, so that its brake holds it.

        Its reported position is not trusted, so no set-point is known to be where the arm is.
        """
        if failed == self._arm:
            self._is_doubted = True
            self._drives.switch_off()

    def _check_near(self, measured_rad: Array, other_rad: Array, how: str) -> None:
        tips = [(arm_kernels.frames(self._kinematics.dh, q)[-1] @ self._grip)[:3, 3] for q in (measured_rad, other_rad)]
        apart_m = float(np.linalg.norm(tips[0] - tips[1]))
        refuse(does_not_follow(self._arm, apart_m, how))
