"""Sliders: the cap covers what lies to both sides of the slot."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.panel import Slider
from perception.vision.outline import footprint_m
from perception.vision.patch import Patch, sample_at
from perception.vision.reading import Status, gated, probability, refused
from perception.vision.status.choice import contrast_noise
from perception.vision.status.cover import covered
from perception.vision.view import Array

SIDE = (0.22, 0.32, 0.40)  # of the cap's width: beyond the slot, inside the cap


def read_slider(patch: Patch, spec: Slider) -> Status:
    """Value of a slider. `patch` shows the plane of the cap's top."""
    along, across = spec.cap_size_m[0], spec.cap_size_m[1]
    lo, hi = sorted((spec.scale.at_min, spec.scale.at_max))
    step = 1.0 / patch.px_per_m
    s = np.arange(lo - along, hi + along, step)
    left, right = (_profile(patch, spec.angle_rad, s, side * across * np.array(SIDE)) for side in (-1.0, 1.0))
    seen = float(np.mean([patch.seen(*_place(spec.angle_rad, s, np.array([o * across]))) for o in (-0.3, 0.3)]))
    if (
        float(
            np.mean(sample_at(patch.inside.astype(np.uint8), *patch.pixel_of(*_place(spec.angle_rad, s, np.zeros(1)))))
        )
        < 0.97
    ):
        return refused("part of the track is outside the image: move the camera", unit=spec.scale.unit)
    if seen < 0.4:
        return refused(
            "the slider cannot be seen (glare, shadow or cover): change the angle or the light", unit=spec.scale.unit
        )
    footprint = footprint_m(spec)
    lean_m = _base_shift_m(patch, spec)  # the foot of the cap shows on that side of its top
    width = max(3, round((along + abs(lean_m)) / step))
    kernel = np.ones(width) / width
    # The cap stands out and may lean over the footprint: look for what comes in from further away.
    lean_px = float(np.linalg.norm(patch.parallax_px_per_m)) * spec.cap_size_m[2]
    room_m = 0.004 + lean_px / patch.px_per_m
    cover = covered(patch, half_width_m=footprint[0] + room_m, half_height_m=footprint[1] + room_m, is_round=False)
    open_ = np.ones_like(s) if cover is None else _open(patch, cover, spec.angle_rad, s, 0.4 * across)
    if _is_cap(np.minimum(left, right), s, open_, along + abs(lean_m)):
        open_ = np.ones_like(s)
    best, best_profile = (-1.0, 0, np.zeros_like(s)), np.zeros_like(s)
    for is_dark in (True, False):
        both = np.minimum(_hat(left, width, is_dark), _hat(right, width, is_dark)) * open_
        both = _closed(both, 0.45 * along / step)  # a cap may carry a line across its middle
        score = np.convolve(both, kernel, "same")
        score[(s - lean_m / 2 < lo - 2 * step) | (s - lean_m / 2 > hi + 2 * step)] = 0.0
        top = int(score.argmax())
        if score[top] > best[0]:
            best, best_profile = (float(score[top]), top, score), both
    peak, top, score = best
    noise = contrast_noise(patch)
    apart = np.abs(s - s[top]) > 1.2 * along
    rival = float(score[apart].max()) if apart.any() else 0.0
    if peak < 2.0 * noise:
        return refused("no cap stands out on the track: come closer or add light", unit=spec.scale.unit)
    place = float(np.clip(_cap_middle(best_profile, top, s, along_m=along, lean_m=lean_m), lo, hi))
    slope = abs(spec.scale.value_at(place + 1e-4) - spec.scale.value_at(place - 1e-4)) / 2e-4
    confidence = probability(
        [
            (np.log(peak / noise), np.log(3.0), 0.3),
            (np.log((rival + noise) / (peak + noise)), np.log(0.7), -0.12),
            (seen, 0.55, 0.1),
        ]
    )
    return gated(
        Status(
            value=spec.scale.value_at(place),
            unit=spec.scale.unit,
            uncertainty=slope * 0.5 / patch.image_px_per_m,
            confidence=confidence,
        )
    )


def _is_cap(profile: Array, s: Array, open_: Array, width_m: float) -> bool:
    """Is what seems to lie across the track the cap itself? A dark cap runs into printed ticks of the same gray.

    The cap is as long as the panel file says, and it is the only thing that stands out there.
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
    length_m = float(s[touched[0][-1]] - s[touched[0][0]])
    return abs(length_m - width_m) < 0.3 * width_m


def _hat(profile: Array, width: int, is_dark: bool) -> Array:
    """What is narrower than twice the cap stands out; glare and shadow do not."""
    size = round(2.6 * width) | 1
    padded = np.pad(profile, size, mode="edge").astype(np.float32)[None]
    operation = cv2.MORPH_BLACKHAT if is_dark else cv2.MORPH_TOPHAT
    hat = cv2.morphologyEx(padded, operation, np.ones((1, size), np.uint8))[0, size:-size]
    return np.asarray(np.maximum(hat - np.median(hat), 0.0), float)


def _closed(profile: Array, width: float) -> Array:
    kernel = np.ones((1, max(3, round(width)) | 1), np.uint8)
    return np.asarray(cv2.morphologyEx(profile.astype(np.float32)[None], cv2.MORPH_CLOSE, kernel)[0], float)


def _open(patch: Patch, cover: NDArray[np.bool_], angle_rad: float, s: Array, across_m: float) -> Array:
    """1 where nothing lies across the track, else 0."""
    u, v = patch.pixel_of(*_place(angle_rad, s, np.linspace(-1.0, 1.0, 5) * across_m))
    return np.asarray(sample_at(cover.astype(np.uint8), u, v).max(axis=1) < 0.3, float)


def _base_shift_m(patch: Patch, spec: Slider) -> float:
    """How far along the track the foot of the cap appears beside its top in the patch, m."""
    u, v = -patch.parallax_px_per_m * spec.cap_size_m[2] / patch.px_per_m
    return float(u * np.cos(spec.angle_rad) - v * np.sin(spec.angle_rad))


def _place(angle_rad: float, s: Array, across: Array) -> tuple[Array, Array]:
    c, n = np.cos(angle_rad), np.sin(angle_rad)
    return s[:, None] * c - across * n, s[:, None] * n + across * c


def _profile(patch: Patch, angle_rad: float, s: Array, across: Array) -> Array:
    return np.asarray(patch.sample(*_place(angle_rad, s, across)).mean(axis=1), float)


def _cap_middle(profile: Array, top: int, s: Array, *, along_m: float, lean_m: float) -> float:
    """Middle of the cap's top from the edges of what stands out.

    Where the cap leans towards one side its wall shows there, in its own gray: then only the other edge is the top's.
    """
    near = slice(max(0, top - 2), top + 3)
    half = 0.5 * float(np.median(profile[near]) or profile[top])
    first, last = top, top
    while first > 0 and profile[first - 1] > half:
        first -= 1
    while last < len(profile) - 1 and profile[last + 1] > half:
        last += 1
    low = s[first] - _part(profile, first, first - 1, half) * (s[1] - s[0])
    high = s[last] + _part(profile, last, last + 1, half) * (s[1] - s[0])
    if abs(lean_m) < 0.1 * along_m:
        return float((low + high - lean_m) / 2)
    return float(low + along_m / 2 if lean_m > 0 else high - along_m / 2)


def _part(profile: Array, inside: int, outside: int, level: float) -> float:
    """How far between two samples the profile crosses a level."""
    if not 0 <= outside < len(profile):
        return 0.0
    drop = profile[inside] - profile[outside]
    return float(np.clip((profile[inside] - level) / drop, 0.0, 1.0)) if drop > 0 else 0.5
