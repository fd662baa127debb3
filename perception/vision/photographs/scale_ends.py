"""Ends of a round gauge's scale, found by its ticks.

On every ring of the face, ticks are followed as long as they are evenly spaced. The ticks of one scale show on several
rings, and all of them end at the same two places; numerals, words and shadows do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from hal.arrays import Array, Image

SAMPLES = 1440  # of a turn
RINGS = np.linspace(0.45, 1.0, 28)  # share of the radius
FACE_SAMPLES = 161  # 40 degrees: what a tick is darker or brighter than
STEPS = (6, 170)  # samples from one tick to the next: 1.5 to 42 degrees
LEAST_REPEATED = 0.15  # correlation of a ring with itself a step on
SEARCHED = 0.25  # of a step: seen aslant, ticks do not lie evenly
LEAST_CONTRAST = 0.35  # of the run's median
HIDDEN_SAMPLES = 96  # 24 degrees: the pointer or a reflection lies over some ticks, over one at least
LEAST_TICKS = 7
SPAN_RAD = np.deg2rad([60.0, 330.0])
SAME_RAD = np.deg2rad(4.0)
LEAST_RINGS, LEAST_SHARE = 2, 0.4  # that agree, and of all rings' weight


@dataclass(frozen=True, slots=True, kw_only=True)
class TickRun:
    """A run of evenly spaced ticks on a ring: angles of the first and the last (rad, clockwise from up), and their number."""

    ends_rad: tuple[float, float]
    ticks: int
    contrast: float

    @property
    def weight(self) -> float:
        """Weight of its ends in the vote."""
        return self.ticks * float(np.log1p(self.contrast))


def scale_ends(gray: Image, u: float, v: float, radius: float) -> tuple[float, float] | None:
    """Angles of the first and the last tick, rad clockwise from up, their middle within half a turn; None where rings disagree.

    Args:
        gray: (H, W) uint8.
        u, v, radius: the dial in it, px.
    """
    runs = [run for profile in _rings(gray, u, v, radius) if (run := _longest(profile)) is not None]
    if not runs:
        return None
    groups = [[other for other in runs if _apart(other, run.ends_rad) < SAME_RAD] for run in runs]
    group = max(groups, key=_weight)
    if len(group) < LEAST_RINGS or _weight(group) < LEAST_SHARE * _weight(runs):
        return None
    weights = [run.weight for run in group]
    first_rad, last_rad = group[0].ends_rad
    off = [[_off(run.ends_rad[k], group[0].ends_rad[k]) for run in group] for k in (0, 1)]
    first, last = np.average(off, axis=1, weights=weights)
    middle_rad = 0.5 * (first_rad + first + last_rad + last)
    whole_turns = middle_rad - _off(middle_rad, 0.0)
    return float(first_rad + first - whole_turns), float(last_rad + last - whole_turns)


def _rings(gray: Image, u: float, v: float, radius: float) -> list[Array]:
    """(SAMPLES,) how far each place of a ring stands out of the face beside it, as its ticks do."""
    turn = np.arange(SAMPLES) * 2 * np.pi / SAMPLES
    x, y = (middle + radius * RINGS[:, None] * way for middle, way in ((u, np.sin(turn)), (v, -np.cos(turn))))
    seen = cv2.remap(np.asarray(gray, np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    round_once = cv2.copyMakeBorder(seen, 1, 1, FACE_SAMPLES, FACE_SAMPLES, cv2.BORDER_WRAP)
    round_once[[0, -1]] = round_once[[1, -2]]
    fine = cv2.blur(round_once, (3, 2), anchor=(1, 0))
    dark = (cv2.blur(fine, (FACE_SAMPLES, 1)) - fine)[1:-1, FACE_SAMPLES:-FACE_SAMPLES].astype(float)
    # Ticks are narrower than the gaps between them, whatever their ink: the gaps would put the ends half a step off.
    return [ring if np.mean(ring**3) > 0.0 else -ring for ring in dark]


def _longest(profile: Array) -> TickRun | None:
    """The run of most weight among those of the two smallest steps at which the profile repeats itself."""
    spectrum = np.fft.rfft(profile - profile.mean())
    repeated = np.fft.irfft(np.abs(spectrum) ** 2)
    if repeated[0] <= 0.0:
        return None
    repeated /= repeated[0]
    k = np.arange(*STEPS)
    peaks = k[(repeated[k] > repeated[k - 1]) & (repeated[k] >= repeated[k + 1]) & (repeated[k] > LEAST_REPEATED)]
    runs = [run for step in peaks[:2] if (run := _follow(profile, int(step))) is not None]
    return max(runs, key=lambda run: run.weight, default=None)


def _follow(profile: Array, step: int) -> TickRun | None:
    """Follow the ticks both ways from the five clearest ones; None for a run that does not belong to a scale."""
    grid = sum(np.roll(profile, -k * step) - np.roll(profile, -k * step - step // 2) for k in range(-2, 3))
    start, contrast = _tick(profile, int(np.argmax(grid)), step)
    contrasts, ends, most_missing = [contrast], [], max(1, HIDDEN_SAMPLES // step)
    for way in (1, -1):
        at, last, missing = start, start, 0
        while missing <= most_missing and abs(at - start) < SAMPLES:
            at += way * step
            tick, contrast = _tick(profile, at, step)
            if contrast > LEAST_CONTRAST * np.median(contrasts):
                contrasts.append(contrast)
                at, last, missing = tick, tick, 0
            else:
                missing += 1
        ends.append(last * 2 * np.pi / SAMPLES)
    if len(contrasts) < LEAST_TICKS or not SPAN_RAD[0] < ends[0] - ends[1] < SPAN_RAD[1]:
        return None
    return TickRun(ends_rad=(ends[1], ends[0]), ticks=len(contrasts), contrast=max(float(np.median(contrasts)), 0.0))


def _tick(profile: Array, near: int, step: int) -> tuple[int, float]:
    """Position of the tick near a place, and its contrast against the gaps beside it."""
    reach = max(1, int(SEARCHED * step))
    places = np.arange(near - reach, near + reach + 1)
    at = int(places[np.argmax(profile[places % SAMPLES])])
    beside = 0.5 * (profile[(at - step // 2) % SAMPLES] + profile[(at + step // 2) % SAMPLES])
    return at, float(profile[at % SAMPLES] - beside)


def _weight(runs: Sequence[TickRun]) -> float:
    return sum(run.weight for run in runs)


def _apart(run: TickRun, ends_rad: tuple[float, float]) -> float:
    """The larger of the angular distances between the ends."""
    return max(abs(_off(one, other)) for one, other in zip(run.ends_rad, ends_rad, strict=True))


def _off(angle_rad: float, other_rad: float) -> float:
    """Angular difference, wrapped to half a turn either way."""
    return float((angle_rad - other_rad + np.pi) % (2 * np.pi) - np.pi)
