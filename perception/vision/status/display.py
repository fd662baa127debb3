"""Seven-segment displays by geometry: ink, comb of digit cells, level of every segment, characters with a margin.

Ink is a white-hat for glowing segments and a black-hat for dark ones, so gradients and glare borders vanish. Lit and
unlit segments separate around one threshold that follows the brightness from cell to cell; each cell takes the character that
explains its segments best within what a number may look like (blanks lead, one sign). The decimal point is what is left
at the foot of a gap when the lit segments have been taken away.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.panel import Display
from perception.vision.image import Image
from perception.vision.patch import Patch, sample_at
from perception.vision.reading import Status, gated, probability, refused
from perception.vision.status.comb import AXES, SEGMENTS, Comb, Float32, find_combs, loop_levels, segment_levels
from perception.vision.view import Array

GLYPHS = (
    ("0", "abcdef"), ("1", "bc"), ("2", "abged"), ("3", "abgcd"), ("4", "fgbc"), ("5", "afgcd"), ("6", "afgedc"),
    ("7", "abc"), ("8", "abcdefg"), ("9", "abcdfg"), ("7", "abcf"), ("6", "fgedc"), ("9", "abcfg"), ("-", "g"), (" ", ""),
)  # fmt: skip
SIGNS = np.array([[1.0 if s in lit else -1.0 for s in SEGMENTS] for _, lit in GLYPHS])
DIGIT_GLYPHS = [k for k, (c, _) in enumerate(GLYPHS) if c.isdigit()]
MINUS, BLANK = len(GLYPHS) - 2, len(GLYPHS) - 1

MARGIN = 0.09  # share of the smaller side that a frame may take
CELL_COST = 0.008  # a comb with one more cell must explain that much more
DOT_RADIUS = 0.075  # of the digit height
POINT_LEVEL = 0.45  # of a lit segment
FREE_MIDDLE = 0.22  # how far digits may sit from the middle when their number is not known


@dataclass(frozen=True, slots=True, kw_only=True)
class Decoded:
    """Text of one comb, the share of ink it explains, its weakest character's margin, and a lit segment's level."""

    text: str
    explained: float
    margin: float
    comb: Comb
    lit: float


def read_display(patch: Patch, spec: Display, *, digits_taught: bool = True) -> Status:
    """Text and value of a display. `patch` shows its window, origin at the middle.

    `digits_taught` False: number of digits and decimals are to be found in the picture.
    """
    gray, inside = _window(patch, spec)
    seen = float((inside & (gray < 250)).mean()) if gray.size else 0.0
    if seen < 0.5:
        return refused(
            "the display cannot be seen (glare, shadow or cover): change the angle or the light", unit=spec.unit
        )
    return read_window(
        gray, digits=spec.digits if digits_taught else None, decimals=spec.decimals if digits_taught else None,
        dark=spec.style == "lcd", unit=spec.unit, limits=(spec.minimum, spec.maximum), seen=seen,
    )  # fmt: skip


def read_window(
    gray: Image, *, digits: int | None, decimals: int | None, dark: bool | None, unit: str = "",
    limits: tuple[float, float] | None = None, seen: float = 1.0,
) -> Status:  # fmt: skip
    """Text of an upright window that shows nothing but the digits.

    Args:
        digits, decimals, dark: what is known; None lets the picture decide.
        limits: smallest and largest value possible.
    """
    counts = range(1, 9) if digits is None else (digits,)
    free = 0.06 if digits else FREE_MIDDLE
    found = [
        decoded
        for is_dark in ((True, False) if dark is None else (dark,))
        for ink in (segment_ink(gray, is_dark),)
        for share, comb in find_combs(ink, counts, free=free)
        if (decoded := decode(ink, comb, share, decimals)) is not None
    ]
    if not found:
        return refused("no digits stand out: come closer, or change the angle or the light", unit=unit)
    best = max(found, key=lambda d: d.explained - CELL_COST * d.comb.count + 0.1 * min(d.margin, 0.5))
    if lies_across(gray, best):
        return refused("something lies across the digits: move it or look past it", unit=unit)
    try:
        value = float(best.text)
    except ValueError:
        return refused("the segments make no number: come closer, or change the angle or the light", unit=unit)
    if limits is not None and not limits[0] <= value <= limits[1]:
        return refused(
            f"the segments look like {best.text}, which is outside the display's range: look again", unit=unit
        )
    half_digit = 0.5 * 10.0 ** -(len(best.text.split(".")[1]) if "." in best.text else 0)
    confidence = probability([(best.margin, 0.25, 0.08), (best.explained, 0.6, 0.05), (seen, 0.6, 0.1)])
    return gated(Status(value=value, unit=unit, uncertainty=half_digit, text=best.text, confidence=confidence))


def segment_ink(gray: Image, is_dark: bool) -> Float32:
    """Hat transform with a kernel wider than a segment's stroke; zero at the typical background."""
    size = max(5, round(0.30 * gray.shape[0])) | 1
    kernel = np.ones((size, size), np.uint8)
    smooth = cv2.GaussianBlur(gray, (0, 0), max(0.6, 0.012 * gray.shape[0]))
    ink = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT if is_dark else cv2.MORPH_TOPHAT, kernel).astype(np.float32)
    return np.asarray(np.maximum(ink - np.percentile(ink, 35), 0.0), np.float32)


