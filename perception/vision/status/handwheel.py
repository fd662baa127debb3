"""Reader of handwheels: the phase of all spokes gives the angle within one spacing, the marked spoke its spacing."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.panel import Handwheel
from perception.vision.image import WHITE_LEVEL
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, gated, probability, refused
from perception.vision.status.choice import contrast_noise
from perception.vision.status.pointer import unroll, wrapped
from perception.vision.status.reader import Reader
from perception.vision.status.wheel_rim import middle_of, rim_gray, unlike

STEPS = 720
GLARE = 0.25  # share of the radius; marks are smaller
RIVAL_STEPS = 30  # 15 degrees: farther away than any part of the same spoke
# Of 330 synthetic wheels that were read correctly 97 % have less; of those misread with a confidence above 0.85 all
# exceed 0.61.
RIVAL_SHARE = 0.55
# Share of the spokes' contrast by which a marked spoke differs from gaps and other spokes. Of 405 wheels read
# correctly four have less; of seven misread ones four, whose mark a cable or glare hides: the selected spoke may be
# unmarked.
LEAST_BEYOND, FAINT = 0.65, 0.7
SPOKE_SHARE = 0.3  # share of the clearest spoke's contrast; weaker spokes are hidden or in glare
# Steps: shift of a spoke by an offset of the wheel, and deviation from a complete wheel
MOST_MOVED, MOST_UNLIKE = 10.0, 3.0
EVERY = 8  # steps between the directions at which gaps are evaluated
SINGLE_SIGMA_RAD = 0.017  # of one spoke's angle: 22 views of six simulated wheels have 0.019 rms
BESIDE = 28  # steps: 14 degrees, outside a spoke and its mark


def read_handwheel(patch: Patch, spec: Handwheel) -> PatchReading:
    """Return the angle of the marked spoke, rad clockwise from straight up, -pi to pi.

    `patch` shows the wheel's plane.
    """
    R, n = spec.radius_m + spec.rim_m, spec.spokes
    angles = 2 * np.pi * np.arange(STEPS) / STEPS
    spoke = unroll(patch, (0.0, 0.0), np.linspace(0.42, 0.72, 8) * R, angles)
    mark = unroll(patch, (0.0, 0.0), np.linspace(0.45, 0.97, 12) * R, angles)
    seen = patch.seen(
        np.outer([0.5, 0.7, 0.9], np.sin(angles[::20])) * R, np.outer([0.5, 0.7, 0.9], np.cos(angles[::20])) * R
    )
    if seen < 0.4:
        return refused("the wheel cannot be seen (glare, shadow or cover): change the angle or the light", unit="rad")
    noise = contrast_noise(patch)
    glare = _glare(patch, R)
    dazzled = unroll(glare, (0.0, 0.0), np.linspace(0.42, 0.72, 8) * R, angles) > 0.2
    shown = np.where(dazzled & ~dazzled.all(axis=1, keepdims=True), np.nan, spoke) if dazzled.any() else spoke
    ink = np.median(np.where(dazzled, 0.0, np.abs(spoke - _gaps(shown, n))), axis=0)
    window = STEPS // 60
    ink = _smooth(ink, window)
    folded = _fold(ink, n)
    phase_step = int(folded.argmax())
    contrast = float(folded.max() - np.median(folded))
    phase = _centred(ink, _peak(folded, phase_step), n) * 2 * np.pi / STEPS
    places = phase + 2 * np.pi * np.arange(n) / n
    profile = np.array([_at(mark, p) for p in places])
    drowned = unroll(glare, (0.0, 0.0), np.linspace(0.45, 0.97, 12) * R, angles)
    profile = np.where(np.array([_at_most(drowned, p) for p in places]) > 0.2, np.nan, profile)
    if n > 2:
        deviation = np.array([_mark_evidence(profile, k) for k in range(n)])
    else:  # each of two spokes differs from the other as much, but only the unmarked one has the colour of the rim
        inside, gray = np.linspace(0.45, 0.97, 12) * R < spec.radius_m - spec.rim_m, rim_gray(patch, spec, angles)
        deviation = np.array([unlike(mark[inside], round(p / (2 * np.pi) * STEPS), gray) for p in places])
    best = int(deviation.argmax())
    second = float(np.sort(deviation)[-2]) if n > 1 else 0.0
    if contrast < noise or deviation[best] < 2 * noise:
        return refused("no marked spoke stands out: come closer or add light", unit="rad")
    confidence = probability(
        [
            (np.log(contrast / noise), np.log(1.5), 0.3),
            (np.log((second + noise) / (deviation[best] + noise)), np.log(0.7), -0.12),
            (seen, 0.55, 0.1),
            # A missing rival must not raise the confidence
            (min(RIVAL_SHARE - _rival(folded, phase_step), 0.0), 0.0, 0.03),
        ]
    )
    if n > 2 and _beyond(profile, best) < LEAST_BEYOND * contrast:
        confidence *= FAINT
    sigma = max(0.35 / (patch.image_px_per_m * 0.6 * R * np.sqrt(n)), 0.5 / (patch.image_px_per_m * R))
    sigma = float(np.hypot(sigma, SINGLE_SIGMA_RAD / np.sqrt(n - 1)))
    angle_rad = float(wrapped(np.array(_by_unmarked(patch, R, places, best))))
    return gated(PatchReading(value=angle_rad, unit="rad", uncertainty=sigma, confidence=confidence))


def _by_unmarked(patch: Patch, R: float, places: Array, best: int) -> float:
    """Return the marked spoke's angle (rad) by the unmarked ones, about the middle of the rim.

    The light from above moves what is seen of the bright marked spoke by a quarter of its width, which is 0.1 rad of a
    small wheel. Where the other spokes are not all clear, the angle is that of the common phase.
    """
    n, half = len(places), min(STEPS // 12, STEPS // (4 * len(places)))
    spoke = unroll(patch, middle_of(patch, R), np.linspace(0.42, 0.72, 8) * R, 2 * np.pi * np.arange(STEPS) / STEPS)
    ink = _smooth(np.median(np.abs(spoke - _gaps(spoke, n)), axis=0), STEPS // 60)
    steps = np.round(np.delete(places, best) / (2 * np.pi) * STEPS).astype(int)
    centres = _centres(ink, steps, half)
    if centres is None or np.abs(centres - steps).max() > (MOST_MOVED if n > 2 else half):
        return float(places[best])
    exact = centres * 2 * np.pi / STEPS - np.delete(places, best)
    return float(places[best] + exact.mean())


def _gaps(spoke: Array | NDArray[np.float32], n: int) -> Array:
    """Return the background (radii, STEPS) between the spokes at every radius.

    It is the median over one spacing around every direction. The median over the whole turn would be wrong under uneven
    light, where the gap on the far side differs from it as much as a spoke does; it only replaces NaN.
    """
    coarse = spoke[:, ::EVERY]
    coarse = np.where(np.isnan(coarse), _median(spoke, axis=1)[:, None], coarse)
    span = round(coarse.shape[1] / n)
    turns = np.concatenate([coarse[:, -(span // 2) :], coarse, coarse[:, : span - span // 2 - 1]], axis=1)
    around = np.median(np.lib.stride_tricks.sliding_window_view(turns, span, axis=1), axis=2)
    return np.repeat(around, EVERY, axis=1)


def _median(values: Array | NDArray[np.float32], *, axis: int) -> Array:
    """Return the median of the known values; much faster than numpy's `nanmedian`."""
    return np.asarray((np.nanmedian if np.isnan(values).any() else np.median)(values, axis=axis), float)


