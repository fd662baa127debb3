"""Collects the measurements of a turning scanner into turns, and says how much of a turn is missing."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

JITTER_RAD = math.radians(2.0)  # of the motor
UNCERTAIN_RAD = math.radians(5.0)  # the motor's speed varies by about 1 percent, so less cannot be told from nothing
STRAYS, STRAY_RAD = 3, math.radians(20.0)  # beside a damaged measurement some good ones are lost, too
MOST_MISSING_RAD = math.pi  # with less of a turn, a fall of the angle does not show where the turn ended
LARGEST_AGE = 1.5  # turns; a gap of more than a turn leaves older measurements behind
REGULAR = (0.5, 1.5)  # times the median step


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurements:
    """Measurements in the order in which they were taken.

    Attributes:
        head_rad: angle of the turning head, which rises steadily; angle_rad: direction of the beam, corrected.
        distance_m: NaN for none. arrived_s: when each arrived, on the links' clock.
    """

    head_rad: Array
    angle_rad: Array
    distance_m: Array
    arrived_s: Array

    def __len__(self) -> int:
        return len(self.head_rad)

    def at(self, which: slice | NDArray[np.bool_]) -> Measurements:
        """Return some of the measurements."""
        return Measurements(
            head_rad=self.head_rad[which],
            angle_rad=self.angle_rad[which],
            distance_m=self.distance_m[which],
            arrived_s=self.arrived_s[which],
        )


def joined(parts: list[Measurements]) -> Measurements:
    """Return the measurements of all parts."""
    return Measurements(
        head_rad=np.concatenate([part.head_rad for part in parts]),
        angle_rad=np.concatenate([part.angle_rad for part in parts]),
        distance_m=np.concatenate([part.distance_m for part in parts]),
        arrived_s=np.concatenate([part.arrived_s for part in parts]),
    )


def missing_rad(head_rad: Array) -> float:
    """Return how much of a turn was not measured: all but one usual step for each measurement.

    Steps over a gap are left out of the mean. Less than 5 degrees counts as nothing.
    """
    step_rad = steps(head_rad)
    usual_rad = float(np.median(step_rad)) if len(step_rad) else 0.0
    regular_rad = step_rad[(step_rad > REGULAR[0] * usual_rad) & (step_rad < REGULAR[1] * usual_rad)]
    if not len(regular_rad):
        return math.tau
    lacking_rad = math.tau - len(head_rad) * float(np.mean(regular_rad))
    return lacking_rad if lacking_rad > UNCERTAIN_RAD else 0.0


def steps(angle_rad: Array) -> Array:
    """Return the differences of neighbours, between minus and plus half a turn."""
    return (np.diff(angle_rad) + np.pi) % math.tau - np.pi


def strays_beside(head_rad: Array, place: int) -> slice:
    """Return the fewest measurements before or from `place` on without which the head goes forward; none if too many."""
    for count in range(1, STRAYS + 1):
        for begin in (place, place - count):
            if begin > 0 and begin + count < len(head_rad):
                over_rad = float(steps(head_rad[[begin - 1, begin + count]])[0])
                if 0.0 < over_rad < STRAY_RAD:
                    return slice(begin, begin + count)
    return slice(0, 0)


class TurnCollector:
    """Splits measurements into turns where the angle of the head falls through zero, so a lost start flag does no harm.

    A piece that came twice is taken once. Up to three measurements from which or to which the head would go back are left
    out if their neighbours fit each other; with more of them the turn is discarded. The last three are held back until the
    next ones show whether they fit.
    """

    def __init__(self) -> None:
        self._parts: list[Measurements] = []
        self._last_rad: float | None = None
        self._is_begun = False
        self._held: Measurements | None = None
        self.count = 0  # measurements taken in so far
        self.discarded = 0

    @property
    def pending(self) -> int:
        """Return the number of measurements that are held back."""
        return 0 if self._held is None else len(self._held)

    def add(self, new: Measurements) -> Iterator[tuple[Measurements, int]]:
        """Yield each turn that is now complete, and `count` at its end."""
        new = self._without_strays(new if self._held is None else joined([self._held, new]))
        kept = max(0, len(new) - STRAYS)
        self._held, new = new.at(slice(kept, None)), new.at(slice(0, kept))
        if len(new) and self._last_rad is not None and steps(np.array([self._last_rad, new.head_rad[0]]))[0] <= 0.0:
            new = new.at(slice(self._repeated(new), None))
        while len(new):
            last_rad = new.head_rad[0] if self._last_rad is None else self._last_rad
            back = np.flatnonzero(steps(np.concatenate(([last_rad], new.head_rad))) < -JITTER_RAD)
            upto = int(back[0]) if len(back) else len(new)
            yield from self._split(new.at(slice(0, upto)), last_rad)
            new = new.at(slice(upto, None))
            if len(new) and (repeated := self._repeated(new)):
                new = new.at(slice(repeated, None))
            elif len(new):
                self.discarded += self._is_begun
                self._parts, self._is_begun, self._last_rad = [], False, None

    def _without_strays(self, new: Measurements) -> Measurements:
        """Return the measurements without the few that do not fit between their neighbours, which fit each other."""
        last_rad = np.array([] if self._last_rad is None else [self._last_rad], np.float64)
        head_rad = np.concatenate((last_rad, new.head_rad))
        is_good = np.ones(len(head_rad), np.bool_)
        for place in np.flatnonzero(steps(head_rad) < -JITTER_RAD) + 1:  # the head goes back to this one
            is_good[strays_beside(head_rad, int(place))] = False
        return new.at(is_good[len(last_rad) :])

    def _split(self, new: Measurements, last_rad: float) -> Iterator[tuple[Measurements, int]]:
        fall_rad = -np.diff(new.head_rad, prepend=last_rad)
        places = [0, *np.flatnonzero(fall_rad > math.pi), len(new)]
        for k, (begin, end) in enumerate(pairwise(places)):
            if k:
                if self._is_begun and self._parts:
                    yield joined(self._parts), self.count
                self._parts, self._is_begun = [], True
            if self._is_begun and end > begin:
                self._parts.append(new.at(slice(begin, end)))
            self.count += int(end - begin)
        if len(new):
            self._last_rad = float(new.head_rad[-1])

    def _repeated(self, new: Measurements) -> int:
        """Return how many of the first measurements are a repetition of the turn's last ones."""
        if not self._parts:
            return 0
        turn = joined(self._parts)
        begins = np.flatnonzero(turn.head_rad == new.head_rad[0])
        if not len(begins):
            return 0
        before = turn.at(slice(int(begins[-1]), None))
        length = min(len(before), len(new))
        is_same = (before.head_rad[:length] == new.head_rad[:length]) & (
            (before.distance_m[:length] == new.distance_m[:length]) | np.isnan(before.distance_m[:length])
        )
        return length if is_same.all() else 0
