"""What is believed of a handwheel while it is turned: its effort, and which of the ways to hold it is to be tried next."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from hal.panel import Handwheel
from manipulation.planning.hand import Hand
from manipulation.skills.crank import spoke_holds
from manipulation.skills.wheel_turn import MOVED_RAD

PUSH_N = 80.0  # of one finger on a spoke
SIDE_N = 54.0  # of the hand on the rim; where the pads slip, the finger beside a spoke takes all of it, and is pressed past it
SPARE_M = 0.001
LEAST_SHARE = 0.5  # of the turn that was felt; a wheel that is seen to have turned less has not followed the hand
SLACK_RAD = 0.03
LEARNT_SHARE = 0.5  # pads that have slipped a little lose nothing in the next hold
MOST_LOST_RAD = 0.15  # what pads, fingers and arm yield under the torque of a heavy wheel
FRICTION = 0.5  # of the pads on paint; where they slip, the spoke takes over
ACROSS_SIDE_M, LEAST_ACROSS_M = 0.006, 0.0005  # wanted and least free space on each side of a hand across the wheel
# The force of one pad is taken by the other, so neither arm nor shaft feel it. With less, for a stated effort, pads slipped by
# up to 0.2 rad, which no finger felt.
GRIP_ACROSS_N = 90.0


class Hold(StrEnum):
    """How a hand holds a wheel."""

    ACROSS = "across"
    SPOKES = "spokes"
    RIM = "rim"


@dataclass(slots=True, kw_only=True)
class Belief:
    """What is believed of a wheel: its effort, by the panel file until it is felt, and which holds have failed.

    Attributes:
        effort_nm: torque that moves the wheel, or the largest that did not.
        failed: holds that were tried in vain.
        ran_nm: torque at which the wheel turned in an earlier hold; 0 before.
        tried_nm: largest torque that was put on the wheel.
        has_slipped: whether the pads slipped in a hold, so that the torque at which the wheel gives way is not known.
        least_arm_m: how far from the hub the spokes must be pushed, because nearer to it did not do.
        out_of_reach: why the arm cannot take a hold; empty where it can take each.
        lost_rad: by how much less the wheel turns in a hold than is felt, because it springs back when it is let go.
    """

    effort_nm: float
    failed: set[Hold] = field(default_factory=set)
    ran_nm: float = 0.0
    tried_nm: float = 0.0
    has_slipped: bool = False
    least_arm_m: float = 0.0
    out_of_reach: str = ""
    lost_rad: float = 0.0
    _first_rad: float | None = None
    _last: tuple[Hold, float, float] | None = None

    def next_hold(self, wheel: Handwheel, hand: Hand) -> Hold | None:
        """Return the hold to try: of those that have not failed, the first that takes the effort, or takes most of it."""
        takes = {hold: nm for hold, nm in torques_nm(wheel, hand).items() if hold not in self.failed}
        enough = [hold for hold, nm in takes.items() if nm > self.effort_nm]
        return enough[0] if enough else max(takes, key=lambda hold: takes[hold], default=None)

    def begin(self, seen_rad: float) -> None:
        """Note where the wheel stood before the first hold."""
        if self._first_rad is None:
            self._first_rad = seen_rad

    def has_moved(self, seen_rad: float) -> bool:
        """Return whether the wheel has turned since the first hold."""
        return self._first_rad is not None and abs(seen_rad - self._first_rad) > MOVED_RAD

    def felt(self, torque_nm: float) -> None:
        """Note a torque that was put on the wheel."""
        self.tried_nm = max(self.tried_nm, torque_nm)

    def ran_at(self, torque_nm: float) -> None:
        """Note the torque at which the wheel turned, which the first time replaces what the panel file states.

        Later only a larger one counts: a short turn, in which pads and arm bend more than the wheel turns, shows too little.
        """
        self.effort_nm = max(self.effort_nm, torque_nm) if self.ran_nm else torque_nm
        self.ran_nm = max(self.ran_nm, torque_nm)
        self.felt(torque_nm)

    def turned(self, hold: Hold, begun_rad: float, expected_rad: float) -> None:
        """Note that a hold has turned the wheel, by what the fingers felt."""
        self._last = (hold, begun_rad, expected_rad)

    def learn(self, seen_rad: float) -> float:
        """Compare what the last hold felt with what is seen; returns the turn that is missing, 0 if it is small.

        A hold that slipped has failed.
        """
        if self._last is None:
            return 0.0
        (hold, begun_rad, expected_rad), self._last = self._last, None
        felt_rad, moved_rad = abs(expected_rad - begun_rad), abs(seen_rad - begun_rad)
        if moved_rad >= LEAST_SHARE * felt_rad - SLACK_RAD:
            lost_rad = self.lost_rad + LEARNT_SHARE * (felt_rad - moved_rad)
            self.lost_rad = float(np.clip(lost_rad, 0.0, MOST_LOST_RAD))
            return 0.0
        self.slipped(hold)
        return felt_rad - moved_rad

    def slipped(self, hold: Hold) -> None:
        """Note that the pads slipped in a hold, which has failed then."""
        self.has_slipped = True
        self.failed.add(hold)


def torques_nm(wheel: Handwheel, hand: Hand) -> dict[Hold, float]:
    """Return the torque that each possible hold of a wheel takes, the best hold first."""
    takes: dict[Hold, float] = {}
    if across_gap_m(wheel, hand) >= LEAST_ACROSS_M:
        takes[Hold.ACROSS] = 2.0 * FRICTION * GRIP_ACROSS_N * outer_m(wheel)
    if holds := spoke_holds(wheel, hand, 0.0, 1.0):
        takes[Hold.SPOKES] = 2.0 * PUSH_N * holds[0].arm_m
    takes[Hold.RIM] = SIDE_N * wheel.radius_m
    return takes


def across_gap_m(wheel: Handwheel, hand: Hand) -> float:
    """Return the free space between each finger and the rim of a hand that is open across the wheel; may be negative."""
    return min(ACROSS_SIDE_M, 0.5 * hand.max_width_m - outer_m(wheel))


def outer_m(wheel: Handwheel) -> float:
    """Return the radius of the wheel with its rim, m."""
    return wheel.radius_m + wheel.rim_m
