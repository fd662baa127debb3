"""Reader of displays in photographs: seven segments, dots, or the drums of a counter, cropped or somewhere in a scene."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from perception.vision.image import as_gray
from perception.vision.photographs.digit_search import DigitRow, find_digit_rows
from perception.vision.photographs.dot_matrix import read_dots
from perception.vision.photographs.drum_search import read_counter_in
from perception.vision.reading import ANSWER_AT, PatchReading, answer_at, gated, limited, refused
from perception.vision.status.digit_grid_worth import slant_energies
from perception.vision.status.display import read_window
from perception.vision.status.glyphs import lit_segments

DIGIT_WINDOW_PX = 64
SCENE_PX = 640  # larger sides are reduced to this for the search
ROWS_TRIED = 4  # rows of digits that are read
ROOM_ABOVE, ROOM_BESIDE = 0.5, 1.6  # margins around a row's cells, relative to the digit height
TURNS = np.tan(np.deg2rad(np.arange(-8.0, 8.1, 1.0)))  # tangents of the tried rotations
RIVAL = 0.3  # weight of other texts read nearby, which lower the confidence
ROW = 0.35  # weight, relative to that of a crop's reading, of a row of digits in it with another text
FEW, FEW_OF_SCENE = 4.0, 5.6  # numbers of segments, see `_agreed`; in scenes fewer segments give less confidence
OF_DRUMS = 0.75  # highest confidence of a counter, whose number of drums is not known
OF_DOTS = 0.75  # highest confidence of a number of dots, whose minus or point may not be seen
FRAME = 0.08  # of a crop's height, which a frame may cover


def read_photographed_display(image: NDArray[Any], *, scene: bool, least_confidence: float = ANSWER_AT) -> PatchReading:
    """Read the display in a photograph.

    Args:
        image: gray or RGB uint8.
        scene: False if the image is cropped to the display.
        least_confidence: as of `inspection.inspect`.

    Raises:
        InvalidRequest, NotObservable: bad image.
    """
    gray = as_gray(image)
    seven = read_segments(gray, scene=scene)
    found = [] if seven is None else [seven]
    if seven is None or not (seven.answered and seven.confidence > OF_DRUMS):
        counter = read_counter_in(gray)
        found += [] if counter is None else [limited(counter, OF_DRUMS)]
        dots = read_dots(gray, is_scene=scene)
        found += [] if dots is None else [limited(dots, OF_DOTS)]
    if not found:
        return refused("no display is found in the picture: crop it, or come closer")
    return answer_at(max(found, key=lambda answer: answer.confidence), least_confidence)


def read_segments(gray: Image, *, scene: bool) -> PatchReading | None:
    """Return the reading of the seven-segment digits in a picture (H, W), or the likeliest refusal; None without any."""
    rows = [(share, answer) for window in _rows(gray) for share, answer in _read(window)]
    answers = rows if scene else _with_rows([pair for window in _crops(gray) for pair in _read(window)], rows)
    return _agreed(answers, FEW_OF_SCENE if scene else FEW) if answers else None


def _read(place: tuple[Image, bool | None, float]) -> list[tuple[float, PatchReading]]:
    """Return the readings of a window, with and without the ink that touches its border, and the window's weight.

    `place`: the window, whether its ink is dark (None: unknown), and its weight.
    """
    window, dark, share = place
    straight = _straight(_scaled(window))
    return [
        (share, read_window(straight, digits=None, decimals=None, dark=dark, framed=framed)) for framed in (True, False)
    ]


def _with_rows(
    whole: list[tuple[float, PatchReading]], rows: list[tuple[float, PatchReading]]
) -> list[tuple[float, PatchReading]]:
    """Return the readings of a crop, and those of rows of digits found in it.

    A row may lack digits, but has no frame and no words beside it. Its reading gets the full weight if the crop has the
    same text, even as a guess.
    """
    supposed = {said.text for _, answer in whole if (said := answer.guess or answer).text is not None}
    return whole + [(1.0 if answer.text in supposed else ROW * share, answer) for share, answer in rows]


def _agreed(answers: list[tuple[float, PatchReading]], few: float = FEW) -> PatchReading:
    """Return the reading with the most weight, or the likeliest refusal if nothing was read.

    Its confidence is lower if there are rivals, the place is doubtful, or segments are few (any bar resembles a 1).

    Args:
        answers: each with the weight of the place where it was read.
        few: number of segments for which the confidence is limited to 1 - 1/e.
    """
    weighed = [
        (share * answer.confidence * float(np.sqrt(lit_segments(answer.text))), share, answer)
        for share, answer in answers
        if answer.text is not None
    ]
    if not weighed:
        return max((answer for _, answer in answers), key=lambda answer: answer.confidence)
    most, _, best = max(weighed, key=lambda found: found[0])
    rivals: dict[str, float] = {}
    for weight, _, answer in weighed:
        if answer.text is not None and answer.text != best.text:
            rivals[answer.text] = max(weight, rivals.get(answer.text, 0.0))
    placed = max(0.5 * (1 + share) * answer.confidence for _, share, answer in weighed if answer.text == best.text)
    enough = 1.0 - float(np.exp(-lit_segments(best.text or "") / few))
    return gated(limited(best, min(best.confidence * most / (most + RIVAL * sum(rivals.values())), placed, enough)))


def _crops(gray: Image) -> list[tuple[Image, bool | None, float]]:
    """Return the whole crop, and the window inside its frame, with unknown polarity and weight 1."""
    inset = round(FRAME * len(gray))
    inner = gray[inset : gray.shape[0] - inset, inset : gray.shape[1] - inset]
    return [(part, None, 1.0) for part in ((gray, inner) if min(gray.shape) > 4 * inset + 24 else (gray,))]


def _rows(gray: Image) -> list[tuple[Image, bool | None, float]]:
    """Return the likeliest rows of digits in a scene, with a margin around them, their polarity and weight."""
    scale = min(1.0, SCENE_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else gray
    rows = find_digit_rows(np.asarray(small, np.uint8))[:ROWS_TRIED]
    found = [(_window(gray, row, scale), row.is_dark, float(np.sqrt(row.score / rows[0].score))) for row in rows]
    return [place for place in found if min(place[0].shape) >= 12]


def _window(gray: Image, row: DigitRow, scale: float) -> Image:
    """Return the part of the image around a row that was found in a copy scaled by `scale`."""
    above, beside = ROOM_ABOVE * row.height, ROOM_BESIDE * row.height
    x0, x1 = (max(0, round(x / scale)) for x in (row.left - beside, row.right + beside))
    y0, y1 = (max(0, round(y / scale)) for y in (row.top - above, row.bottom + above))
    return gray[y0:y1, x0:x1]


def _scaled(window: Image) -> Image:
    """Return the window with a height of `DIGIT_WINDOW_PX`."""
    factor = DIGIT_WINDOW_PX / window.shape[0]
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(window, None, fx=factor, fy=factor, interpolation=how), np.uint8)


def _straight(window: Image) -> Image:
    """Return the window sheared so that the horizontal edges of the digits and of the frame are level.

    The shear approximates a rotation; the reader itself finds the remaining slant of the uprights.
    """
    edges = np.abs(cv2.Sobel(cv2.GaussianBlur(window, (0, 0), 1.0), cv2.CV_32F, 0, 1))
    energies = slant_energies(np.ascontiguousarray(edges.T), TURNS)
    turn = -float(TURNS[int(energies.argmax())])
    if turn == 0.0:
        return window
    shear = np.array([[1.0, 0.0, 0.0], [turn, 1.0, -turn * (window.shape[1] - 1) / 2]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(window, shear, window.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )
