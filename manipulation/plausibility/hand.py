"""Compares gripper and fingers with their commands and with the force at the wrist.

A finding needs two independent pieces of evidence and states only what no healthy device could report.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.devices import ForceTorque, Touch
from manipulation.plausibility.finding import Finding, Symptom

WIDTH_OFF_M = 0.003  # pads at rest that hold nothing are nearer than this to the commanded width
FELT_N = 8.0  # twice the hand's inertial force in a transfer, and far above the threshold of a touch switch
NEAR_TIPS_M = 0.03  # largest lever arm of a force about the tips; the fingers do not sense a force further up
UNFELT_S = 0.05
QUIET_S = 20.0  # no further finding for this time, so that the hand can leave the object that it pushes on
FREE_N = 5.0
FREE_WAY_M = 0.15  # longer than any retreat, after which a finger has left whatever it touched


@dataclass(frozen=True, slots=True, kw_only=True)
class Pads:
    """State of the pads as the gripper reports it."""

    width_m: float
    is_moving: bool = False
    is_holding: bool = False


def wrong_width(gripper: str, now: Pads, *, sent_m: float, begun_m: float) -> Finding | None:
    """Find pads that hold nothing but report another width than commanded, or opening pads that report no motion.

    Args:
        now: the gripper's report after it was sent to a width and has come to rest.
        sent_m: the width that the gripper accepted.
        begun_m: the width that it reported before.
    """
    is_off = abs(now.width_m - sent_m) > WIDTH_OFF_M
    is_still = abs(now.width_m - begun_m) <= 0.5 * WIDTH_OFF_M
    is_settled = not now.is_moving and not now.is_holding
    if not is_off or not (is_settled or (is_still and sent_m > begun_m)):
        return None
    return Finding(
        device=gripper,
        symptom=Symptom.DISOBEYS,
        what=f"{gripper} was sent to {1e3 * sent_m:.1f} mm and says {1e3 * now.width_m:.1f} mm, before that"
        f" {1e3 * begun_m:.1f}, with nothing held: its reading is frozen or wrong, or the pads are blocked",
        remedy="look at the pads, then switch the gripper off and on",
    )


class TouchMonitor:
    """Finds touch sensors that feel nothing while the wrist does, or feel something where nothing can be.

    A force counts only if it acts near the tips. A free hand is one that has opened and travels with no force at the
    wrist.
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

    def pads_moved(self, begun_m: float, now: Pads) -> None:
        """Note the end of a motion of the pads that began at a width."""
        self._is_empty = now.width_m > begun_m + WIDTH_OFF_M and not now.is_holding

    def begin(self, *, moves_pads: bool) -> None:
        """Note that a motion begins, because its tips may differ from those of the previous motion."""
        self._before_s = None
        self._free_from_m = None
        if moves_pads:
            self._is_empty = False

    def note(self, contacts: tuple[bool, ...], wrench: Array, tip_m: Array, *, stamp_s: float) -> Finding | None:
        """Check one tick; a finding is returned once and then suppressed for a while.

        Args:
            wrench: (6,) contact wrench in tool axes about the tips.
            tip_m: (3,) position of the tips.
        """
        if not self._is_watched or stamp_s < self._quiet_until_s:
            return None
        lasted_s = 0.0 if self._before_s is None else stamp_s - self._before_s
        self._before_s = stamp_s
        force_n, turn_nm = float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
        if any(contacts):
            self._unfelt_s = 0.0
        elif force_n >= self._force_n and turn_nm <= NEAR_TIPS_M * force_n:
            self._unfelt_s += lasted_s
            if self._unfelt_s >= UNFELT_S:
                what = f"feels nothing while {force_n:.0f} N push on the tips of the fingers"
                return self._found(Symptom.NUMB, what, stamp_s)
        if not (self._is_empty and any(contacts) and force_n < FREE_N):
            self._free_from_m = None
        elif self._free_from_m is None:
            self._free_from_m = tip_m.copy()
        elif float(np.linalg.norm(tip_m - self._free_from_m)) >= FREE_WAY_M:
            way = f"{1e3 * FREE_WAY_M:.0f} mm"
            what = f"says contact while the open hand goes {way} with nothing felt at the wrist"
            return self._found(Symptom.PHANTOM, what, stamp_s)
        return None

    def _found(self, symptom: Symptom, what: str, stamp_s: float) -> Finding:
        self._unfelt_s, self._free_from_m = 0.0, None
        self._quiet_until_s = stamp_s + QUIET_S
        return Finding(
            device=self._name,
            symptom=symptom,
            what=f"{self._name} {what}: it is frozen or off its zero",
            remedy="press each finger by hand and watch it",
        )
