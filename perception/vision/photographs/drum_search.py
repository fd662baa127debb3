"""Search for a mechanical counter in a picture: digits at equal distances on one line.

Marks of ink of the height of a digit are found against the mean of their surroundings. Three or more of one height, at
equal distances on one line, are a row. It is extended by drums that show a digit although it is no mark of its own, as
one that glare cuts; it ends before ink that reaches into the next place, as that of a unit does. `read_counter` reads it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.panel.counter import Counter
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, gated, limited
from perception.vision.status.counter import alike_drum, read_counter

MOST_PX = 960  # larger pictures are reduced to this
AROUND_PX = (31, 61, 121)  # sides of the squares over whose mean ink stands out
INK_LEVELS = 12  # gray levels by which ink differs from that mean
LEAST_PX, MOST_SHARE = 14, 0.5  # least height of a digit, and its largest ratio to the picture's smaller side
SLENDER, WIDE = 0.1, 0.95  # ratio of a digit's width to its height
MOST_MARKS, MOST_PAIRS, MOST_ROWS = 900, 3000, 4
NEAREST, FARTHEST = 0.85, 2.2  # distance of drums over a digit's height; printed numbers stand closer
SAME_HEIGHT, BESIDE, LEVEL = 0.2, 0.15, 0.2  # ratio of heights, distance from a row's places in heights, slope
LEAST_DRUMS, MOST_DRUMS = 3, 8
REACH = 3  # drums by which a row is extended at either end at most
LEAST_ALIKE = 0.66  # correlation of a drum that extends a row with its best digit
MIDDLE, NEXT = 0.3, 0.6  # distance from a drum's middle, in distances of drums, of its digit, and of what is beside it
DIGIT_PX = 40.0  # height of a digit in the patch
DIGIT_SHARES = (0.47, 0.52, 0.58)  # of the counter's height; with it differs how far apart the digits of a drum are
METRES_PER_PX = 0.001  # one pixel of the picture counts as a millimetre


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Row:
    """Drums at `first + k step`, px of the picture; height of a digit, px; number of drums; how well they fit."""

    first: Array
    step: Array
    height: float
    drums: int
    is_dark: bool
    off: float

    @property
    def middle(self) -> Array:
        """The middle between the first and the last drum."""
        return np.asarray(self.first + 0.5 * (self.drums - 1) * self.step)

    @property
    def pitch(self) -> float:
        """Distance of neighbouring drums, px."""
        return float(np.hypot(*self.step))


def read_counter_in(gray: Image) -> PatchReading | None:
    """Return the likeliest reading of a row of drums in a picture (H, W) uint8, or None.

    Its confidence is lower if other rows, or other heights of the digits on the drums, are read as another number.
    """
    scale = min(1.0, MOST_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else gray
    picture = np.asarray(small, np.uint8)
    found = [row for is_dark in (True, False) for row in find_rows(picture, is_dark=is_dark)]
    rows = [_extended(picture, row) for row in found if _shows_digits(picture, row)]
    told = [read_counter(_patch(picture, row), _counter(row, share)) for row in rows for share in DIGIT_SHARES]
    answers = [answer for answer in told if answer.answered]
    if not answers:
        return None
    best = max(answers, key=lambda answer: answer.confidence)
    rival = max((answer.confidence for answer in answers if answer.text != best.text), default=0.0)
    return gated(limited(best, best.confidence**2 / (best.confidence + rival)))


def find_rows(gray: Image, *, is_dark: bool) -> list[Row]:
    """Return the rows of marks at equal distances, those of most marks first."""
    marks = _marks(gray, is_dark)
    rows = sorted(_rows(marks, is_dark), key=lambda row: (-row.drums, row.off))
    kept: list[Row] = []
    for row in rows:
        if len(kept) < MOST_ROWS and not any(_are_one(row, other) for other in kept):
            kept.append(row)
    return kept


def _are_one(a: Row, b: Row) -> bool:
    """Return whether two rows are found at the same place."""
    return float(np.hypot(*(a.middle - b.middle))) < max(a.height, b.height) and abs(a.pitch - b.pitch) < 0.2 * b.pitch


def _above_mean(gray: Image, side_px: int, is_dark: bool) -> NDArray[np.bool_]:
    """Return where the picture is darker or brighter than the mean around."""
    over = gray.astype(np.int16) - cv2.blur(gray, (side_px, side_px))
    return np.asarray((-over if is_dark else over) > INK_LEVELS)


def _marks(gray: Image, is_dark: bool) -> Array:
    """Return (N, 3) middle and height of the connected pieces of ink as tall and wide as a digit, tallest first."""
    found = [np.zeros((0, 3))]
    for side in AROUND_PX:
        ink = _above_mean(gray, side, is_dark).astype(np.uint8)
        x, y, w, h, _ = cv2.connectedComponentsWithStats(ink)[2][1:].T
        fits = (
            (h >= LEAST_PX) & (h <= min(1.2 * side, MOST_SHARE * min(gray.shape))) & (w < WIDE * h) & (w > SLENDER * h)
        )
        found.append(np.column_stack([x + w / 2, y + h / 2, h])[fits])
    marks = np.concatenate(found)
    return np.asarray(marks[np.argsort(-marks[:, 2], kind="stable")][:MOST_MARKS], float)


def _rows(marks: Array, is_dark: bool) -> Iterator[Row]:
    """Yield the row through each pair of neighbouring marks, if it has enough of them."""
    across, down = (marks[:, axis] - marks[:, axis, None] for axis in (0, 1))
    tall = marks[:, 2]
    near = (across > NEAREST * tall[:, None]) & (across < FARTHEST * tall[:, None]) & (np.abs(down) < LEVEL * across)
    for i, j in np.argwhere(near & (np.abs(tall - tall[:, None]) < SAME_HEIGHT * tall[:, None]))[:MOST_PAIRS]:
        apart = np.column_stack([across[i], down[i]])
        step = apart[j]
        place = np.rint(apart @ step / (step @ step))
        off = np.hypot(*(apart - place[:, None] * step).T) / tall[i]
        good = (off < BESIDE) & (np.abs(tall - tall[i]) < SAME_HEIGHT * tall[i])
        taken = set(place[good].astype(int).tolist())
        low, high = 0, 1
        while low - 1 in taken:
            low -= 1
        while high + 1 in taken:
            high += 1
        if not LEAST_DRUMS <= high - low + 1 <= MOST_DRUMS:
            continue
        good &= (place >= low) & (place <= high)
        line = np.linalg.lstsq(np.column_stack([np.ones(good.sum()), place[good] - low]), marks[good, :2], rcond=None)[
            0
        ]
        yield Row(
            first=line[0], step=line[1], height=float(np.median(tall[good])), drums=high - low + 1, is_dark=is_dark,
            off=float(off[good].mean()),
        )  # fmt: skip


def _shows_digits(gray: Image, row: Row) -> bool:
    """Return whether most of the row's drums resemble a digit."""
    return float(np.median([_alike(gray, row, at) for at in range(row.drums)])) >= LEAST_ALIKE


