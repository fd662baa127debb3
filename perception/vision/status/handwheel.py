"""Reader of handwheels: the phase of all spokes gives the angle within one spacing, the marked spoke its spacing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.panel import Handwheel
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, gated, probability, refused
from perception.vision.status.choice import contrast_noise
from perception.vision.status.pointer import unroll, wrapped
from perception.vision.status.reader import Reader

STEPS = 720
# Share of the spokes' contrast by which a marked spoke differs from gaps and other spokes. Of 405 wheels read
# correctly four have less; of seven misread ones four, whose mark a cable or glare hides: the selected spoke may be
# unmarked.
LEAST_BEYOND, FAINT = 0.65, 0.7
SPOKE_SHARE = 0.3  # share of the clearest spoke's contrast; weaker spokes are hidden or in glare
MOST_MOVED = 10.0  # steps: shift of a spoke by an offset of the wheel
ANGLES = 2 * np.pi * np.arange(STEPS) / STEPS
SPOKE, MARK = (
    np.linspace(0.42, 0.72, 8),
    np.linspace(0.45, 0.97, 12),
)  # radii of spokes and of their marks, over the wheel's
SMOOTHED = 12  # steps
EVERY = 8  # steps between the directions at which gaps are evaluated
SINGLE_SIGMA_RAD = 0.017  # of one spoke's angle: 22 views of six simulated wheels have 0.019 rms
BESIDE = 28  # steps: 14 degrees, outside a spoke and its mark
# Search for the middle of the rim
DIRECTIONS = 72
NEAR = 0.18  # share of the radius within which the rim's edge is searched
EDGE = 4  # samples between the two whose difference is the slope of the gray
STRONG = 0.5  # share of the usual slope; weaker edges are hidden
KEPT = 2.5  # times the usual residual; farther edges are of something else
LEAST_KEPT = 0.6  # share of the directions that must agree
ROUNDS = 4


def read_handwheel(patch: Patch, spec: Handwheel) -> PatchReading:
    """Return the angle of the marked spoke, rad clockwise from straight up, -pi to pi.

    `patch` shows the wheel's plane.
    """
    R, n = spec.radius_m + spec.rim_m, spec.spokes
    spoke = unroll(patch, (0.0, 0.0), SPOKE * R, ANGLES)
    mark = unroll(patch, (0.0, 0.0), MARK * R, ANGLES)
    a, r = ANGLES[::20], R * np.array([[0.5], [0.7], [0.9]])
    seen = patch.seen(r * np.sin(a), r * np.cos(a))
    if seen < 0.4:
        return refused("the wheel cannot be seen (glare, shadow or cover): change the angle or the light", unit="rad")
    noise = contrast_noise(patch)
    ink = _ink(spoke, n)
    folded = _fold(ink, n)
    contrast = float(folded.max() - np.median(folded))
    phase = _peak(folded, int(folded.argmax())) * 2 * np.pi / STEPS
    places = phase + 2 * np.pi * np.arange(n) / n
    profile = np.array([_at(mark, p) for p in places])
    if n > 2:
        others = (np.median(np.delete(profile, k, axis=0), axis=0) for k in range(n))
        deviation = np.array([_held(np.abs(own - rest)) for own, rest in zip(profile, others, strict=True)])
    else:  # each of two spokes differs from the other as much, but only the unmarked one has the colour of the rim
        rim = unroll(patch, (0.0, 0.0), spec.radius_m + spec.rim_m * np.linspace(-0.5, 0.5, 5), ANGLES)
        near = [
            mark[spec.radius_m - spec.rim_m > MARK * R][:, (_step(p) + np.arange(-3, 4)) % STEPS].mean(axis=1)
            for p in places
        ]
        deviation = np.array([_held(np.abs(gray - float(np.median(rim)))) for gray in near])
    best = int(deviation.argmax())
    second = float(np.sort(deviation)[-2]) if n > 1 else 0.0
    if contrast < noise or deviation[best] < 2 * noise:
        return refused("no marked spoke stands out: come closer or add light", unit="rad")
    confidence = probability(
        [
            (np.log(contrast / noise), np.log(1.5), 0.3),
            (np.log((second + noise) / (deviation[best] + noise)), np.log(0.7), -0.12),
            (seen, 0.55, 0.1),
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
    ink = _ink(unroll(patch, _middle_of(patch, R), SPOKE * R, ANGLES), n)
    steps = np.round(np.delete(places, best) / (2 * np.pi) * STEPS).astype(int)
    offsets = np.arange(-half, half + 1)
    windows = ink[(steps[:, None] + offsets) % STEPS]
    heights = windows.max(axis=1) - np.median(ink)
    weights = np.maximum(windows - 0.5 * (windows.max(axis=1) + windows.min(axis=1))[:, None], 0.0)
    moved = (weights * offsets).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-9)
    if heights.min() <= SPOKE_SHARE * heights.max() or np.abs(moved).max() > (MOST_MOVED if n > 2 else half):
        return float(places[best])
    exact = (steps + moved) * 2 * np.pi / STEPS - np.delete(places, best)
    return float(places[best] + exact.mean())


def _ink(spoke: NDArray[np.float32], n: int) -> Array:
    """Return how much the gray of every direction (STEPS,) differs from the gaps between `n` spokes, smoothed.

    The gray of the gaps is the median over one spacing around every direction. The median over the whole turn would be
    wrong under uneven light, where the gap on the far side differs from it as much as a spoke does.
    """
    coarse = spoke[:, ::EVERY]
    span = round(coarse.shape[1] / n)
    turns = np.concatenate([coarse[:, -(span // 2) :], coarse, coarse[:, : span - span // 2 - 1]], axis=1)
    gaps = np.median(np.lib.stride_tricks.sliding_window_view(turns, span, axis=1), axis=2)
    ink = np.median(np.abs(spoke - np.repeat(gaps, EVERY, axis=1)), axis=0)
    kernel = np.hanning(SMOOTHED + 2)[1:-1]
    padded = np.concatenate([ink[-SMOOTHED:], ink, ink[:SMOOTHED]])
    return np.convolve(padded, kernel / kernel.sum(), "same")[SMOOTHED:-SMOOTHED]


def _fold(ink: Array, n: int) -> Array:
    """Return the mean over all spokes but the strongest, for every phase within one spacing; of two spokes over both."""
    period = STEPS / n
    steps = np.arange(int(period))
    if STEPS % n == 0:
        stacked = ink.reshape(n, -1)
    else:
        stacked = np.array([np.interp(steps + k * period, np.arange(STEPS), ink, period=STEPS) for k in range(n)])
    return np.asarray(np.sort(stacked, axis=0)[: n - 1 if n > 2 else n].mean(axis=0))


def _peak(folded: Array, top: int) -> float:
    """Return the centre of mass of the peak, because spokes are wide and flat."""
    half = len(folded) // 4
    offsets = np.arange(-half, half + 1)
    values = folded[(top + offsets) % len(folded)]
    weight = np.maximum(values - (values.max() + values.min()) / 2, 0.0)
    return float(top + (weight * offsets).sum() / max(weight.sum(), 1e-9))


def _at(mark: NDArray[np.float32], angle: float) -> Array:
    """Return the gray of a spoke's strip relative to both sides, per radius."""
    step = _step(angle)
    near = mark[:, (step + np.arange(-6, 7)) % STEPS].mean(axis=1)
    beside = [mark[:, (step + side * BESIDE + np.arange(-4, 5)) % STEPS].mean(axis=1) for side in (-1, 1)]
    return np.asarray(near - (beside[0] + beside[1]) / 2, float)  # glare is on both sides as well, a mark is not


