"""The scales that the numbers around a dial tell: their values rise, or fall, evenly with the angle, at equal steps.

A number that was misread, a word's, or one of another scale does not fit the others, so that a few that fit are proof.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.vision.photographs.numerals import Number

CUTS = 8  # directions at which the angles may begin again
SAME_RING, SAME_HEIGHT = 0.13, 0.22  # of the radius, and of the heights' logarithm, between the numbers of one scale
WITHIN_RAD = np.deg2rad(6.0)  # from its place; the middle of a number is not exactly at its tick
LEAST_APART_RAD = np.deg2rad(7.0)
SPAN_RAD = np.deg2rad([30.0, 350.0])
LEAST_NUMBERS = 3
LONGER, LACKING = 0.7, 0.4  # weight of each further digit of a number, and cost of a number that is not found
LEAST_WEIGHT = 2.7
OFF_STEP = 1e-6  # of a step, from a whole number of steps
MOST_STEPS = 30
MANTISSAS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.5, 8.0)  # of the step between two numbers of a scale
SAME_SWEEP_RAD = np.deg2rad(25.0)  # the last number of a second scale may stand before its end
MOST_FURTHER = 4  # steps by which a scale goes on at either end beyond the numbers that were read
UPRIGHT_RAD = np.deg2rad(5.0)  # most scales lie evenly about straight up
TURN_STEPS, OFF_TURN = (
    (8, 10, 12),
    0.03,
)  # steps of a scale that is a full turn, and by how much of it they may miss a turn
LEAST_SHARE = 0.5  # of a scale that is told, which its numbers must span
PROVEN, SURE, LIKELY = 4, 0.93, 0.75  # numbers beyond those that lack which make a scale sure, and its confidence then
OUTER = 0.6  # of the radius: a scale further in may have an outer one, in another unit, that was not read


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintedScale:
    """A scale that the numbers of a dial tell.

    Attributes:
        minimum, maximum: its least and its largest number.
        at_min, at_max: pointer angles there, rad clockwise from up, less than a turn apart.
        step: between two of its numbers.
        off: mean distance of the numbers from the dial's middle, over the radius.
        numbers: how many fit.
        lacking: how many of its numbers were not found, or misread.
    """

    minimum: float
    maximum: float
    at_min: float
    at_max: float
    step: float
    off: float
    numbers: int
    lacking: int

    def is_beside(self, other: PrintedScale) -> bool:
        """Return whether another scale lies on another ring and has nearly the same sweep."""
        one, two = self.whole(), other.whole()
        apart_rad = max(abs(one.at_min - two.at_min), abs(one.at_max - two.at_max))
        return abs(self.off - other.off) > SAME_RING and apart_rad < SAME_SWEEP_RAD

    def ends_of(self, low: float, high: float) -> tuple[float, float] | None:
        """Return the pointer angles at the ends of a scale that is told; None if these are not numbers of that scale."""
        slope = (self.at_max - self.at_min) / (self.maximum - self.minimum)
        ends_rad = self.at_min + slope * (low - self.minimum), self.at_min + slope * (high - self.minimum)
        is_inside = low - OFF_STEP * self.step <= self.minimum and self.maximum <= high + OFF_STEP * self.step
        is_most = self.maximum - self.minimum >= LEAST_SHARE * (high - low)
        return ends_rad if is_inside and is_most and abs(ends_rad[1] - ends_rad[0]) < SPAN_RAD[1] else None

    @property
    def confidence(self) -> float:
        """Largest confidence of a reading by this scale."""
        return SURE if self.numbers - self.lacking >= PROVEN and self.off > OUTER else LIKELY

    @property
    def is_proven_if_told(self) -> bool:
        """Whether a reading on this scale is sure where its end values are told, too."""
        return self.numbers - self.lacking >= PROVEN - 1

    def full_turn(self) -> float | None:
        """Return the value of a full turn of a scale that begins with 0 straight up; None if it is no such scale.

        It is negative if the values rise counter-clockwise.
        """
        slope = (self.at_max - self.at_min) / (self.maximum - self.minimum)
        at_zero = self.at_min - slope * self.minimum
        at_zero -= 2 * np.pi * round(at_zero / (2 * np.pi))
        steps = abs(2 * np.pi / slope) / self.step
        if abs(at_zero) > UPRIGHT_RAD or self.minimum < 0.0 or round(steps) not in TURN_STEPS:
            return None
        if abs(steps - round(steps)) > OFF_TURN * steps or self.maximum > (round(steps) + OFF_STEP) * self.step:
            return None
        return float(np.copysign(round(steps) * self.step, slope))

    def whole(self) -> PrintedScale:
        """Return the scale with the ends that lie evenly about straight up, where numbers at its ends were not read."""
        step_rad = (self.at_max - self.at_min) * self.step / (self.maximum - self.minimum)
        ways = sorted(
            ((low, high) for low in range(MOST_FURTHER + 1) for high in range(MOST_FURTHER + 1)),
            key=lambda way: (sum(way), way),
        )
        for low, high in ways:
            ends_rad = self.at_min - low * step_rad, self.at_max + high * step_rad
            middle_rad = 0.5 * sum(ends_rad)
            middle_rad -= 2 * np.pi * round(middle_rad / (2 * np.pi))
            if abs(middle_rad) < UPRIGHT_RAD and abs(ends_rad[1] - ends_rad[0]) < SPAN_RAD[1]:
                return replace(
                    self, minimum=self.minimum - low * self.step, maximum=self.maximum + high * self.step,
                    at_min=ends_rad[0], at_max=ends_rad[1], lacking=self.lacking + low + high,
                )  # fmt: skip
        return self


def printed_scales(groups: Sequence[Sequence[Number]]) -> list[PrintedScale]:
    """Return the scale that the numbers of one group tell, and a second one on another ring of the same sweep.

    The outer one comes first.
    """
    found = [(score, scale, used, group) for group in groups for score, scale, used in _best(group)]
    if not found:
        return []
    _, scale, used, group = max(found, key=lambda one: one[0])
    beside = [second for _, second, _ in _best([one for one in group if one not in used]) if scale.is_beside(second)]
    return sorted([scale, *beside], key=lambda one: -one.off)


def _best(numbers: Sequence[Number]) -> list[tuple[float, PrintedScale, list[Number]]]:
    """Return the scale of most weight, with its weight and its numbers; nothing without one."""
    if len(numbers) < LEAST_NUMBERS:
        return []
    best: tuple[float, list[int], Array] | None = None
    value, off, tall = (np.array([getattr(one, name) for one in numbers]) for name in ("value", "off", "height"))
    alike = (np.abs(off[:, None] - off) < SAME_RING) & (np.abs(np.log(tall[:, None] / tall)) < SAME_HEIGHT)
    weight = np.array([one.probability * (1.0 + LONGER * (len(one.text) - 1)) for one in numbers])
    for cut in np.arange(CUTS) * 2 * np.pi / CUTS:
        angle = (np.array([one.angle_rad for one in numbers]) - cut) % (2 * np.pi)
        for i in range(len(numbers)):
            for j in range(i + 1, len(numbers)):
                apart = angle[j] - angle[i]
                if abs(apart) < LEAST_APART_RAD or value[i] == value[j] or not alike[i, j]:
                    continue
                slope = (value[j] - value[i]) / apart
                fits = np.abs(value - value[i] - slope * (angle - angle[i])) < WITHIN_RAD * abs(slope)
                fits &= alike[i] & alike[j]
                rows = _one_each(np.flatnonzero(fits), value, weight)
                if best is not None and weight[rows].sum() <= best[0]:
                    continue
                score, rows = _on_steps(rows, value, weight)
                if len(rows) >= LEAST_NUMBERS and score > (LEAST_WEIGHT if best is None else best[0] + 1e-9):
                    best = score, rows, angle + cut
    if best is None:
        return []
    score, rows, angles = best
    scale = _fitted(value[rows], angles[rows], off[rows], weight[rows])
    return [] if scale is None else [(score, scale, [numbers[k] for k in rows])]


def _one_each(rows: NDArray[np.intp], value: Array, weight: Array) -> list[int]:
    """Return the likeliest number of each value."""
    kept: dict[float, int] = {}
    for row in rows[np.argsort(-weight[rows], kind="stable")]:
        kept.setdefault(float(value[row]), int(row))
    return list(kept.values())


def _on_steps(rows: list[int], value: Array, weight: Array) -> tuple[float, list[int]]:
    """Return the numbers that are whole multiples of the likeliest step, and their weight less that of those that lack."""
    best: tuple[float, list[int]] = (0.0, [])
    ordered = np.sort(value[rows])
    for step in {float(f"{part:.6g}") for part in np.diff(ordered) if part > 0.0}:
        if not _is_usual(step):
            continue
        kept = [row for row in rows if abs(value[row] / step - round(value[row] / step)) < OFF_STEP]
        if len(kept) < LEAST_NUMBERS:
            continue
        steps = round(np.ptp(value[kept]) / step)
        score = float(weight[kept].sum()) - LACKING * (steps + 1 - len(kept))
        if steps <= MOST_STEPS and score > best[0]:
            best = score, kept
    return best


def _is_usual(step: float) -> bool:
    """Return whether a step has a mantissa that scales have."""
    mantissa = step / 10.0 ** np.floor(np.log10(step) + 1e-9)
    return bool(min(abs(mantissa - one) for one in MANTISSAS) < 1e-4)


def _fitted(values: Array, angles: Array, offs: Array, weights: Array) -> PrintedScale | None:
    """Return the scale through numbers by least squares; None if it spans too little or too much."""
    A = np.column_stack([values, np.ones(len(values))]) * np.sqrt(weights)[:, None]
    slope, start = np.linalg.lstsq(A, angles * np.sqrt(weights), rcond=None)[0]
    low, high = float(values.min()), float(values.max())
    step = min(float(f"{part:.6g}") for part in np.diff(np.sort(values)))
    at_min, at_max = float(slope * low + start), float(slope * high + start)
    if not SPAN_RAD[0] < abs(at_max - at_min) < SPAN_RAD[1]:
        return None
    turn = 2 * np.pi * round(0.5 * (at_min + at_max) / (2 * np.pi))
    return PrintedScale(
        minimum=low, maximum=high, at_min=at_min - turn, at_max=at_max - turn, step=step, off=float(offs.mean()),
        numbers=len(values), lacking=round((high - low) / step) + 1 - len(values),
    )  # fmt: skip
