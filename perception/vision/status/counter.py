"""Reader of mechanical counters: correlates each drum with drawn digits and decides about all drums together.

A drum may stand between two digits. It does so only if it is the last one, or if the one on its right goes from 9 to 0;
then both stand equally far. The likeliest number, and how far its last drum has turned, are found by a dynamic program over
the drums, for every height at which the row of digits may lie.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.panel.counter import DRUM_PITCH, Counter
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, doubted, gated, probability, refused
from perception.vision.status.choice import contrast_noise
from perception.vision.status.reader import Reader

ROWS = 24  # of a cell
CELL_HEIGHT, CELL_WIDTH = 0.72, 0.78  # over the counter's height, and over the distance between windows
SIDE_PX, UP_PX = 2, 4  # how far digits may lie from the middles of their windows, in pixels of a cell
FONTS: tuple[str | int, ...] = (
    "open",
    "hooked",
    cv2.FONT_HERSHEY_DUPLEX,
)  # by name: of `SHAPES`, round as engraved digits are
STROKES = (0.09, 0.14, 0.2)  # over the digit's height
HEIGHTS = (0.47, 0.52, 0.57)  # of a digit, over the counter's
NARROWED = (0.88, 1.0, 1.12)
RISES_PX = (-1.5, -0.75, 0.0, 0.75, 1.5)  # from the middle of the row to its last digit
TURNED = np.arange(0.0, 0.95, 0.1)  # of the way to the next digit
ABOUT_TO_TURN = 0.85
DRAWN_LARGER = 4
BLURS_PX = (0.4, 0.8)
SIGMA_STEPS = 0.06
UNLIKELY = 0.03  # correlation by which a drum between two digits must be more alike than one that stands
LEAST_ALIKE = 0.55
HIDDEN = "the counter cannot be seen (glare, shadow or cover): change the angle or the light"
UNLIKE = "no digit stands out on a drum: come closer, or change the angle or the light"
BETWEEN = "the last drum is about to show its next digit: look again later"

Float32 = NDArray[np.float32]
Line = list[tuple[float, float]]


def _arc(x: float, y: float, rx: float, ry: float, first_deg: float, last_deg: float) -> Line:
    """Return points of an ellipse's arc, counter-clockwise from the right."""
    a = np.deg2rad(np.linspace(first_deg, last_deg, 25))
    return list(zip(x + rx * np.cos(a), y + ry * np.sin(a), strict=True))


def _shapes(hook_deg: float, five: Line, *foot: Line) -> tuple[list[Line], ...]:
    """Return the strokes of the digits from 0 to 9 in a box 0.6 wide and 1 tall, y up.

    Args:
        hook_deg: angle by which the ends of 3, 6 and 9 turn in further.
        five: the stroke of the 5.
        foot: strokes below the 1.
    """
    six = [_arc(0.3, 0.32, 0.3, 0.32, 0, 360), _arc(0.33, 0.49, 0.33, 0.51, 65 - hook_deg / 3, 200)]
    return (
        [_arc(0.3, 0.5, 0.3, 0.5, 0, 360)],
        [[(0.08, 0.8), (0.33, 1.0), (0.33, 0.0)], *foot],
        [[*_arc(0.3, 0.71, 0.28, 0.29, 175, -35), (0.0, 0.0), (0.6, 0.0)]],
        [[*_arc(0.28, 0.75, 0.26, 0.25, 140 + hook_deg, -90), *_arc(0.28, 0.26, 0.3, 0.26, 90, -135 - hook_deg)]],
        [[(0.44, 0.0), (0.44, 1.0), (0.0, 0.28), (0.6, 0.28)]],
        [five],
        six,
        [[(0.0, 1.0), (0.58, 1.0), (0.2, 0.0)]],
        [_arc(0.3, 0.75, 0.26, 0.25, 0, 360), _arc(0.3, 0.26, 0.3, 0.26, 0, 360)],
        [[(0.6 - x, 1.0 - y) for x, y in stroke] for stroke in six],
    )


FLAT_FIVE = [(0.56, 1.0), (0.05, 1.0), (0.05, 0.54), *_arc(0.25, 0.27, 0.37, 0.34, 128, -133)]
ROUND_FIVE = [(0.52, 1.0), (0.09, 1.0), (0.06, 0.48), *_arc(0.29, 0.34, 0.29, 0.34, 130, -163)]
SHAPES = {"open": _shapes(0.0, FLAT_FIVE), "hooked": _shapes(33.0, ROUND_FIVE, [(0.06, 0.0), (0.6, 0.0)])}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drums:
    """What the drums show.

    Attributes:
        digits: lower digit of each drum.
        turned: how far those that turn are on their way to the next digit, 0 to 1.
        alike: (digits,) correlation of each drum with what it is said to show.
        lead: (digits,) how much less alike the next likely digit is.
    """

    digits: tuple[int, ...]
    turned: float
    alike: Array
    lead: Array