def _smooth(values: Array, width: int) -> Array:
    """Return a periodic profile smoothed over `width` samples."""
    kernel = np.hanning(width + 2)[1:-1]
    padded = np.concatenate([values[-width:], values, values[:width]])
    return np.convolve(padded, kernel / kernel.sum(), "same")[width:-width]


def _fold(ink: Array, n: int) -> Array:
    """Return the mean over all spokes but the strongest, for every phase within one spacing; of two spokes over both."""
    period = STEPS / n
    steps = np.arange(int(period))
    if STEPS % n == 0:
        stacked = ink.reshape(n, -1)
    else:
        stacked = np.array([np.interp(steps + k * period, np.arange(STEPS), ink, period=STEPS) for k in range(n)])
    return np.asarray(np.sort(stacked, axis=0)[: n - 1 if n > 2 else n].mean(axis=0))


def _rival(folded: Array, top: int) -> float:
    """Return the score of the best clearly different phase relative to that of the phase at `top`."""
    n = len(folded)
    apart = np.abs((np.arange(n) - top + n // 2) % n - n // 2) > RIVAL_STEPS
    ground = float(np.median(folded))
    return (float(folded[apart].max()) - ground) / max(float(folded[top]) - ground, 1e-6)


def _peak(folded: Array, top: int) -> float:
    """Return the centre of mass of the peak, because spokes are wide and flat."""
    half = len(folded) // 4
    offsets = np.arange(-half, half + 1)
    values = folded[(top + offsets) % len(folded)]
    weight = np.maximum(values - (values.max() + values.min()) / 2, 0.0)
    return float(top + (weight * offsets).sum() / max(weight.sum(), 1e-9))


def _centred(ink: Array, phase: float, n: int) -> float:
    """Return the phase (steps) as the mean over all spokes, if all are visible and lie as on a complete wheel.

    If the wheel is displaced in the patch, some spokes appear rotated one way and others the other way, with mean zero;
    the fold only has what most of them share. A shift of 1 mm is 3 degrees at the spokes' middle. A cable or a shadow
    shifts only one spoke, or shifts it farther.
    """
    wanted = phase + STEPS / n * np.arange(n)
    places = np.round(wanted).astype(int)
    centres = _centres(ink, places, round(STEPS / n / 4))
    if centres is None:
        return phase
    moved = centres - wanted
    angles = 2 * np.pi * places / STEPS
    J = np.column_stack([np.ones(n), np.sin(angles), np.cos(angles)])
    unlike = moved - J @ np.linalg.lstsq(J, moved, rcond=None)[0]
    if np.abs(moved).max() > MOST_MOVED or np.abs(unlike).max() > MOST_UNLIKE:
        return phase
    return phase + float(moved.mean())


def _centres(ink: Array, steps: NDArray[np.int64], half: int) -> Array | None:
    """Return the centres of mass (steps) of the spokes within `half` of some steps; None if one is much fainter than others."""
    offsets = np.arange(-half, half + 1)
    windows = ink[(steps[:, None] + offsets) % STEPS]
    heights = windows.max(axis=1) - np.median(ink)
    if heights.min() <= SPOKE_SHARE * heights.max():
        return None
    weights = np.maximum(windows - 0.5 * (windows.max(axis=1) + windows.min(axis=1))[:, None], 0.0)
    return np.asarray(steps + (weights * offsets).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-9))


def _at(mark: NDArray[np.float32], angle: float) -> Array:
    """Return the gray of a spoke's strip relative to both sides, per radius."""
    step = round(angle / (2 * np.pi) * STEPS)
    near = mark[:, (step + np.arange(-6, 7)) % STEPS].mean(axis=1)
    beside = [mark[:, (step + side * BESIDE + np.arange(-4, 5)) % STEPS].mean(axis=1) for side in (-1, 1)]
    return np.asarray(near - (beside[0] + beside[1]) / 2, float)  # glare is on both sides as well, a mark is not


def _mark_evidence(profile: Array, k: int) -> float:
    """Return the largest difference (gray levels) of spoke `k` from the others that holds at two neighbouring radii."""
    rest = np.delete(profile, k, axis=0)
    known = np.isfinite(rest).any(axis=0) & np.isfinite(profile[k])
    others = _median(np.where(known, rest, 0.0), axis=0)
    difference = np.where(known, np.abs(profile[k] - others), 0.0)
    return float(np.minimum(difference[:-1], difference[1:]).max())


def _beyond(profile: Array, k: int) -> float:
    """Return by how much (gray levels) spoke `k` is outside the range of gaps and other spokes.

    It is the largest amount that holds at two neighbouring radii.
    """
    rest = np.nan_to_num(np.delete(profile, k, axis=0))
    over, under = profile[k] - rest.max(axis=0, initial=0.0), rest.min(axis=0, initial=0.0) - profile[k]
    beyond = np.nan_to_num(np.maximum(over, under)).clip(min=0.0)
    return float(np.minimum(beyond[:-1], beyond[1:]).max())


def _at_most(mask: NDArray[np.float32], angle: float) -> Array:
    """Return the largest value at a spoke and on both sides of it, at the places that `_at` samples."""
    step = round(angle / (2 * np.pi) * STEPS)
    return np.asarray(mask[:, (step + np.arange(-BESIDE - 4, BESIDE + 5)) % STEPS].max(axis=1), float)


def _glare(patch: Patch, radius_m: float) -> Patch:
    """Return a patch that is 1 where glare hides the wheel: saturated areas that are wider than any mark."""
    white = (patch.gray >= WHITE_LEVEL).astype(np.uint8)
    if not white.any():
        return replace(patch, gray=white)
    size = max(3, round(GLARE * radius_m * patch.px_per_m)) | 1
    round_ = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    wide = cv2.morphologyEx(white, cv2.MORPH_OPEN, round_)
    return replace(patch, gray=np.asarray(cv2.dilate(wide, np.ones((size // 2 | 1,) * 2, np.uint8)), np.uint8))


READER = Reader[Handwheel](read=read_handwheel, guesses_right=0.38)
