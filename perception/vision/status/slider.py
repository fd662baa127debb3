"""Reader of sliders: the cap is found where it covers both sides of the slot."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from hal.arrays import Array
from hal.panel import Slider
from perception.vision.image import WHITE_LEVEL
from perception.vision.patch import Patch, sample_at
from perception.vision.reading import ANSWER_AT, PatchReading, doubted, gated, probability, refused
from perception.vision.status.choice import contrast_noise
from perception.vision.status.occluder_bands import lying_across
from perception.vision.status.reader import Reader
from perception.vision.status.track import BOX_M, track_shift

SLOT = 0.2  # share of the cap's width: half of the slot plus its blur
EDGE_BOX = 0.22  # share of the cap's length; a line across its middle is farther than this from its edges
LEAST_INSIDE = 0.8  # share of the track that must be in the image
LEAST_OPEN = 0.4  # share of a box that must not be occluded
SLACK = 0.12  # share of the cap's length by which a cap may differ from its nominal length
NEXT_TO = 0.4  # share of the cap's length: tolerance for two caps sharing an edge
SAME_EDGE = 1.25  # times the cap's weaker edge
#: Line across a cap's middle, in cap lengths: half of its averaged width, and distance and width of its flanks.
LINE, LINE_FLANK, LINE_WIDTH = 0.05, 0.15, 0.10
# Share of the cap's length: largest distance from the middle of its edges, as its shadow may shift one of them.
LINE_NEAR = 0.17
# Least contrast of a line: in sigmas of the contrast's noise, and as a share of the cap's edge
LINE_NOISES, LINE_SHARE = 2.0, 0.15
LINE_SURE = 0.12  # in cap lengths from the middle of the edges: what lies further is often the edge of a cable
NO_LINE = 0.75  # of 12 caps in bad light without a visible line 8 were correct, because cables and glare resemble caps
RIGHT = 0.02  # share of the travel within which a reading is right
PLACE_PX = 0.35  # standard deviation of the middle of a cap, image px
BEYOND, MOST_BEYOND = 0.8, 0.4  # in cap widths from the track; share that may be as dark there
SIDES = np.linspace(-0.40, 0.40, 17)  # in cap widths: inside the cap


def read_slider(patch: Patch, spec: Slider) -> PatchReading:
    """Return the value of a slider. `patch` shows the plane of the cap's top."""
    along, across = spec.cap_size_m[0], spec.cap_size_m[1]
    lo, hi = sorted((spec.scale.at_min, spec.scale.at_max))
    step = 1.0 / patch.px_per_m
    s = np.arange(lo - along, hi + along, step)
    left, right = (_profile(patch, spec.angle_rad, s, side) for side in _beside_slot(patch, spec))
    seen = float(np.mean([patch.seen(*_place(spec.angle_rad, s, np.array([o * across]))) for o in (-0.3, 0.3)]))
    u, v = patch.pixel_of(*_place(spec.angle_rad, s, np.zeros(1)))
    inside = sample_at(patch.inside.astype(np.uint8), u, v)[:, 0]
    if float(inside.mean()) < LEAST_INSIDE:
        return refused("part of the track is outside the image: move the camera", unit=spec.scale.unit)
    lean_m = _base_shift_m(patch, spec, s)  # displacement of a cap's foot from its top in the image
    open_ = inside * _uncovered(patch, spec, s, np.minimum(left, right), float(np.median(lean_m)))
    found = _best_pair(left, right, s, open_, along_m=along, lean_m=lean_m, limits_m=(lo, hi))
    noise = contrast_noise(patch)
    unseen = (
        "the slider cannot be seen (glare, shadow or cover): change the angle or the light"
        if seen < 0.4
        else "no cap stands out on the track: come closer or add light"
    )
    if found.peak <= 0.0:
        return refused(unseen, unit=spec.scale.unit)
    least = max(LINE_NOISES * noise, LINE_SHARE * found.peak)
    line_m = _line(left, right, s, open_, near_m=found.place_m, along_m=along, least=least)
    cap_m = found.place_m if line_m is None else line_m
    is_open = _near(1.0 - open_, BOX_M / step) < 0.5
    track = track_shift(patch, spec, cap_m=cap_m, is_open=lambda at_m: float(np.interp(at_m, s, is_open)) > 0.99)
    place = float(np.clip(cap_m - track.shift_m, lo, hi))
    slope = abs(spec.scale.value_at(place + 1e-4) - spec.scale.value_at(place - 1e-4)) / 2e-4
    confidence = probability(
        [
            (np.log(found.peak / noise), np.log(3.0), 0.3),
            (np.log((found.rival + noise) / (found.peak + noise)), np.log(0.7), -0.12),
        ]
    )
    confidence *= float(inside.mean())  # the cap may be in the part of the track that is outside the image
    if line_m is None or abs(line_m - found.place_m) > LINE_SURE * along:
        confidence *= NO_LINE
    sigma_m = float(np.hypot(PLACE_PX / patch.image_px_per_m, track.sigma_m))
    # An uncertain place alone refuses nothing, because the answer states its uncertainty.
    near = float(erf(RIGHT * spec.travel_m / sigma_m / np.sqrt(2.0)))
    status = PatchReading(
        value=spec.scale.value_at(place),
        unit=spec.scale.unit,
        uncertainty=slope * sigma_m,
        confidence=max(confidence * near, min(confidence, ANSWER_AT)),
    )
    return gated(status) if found.peak >= 2.0 * noise else doubted(status, unseen)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Cap:
    """Middle of the cap's top, m along the track, and the contrasts of its weaker edge and of its best rival."""

    place_m: float
    peak: float
    rival: float


