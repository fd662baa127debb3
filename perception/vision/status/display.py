"""Geometric reader of seven-segment displays: ink, grid of digit cells, level of every segment, the likeliest number.

Occluders (a cable, saturation) are found first, and the segments behind them count as unknown. The numbers that remain
possible are weighted by their likelihood, by the display's range and by the previous reading; if two are about equally
likely, the reading is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.panel import Display
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, Possible, doubted, gated, probability, refused
from perception.vision.status.decimal_point import DecimalPoint, find_colon, find_decimal_point
from perception.vision.status.digit_grid import DigitGrid, find_digit_grids
from perception.vision.status.digit_grid_worth import Float32, apartness
from perception.vision.status.glyphs import CLOSE, LEAST_SEEN, LIT, NAMES, Number, likelihoods, numbers, separate
from perception.vision.status.ink import segment_ink, without_border
from perception.vision.status.levels import loop_levels, segment_levels, with_hidden_ends, without_frames
from perception.vision.status.occluder_bands import lying_across
from perception.vision.status.reader import Hints, Reader
from perception.vision.status.stray import leaves_out, stray_ink

MARGIN = 0.09  # share of the smaller side that a frame may cover
WORK_ROWS = 64  # height in px to which a window is scaled for reading; a stroke is then 4 px wide
MOST_CELLS = 8  # for a display whose number of digits is not known
CELL_COST = 0.008  # share by which a grid with one more cell must explain more ink
FITS = 12.0  # cap on the log-likelihood (nats) per character: no fit counts as better
SAME_COMB = 0.05  # in digit heights; grids with smaller differences are the same
WORTH_WEIGHT = 8.0  # nats per character by which a grid with e times the worth may have a worse fit
TEMPERATURE = 2.0  # the errors of neighbouring segments are correlated, so log-likelihoods count half
KNOWN_FREE, FREE = 0.35, 0.5  # largest distance of the digits from the window's middle, over its width

STRAY, STRAY_SCALE = 0.045, 0.003  # half and scale of the evidence for ink off the strokes, see `stray_ink`
# Level of the weakest digit relative to the typical one. Of 355 hard synthetic displays that were read correctly all
# exceed 0.52; of 9 misread ones two are below 0.36: a digit behind an undetected cable, and one in glare.
WEAK, WEAK_SCALE = 0.44, 0.025
LEFT_OUT = 0.7  # factor on the confidence if there may be a digit or a sign beside those that were read
SURE = 0.732  # largest probability that a single piece of evidence gives

MOST_NAMED, NAMED = 4, 0.1  # maximum number of candidates in a refusal's text, and the least probability of each
MOST_POSSIBLE = 10  # maximum number of candidates in a refusal's data


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decoded:
    """The numbers that one grid may show, best first.

    Attributes:
        ink, seen: (H, W) ink and visibility of the picture on which the grid lies.
        listed: the numbers.
        explained: share of the ink that the lit segments explain.
        grid: the digit cells.
        lit_levels: (cells, 7) level of the best number's lit segments, 0 for the others.
        weakest: level of its weakest digit relative to the typical one.
        fit: mean log-likelihood of its characters.
    """

    ink: Float32
    seen: Float32
    listed: Sequence[Number]
    explained: float
    grid: DigitGrid
    lit_levels: Array
    weakest: float
    fit: float


def read_display(
    patch: Patch, spec: Display, *, digits_taught: bool = True, before: float | None = None
) -> PatchReading:
    """Return text and value of a display. `patch` shows its window and the plate around it, origin at the middle.

    Args:
        digits_taught: if False, the number of digits and decimals is determined from the picture.
        before: the previous reading, which decides between numbers that are about equally likely.
    """
    rows, columns = _window(patch, spec)
    gray, inside = patch.gray[rows, columns], patch.inside[rows, columns]
    dark = spec.style == "lcd"
    hidden = lying_across(
        patch, half_width_m=spec.width_m / 2, half_height_m=spec.height_m / 2, is_round=False, dark_ink=dark
    )
    hidden = ~inside if hidden is None else hidden[rows, columns] | ~inside
    seen = float((~hidden & (dark | (gray < 250))).mean()) if gray.size else 0.0
    if seen < 0.5:
        return refused(
            "the display cannot be seen (glare, shadow or cover): change the angle or the light", unit=spec.unit
        )
    return read_window(
        gray, digits=spec.digits if digits_taught else None, decimals=spec.decimals if digits_taught else None,
        dark=dark, unit=spec.unit, limits=(spec.minimum, spec.maximum), hidden=hidden, before=before,
        bare=True,
    )  # fmt: skip


def read_window(
    gray: Image, *, digits: int | None, decimals: int | None, dark: bool | None, unit: str = "",
    limits: tuple[float, float] | None = None, hidden: NDArray[np.bool_] | None = None, before: float | None = None,
    framed: bool = False, bare: bool = False,
) -> PatchReading:  # fmt: skip
    """Read the text in an upright window of digits.

    Args:
        digits, decimals: number of digits and decimals; None: determined from the picture.
        dark: whether segments are darker than their background; None: determined from the picture.
        limits: smallest and largest possible value.
        hidden: (H, W) True where something occludes the window.
        before: the previous reading.
        framed: whether the picture shows a frame on all sides.
        bare: whether the window contains nothing but digits, so that unexplained ink is evidence against the reading.
    """
    gray, hidden = _working_size(gray, hidden)
    polarities = (True, False) if dark is None else (dark,)
    found = [
        decoded for is_dark in polarities if (decoded := _decoded(gray, is_dark, hidden, digits, framed)) is not None
    ]
    if not found:
        return refused("no digits stand out: come closer, or change the angle or the light", unit=unit)
    best = max(found, key=lambda d: d.explained * apartness(d.grid.gap) - CELL_COST * d.grid.count)
    where = best.ink, best.seen, best.grid, best.lit_levels
    colon = find_colon(*where) if decimals is None and not bare else None
    if colon is not None:
        no_point = DecimalPoint(place=None, probability=1.0)
        return _as_time(_answer(best, no_point, unit, None, limits, before, covered=False, bare=bare), best, colon)
    point = find_decimal_point(*where) if decimals is None else None
    is_covered = hidden is not None and bool(hidden.any())
    return _answer(best, point, unit, decimals, limits, before, covered=is_covered, bare=bare)


def _as_time(number: PatchReading, found: Decoded, place: int) -> PatchReading:
    """Return the reading of a clock, which has text but no value.

    It is in doubt unless one or two digits precede its colon and two follow it.
    """
    characters = found.listed[0].characters
    before, after = characters[:place].strip(), characters[place:]
    text = f"{before}:{after}"
    guess = number.guess and replace(number.guess, value=None, uncertainty=None, text=text)
    shown = text if number.answered else None
    time = replace(number, value=None, uncertainty=None, text=shown, possible=(), guess=guess)
    fits = before.isdigit() and after.isdigit() and len(before) <= 2 and len(after) == 2
    return (
        time if fits else doubted(time, "a colon, but no time beside it: come closer, or change the angle or the light")
    )


def _decoded(
    gray: Image, is_dark: bool, hidden: NDArray[np.bool_] | None, digits: int | None, framed: bool
) -> Decoded | None:
    """Decode the best grid of digits of one polarity; None if there is none."""
    ink, seen = segment_ink(gray, is_dark, hidden)
    ink, lost = without_border(ink, framed=framed)
    if lost is not None:
        seen = np.asarray(np.where(lost, 0.0, seen), np.float32)
    most = digits or MOST_CELLS
    grids = find_digit_grids(ink, seen, most=most, free=KNOWN_FREE if digits else FREE)
    if not seen.all():
        grids = [(worth, with_hidden_ends(seen, grid, most)) for worth, grid in grids]
    best: Decoded | None = None
    most_worth = score = 0.0
    for worth, grid in grids:
        if worth <= 0 or (best is not None and (best.fit > FITS or _same(best.grid, grid))):
            break
        decoded = decode(ink, seen, grid, all_cells=digits is not None)
        if decoded is None:
            continue
        most_worth = most_worth or worth
        # A grid that is too high claims ink that does not exist, so the levels of its segments differ.
        this = decoded.fit + WORTH_WEIGHT * float(np.log(worth / most_worth))
        if best is None or this > score:
            best, score = decoded, this
    return best


def _same(a: DigitGrid, b: DigitGrid) -> bool:
    """Return whether two grids lie on the same digits, so that only one of them needs to be read."""
    off = np.abs(a.numbers - b.numbers)  # left, pitch, width, top, bottom
    return a.count == b.count and bool(off[:5].max() < SAME_COMB * a.height_px)


def decode(ink: Float32, seen: Float32, grid: DigitGrid, *, all_cells: bool = False) -> Decoded | None:
    """Decode the numbers that a grid may show; None if lit and unlit segments do not separate.

    Args:
        all_cells: whether the grid's last cell is the display's last; otherwise blank cells at its end are not counted.
    """
    segments, shares = segment_levels(ink, seen, grid)
    levels = separate(without_frames(ink, grid, segments), shares, *loop_levels(ink, seen, grid))
    if levels is None:
        return None
    characters, blank = likelihoods(levels)
    listed = numbers(characters, blank) if all_cells else _of_any_length(characters, blank)
    count = len(listed[0].characters)
    grid = replace(grid, count=count)
    shown = np.array([_lit(c) for c in listed[0].characters])
    lit_levels = np.where(shown, levels.ink[:count], 0.0)
    explained = _explained(ink, grid, lit_levels)
    written = shown.any(axis=1)
    fit = float(characters[:count].max(axis=1)[written].mean()) if written.any() else -np.inf
    return Decoded(
        ink=ink, seen=seen, listed=listed, explained=explained, grid=grid, lit_levels=lit_levels, fit=fit,
        weakest=_weakest(levels.ink[:count], shown & (shares[:count] >= LEAST_SEEN), listed[0].characters),
    )  # fmt: skip


def _weakest(ink: Array, lit: NDArray[np.bool_], characters: str) -> float:
    """Return the mean level of the visible lit segments of the weakest digit, relative to the typical digit."""
    is_digit = lit.any(axis=1) & np.array([character.isdigit() for character in characters])
    if not is_digit.any():
        return 1.0
    cells = (ink * lit).sum(axis=1)[is_digit] / lit.sum(axis=1)[is_digit]
    return float(cells.min() / max(np.median(cells), 1e-6))


def _of_any_length(characters: Array, blank: Array) -> list[Number]:
    """Return the likely numbers of a display whose last cells may not belong to it, best first."""
    tail = np.append(np.cumsum(blank[::-1])[::-1], 0.0)  # log-likelihood that all cells from each one on are blank
    listed = [
        replace(number, log_likelihood=number.log_likelihood + float(tail[count]))
        for count in range(1, len(blank) + 1)
        for number in numbers(characters[:count], blank[:count])
    ]
    listed.sort(key=lambda n: n.log_likelihood, reverse=True)
    return [n for n in listed if n.log_likelihood > listed[0].log_likelihood - CLOSE]


def _lit(character: str) -> NDArray[np.bool_]:
    """Return which segments (7,) a character lights."""
    return LIT[NAMES.index(character)] if character in NAMES else np.zeros(7, bool)


def _explained(ink: Float32, grid: DigitGrid, lit_levels: Array) -> float:
    """Return the share (0 to 1) of the picture's ink energy, squared level times area, that lit segments explain."""
    h = grid.height_px
    area = np.where([True, False, False, True, False, False, True], grid.width_px, h / 2) * 0.08 * h
    total = float((ink.astype(float) ** 2).sum())
    return float((lit_levels**2 * area).sum() / max(total, 1e-9))