def decode(ink: Float32, comb: Comb, share: float, decimals: int | None) -> Decoded | None:
    """The reading of a comb that explains `share` of the ink; None when lit and unlit do not separate."""
    levels = segment_levels(ink, comb)
    threshold, lit = _levels_of(levels, loop_levels(ink, comb))
    if lit < 3.0:
        return None
    scaled = np.clip((levels - threshold) / np.maximum(lit - threshold, 0.5 * lit) * 0.5, -0.5, 0.5)
    glyphs, margin = _number(scaled)
    characters = "".join(GLYPHS[k][0] for k in glyphs)
    text = _with_point(characters, ink, comb, np.where(SIGNS[glyphs] > 0, levels, 0.0), lit, decimals)
    return Decoded(text=text, explained=share, margin=margin, comb=comb, lit=lit)


def _window(patch: Patch, spec: Display) -> tuple[Image, NDArray[np.bool_]]:
    margin = MARGIN * min(spec.width_m, spec.height_m)
    w, h = spec.width_m / 2 - margin, spec.height_m / 2 - margin
    u, v = patch.pixel_of(np.array([-w, w]), np.array([h, -h]), 0.0)
    cols = slice(max(0, round(u[0])), round(u[1]) + 1)
    rows = slice(max(0, round(v[0])), round(v[1]) + 1)
    return patch.gray[rows, cols], patch.inside[rows, cols]


def _levels_of(levels: Array, loops: Array) -> tuple[Array, float]:
    """(cells, 1) threshold of every cell and the level of a lit segment: Otsu over all, then drawn towards each cell."""
    values = np.sort(np.concatenate([levels.ravel(), loops.ravel()]))  # so that "888" has something unlit
    n = np.arange(1, len(values))
    low, high = np.cumsum(values)[:-1] / n, (values.sum() - np.cumsum(values)[:-1]) / (len(values) - n)
    k = int((n * (len(values) - n) * (high - low) ** 2).argmax())
    threshold, lit = (low[k] + high[k]) / 2, float(high[k])
    strongest = np.sort(levels, axis=1)[:, -2:].mean(axis=1, keepdims=True)  # every digit has two lit segments
    own = np.where(strongest > 0.5 * lit, strongest * threshold / max(lit, 1e-9), threshold)
    return np.asarray(0.5 * (threshold + own)), lit


def _number(scaled: Array) -> tuple[list[int], float]:
    """Glyph indices of the best number and the margin of its weakest cell.

    A number is blanks, then perhaps a sign, then digits.
    """
    scores = scaled @ SIGNS.T  # (cells, glyphs)
    digit = scores[:, DIGIT_GLYPHS]
    best_digit = digit.max(axis=1)
    count = len(scaled)
    forms: list[tuple[float, int, bool]] = []
    for blanks in range(count):
        lead = float(scores[:blanks, BLANK].sum())
        forms.append((lead + float(best_digit[blanks:].sum()), blanks, False))
        if blanks + 1 < count:
            signed = lead + float(scores[blanks, MINUS]) + float(best_digit[blanks + 1 :].sum())
            forms.append((signed, blanks, True))
    forms.sort(reverse=True)
    total, blanks, is_signed = forms[0]
    glyphs = [BLANK] * blanks + [MINUS] * is_signed
    glyphs += [DIGIT_GLYPHS[int(row.argmax())] for row in digit[len(glyphs) :]]
    margins = [_margin(row, [GLYPHS[k][0] for k in DIGIT_GLYPHS]) for row in digit[blanks + is_signed :]]
    if len(forms) > 1:
        margins.append(total - forms[1][0])
    return glyphs, float(min(margins))


def _margin(scores: Array, names: list[str]) -> float:
    """Best score less the best of another character."""
    k = int(scores.argmax())
    return float(scores[k] - max(s for s, name in zip(scores, names, strict=True) if name != names[k]))


def _with_point(characters: str, ink: Float32, comb: Comb, lit_levels: Array, lit: float, decimals: int | None) -> str:
    """Text with its decimal point: where the panel file says, else where a dot is lit at the foot of a gap."""
    taught = len(characters) - decimals if decimals else None
    place = _point_place(ink, comb, lit_levels, lit) if decimals is None else taught
    text = characters if place is None else f"{characters[:place]}.{characters[place:]}"
    return text.strip()