def _best_pair(
    left: Array, right: Array, s: Array, open_: Array, *, along_m: float, lean_m: Array, limits_m: tuple[float, float]
) -> _Cap:
    """Find the pair of opposite edges that are one cap length apart.

    Anything between them (a line, a highlight) is ignored. Every edge counts with the weaker of the two sides of the
    slot, and the pair with its weaker edge, because a tick or a label is on one side, and glare and shadow have one
    edge.
    """
    step = float(s[1] - s[0])
    low_shift, high_shift = along_m / 2 - np.minimum(lean_m, 0.0), along_m / 2 + np.maximum(lean_m, 0.0)
    box, slack = EDGE_BOX * along_m / step, SLACK * along_m / step
    falls = np.stack([_fall(side, open_, box) for side in (left, right)])
    hidden = np.isnan(falls[0])
    white = np.stack([_near((side >= WHITE_LEVEL).astype(float), box) for side in (left, right)])
    off = (s < limits_m[0] - SLACK * along_m) | (s > limits_m[1] + SLACK * along_m)
    sides: list[tuple[Array, Array, Array, Array]] = []
    for sign in (1.0, -1.0):
        into, out = (_both_sides(np.maximum(k * np.nan_to_num(falls), 0.0), white) for k in (sign, -sign))
        at_low, at_high = (
            np.interp(s + shift, s, _near(edge, slack)) for edge, shift in ((into, -low_shift), (out, high_shift))
        )
        no_low, no_high = (np.interp(s + shift, s, hidden) > 0.5 for shift in (-low_shift, high_shift))
        score = np.where(off | no_low | no_high, 0.0, np.minimum(at_low, at_high))
        # A candidate with one edge under a cable may also be the cap, so it is a rival with its visible edge alone.
        perhaps = np.where(no_low, np.where(no_high, 0.0, at_high), np.where(no_high, at_low, score))
        sides.append((score, np.where(off, 0.0, perhaps), into, out))
    (score, perhaps, into, out), other = sorted(sides, key=lambda side: -float(side[0].max()))
    top = int(score.argmax())
    if score[top] <= 0:
        return _Cap(place_m=0.0, peak=0.0, rival=0.0)
    apart = np.abs(s - s[top]) > 0.4 * along_m
    low = _crest(s, into, float(s[top] - low_shift[top]), SLACK * along_m)
    high = _crest(s, out, float(s[top] + high_shift[top]), SLACK * along_m)
    lean = float(lean_m[top])
    place = (low + high - lean) / 2
    if abs(lean) >= 0.1 * along_m:  # only one edge belongs to the top, the other to the foot
        place = low + along_m / 2 if lean > 0 else high - along_m / 2
    beside = np.abs(s - s[top]) > along_m  # the line across a cap's middle must not count as an edge of another cap
    whole = max(float(score[apart].max(initial=0.0)), float(other[0].max()))
    # One edge of a complete cap could also bound a neighbour of another gray whose far edge is hidden.
    next_to_it = np.abs(np.abs(s - s[top]) - along_m) < NEXT_TO * along_m
    elsewhere = np.where(next_to_it & (other[1] <= SAME_EDGE * score[top]), 0.0, other[1])
    rival = max(whole, *(float(partly[beside].max(initial=0.0)) for partly in (perhaps, elsewhere)))
    return _Cap(place_m=place, peak=float(score[top]), rival=rival)