def _answer(
    found: Decoded, point: DecimalPoint | None, unit: str, decimals: int | None, limits: tuple[float, float] | None,
    before: float | None, *, covered: bool, bare: bool,
) -> PatchReading:  # fmt: skip
    """Return the likeliest number within the range, or a refusal with its reason."""
    texts = [(_with_point(n.characters, point, decimals), n.log_likelihood) for n in found.listed]
    valued = [(text, value, score) for text, score in texts if (value := _value(text)) is not None]
    if not valued:
        return refused("the segments make no number: come closer, or change the angle or the light", unit=unit)
    low, high = limits if limits is not None else (-np.inf, np.inf)
    possible = [(text, value, score) for text, value, score in valued if low <= value <= high]
    if not possible or possible[0][2] < valued[0][2] - 2 * TEMPERATURE:
        return refused(
            f"the segments look like {valued[0][0]}, which is outside the display's range: look again", unit=unit
        )
    weights = np.array([score / TEMPERATURE + _expected(value, before, high - low) for _, value, score in possible])
    share = np.exp(weights - weights.max())
    share /= share.sum()
    trust = (point.probability if point else 1.0) * probability([(found.explained, 0.3, 0.06)]) / SURE
    if bare:
        stray = stray_ink(found.ink, found.grid, found.lit_levels)
        trust *= probability([(-stray, -STRAY, STRAY_SCALE)]) / SURE
        trust *= probability([(found.weakest, WEAK, WEAK_SCALE)]) / SURE
    elif leaves_out(found.ink, found.grid, found.lit_levels):
        trust *= LEFT_OUT
    rivals = _ranked([(text, value) for text, value, _ in possible], share, trust)
    named = [rival.text for rival in rivals[:MOST_NAMED] if rival.probability > NAMED * trust]
    maybe = f" ({' or '.join(named)}?)" if len(named) > 1 else ""
    why = (
        f"something lies across the digits{maybe}: move it or look past it"
        if covered and share.max() < 0.8
        else f"the evidence is too weak{maybe}: come closer, change the angle or the light"
    )
    best = rivals[0]
    said = PatchReading(
        value=best.value, unit=unit, uncertainty=best.half_digit, text=best.text, confidence=min(best.probability, 0.97),
    )  # fmt: skip
    return gated(said, why, rivals[:MOST_POSSIBLE])


def _ranked(numbers: Sequence[tuple[str, float]], share: Array, trust: float) -> tuple[Possible, ...]:
    """Return texts and values with their probabilities, likeliest first.

    Of equally likely ones the value farthest from zero is first: a cable often makes several numbers equally likely,
    and a caller that uses the first one then errs on the side of an alarm.
    """
    order = sorted(range(len(numbers)), key=lambda i: (-round(float(share[i]), 6), -abs(numbers[i][1])))
    return tuple(Possible(text=numbers[i][0], value=numbers[i][1], probability=float(share[i]) * trust) for i in order)


def _expected(value: float, before: float | None, span: float) -> float:
    """Return the log-probability of a value given the previous one; most readings change little."""
    if before is None or not np.isfinite(span) or span <= 0:
        return 0.0
    return float(np.log(0.05 + 0.95 * np.exp(-abs(value - before) / (0.05 * span))))


def _with_point(characters: str, point: DecimalPoint | None, decimals: int | None) -> str:
    """Return the text with its decimal point, at the place in the panel file or else at the dot found in a gap."""
    place = (len(characters) - decimals if decimals else None) if point is None else point.place
    if place is not None and place >= len(characters):
        place = None  # place for a number with fewer digits
    if place and not characters[place - 1].isdigit():
        return ""  # a point needs a digit before it
    text = characters if place is None else f"{characters[:place]}.{characters[place:]}"
    return text.replace(" ", "")