def _step(angle: float) -> int:
    return round(angle / (2 * np.pi) * STEPS)


def _beyond(profile: Array, k: int) -> float:
    """Return by how much (gray levels) spoke `k` is outside the range of gaps and other spokes."""
    rest = np.delete(profile, k, axis=0)
    over, under = profile[k] - rest.max(axis=0, initial=0.0), rest.min(axis=0, initial=0.0) - profile[k]
    return _held(np.maximum(over, under).clip(min=0.0))


def _held(difference: Array) -> float:
    """Return the largest difference that holds at two neighbouring radii."""
    return float(np.minimum(difference[:-1], difference[1:]).max())


def _middle_of(patch: Patch, radius_m: float) -> tuple[float, float]:
    """Return the middle (m) of a circle of about this radius whose edge is visible, or (0, 0) where there is none."""
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    radii = np.linspace(1.0 - NEAR, 1.0 + NEAR, 73) * radius_m
    gray = np.asarray(unroll(patch, (0.0, 0.0), radii, angles), float)
    third = len(radii) // 3
    slope = (gray[EDGE:] - gray[:-EDGE]) * np.sign(np.median(gray[-third:]) - np.median(gray[:third]))
    edges = (0.5 * (radii[EDGE:] + radii[:-EDGE]))[slope.argmax(axis=0)]
    strength = slope.max(axis=0)
    kept = strength > STRONG * np.median(strength)
    J = np.column_stack([np.ones(DIRECTIONS), np.sin(angles), np.cos(angles)])
    circle = np.zeros(3)
    for _ in range(ROUNDS):
        if kept.sum() < LEAST_KEPT * DIRECTIONS:
            return 0.0, 0.0
        circle = np.linalg.lstsq(J[kept], edges[kept], rcond=None)[0]
        off = np.abs(edges - J @ circle)
        kept = off < max(0.02 * radius_m, KEPT * float(np.median(off[kept])))
    return float(circle[1]), float(circle[2])


READER = Reader[Handwheel](read=read_handwheel, guesses_right=0.38)
