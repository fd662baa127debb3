"""Devices that answer, and answer wrongly: what they say is compared with what was asked of the cell and felt.

Each doubt needs two witnesses, and tells only what no healthy device could say; the rest is believed.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.devices import ForceTorque, Touch
from hal.motion import DeclaredMotion, GripperMotion
from manipulation.control.sensing import DeviceFailure, Sample

FROZEN_S, FROZEN_TICKS, FROZEN_PERIODS = 0.1, 10, 4  # 6 N more in a touch; noise has never repeated so long
WIDTH_OFF_M = 0.003  # pads that rest and hold nothing are nearer than this to where they were sent
FELT_N = 8.0  # twice what the hand's own inertia makes of a transfer, and far above what closes a switch
NEAR_TIPS_M = 0.03  # lever arm of a force about the tips: what pushes further up is not for the fingers to feel
UNFELT_S = 0.05
QUIET_S = 20.0  # after it was told: the hand must be able to leave what it pushes on
FREE_N = 5.0
FREE_WAY_M = 0.15  # longer than any retreat: a finger that leaves something behind has left it by then


class FrozenWrench:
    """Tells a force/torque sensor that repeats one reading under new stamps: no guard would ever see a contact.

    A sensor that states no noise is believed: it may well repeat itself.
    """

    def __init__(self, sensor: ForceTorque | None) -> None:
        self._name = "" if sensor is None else sensor.name
        capabilities = None if sensor is None else sensor.capabilities()
        self._is_noisy = capabilities is not None and capabilities.force_sigma_n > 0.0
        period_s = 0.0 if capabilities is None else 1.0 / capabilities.rate_hz
        self._longest_s = max(FROZEN_S, FROZEN_PERIODS * period_s)
        self._kept = b""
        self._since_s = 0.0
        self._ticks = 0

    def check(self, sample: Sample) -> None:
        """Note the newest sample.

        Raises:
            DeviceFailure: all six numbers have been the same for too long.
        """
        if not self._is_noisy:
            return
        newest = sample.raw_wrench.tobytes()
        if newest != self._kept:
            self._kept, self._since_s, self._ticks = newest, sample.stamp_s, 0
            return
        self._ticks += 1
        lasted_s = sample.stamp_s - self._since_s
        if lasted_s >= self._longest_s and self._ticks >= FROZEN_TICKS:
            raise DeviceFailure(
                self._name, f"{self._name} repeats the same reading under new stamps for {lasted_s:.2f} s"
            )


def check_width(gripper: str, sent_m: float, begun_m: float, sample: Sample) -> None:
    """The pads were sent to a width and rest now: is that where the gripper says that they are?

    Args:
        sent_m: the width that the gripper took.
        begun_m: what it said before.

    Raises:
        DeviceFailure: pads that hold nothing say that they stand elsewhere, or open ones that they did not move.
    """
    width_m = sample.gripper_width_m
    is_off = abs(width_m - sent_m) > WIDTH_OFF_M
    is_still = abs(width_m - begun_m) <= 0.5 * WIDTH_OFF_M
    is_settled = not sample.gripper_is_moving and not sample.gripper_is_holding
    if is_off and (is_settled or (is_still and sent_m > begun_m)):
        raise DeviceFailure(
            gripper,
            f"{gripper} was sent to {1e3 * sent_m:.1f} mm and says {1e3 * width_m:.1f} mm, before that"
            f" {1e3 * begun_m:.1f}, with nothing held: its reading is frozen or wrong, or the pads are blocked."
            " ToolReading at the pads, then switch the gripper off and on",
        )


class DoubtedTouch:
    """Tells fingers that feel nothing while the wrist does, and such that feel something where there is nothing.

    A force counts only if it acts near the tips; a free hand is one that has opened and travels with an idle wrist.
    """

    def __init__(self, sensor: Touch | None, force_torque: ForceTorque | None) -> None:
        self._name = "" if sensor is None else sensor.name
        self._is_watched = sensor is not None and force_torque is not None
        self._force_n = FELT_N
        if sensor is not None:
            self._force_n = max(FELT_N, 4.0 * sensor.capabilities().threshold_n)
        self._is_empty = False  # the pads have opened since they last closed
        self._unfelt_s = 0.0
        self._before_s: float | None = None
        self._free_from_m: Array | None = None
        self._quiet_until_s = float("-inf")

    def pads_moved(self, begun_m: float, sample: Sample) -> None:
        """Note the end of a motion of the pads."""
        self._is_empty = sample.gripper_width_m > begun_m + WIDTH_OFF_M and not sample.gripper_is_holding

    def begin(self, motion: DeclaredMotion) -> None:
        """Note that a motion begins: its tips may be others than those of the one before."""
        self._before_s = None
        self._free_from_m = None
        if isinstance(motion, GripperMotion):
            self._is_empty = False

    def check(self, sample: Sample, wrench: Array, tip_m: Array) -> None:
        """Note one tick: the contact wrench (6,) in tool axes about the tips, and where they are (3,), m.

        Raises:
            DeviceFailure: the fingers contradict the wrist; told once, then not for a while.
        """
        if not self._is_watched or sample.stamp_s < self._quiet_until_s:
            return
        lasted_s = 0.0 if self._before_s is None else sample.stamp_s - self._before_s
        self._before_s = sample.stamp_s
        force_n, turn_nm = float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
        if any(sample.contacts):
            self._unfelt_s = 0.0
        elif force_n >= self._force_n and turn_nm <= NEAR_TIPS_M * force_n:
            self._unfelt_s += lasted_s
            if self._unfelt_s >= UNFELT_S:
                self._fail(sample, f"feels nothing while {force_n:.0f} N push on the tips of the fingers")
        if not (self._is_empty and any(sample.contacts) and force_n < FREE_N):
            self._free_from_m = None
        elif self._free_from_m is None:
            self._free_from_m = tip_m.copy()
        elif float(np.linalg.norm(tip_m - self._free_from_m)) >= FREE_WAY_M:
            way = f"{1e3 * FREE_WAY_M:.0f} mm"
            self._fail(sample, f"says contact while the open hand goes {way} with nothing felt at the wrist")

    def _fail(self, sample: Sample, cause: str) -> None:
        self._unfelt_s, self._free_from_m = 0.0, None
        self._quiet_until_s = sample.stamp_s + QUIET_S
        raise DeviceFailure(
            self._name, f"{self._name} {cause}: it is frozen or off its zero. Press each finger by hand and watch it"
        )