def read_counter(patch: Patch, spec: Counter) -> PatchReading:
    """Read text and value of a counter. `patch` shows the plane of its face, origin at its middle."""
    x, y = _grid(spec, 0)
    middles = _middles(spec)
    seen = [patch.seen(x + middle, y) for middle in middles]
    if min(seen) < 0.7:
        return refused(HIDDEN, unit=spec.unit)
    cells = [_cell(patch, spec, middle) for middle in middles]
    contrast = min(float(np.ptp(np.quantile(cell, (0.03, 0.97)))) for cell in cells)
    noise = contrast_noise(patch)
    if contrast < 3.0 * noise:
        return refused(UNLIKE, unit=spec.unit)
    drums = find_drums(_rows_of(np.array([_scores(cell, x.shape[1]) for cell in cells])))
    count = int("".join(map(str, drums.digits)))
    status = PatchReading(
        value=(count + drums.turned) * spec.step,
        text=spec.text_of(count),
        unit=spec.unit,
        uncertainty=SIGMA_STEPS * spec.step,
        confidence=probability(
            [
                (float(drums.alike.min()), 0.70, 0.04),
                (float(drums.lead.min()), 0.035, 0.012),
                (min(seen), 0.85, 0.05),
            ]
        ),
    )
    if drums.alike.min() < LEAST_ALIKE:
        return doubted(status, UNLIKE)
    if drums.turned > ABOUT_TO_TURN:
        return doubted(status, BETWEEN)
    if not spec.minimum <= count * spec.step <= spec.maximum:
        return doubted(
            status, "the number is out of the counter's range: come closer, or change the angle or the light"
        )
    return gated(status)


def alike_drum(patch: Patch, spec: Counter) -> float:
    """Return the correlation of the drum in the middle of a patch with the digit that it resembles most."""
    x, _ = _grid(spec, 0)
    return float(_scores(_cell(patch, spec, 0.0), x.shape[1]).max())


def find_drums(scores: Float32) -> Drums:
    """Find the most likely digits.

    Args:
        scores: (drums, rows, turned, 10) correlation of each drum with each digit, for every way in which the row may be
            drawn and lie, and for every share of the way to the next digit.
    """
    best = np.zeros((2, *scores.shape[1:3]))  # of all drums so far from the left: the next one stands still, or turns
    chosen = []
    for cell in scores:
        still = np.repeat(cell[:, :1], cell.shape[1], axis=1) + best[0][..., None]
        moved = cell - UNLIKELY * (TURNED[:, None] > 0)
        turning = moved + best[0][..., None]
        turning[..., 9] = moved[..., 9] + best[1]
        chosen.append((still.argmax(-1), turning.argmax(-1)))
        best = np.array([still.max(-1), turning.max(-1)])
    height, share = np.unravel_index(best[1].argmax(), best[1].shape)
    digits, alike, lead = [], [], []
    does_turn = True
    for cell, choices in zip(scores[::-1], chosen[::-1], strict=True):
        digit = int(choices[int(does_turn)][height, share])
        at = share if does_turn else 0
        mine = float(cell[height, at, digit])
        digits.append(digit)
        alike.append(mine)
        lead.append(mine - _rival(cell[height], digit, float(TURNED[at]), may_turn=does_turn))
        does_turn = does_turn and digit == 9
    return Drums(
        digits=tuple(digits[::-1]), turned=float(TURNED[share]), alike=np.array(alike[::-1]), lead=np.array(lead[::-1])
    )


def _rival(cell: Float32, digit: int, turned: float, *, may_turn: bool) -> float:
    """Return the correlation of a drum with the most likely place that is more than half a digit away."""
    shares = TURNED if may_turn else TURNED[:1]
    places = shares[:, None] + np.arange(10)
    away = np.abs((places - digit - turned + 5.0) % 10.0 - 5.0)
    return float(cell[: len(shares)][away > 0.5].max())


def _middles(spec: Counter) -> Array:
    return np.asarray((np.arange(spec.digits) - (spec.digits - 1) / 2) * spec.pitch_m, float)


def _grid(spec: Counter, reach: int) -> tuple[Array, Array]:
    """Return the places of a cell's pixels about the middle of its window, with room to move it; two samples per pixel and side."""
    px_m = CELL_HEIGHT * spec.height_m / ROWS
    columns = max(6, round(CELL_WIDTH * spec.pitch_m / px_m))
    half = 2 * (columns + 2 * SIDE_PX * reach), 2 * (ROWS + 2 * UP_PX * reach)
    u, v = ((np.arange(n) - (n - 1) / 2) * px_m / 2 for n in half)
    x, y = np.meshgrid(u, -v)
    return x, y