def _value(text: str) -> float | None:
    """Return the number of a text; None if it is none."""
    try:
        return float(text)
    except ValueError:
        return None


def _window(patch: Patch, spec: Display) -> tuple[slice, slice]:
    """Return the rows and columns of the patch that show the window without its frame."""
    margin = MARGIN * min(spec.width_m, spec.height_m)
    w, h = spec.width_m / 2 - margin, spec.height_m / 2 - margin
    u, v = patch.pixel_of(np.array([-w, w]), np.array([h, -h]), 0.0)
    return slice(max(0, round(v[0])), round(v[1]) + 1), slice(max(0, round(u[0])), round(u[1]) + 1)


def _working_size(gray: Image, hidden: NDArray[np.bool_] | None) -> tuple[Image, NDArray[np.bool_] | None]:
    """Return the window and its mask, reduced to `WORK_ROWS` rows if it is larger."""
    rows, columns = gray.shape
    if rows <= 1.15 * WORK_ROWS:
        return gray, hidden
    size = (max(8, round(columns * WORK_ROWS / rows)), WORK_ROWS)
    small = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)
    if hidden is None or not hidden.any():
        return small, None
    return small, cv2.resize(hidden.astype(np.uint8) * 4, size, interpolation=cv2.INTER_LINEAR) > 1


class _DisplayReader(Reader[Display]):
    """Reader that uses the number of digits taught and the previous reading."""

    def status(self, patch: Patch, spec: Display, hints: Hints) -> PatchReading:
        """Return text and value of a display."""
        return read_display(patch, spec, digits_taught=hints.digits_taught, before=hints.before)


READER = _DisplayReader(read=read_display, guesses_right=0.06, is_telling=True)
