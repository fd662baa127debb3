"""Search for the ends of a round gauge's scale by its ticks.

On every ring of the face, ticks are followed as long as they are evenly spaced. The ticks of one scale are visible on
several rings, and all of them end at the same two places; numerals, words and shadows do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from hal.arrays import Array, Image

SAMPLES = 1440  # of a turn
RINGS = np.linspace(0.45, 1.0, 28)  # shares of the radius
FACE_SAMPLES = 161  # 40 degrees: width of the background with which a tick is compared
STEPS = (6, 170)  # samples from one tick to the next: 1.5 to 42 degrees
LEAST_REPEATED = 0.15  # correlation of a ring with itself shifted by a step
SEARCHED = 0.25  # of a step; in an oblique view ticks are not evenly spaced
LEAST_CONTRAST = 0.35  # of a tick, relative to the run's median
HIDDEN_SAMPLES = 96  # 24 degrees: the pointer or a reflection may hide so much of the scale, or at least one tick
LEAST_TICKS = 7
SPAN_RAD = np.deg2rad([60.0, 330.0])
SAME_RAD = np.deg2rad(4.0)
LEAST_RINGS, LEAST_SHARE = 2, 0.4  # that agree, and their share of the weight of all rings


@dataclass(frozen=True, slots=True, kw_only=True)
class TickRun:
    """A run of evenly spaced ticks on a ring: angles of the first and last (rad clockwise from up), number, contrast."""

    ends_rad: tuple[float, float]
    ticks: int
    contrast: float

    @property
    def weight(self) -> float:
        """Weight of the run's ends in the vote."""
        return self.ticks * float(np.log1p(self.contrast))


def scale_ends(gray: Image, u: float, v: float, radius: float) -> tuple[float, float] | None:
    """Return the angles of the first and the last tick, rad clockwise from up; None if the rings do not agree.

    The middle of both is within half a turn.

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
    """Return for each ring how far its places (SAMPLES,) stand out of the face beside them.

    The sign is such that ticks are positive.
    """
    turn = np.arange(SAMPLES) * 2 * np.pi / SAMPLES
    x, y = (middle + radius * RINGS[:, None] * way for middle, way in ((u, np.sin(turn)), (v, -np.cos(turn))))
    seen = cv2.remap(np.asarray(gray, np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    round_once = cv2.copyMakeBorder(seen, 1, 1, FACE_SAMPLES, FACE_SAMPLES, cv2.BORDER_WRAP)
    round_once[[0, -1]] = round_once[[1, -2]]
    fine = cv2.blur(round_once, (3, 2), anchor=(1, 0))
    dark = (cv2.blur(fine, (FACE_SAMPLES, 1)) - fine)[1:-1, FACE_SAMPLES:-FACE_SAMPLES].astype(float)
    # Ticks, dark or bright, are narrower than gaps. If gaps were followed, the ends would be off by half a step.
    return [ring if np.mean(ring**3) > 0.0 else -ring for ring in dark]


def _longest(profile: Array) -> TickRun | None:
    """Return the run of most weight at the two smallest steps at which the profile repeats itself.

    None if there is none.
    """
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
    """Follow the ticks both ways from the five clearest ones; returns None if the run does not belong to a scale."""
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
    """Return the position of the tick near a place, and its contrast to the gaps beside it."""
    reach = max(1, int(SEARCHED * step))
    places = np.arange(near - reach, near + reach + 1)
    at = int(places[np.argmax(profile[places % SAMPLES])])
    beside = 0.5 * (profile[(at - step // 2) % SAMPLES] + profile[(at + step // 2) % SAMPLES])
    return at, float(profile[at % SAMPLES] - beside)


def _weight(runs: Sequence[TickRun]) -> float:
    """Return the weight of several runs."""
    return sum(run.weight for run in runs)


def _apart(run: TickRun, ends_rad: tuple[float, float]) -> float:
    """Return the larger of the angular distances between the ends."""
    return max(abs(_off(one, other)) for one, other in zip(run.ends_rad, ends_rad, strict=True))


def _off(angle_rad: float, other_rad: float) -> float:
    """Return the angular difference, wrapped to half a turn either way."""
    return float((angle_rad - other_rad + np.pi) % (2 * np.pi) - np.pi)