def _extended(gray: Image, row: Row) -> Row:
    """Return the row with the drums beside it that show a digit whose ink ends before the next place."""
    inked = _above_mean(gray, int(2 * row.height) | 1, row.is_dark).astype(np.uint8)
    pieces = np.asarray(cv2.connectedComponents(inked)[1], np.int32)
    low, high = 0, row.drums - 1
    for ends in (range(-1, -1 - REACH, -1), range(row.drums, row.drums + REACH)):
        for at in ends:
            if high - low + 1 >= MOST_DRUMS or _reaches_out(pieces, row, at) or _alike(gray, row, at) < LEAST_ALIKE:
                break
            low, high = min(low, at), max(high, at)
    return _part(row, low, high)


def _part(row: Row, low: int, high: int) -> Row:
    """Return the places `low` to `high` of a row as a row."""
    return replace(row, first=row.first + low * row.step, drums=high - low + 1)


def _reaches_out(pieces: NDArray[np.int32], row: Row, at: int) -> bool:
    """Return whether a piece of ink in the middle of the place `at` of a row reaches into the next place."""
    along, across = np.meshgrid(np.linspace(-0.75, 0.75, 31), np.linspace(-0.5, 0.5, 21))
    up = np.array([-row.step[1], row.step[0]]) * row.height / row.pitch
    places = row.first + (at + along)[..., None] * row.step + across[..., None] * up
    u, v = np.moveaxis(np.clip(np.rint(places), 0, np.array(pieces.shape[::-1]) - 1).astype(int), -1, 0)
    seen = pieces[v, u]
    middle = set(seen[(np.abs(along) < MIDDLE) & (np.abs(across) < 0.4)].tolist()) - {0}
    return bool(middle & set(seen[np.abs(along) > NEXT].tolist()))


def _alike(gray: Image, row: Row, at: int) -> float:
    """Return how much the best digit resembles what stands at the place `at` of a row."""
    one = replace(_part(row, at, at), step=row.step * row.height / row.pitch)  # of one width, drawn once
    return max(alike_drum(_patch(gray, one), _counter(one, share)) for share in DIGIT_SHARES)


def _counter(row: Row, share: float) -> Counter:
    """Return the row as a counter of which only the size and the number of drums are known.

    `share`: height of a digit over the counter's.
    """
    return Counter.model_construct(
        name="counter", position_m=(0.0, 0.0), digits=row.drums, width_m=row.drums * row.pitch * METRES_PER_PX,
        height_m=row.height / share * METRES_PER_PX, ink="black" if row.is_dark else "white", minimum=0.0,
        maximum=10.0**row.drums - 1.0, decimals=0, unit="",
    )  # fmt: skip


def _patch(gray: Image, row: Row) -> Patch:
    """Return the part of the picture around a row, with its digits upright and DIGIT_PX high."""
    zoom = DIGIT_PX / row.height
    width, height = round((row.drums + 1) * row.pitch * zoom), round(4.0 * DIGIT_PX)
    right = row.step / row.pitch / zoom
    turn = np.column_stack([right, [-right[1], right[0]]])
    move = np.column_stack([turn, row.middle - turn @ [width / 2, height / 2]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (width, height)
    ones = np.ones(gray.shape, np.uint8)
    return Patch(
        gray=np.asarray(cv2.warpAffine(gray, move, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8),
        colour=None, inside=np.asarray(cv2.warpAffine(ones, move, size, flags=flags)) > 0, px_per_m=zoom / METRES_PER_PX,
        image_px_per_m=1.0 / METRES_PER_PX, origin_px=np.array([width / 2, height / 2]), parallax_px_per_m=np.zeros(2),
        growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip
