"""Seven-segment displays by geometry: find the comb of digit cells, measure every segment, decode with a confidence.

1. Ink: white-hat for glowing segments, black-hat for dark ones: gradients and glare borders vanish.
2. The slant is the one that makes the columns of upright segments sharpest.
3. The comb (left edge, pitch, digit width) is searched on the profile of those rows that only upright segments cross.
4. Every segment of every cell gets a mean; lit and unlit separate around one threshold; each cell takes the character
   that explains its segments best, and the margin to the second best is the evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.panel import Display
from perception.vision.patch import Patch, sample_at
from perception.vision.reading import Status, gated, probability, refused
from perception.vision.view import Array

#: Segments in the order a b c d e f g: top, upper right, lower right, bottom, lower left, upper left, middle.
GLYPHS = {
    "0": "abcdef",
    "1": "bc",
    "2": "abged",
    "3": "abgcd",
    "4": "fgbc",
    "5": "afgcd",
    "6": "afgedc",
    "7": "abc",
    "8": "abcdefg",
    "9": "abcdfg",
    "-": "g",
    " ": "",
}
VARIANTS = (("7", "abcf"), ("6", "fgedc"), ("9", "abcfg"))
SEGMENTS = "abcdefg"

MARGIN = 0.09  # share of the smaller side that a frame may take
PITCHES = np.geomspace(1.22, 2.8, 34)  # of the digit width
SLANTS = np.tan(np.deg2rad(np.arange(-2.0, 16.1, 2.0)))

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Comb:
    """Digit cells in patch pixels, deslanted: `left_px` of the first, `pitch_px`, `width_px` between the axes of the
    upright segments, and the rows of the top and bottom segments' axes."""

    left_px: float
    pitch_px: float
    width_px: float
    top_px: float
    bottom_px: float
    count: int
    slant: float

    def column_px(self, cell: int) -> float:
        """Axis of the left upright segments of a cell."""
        return self.left_px + cell * self.pitch_px


def read_display(patch: Patch, spec: Display, *, digits_taught: bool = True) -> Status:
    """Text and value of a display. `patch` shows its window, origin at the middle.

    `digits_taught` False: number of digits and decimals are to be found in the picture.
    """
    window = _window(patch, spec)
    seen = float(((window[1]) & (window[0] < 250)).mean())
    if seen < 0.6:
        return refused(
            "the display cannot be seen (glare, shadow or cover): change the angle or the light", unit=spec.unit
        )
    return read_window(
        window[0],
        digits=spec.digits if digits_taught else None,
        decimals=spec.decimals if digits_taught else None,
        dark=spec.style == "lcd",
        unit=spec.unit,
        limits=(spec.minimum, spec.maximum),
        seen=seen,
    )


def read_window(
    gray: NDArray[np.uint8],
    *,
    digits: int | None,
    decimals: int | None,
    dark: bool | None,
    unit: str = "",
    limits: tuple[float, float] | None = None,
    seen: float = 1.0,
) -> Status:
    """Text of an upright window that shows nothing but the digits.

    Args:
        digits, decimals, dark: what is known; None lets the picture decide.
        limits: smallest and largest value possible.
    """
    best: tuple[float, str, float] | None = None
    for is_dark in (True, False) if dark is None else (dark,):
        ink = segment_ink(gray, is_dark)
        for count in range(1, 9) if digits is None else (digits,):
            found = _decode(ink, count, decimals)
            if found is not None and (best is None or found[0] > best[0]):
                best = found
    if best is None:
        return refused("no digits stand out: come closer, or change the angle or the light", unit=unit)
    _, text, margin = best
    try:
        value = float(text)
    except ValueError:
        return refused("the segments make no number: come closer, or change the angle or the light", unit=unit)
    if limits is not None and not limits[0] <= value <= limits[1]:
        return refused(f"the segments look like {text}, which is outside the display's range: look again", unit=unit)
    half_digit = 0.5 * 10.0 ** -(len(text.split(".")[1]) if "." in text else 0)
    confidence = probability([(margin, 0.12, 0.06), (seen, 0.75, 0.1)])
    return gated(Status(value=value, unit=unit, uncertainty=half_digit, text=text, confidence=confidence))


def segment_ink(gray: NDArray[np.uint8], is_dark: bool) -> Float32:
    """Hat transform with a kernel wider than a segment's stroke, smoothed a little; zero at the typical background."""
    size = max(5, round(0.28 * gray.shape[0])) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (size, size))
    smooth = cv2.GaussianBlur(gray, (3, 3), 0)
    ink = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT if is_dark else cv2.MORPH_TOPHAT, kernel).astype(np.float32)
    return np.asarray(np.maximum(ink - np.percentile(ink, 30), 0.0), np.float32)


def _window(patch: Patch, spec: Display) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    margin = MARGIN * min(spec.width_m, spec.height_m)
    u, v = patch.pixel_of(
        np.array([-1.0, 1.0]) * (spec.width_m / 2 - margin), np.array([1.0, -1.0]) * (spec.height_m / 2 - margin)
    )
    cols = slice(max(0, round(u[0])), round(u[1]) + 1)
    rows = slice(max(0, round(v[0])), round(v[1]) + 1)
    return patch.gray[rows, cols], patch.inside[rows, cols]


def _decode(ink: Float32, count: int, decimals: int | None) -> tuple[float, str, float] | None:
    """(quality, text, margin) of the best reading with `count` cells."""
    rows = _digit_rows(ink)
    if rows is None:
        return None
    slant = _slant(ink, rows)
    upright = _deslanted(ink, slant, rows)
    comb = _comb(upright, rows, count, slant)
    if comb is None:
        return None
    levels = _segment_levels(upright, comb)
    lit = float(np.percentile(levels, 92))
    threshold = _threshold(levels)
    if lit < 4.0 or threshold >= lit:
        return None
    scaled = (levels - threshold) / (lit - threshold) / 2.0  # +0.5 clearly lit, negative unlit
    scaled = np.clip(scaled, -0.5, 0.5)
    cells = [_character(cell) for cell in scaled]
    text = _with_point("".join(c for c, _ in cells), upright, comb, lit, decimals)
    margin = min(m for _, m in cells)
    explained = _explained(upright, comb, scaled > 0)
    return explained + 0.3 * margin, text, margin


def _digit_rows(ink: Float32) -> tuple[float, float] | None:
    """Rows of the top and bottom segments' axes: where the ink begins and ends."""
    strong = np.percentile(ink, 99)
    if strong < 4:
        return None
    lit = ink > 0.5 * strong
    profile = lit.sum(axis=1).astype(float)
    there = np.flatnonzero(profile >= max(2.0, 0.12 * profile.max()))
    if len(there) < 6 or there[-1] - there[0] < 0.25 * ink.shape[0]:
        return None
    half_stroke = 0.05 * (there[-1] - there[0])
    return float(there[0] + half_stroke), float(there[-1] - half_stroke)


def _slant(ink: Float32, rows: tuple[float, float]) -> float:
    """Tangent of the slant with the sharpest columns."""
    scores = []
    for slant in SLANTS:
        profile = _upright_profile(_deslanted(ink, slant, rows), rows)
        scores.append(float((profile**2).sum()))
    return float(SLANTS[int(np.argmax(scores))])


def _deslanted(ink: Float32, slant: float, rows: tuple[float, float]) -> Float32:
    middle = (rows[0] + rows[1]) / 2
    shear = np.array([[1.0, -slant, slant * middle], [0.0, 1.0, 0.0]])  # source x of target (x, y)
    return np.asarray(
        cv2.warpAffine(ink, shear, ink.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP), np.float32
    )


def _upright_profile(ink: Float32, rows: tuple[float, float]) -> Array:
    """Column means over the rows that only upright segments cross."""
    top, bottom = rows
    height = bottom - top
    take = np.concatenate(
        [np.arange(top + 0.17 * height, top + 0.36 * height), np.arange(top + 0.64 * height, top + 0.83 * height)]
    )
    return np.asarray(ink[np.clip(np.round(take).astype(int), 0, len(ink) - 1)].mean(axis=0), float)


def _comb(ink: Float32, rows: tuple[float, float], count: int, slant: float) -> Comb | None:
    """The comb that explains most upright ink, near the middle of the window."""
    profile = _upright_profile(ink, rows)
    total = profile.sum()
    if total <= 0:
        return None
    height = rows[1] - rows[0]
    width = ink.shape[1]
    x = np.arange(width)
    sigma = max(0.055 * height, 1.0)
    kernel = np.exp(-0.5 * (np.arange(-round(3 * sigma), round(3 * sigma) + 1) / sigma) ** 2)
    blurred = np.convolve(profile, kernel / kernel.sum(), "same")
    best: tuple[float, float, float, float] | None = None
    for digit in np.linspace(0.40, 0.62, 6) * height:
        for pitch in PITCHES * digit:
            span = (count - 1) * pitch + digit
            if span > width + 2:
                continue
            slack = max(0.10 * width, 0.2 * pitch)
            lefts = np.arange((width - span) / 2 - slack, (width - span) / 2 + slack + 0.5, 1.0)
            places = lefts[:, None] + np.concatenate([np.arange(count) * pitch, np.arange(count) * pitch + digit])
            between = lefts[:, None] + np.concatenate(
                [np.arange(count) * pitch + digit / 2, np.arange(count) * pitch + digit + (pitch - digit) / 2]
            )
            hit = np.interp(places, x, blurred, left=0, right=0).sum(axis=1)
            miss = np.interp(between, x, blurred, left=0, right=0).sum(axis=1)
            off = np.abs(lefts - (width - span) / 2) / width
            score = (hit - 1.2 * miss) - 0.8 * off * hit
            k = int(score.argmax())
            if best is None or score[k] > best[0]:
                best = (float(score[k]), float(lefts[k]), float(pitch), float(digit))
    if best is None or best[0] <= 0:
        return None
    return Comb(
        left_px=best[1], pitch_px=best[2], width_px=best[3], top_px=rows[0], bottom_px=rows[1], count=count, slant=slant
    )


def _segment_levels(ink: Float32, comb: Comb) -> Array:
    """(cells, 7) mean ink of every segment, along the middle part of its axis and a little across."""
    h, w = comb.bottom_px - comb.top_px, comb.width_px
    s = np.linspace(0.28, 0.72, 7)
    left, right = np.zeros(7), np.ones(7)
    axes = {
        "a": (s, 0 * s),
        "d": (s, 0 * s + 1),
        "g": (s, 0 * s + 0.5),
        "f": (left, s / 2),
        "b": (right, s / 2),
        "e": (left, 0.5 + s / 2),
        "c": (right, 0.5 + s / 2),
    }
    stroke = 0.045 * h
    levels = np.zeros((comb.count, 7))
    for k in range(comb.count):
        for j, name in enumerate(SEGMENTS):
            fx, fy = axes[name]
            u, v = comb.column_px(k) + fx * w, comb.top_px + fy * h
            across = np.array([-1.0, 0.0, 1.0])[:, None] * stroke
            du, dv = (0 * across, across) if name in "adg" else (across, 0 * across)
            levels[k, j] = float(np.median(sample_at(ink, u + du, v + dv).max(axis=0)))
    return levels


def _threshold(levels: Array) -> float:
    """Otsu's threshold of the segment levels. Source: N. Otsu, IEEE Trans. SMC 9(1), 1979."""
    values = np.sort(levels.ravel())
    best, threshold = -1.0, float(values.mean())
    for k in range(1, len(values)):
        low, high = values[:k], values[k:]
        between = len(low) * len(high) * (high.mean() - low.mean()) ** 2
        if between > best:
            best, threshold = float(between), float((low.mean() + high.mean()) / 2)
    return threshold


def _character(scaled: Array) -> tuple[str, float]:
    """Best character of a cell and its margin over the second best, per segment that differs."""
    scores: dict[str, float] = {}
    for character, lit in (*GLYPHS.items(), *VARIANTS):
        sign = np.array([1.0 if s in lit else -1.0 for s in SEGMENTS])
        scores[character] = max(scores.get(character, -9.0), float((sign * scaled).sum()))
    ordered = sorted(scores, key=lambda c: scores[c], reverse=True)
    return ordered[0], scores[ordered[0]] - scores[ordered[1]]


def _with_point(characters: str, ink: Float32, comb: Comb, lit: float, decimals: int | None) -> str:
    """Text with its decimal point: where the panel file says, else where a dot is lit below the gap of two cells."""
    taught = len(characters) - decimals if decimals else None
    place = _point_place(ink, comb, lit) if decimals is None else taught
    text = characters if place is None else f"{characters[:place]}.{characters[place:]}"
    return text.strip()


def _point_place(ink: Float32, comb: Comb, lit: float) -> int | None:
    """Number of cells before the decimal point, or None."""
    gap = comb.pitch_px - comb.width_px
    best, place = 0.0, None
    h = comb.bottom_px - comb.top_px
    for k in range(comb.count - 1):
        x = comb.column_px(k) + comb.width_px + gap * np.linspace(0.35, 0.65, 5)
        y = comb.bottom_px + h * np.linspace(-0.02, 0.05, 4)
        dot = float(np.percentile(sample_at(ink, x[None, :] + 0 * y[:, None], y[:, None] + 0 * x[None, :]), 70))
        above = float(sample_at(ink, x, np.full(5, comb.bottom_px - 0.25 * h)).mean())
        if dot - above > best:
            best, place = dot - above, k + 1
    return place if best > 0.45 * lit else None


def _explained(ink: Float32, comb: Comb, lit: NDArray[np.bool_]) -> float:
    """Share of the strong ink that lies on lit segments (a little around them)."""
    canvas = np.zeros(ink.shape, np.uint8)
    h, w = comb.bottom_px - comb.top_px, comb.width_px
    corner = {
        "a": (0, 0, 1, 0),
        "d": (0, 1, 1, 1),
        "g": (0, 0.5, 1, 0.5),
        "f": (0, 0, 0, 0.5),
        "b": (1, 0, 1, 0.5),
        "e": (0, 0.5, 0, 1),
        "c": (1, 0.5, 1, 1),
    }
    thick = max(2, round(0.2 * h))
    for k in range(comb.count):
        for j, name in enumerate(SEGMENTS):
            if lit[k, j]:
                x0, y0, x1, y1 = corner[name]
                start = (round(comb.column_px(k) + x0 * w), round(comb.top_px + y0 * h))
                end = (round(comb.column_px(k) + x1 * w), round(comb.top_px + y1 * h))
                cv2.line(canvas, start, end, 1, thick)
    strong = np.where(ink > 0.3 * np.percentile(ink, 98), ink, 0.0)
    inside = float(strong[canvas > 0].sum())
    area = float((canvas > 0).mean())
    return inside / max(float(strong.sum()), 1e-6) - 0.5 * area