def _cell(patch: Patch, spec: Counter, middle_m: float) -> Float32:
    """Return a drum's window in pixels of a cell, with bright digits on a dark ground."""
    x, y = _grid(spec, 1)
    fine = patch.sample(x + middle_m, y)
    cell = fine.reshape(fine.shape[0] // 2, 2, fine.shape[1] // 2, 2).mean(axis=(1, 3))
    return np.asarray(cell if spec.ink == "white" else 255.0 - cell, np.float32)


def _scores(cell: Float32, samples: int) -> Float32:
    """Return the (heights, 1, turned, 10) correlation of a cell with every drawing, at the best place sideways."""
    columns = samples // 2
    windows = np.lib.stride_tricks.sliding_window_view(cell, (ROWS, columns))
    drawings = _drawings(columns)
    alike = _unit(windows.reshape(-1, ROWS * columns)) @ drawings.reshape(-1, ROWS * columns).T
    drawn = alike.reshape(*windows.shape[:2], *drawings.shape[:3])
    best = np.pad(drawn.max(axis=(1, 2)), ((1, 1), (0, 0), (0, 0)), mode="edge")
    played = np.maximum(best[1:-1], np.maximum(best[:-2], best[2:]))  # a drum has a pixel of play
    return np.asarray(played[:, None], np.float32)


def _rows_of(scores: Float32) -> Float32:
    """Return (drums, rows, turned, 10) of the scores of all drums: in a row all digits lie on one straight line."""
    drums, heights = scores.shape[:2]
    along = np.linspace(-1.0, 1.0, drums)
    rows = []
    for rise in RISES_PX:
        moved = np.rint(rise * along).astype(int)
        for height in range(heights):
            if height + moved.min() >= 0 and height + moved.max() < heights:
                rows.append(scores[np.arange(drums), height + moved])
    return np.concatenate(rows, axis=1)


@lru_cache(maxsize=8)
def _drawings(columns: int) -> Float32:
    """Return (variants, turned, 10, pixels) drums as they look in a cell of so many columns, without mean and of unit length."""
    tall_px = [height * ROWS / CELL_HEIGHT for height in HEIGHTS]
    strips = []
    for font, stroke, tall, narrowed in product(FONTS, STROKES, tall_px, NARROWED):
        sharp = [_drawn(digit, font, tall, stroke, narrowed, columns) for digit in range(10)]
        strips += [[cv2.GaussianBlur(digit, (0, 0), blur) for digit in sharp] for blur in BLURS_PX]
    digits = np.array(strips, np.float32)
    drums = np.stack([_turned(digits, share) for share in TURNED], axis=1)
    return _unit(drums.reshape(*drums.shape[:3], ROWS * columns))


def _drawn(digit: int, font: str | int, height_px: float, stroke: float, narrowed: float, columns: int) -> Float32:
    """Draw a digit in the middle of a cell with a cell's room above and below, drawn larger and reduced."""
    zoom = DRAWN_LARGER
    canvas = np.zeros((3 * ROWS * zoom, 2 * columns * zoom), np.uint8)
    thick = max(1, round(stroke * height_px * zoom))
    tall = height_px * zoom - thick
    if isinstance(font, str):
        for line in SHAPES[font][digit]:
            at = np.array(line) * [tall, -tall] + [0.5 * columns * zoom, 1.5 * ROWS * zoom + tall / 2]
            cv2.polylines(canvas, [np.rint(at * 16).astype(np.int32)], False, 255, thick, cv2.LINE_AA, 4)
    else:  # a Hershey digit is 21 units tall
        origin = (round(0.5 * columns * zoom), round(1.5 * ROWS * zoom + tall / 2))
        cv2.putText(canvas, str(digit), origin, font, tall / 21.0, 255, thick, cv2.LINE_AA)
    middle = float(np.flatnonzero(canvas.any(axis=0))[[0, -1]].mean())
    move = np.array([[narrowed, 0.0, columns * zoom / 2 - narrowed * middle], [0.0, 1.0, 0.0]])
    moved = cv2.warpAffine(canvas, move, (columns * zoom, 3 * ROWS * zoom))
    return np.asarray(cv2.resize(moved, (columns, 3 * ROWS), interpolation=cv2.INTER_AREA), np.float32)


def _turned(digits: Float32, share: float) -> Float32:
    """Return drums on the way from each of (variants, 10, 3 ROWS, columns) digits to the next, which comes up from below."""
    pitch = DRUM_PITCH * ROWS / CELL_HEIGHT
    return _window(digits, share * pitch) + _window(np.roll(digits, -1, axis=1), (share - 1.0) * pitch)


def _window(strips: Float32, up_px: float) -> Float32:
    """Return the `ROWS` in the middle of (variants, 10, 3 ROWS, columns) strips that were moved up, interpolated linearly."""
    whole = math.floor(up_px)
    part = np.float32(up_px - whole)
    padded = np.pad(strips, ((0, 0), (0, 0), (ROWS, ROWS), (0, 0)))
    upper, lower = (padded[:, :, first : first + ROWS] for first in (2 * ROWS + whole, 2 * ROWS + whole + 1))
    return np.asarray((1.0 - part) * upper + part * lower, np.float32)


def _unit(rows: Float32) -> Float32:
    """Return rows without their mean, of unit length."""
    free = rows - rows.mean(axis=-1, keepdims=True)
    return np.asarray(free / np.maximum(np.linalg.norm(free, axis=-1, keepdims=True), 1e-6), np.float32)


READER = Reader[Counter](read=read_counter, is_telling=True)