def _line(
    left: Array, right: Array, s: Array, open_: Array, *, near_m: float, along_m: float, least: float
) -> float | None:
    """Return the position of the line across the cap's middle, m along the track.

    None if it is not visible on both sides. A cap casts a shadow of nearly its own gray to one side, which shifts that
    edge but not the line on its top.
    """
    step = float(s[1] - s[0])
    thin, far, wide = (max(1, round(k * along_m / step)) for k in (LINE, LINE_FLANK, LINE_WIDTH / 2))
    sides = []
    for side in (left, right):
        core, flank = (cv2.blur(side[None], (2 * n + 1, 1))[0] for n in (thin, wide))
        before, behind = np.roll(flank, far), np.roll(flank, -far)
        sides.append(
            (core - np.maximum(before, behind), np.minimum(before, behind) - core, core - (before + behind) / 2)
        )
    near = (np.abs(s - near_m) <= LINE_NEAR * along_m) & (_near(1.0 - open_, far + wide) < 0.5)
    bright, dark, bend = (np.stack(pair) for pair in zip(*sides, strict=True))
    ridges = [np.where(near, both.min(axis=0), 0.0) for both in (bright, dark)]
    sign, ridge = (1.0, ridges[0]) if ridges[0].max() >= ridges[1].max() else (-1.0, ridges[1])
    top = int(ridge.argmax())
    return _crest(s, sign * bend.sum(axis=0), float(s[top]), LINE * along_m) if ridge[top] >= least else None


def _fall(profile: Array, open_: Array, box: float) -> Array:
    """Return the decrease of gray at every place: mean over a box before it minus that behind it; NaN if occluded."""
    n = max(2, round(box))
    weight, gray = np.pad(open_, n, mode="edge"), np.pad(profile, n, mode="edge")
    count, total = (np.concatenate([[0.0], np.cumsum(x)]) for x in (weight, weight * gray))
    at = np.arange(len(profile)) + n
    before, behind = count[at] - count[at - n], count[at + n] - count[at]
    seen = np.minimum(before, behind) >= LEAST_OPEN * n
    means = [
        part / np.maximum(k, 1.0)
        for part, k in ((total[at] - total[at - n], before), (total[at + n] - total[at], behind))
    ]
    return np.asarray(np.where(seen, means[0] - means[1], np.nan))


def _near(profile: Array, reach: float) -> Array:
    """Return the running maximum within `reach` samples."""
    kernel = np.ones((1, 2 * max(1, round(reach)) + 1), np.uint8)
    return np.asarray(cv2.dilate(np.asarray(profile, np.float32)[None], kernel)[0], float)


def _both_sides(edges: Array, white: Array) -> Array:
    """Return the weaker (N,) of the two sides' edges, or the other side's edge where one side is saturated.

    On a saturated side an edge appears too weak.
    """
    weaker = edges.min(axis=0)
    blind = white > 0
    return np.asarray(np.where(blind[0] != blind[1], np.where(blind[0], edges[1], edges[0]), weaker))


def _crest(s: Array, edge: Array, at_m: float, reach_m: float) -> float:
    """Return the position of an edge signal's maximum within reach of a place, m."""
    near = np.flatnonzero(np.abs(s - at_m) <= reach_m + (s[1] - s[0]))
    k = int(near[edge[near].argmax()])
    if not 0 < k < len(s) - 1:
        return float(s[k])
    bend = edge[k - 1] - 2 * edge[k] + edge[k + 1]
    offset = 0.5 * (edge[k - 1] - edge[k + 1]) / bend if bend < 0 else 0.0
    return float(s[k] + np.clip(offset, -0.5, 0.5) * (s[1] - s[0]))


def _uncovered(patch: Patch, spec: Slider, s: Array, profile: Array, lean_m: float) -> Array:
    """Return 1 where nothing occludes the track, else 0."""
    # The cap stands out and may extend beyond the footprint, so occluders are searched for farther out.
    lean_px = float(np.linalg.norm(patch.parallax_px_per_m)) * spec.cap_size_m[2]
    room_m = 0.004 + lean_px / patch.px_per_m
    width, height = spec.half_footprint_m
    cover = lying_across(patch, half_width_m=width + room_m, half_height_m=height + room_m, is_round=False)
    if cover is None:
        return np.ones_like(s)
    open_ = _open(patch, cover, spec.angle_rad, s, 0.4 * spec.cap_size_m[1])
    beyond = [_profile(patch, spec.angle_rad, s, np.array([k * spec.cap_size_m[1]])) for k in (-BEYOND, BEYOND)]
    is_cap = _is_cap(profile, np.maximum(*beyond), s, open_, spec.cap_size_m[0] + abs(lean_m))
    return np.ones_like(s) if is_cap else open_