def _point_place(ink: Float32, comb: Comb, lit_levels: Array, lit: float) -> int | None:
    """Number of cells before the decimal point, or None.

    The lit segments are taken away; what a dot template finds at the foot of a gap must reach a lit segment's level and
    stand out from the other gaps.
    """
    drawn, sigma = _drawn(ink, comb, lit_levels)
    h = comb.bottom_px - comb.top_px
    dot = _dot(DOT_RADIUS * h, sigma)
    found = cv2.filter2D(ink - drawn, -1, dot / float((dot * dot).sum()), borderType=cv2.BORDER_REPLICATE)
    gap = (comb.pitch_px - comb.width_px) / comb.width_px
    x, y = np.meshgrid(np.linspace(0.25, 0.75, 6), np.linspace(-0.02, 0.06, 4))
    amplitude = float(np.percentile(drawn, 99.0)) if drawn.any() else lit
    peak = float(dot.max())
    levels = []
    for k in range(comb.count - 1):
        u, v = comb.place(1.0 + gap * x, 1.0 + y, np.array(float(k)))
        levels.append(float(sample_at(found, u, v).max()) * peak)
    if not levels:
        return None
    k = int(np.argmax(levels))
    others = sorted(levels[:k] + levels[k + 1 :])
    typical = max(others[len(others) // 2], 0.0) if others else 0.0
    return k + 1 if levels[k] - typical > POINT_LEVEL * amplitude * peak else None


def _dot(radius_px: float, sigma_px: float) -> Float32:
    """A blurred disc of unit height before the blur."""
    half = int(np.ceil(radius_px + 2.5 * sigma_px))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    disc = np.clip(radius_px + 0.5 - np.hypot(x, y), 0.0, 1.0).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(disc, (0, 0), max(sigma_px, 0.3), borderType=cv2.BORDER_CONSTANT), np.float32)


def _drawn(ink: Float32, comb: Comb, levels: Array) -> tuple[Float32, float]:
    """The lit segments as drawn strokes with the width and blur that leave the least, and that blur in px."""
    h = comb.bottom_px - comb.top_px
    tried = []
    for stroke in (0.09, 0.13):
        canvas = _strokes(ink.shape, comb, levels, max(1, round(stroke * h)))
        for sigma in (0.02 * h, 0.05 * h, 0.09 * h):
            shape = cv2.GaussianBlur(canvas, (0, 0), max(sigma, 0.3))
            fit = shape * float((shape * ink).sum() / max(float((shape * shape).sum()), 1e-6))
            tried.append((float(((ink - fit) ** 2).sum()), fit, sigma))
    _, fit, sigma = min(tried, key=lambda t: t[0])
    return np.asarray(fit, np.float32), float(sigma)


def _strokes(shape: tuple[int, ...], comb: Comb, levels: Array, thickness_px: int) -> Float32:
    canvas = np.zeros(shape, np.float32)
    for k, j in zip(*np.nonzero(levels > 0), strict=True):
        start, end = AXES[j]
        ends = start + np.array([[0.12], [0.88]]) * (end - start)
        u, v = comb.place(ends[:, 0], ends[:, 1], np.array(float(k)))
        (u0, u1), (v0, v1) = np.round(u * 16).astype(int), np.round(v * 16).astype(int)
        cv2.line(canvas, (int(u0), int(v0)), (int(u1), int(v1)), float(levels[k, j]), thickness_px, cv2.LINE_AA, 4)
    return canvas


def lies_across(gray: Image, found: Decoded) -> bool:
    """Whether something crosses the window above and below the digits: a cable or a hand, not a segment."""
    comb = found.comb
    h = comb.bottom_px - comb.top_px
    above = gray[: max(0, round(comb.top_px - 0.14 * h))].astype(np.float32)
    below = gray[round(comb.bottom_px + 0.18 * h) :].astype(np.float32)
    crossed = [_differs(part, 0.4 * found.lit) for part in (above, below) if len(part) >= 2]
    if len(crossed) < 2:
        return False
    reach = round(0.35 * h)  # a cable may lean
    wide = [cv2.dilate(c.astype(np.uint8)[None], np.ones((1, 2 * reach + 1), np.uint8))[0] > 0 for c in crossed]
    left, right = comb.left_px, comb.left_px + (comb.count - 1) * comb.pitch_px + comb.width_px
    columns = np.arange(gray.shape[1])
    between = (columns >= left - 0.1 * h) & (columns <= right + 0.1 * h)
    return bool((wide[0] & wide[1] & between).any())


def _differs(part: NDArray[np.float32], least: float) -> NDArray[np.bool_]:
    """(W,) columns whose gray stands out from the neighbourhood."""
    column = cv2.GaussianBlur(np.median(part, axis=0)[None], (0, 0), 1.0)[0]
    broad = cv2.medianBlur(column[None], 5)[0]
    size = max(5, len(column) // 3) | 1
    kernel = np.ones((1, size), np.uint8)
    hat = np.maximum(
        cv2.morphologyEx(broad[None], cv2.MORPH_TOPHAT, kernel)[0],
        cv2.morphologyEx(broad[None], cv2.MORPH_BLACKHAT, kernel)[0],
    )
    return np.asarray(hat > max(least, 6.0))
