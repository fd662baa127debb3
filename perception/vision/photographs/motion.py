"""Needles that move: the sector that one sweeps while a picture is taken, and its motion over several pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from perception.vision.bilinear import polar_values
from perception.vision.reading import Motion, PatchReading, SeenScale, refused
from perception.vision.status.pointer import PointerFit

SECTOR_RAD = np.deg2rad(np.linspace(-60.0, 60.0, 241))  # about a pointer's direction
NEAR_RAD = np.deg2rad(4.0)
SMOOTHED = 5  # of these directions
BANDS = ((0.26, 0.38), (0.38, 0.5))  # shares of the radius: beyond the hub's cap, before most numerals
BAND_RADII = 8
# Share of a pointer's ink that counts, because a swinging needle stays longest where it turns round, and the angles over which
# it reaches in the two bands when it swings. Of 97 drawn needles at rest one reaches nearly so far; of those that swing by 4 to
# 6 % of the scale three in four do, if anything is taken for a pointer.
PLATEAU, SWEPT_RAD = 0.25, np.deg2rad([30.0, 18.0])
LEAST_SHARE = 0.5  # of the pictures of a series, which must be read
MOST_SHARE = 0.5  # of those, in which a display must show one text for that to be the answer


def is_swept(gray: Image, fit: PointerFit, u: float, v: float, radius: float) -> bool:
    """Return whether a pointer sweeps a sector while the picture is taken: it has ink over more than its own width.

    Args:
        gray: (H, W) uint8.
        fit: the pointer, or the end of the sector that was taken for it.
        u, v, radius: the dial in it, px.
    """
    turns = fit.angle_rad + SECTOR_RAD
    directions = np.ascontiguousarray(np.stack([np.sin(turns), -np.cos(turns)]))
    swept = [
        _extent_rad(
            polar_values(gray, (u, v), np.linspace(*band, BAND_RADII) * radius, directions), is_dark=fit.is_dark
        )
        for band in BANDS
    ]
    return bool((np.array(swept) >= SWEPT_RAD).all())


def _extent_rad(seen: NDArray[np.float32], *, is_dark: bool) -> float:
    """Return the angle about a pointer over which its ink reaches; `seen` are gray levels (radii, directions) about it."""
    mean = seen.mean(axis=0)
    ink = np.convolve((np.median(mean) - mean) * (1.0 if is_dark else -1.0), np.ones(SMOOTHED) / SMOOTHED, "same")
    near = np.flatnonzero(np.abs(SECTOR_RAD) < NEAR_RAD)
    middle = int(near[ink[near].argmax()])
    bare = np.flatnonzero(ink < PLATEAU * ink[middle])
    first, last = bare[bare < middle], bare[bare > middle]
    ends = SECTOR_RAD[[int(first[-1]) if len(first) else 0, int(last[0]) if len(last) else -1]]
    return float(ends[1] - ends[0])


def over_pictures(readings: Sequence[PatchReading]) -> PatchReading:
    """Return the mean of the readings of one instrument in several pictures, with its motion.

    Pictures that are refused, or in which another scale was read, do not count. A display's text is the one
    that most of them show, and its number is the value then.

    Args:
        readings: oldest first.
    """
    usual = Counter(_ends(reading.scale) for reading in readings if reading.value is not None).most_common(1)
    used = [k for k, one in enumerate(readings) if one.value is not None and _ends(one.scale) == usual[0][0]]
    if len(used) < max(2, LEAST_SHARE * len(readings)):
        why = next((one.reason for one in readings if one.reason), "they show different scales")
        return refused(f"only {len(used)} of {len(readings)} pictures can be read; the others: {why}")
    last = readings[used[-1]]
    turn = _turn(last.scale)
    values = np.array([readings[k].value for k in used], float)
    values = values if turn is None else np.unwrap(values, period=turn)
    trend, start = np.polyfit(used, values, 1)
    rest = values - trend * np.array(used) - start
    sigmas = np.array([readings[k].uncertainty or 0.0 for k in used])
    mean = float(values.mean() if turn is None else values.mean() % turn)
    text, times = Counter(readings[k].text for k in used).most_common(1)[0]
    is_shown = text is not None and times > MOST_SHARE * len(used)
    if is_shown:
        mean = next(float(readings[k].value or 0.0) for k in used if readings[k].text == text)
    return replace(
        last, value=mean, text=text if is_shown else None,
        uncertainty=float(np.sqrt((np.mean(sigmas**2) + rest.var()) / len(used))),
        confidence=float(np.median([readings[k].confidence for k in used])),
        motion=Motion(
            values=tuple(one.value if k in used else None for k, one in enumerate(readings)),
            amplitude=0.5 * float(np.ptp(rest)), trend=float(trend),
        ),
    )  # fmt: skip


def _ends(scale: SeenScale | None) -> tuple[float, float] | None:
    return None if scale is None else (scale.minimum, scale.maximum)


def _turn(scale: SeenScale | None) -> float | None:
    """Return the value of a full turn of a scale that is one."""
    return None if scale is None or not scale.is_full_turn else scale.maximum - scale.minimum