def _is_cap(profile: Array, beyond: Array, s: Array, open_: Array, width_m: float) -> bool:
    """Return whether the apparent occluder of the track is the cap itself, merged with printed ticks of the same gray.

    The cap has the length that the panel file states, it is the only thing that stands out there, and it ends on both
    sides.

    Args:
        profile, beyond: (N,) gray along the track on the cap's sides, and the brighter of the two strips beyond them.
    """
    shut = open_ < 0.5
    if not shut.any():
        return False
    level = 0.5 * (float(np.median(profile)) + float(profile.min()))
    dark = _closed((profile < level).astype(float), 0.3 * width_m / (s[1] - s[0])) > 0.5
    places = np.flatnonzero(dark)
    runs = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
    touched = [run for run in runs if len(run) > 2 and shut[run].any()]
    others = [run for run in runs if len(run) > 2 and not shut[run].any()]
    if len(touched) != 1 or others:
        return False
    if float((beyond[touched[0]] < level).mean()) > MOST_BEYOND:
        return False
    length_m = float(s[touched[0][-1]] - s[touched[0][0]])
    return abs(length_m - width_m) < 0.3 * width_m


def _closed(profile: Array, width: float) -> Array:
    """Return the profile after a morphological closing."""
    kernel = np.ones((1, max(3, round(width)) | 1), np.uint8)
    return np.asarray(cv2.morphologyEx(profile.astype(np.float32)[None], cv2.MORPH_CLOSE, kernel)[0], float)


def _open(patch: Patch, cover: NDArray[np.bool_], angle_rad: float, s: Array, across_m: float) -> Array:
    """Return 1 where nothing occludes the track, else 0."""
    u, v = patch.pixel_of(*_place(angle_rad, s, np.linspace(-1.0, 1.0, 5) * across_m))
    return np.asarray(sample_at(cover.astype(np.uint8), u, v).max(axis=1) < 0.3, float)


def _base_shift_m(patch: Patch, spec: Slider, s: Array) -> Array:
    """Return the displacement (N,), m along the track, of a cap's foot from its top in the image, at places `s` (N,).

    The foot is farther from the camera than the top, so it appears nearer to the point below the camera: seen from in
    front of the track's middle, a cap at its end leans by a millimetre.
    """
    u, v = -patch.parallax_px_per_m * spec.cap_size_m[2] / patch.px_per_m
    at_middle_m = float(u * np.cos(spec.angle_rad) - v * np.sin(spec.angle_rad))
    return np.asarray(at_middle_m - patch.growth_per_m * spec.cap_size_m[2] * s)


def _beside_slot(patch: Patch, spec: Slider) -> tuple[Array, Array]:
    """Return the distances across the track, m, at which the cap is searched for: inside the cap, and not on the slot.

    The slot lies deeper than the cap's top, so in an oblique view it appears displaced from the track's middle.
    """
    across = spec.cap_size_m[1]
    u, v = -patch.parallax_px_per_m * spec.cap_size_m[2] / patch.px_per_m
    slot = -float(u * np.sin(spec.angle_rad) + v * np.cos(spec.angle_rad))
    free = SIDES[np.abs(SIDES * across - slot) >= SLOT * across] * across
    left, right = free[free < slot], free[free >= slot]
    if min(len(left), len(right)) >= 3:
        return left, right
    return free[: len(free) // 2], free[len(free) // 2 :]


def _place(angle_rad: float, s: Array, across: Array) -> tuple[Array, Array]:
    """Return x, y of positions along the track and across it."""
    c, n = np.cos(angle_rad), np.sin(angle_rad)
    return s[:, None] * c - across * n, s[:, None] * n + across * c


def _profile(patch: Patch, angle_rad: float, s: Array, across: Array) -> Array:
    """Return the gray along the track, averaged over the distances `across`."""
    return np.asarray(patch.sample(*_place(angle_rad, s, across)).mean(axis=1), float)


READER = Reader[Slider](read=read_slider, guesses_right=0.38, side_m=0.012)
