"""Where two fingers stand behind two spokes of a handwheel, so that a turn of the hand about the hub turns the wheel.

The fingers push the spokes and squeeze nothing, so the friction of the pads does not matter. With two opposite spokes
the two pushes are a couple: the wheel turns, and nothing pushes the arm sideways. With an odd number of spokes a part
of the pushes remains: 2 F cos(alpha / 2) for spokes that are alpha apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.panel import Handwheel
from manipulation.planning.hand import Hand
from manipulation.skills.context import panel_from_grip

# Wanted and least space between a finger and the rim: the panel's pose and the rim's own shape are known less well, and
# friction on the spokes shifts the hand by up to 3 mm in a long turn.
RIM_MARGINS_M = (0.0045, 0.0022)
HUB_MARGIN_M = 0.0013
BEHIND_M = 0.006  # wanted distance between a finger and the spoke that it will push
LEAST_BEHIND_M = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class SpokeHold:
    """Two fingers behind two spokes; angles are clockwise from up, in the panel.

    Attributes:
        towards_rad: direction from the hub to the middle of the hand.
        offset_m: distance from the hub to the middle of the hand.
        half_m: half the distance between the middles of the fingers.
        arm_m: distance from the hub at which the fingers push.
        behind_rad: turn of the hand before the fingers meet the spokes.
    """

    towards_rad: float
    offset_m: float
    half_m: float
    arm_m: float
    behind_rad: float

    @property
    def side_per_nm(self) -> float:
        """Force along the line of the fingers for each N m when both push equally, N/(N m)."""
        return self.offset_m / float(np.hypot(self.offset_m, self.half_m)) / self.arm_m

    def opening_m(self, hand: Hand) -> float:
        """Opening between the fingers, m."""
        return 2.0 * self.half_m - hand.finger_thickness_m

    def grip(self, wheel: Handwheel, turned_rad: float, z_m: float, *, flip: bool) -> RigidTransform:
        """Return panel_from_grip after a turn of the hand about the hub, with the tips `z_m` above the plate."""
        angle = self.towards_rad + turned_rad
        x, y = wheel.position_m
        point = (x + self.offset_m * np.sin(angle), y + self.offset_m * np.cos(angle), z_m)
        return panel_from_grip(point, -angle + (np.pi if flip else 0.0))


def spoke_holds(
    wheel: Handwheel, hand: Hand, angle_rad: float, sign: float, *, least_arm_m: float = np.inf
) -> tuple[SpokeHold, ...]:
    """Return the holds with which the wheel at `angle_rad` can be turned clockwise (`sign` 1) or back (-1).

    There is none when the fingers do not fit between rim, hub and spokes.

    Args:
        least_arm_m: distance from the hub at which the push is enough; the fingers stand further from the rim if they then
            push no nearer to the hub than this.
    """
    wide, narrow = (_holds(wheel, hand, angle_rad, sign, margin_m) for margin_m in RIM_MARGINS_M)
    return wide if wide and wide[0].arm_m >= least_arm_m else narrow


def _holds(wheel: Handwheel, hand: Hand, angle_rad: float, sign: float, rim_margin_m: float) -> tuple[SpokeHold, ...]:
    apart = wheel.spokes // 2  # number of sectors between the two spokes
    alpha = 2.0 * np.pi * apart / wheel.spokes
    stand = _furthest_m(wheel, hand, alpha, rim_margin_m)
    half, offset = stand * float(np.sin(alpha / 2)), stand * float(np.cos(alpha / 2))
    inner = np.hypot(half - hand.finger_thickness_m / 2, max(0.0, offset - hand.finger_width_m / 2))
    if stand <= 0.0 or inner < wheel.hub_m + HUB_MARGIN_M:
        return ()
    lead, arm = _meeting(hand, half, offset, wheel.spoke_m)
    behind = min(lead + BEHIND_M / arm, np.pi / wheel.spokes)
    if behind < lead + LEAST_BEHIND_M / arm:
        return ()
    holds = []
    for k in range(wheel.spokes if alpha < np.pi - 1e-9 else wheel.spokes // 2):
        first = angle_rad + 2.0 * np.pi * k / wheel.spokes - sign * behind
        holds.append(
            SpokeHold(
                towards_rad=first + alpha / 2, offset_m=offset, half_m=half, arm_m=arm, behind_rad=behind - lead
            )
        )  # fmt: skip
    return tuple(holds)


def _meeting(hand: Hand, half_m: float, offset_m: float, spoke_m: float) -> tuple[float, float]:
    """Return the angle from the middle of a finger to the spoke that it just touches, and where on the spokes that is.

    The angle is that of the finger that touches first, the distance from the hub the mean of both fingers. From the hub
    the fingers are at (half, offset) and (-half, offset), and the turn goes from x to y. The corner of a finger at the
    polar angle a and the distance r touches the near side of a spoke at the angle a + asin(spoke / r).
    """
    t, w = hand.finger_thickness_m / 2, hand.finger_width_m / 2
    leads, arms = [], []
    for x in (half_m, -half_m):
        corners = np.array([[x + a * t, offset_m + b * w] for a in (-1, 1) for b in (-1, 1)])
        far = np.hypot(corners[:, 0], corners[:, 1])
        ahead = np.arctan2(corners[:, 1], corners[:, 0]) - np.arctan2(offset_m, x)
        touched = (ahead + np.pi) % (2.0 * np.pi) - np.pi + np.arcsin(spoke_m / far)
        k = int(np.argmax(touched))
        leads.append(float(touched[k]))
        arms.append(float(far[k]))
    return max(leads), 0.5 * (arms[0] + arms[1])


def _furthest_m(wheel: Handwheel, hand: Hand, alpha_rad: float, rim_margin_m: float) -> float:
    """Return how far from the hub the fingers can stand: their outer corners clear the rim, and the hand opens so far.

    (stand sin(alpha/2) + t/2)^2 + (stand cos(alpha/2) + w/2)^2 = free^2 with the finger's thickness t and width w.
    """
    free = wheel.radius_m - wheel.rim_m - rim_margin_m
    s, c = float(np.sin(alpha_rad / 2)), float(np.cos(alpha_rad / 2))
    t, w = hand.finger_thickness_m / 2, hand.finger_width_m / 2
    linear = s * t + c * w
    under = linear**2 - (t * t + w * w - free**2)
    if under <= 0.0:
        return 0.0
    return float(min(np.sqrt(under) - linear, (hand.max_width_m + hand.finger_thickness_m) / (2.0 * s)))
