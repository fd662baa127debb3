"""What a hand feels when it turns something: when the object gives way, at which effort, and how far it has moved.

The pads yield, so the hand is ahead of the object: first the torque rises with the turn of the hand, and where it rises
no more, the object has given way.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hal.arrays import Array

STEP_RAD = 0.01
WINDOW = 4  # steps over which a slope is taken
FLAT_RATIO = 0.3  # of the steepest slope: below it the object moves
LEAST_NM = 0.06  # above noise, drift and the hand's own inertia
SLIP_RATIO = 0.5
SLIDING_RATIO, STEEP_RATIO = 0.5, 0.5  # see `_breakaway`
LIGHTER_RATIO, SEATING_RAD = 0.75, 0.2  # see `_breakaway`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Felt:
    """Torques that a hand felt in one hold.

    Attributes:
        turned_rad, torque_nm: turns of the hand (N,) since it came down, and the torques (N,) against them.
        is_moving: whether the object has given way.
        running_nm: torque at which it moves.
        moved_rad: how far it has turned.
        has_slipped: whether the torque has fallen from what moved the object.
    """

    turned_rad: Array = field(default_factory=lambda: np.zeros(1))
    torque_nm: Array = field(default_factory=lambda: np.zeros(1))
    is_moving: bool = False
    running_nm: float = 0.0
    moved_rad: float = 0.0
    has_slipped: bool = False

    @property
    def end_rad(self) -> float:
        """Turn of the hand at the end."""
        return float(self.turned_rad[-1])

    @property
    def peak_nm(self) -> float:
        """Largest torque."""
        return float(self.torque_nm.max())


def felt_in(before: Felt, turned_rad: Array, torque_nm: Array, *, ran_nm: float = 0.0) -> Felt:
    """Return what was felt in a hold after one more motion of it.

    Args:
        ran_nm: torque at which the object turned in an earlier hold; 0 where it has not.
    """
    turned = np.concatenate([before.turned_rad, turned_rad])
    torque = np.concatenate([before.torque_nm, torque_nm])
    ahead = np.maximum.accumulate(turned)
    grid = np.arange(0.0, ahead[-1], STEP_RAD)
    unknown = Felt(turned_rad=turned, torque_nm=torque)
    if len(grid) <= WINDOW + 1:
        return unknown
    order = np.argsort(ahead, kind="stable")
    level = np.interp(grid, ahead[order] + 1e-9 * np.arange(len(order)), torque[order])
    level = np.array([np.median(level[max(0, k - 1) : k + 2]) for k in range(len(level))])
    slopes = (level[WINDOW:] - level[:-WINDOW]) / (WINDOW * STEP_RAD)
    gives = _breakaway(level, slopes, LIGHTER_RATIO * ran_nm)
    end_nm = float(np.median(torque[-5:]))
    if gives is None:
        return Felt(turned_rad=turned, torque_nm=torque, has_slipped=end_nm < SLIP_RATIO * level.max() - LEAST_NM)
    running = float(np.median(level[gives:][-30:]))
    moved = ahead[-1] - _wound_up(grid, level, gives, end_nm, float(slopes[:gives].max()))
    return Felt(
        turned_rad=turned,
        torque_nm=torque,
        is_moving=True,
        running_nm=running,
        moved_rad=max(0.0, float(moved)),
        has_slipped=end_nm < SLIP_RATIO * level.max() - LEAST_NM,
    )


def _wound_up(grid: Array, level_nm: Array, gives: int, end_nm: float, slope: float) -> float:
    """Return the turn of the hand at which it had loaded the object with `end_nm`, before that gave way.

    The hand is ahead of the object by what pads, fingers and arm yield under the present torque. They have yielded as much
    under the same torque while the object still stood, which needs no assumption about how they yield.
    """
    loaded = np.maximum.accumulate(level_nm[: gives + 1])
    if end_nm >= loaded[-1]:
        return float(grid[gives] + (end_nm - loaded[-1]) / slope)
    k = max(1, int(np.argmax(loaded > end_nm)))
    share = (end_nm - loaded[k - 1]) / max(loaded[k] - loaded[k - 1], 1e-9)
    return float(grid[k - 1] + np.clip(share, 0.0, 1.0) * (grid[k] - grid[k - 1]))


def _breakaway(level_nm: Array, slopes: Array, expected_nm: float) -> int | None:
    """Return the index at which a rising torque (N,) becomes flat; None when it does not.

    A torque that is flat and then rises steeply to a flat one of more than twice its size was a finger that slid, before
    both pushed: the object gives way at the second. So was a flat torque below `expected_nm`, with which the object has
    turned before, unless it stays flat for `SEATING_RAD`.
    """
    found: int | None = None
    for k in range(1, len(slopes)):
        steepest = float(slopes[:k].max())
        is_flat = level_nm[k] > LEAST_NM and steepest > 0.5 and slopes[k] < FLAT_RATIO * steepest
        if not is_flat:
            continue
        if (
            found is None
            or level_nm[found] < expected_nm <= level_nm[k]
            or (level_nm[found] < SLIDING_RATIO * level_nm[k] and slopes[found:k].max() >= STEEP_RATIO * steepest)
        ):
            found = k
    if found is not None and level_nm[found] < expected_nm and (len(level_nm) - found) * STEP_RAD < SEATING_RAD:
        return None
    return found
