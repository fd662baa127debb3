"""Position of a slider's printed or milled slot in a patch, by its two ends.

The pose of the panel in a close-up with few registered edges may be wrong by some millimetres at the slider. A cap is
therefore read relative to the middle of its own slot, which has the same error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.panel import Slider
from perception.vision.patch import Patch
from perception.vision.status.choice import contrast_noise

INSIDE_M = 0.0008  # half of the strip along the slot's middle that is averaged; narrower than a slot
BOX_M = 0.0012  # length of the two boxes whose difference is the contrast of an end
STEP_M = 0.0001
REACH_M = 0.005  # search to each side of an end; more than an error of the pose
PLACED_M = 0.002  # largest shift where the plate's border was seen; what is further is no end of this slot
LEAST_NOISES, LEAST_SHARE = 4.0, 0.5  # least contrast of an end in sigmas of its noise, and relative to the other end
# Largest half of the difference between the length of the slot and that of the file, and the same per length.
UNEQUAL_M, UNEQUAL_SHARE = 0.0007, 0.005
CAP_ROOM_M = 0.003  # an end nearer to the cap than this may be the edge of the cap or of its shadow
BOTH_SIGMA_M = 0.0002  # with both ends; the cap's own building tolerance
# With both ends of a slot that ends before the cap does, so that only their likeness tells them from other edges.
SHORT_SIGMA_M, SHORT_SHARE = 0.0003, 0.7
ONE_SIGMA_M = 0.0005  # with one end, as the file does not state by how much the slot is longer than the way
NONE_SIGMA_M = 0.0008  # without one, where the cap hides both: RMS error of 43 registered close-ups on random panels
# With an end that is not where it should be seen, within the reach of the search: then the pose is wrong by more, as that of
# a panel that has just been moved.
MISSED_SIGMA_M = 0.003


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackShift:
    """Displacement of the slot along the track from its expected place in the patch, with one standard deviation, m."""

    shift_m: float
    sigma_m: float


def track_shift(patch: Patch, spec: Slider, *, cap_m: float, is_open: Callable[[float], bool]) -> TrackShift:
    """Return how far the slot lies from where the patch should show it; zero with a large sigma if no end is found.

    Args:
        cap_m: place of the cap on the track, which may hide one end.
        is_open: whether nothing lies across the track near a place, m.
    """
    half_m = (spec.travel_m + spec.cap_size_m[0]) / 2
    room_m = spec.cap_size_m[0] / 2 + abs(patch.growth_per_m) * spec.cap_size_m[2] * half_m + CAP_ROOM_M
    sides = [sign for sign in (-1.0, 1.0) if abs(sign * half_m - cap_m) > room_m]
    profiles = [_contrast(patch, spec, sign * half_m) for sign in sides]
    least = LEAST_NOISES * contrast_noise(patch)
    seen = max((_ends(profiles, shade, least) for shade in (1.0, -1.0)), key=_weakest)
    most_m = PLACED_M if patch.is_placed else REACH_M + BOX_M
    unequal_m = UNEQUAL_M + UNEQUAL_SHARE * half_m
    if len(seen) == 2:
        (low_m, low_contrast), (high_m, high_contrast) = seen
        ratio = low_contrast / high_contrast
        shift_m, longer_m = (low_m + high_m) / 2, (high_m - low_m) / 2
        alike, is_near = min(ratio, 1.0 / ratio), abs(shift_m) <= most_m
        if is_near and alike >= LEAST_SHARE and abs(longer_m) <= unequal_m:
            return TrackShift(shift_m=shift_m, sigma_m=BOTH_SIGMA_M)
        is_clear = all(is_open(at) and abs(at - cap_m) > room_m for at in (low_m - half_m, high_m + half_m))
        is_short = patch.is_placed and -spec.cap_size_m[0] / 2 <= longer_m < 0.0
        if is_near and alike >= SHORT_SHARE and is_clear and is_short:
            return TrackShift(shift_m=shift_m, sigma_m=SHORT_SIGMA_M)
    elif len(sides) == len(seen) == 1 and abs(seen[0][0]) <= most_m:
        may_be_short = patch.is_placed and -sides[0] * seen[0][0] > unequal_m
        if not may_be_short:
            return TrackShift(shift_m=seen[0][0], sigma_m=ONE_SIGMA_M)
    return TrackShift(shift_m=0.0, sigma_m=MISSED_SIGMA_M if sides and not patch.is_placed else NONE_SIGMA_M)


def _contrast(patch: Patch, spec: Slider, end_m: float) -> tuple[Array, Array]:
    """Return how much brighter the plate beyond is than the slot before (N,), by the displacement from `end_m` (N,), m."""
    s = end_m + np.sign(end_m) * np.arange(-REACH_M - BOX_M, REACH_M + BOX_M + STEP_M / 2, STEP_M)
    across = np.linspace(-INSIDE_M, INSIDE_M, 5)
    c, sin = np.cos(spec.angle_rad), np.sin(spec.angle_rad)
    x, y = s[:, None] * c - across * sin, s[:, None] * sin + across * c
    gray = np.asarray(patch.sample(x, y, 0.0).mean(axis=1), float)
    n = round(BOX_M / STEP_M)
    total = np.concatenate([[0.0], np.cumsum(gray)])
    at = np.arange(n, len(gray) - n + 1)
    return s[at] - end_m - np.sign(end_m) * STEP_M / 2, (total[at + n] - 2.0 * total[at] + total[at - n]) / n


def _ends(profiles: list[tuple[Array, Array]], shade: float, least: float) -> list[tuple[float, float]]:
    """Return the displacement and the contrast of every end of a slot that is darker (1) or brighter (-1) than the plate."""
    ends = [(at, shade * contrast) for at, contrast in profiles]
    return [(float(at[k]), float(c[k])) for at, c in ends for k in [int(c.argmax())] if c[k] >= least]


def _weakest(ends: list[tuple[float, float]]) -> tuple[int, float]:
    """Return by what ends are compared: their number, and their least contrast."""
    return len(ends), min((contrast for _, contrast in ends), default=0.0)
