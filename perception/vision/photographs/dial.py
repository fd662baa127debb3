"""Reader of one dial that fills a photograph of a meter or gauge; nothing is taught, and at most its scale is told.

The search for its pointers is in `hands`, that for the ends of its scale in `scale_ends`, and that for the scale itself, by its
numerals, in `numerals` and `numeral_scale`. `units` reads the unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from hal.panel import Scale
from perception.vision.image import as_gray
from perception.vision.photographs.dial_outline import SIDE_PX, dial_circle
from perception.vision.photographs.hands import Pointer, confidence_of, find_hands
from perception.vision.photographs.motion import is_swept
from perception.vision.photographs.numeral_direction import numerals_run
from perception.vision.photographs.numeral_scale import SURE, PrintedScale, printed_scales
from perception.vision.photographs.numerals import find_numbers
from perception.vision.photographs.scale_ends import scale_ends
from perception.vision.photographs.units import find_unit
from perception.vision.reading import (
    ANSWER_AT,
    PatchReading,
    SeenFace,
    SeenPointer,
    SeenScale,
    answer_at,
    doubted,
    gated,
    limited,
    refused,
)
from perception.vision.status.gauge import status_of_pointer
from perception.vision.status.pointer import PointerFit

SCALE_END_RAD = np.deg2rad(135.0)  # almost all round gauges use three quarters of a turn
USUAL_RAD = np.deg2rad(10.0)  # ticks that end so near to that mean it, with one tick more or less
# A scale with the usual span whose middle is off by more than TURNED_RAD is rotated as a whole.
SAME_SPAN_RAD, TURNED_RAD = np.deg2rad([5.0, 3.0])
# If the middle of another span is farther from straight up, the ticks at one end are not visible.
LOPSIDED_RAD = np.deg2rad(10.0)
BY_NUMERALS = 0.75  # largest confidence if the numerals run against what was told, or are not legible
# Largest confidence of a reading on a narrow scale: in an oblique view the direction may be wrong by 2 degrees, which is
# more than 2.5 % of it.
NARROW, NARROW_RAD = 0.75, np.deg2rad(75.0)
RED_UNASKED = 0.75  # largest confidence of a gauge's red pointer that nobody asked for: it may be that of a limit
NO_SCALE = "the numerals do not tell the scale: come closer, or give the values at its ends, for example 0 to 10"
# Share of the radius that every pointer reaches. What ends before is made of numerals and ticks on one line with the middle:
# of 190 pointers read correctly, drawn and real ones, none is shorter than .46; misread ones have .3 to .4.
SHORTEST = 0.42
TOO_SHORT = "no pointer that reaches the scale stands out: come closer, add light, or wait until the needle rests"
MOVES = (
    "the needle moves while the picture is taken: take several pictures with a short exposure, and read them together"
)
BY_TICKS = (
    0.75  # largest confidence if the ends are not told: one may be off by a tick, or the values may fall clockwise
)
Told = tuple[SeenScale, float] | str
"""A scale and the largest confidence that it justifies; or why it cannot be the scale."""


def read_dial(
    image: NDArray[Any], scale: tuple[float, float] | None, *, is_turn: bool = False,
    ends_rad: tuple[float, float] | None = None, pointer: Pointer | None = None, least_confidence: float = ANSWER_AT,
) -> PatchReading:  # fmt: skip
    """Read the dial that fills the picture.

    Args:
        image: gray or RGB uint8, cropped to the dial.
        scale: values at the ends of the scale, of which the first is left when the scale runs clockwise; it is the greater
            one where the values fall clockwise. None: the scale is the outer one of those that the numerals tell.
        is_turn: whether the scale is a full turn that begins straight up.
        ends_rad: pointer angles at the ends of a scale that is not. If None, the numerals tell them, else the ends of the
            ticks, or they are three quarters of a turn if these are not found.
        pointer: which one is read if there is a red one beside another one; `black` is the one that is not red.
        least_confidence: as of `inspection.inspect`.

    Raises:
        InvalidRequest, NotObservable: bad image.
    """
    gray = as_gray(image)
    factor = SIDE_PX / max(gray.shape)
    interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    picture = np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=interpolation), np.uint8)
    circle = dial_circle(gray, factor)
    u, v, radius = (one / factor for one in circle)

    def told() -> Told:
        scales = [] if is_turn or ends_rad is not None else printed_scales(find_numbers(gray, u, v, radius))
        if scale is None:
            return _printed(scales)
        return _by_numerals(scales, scale) or _scale_of(as_gray(picture), circle, scale, ends_rad, is_turn=is_turn)

    red_most = 1.0 if is_turn else RED_UNASKED
    found = _read(picture, circle, told, pointer, red_most=red_most, least_confidence=least_confidence)
    face = SeenFace(middle=(u, v), right=(radius, 0.0), up=(0.0, -radius))
    return replace(found, face=face, unit=find_unit(gray, u, v, radius) if found.answered else "")


def _read(
    picture: Image, circle: tuple[float, float, float], told: Callable[[], Told], pointer: Pointer | None,
    *, red_most: float, least_confidence: float,
) -> PatchReading:  # fmt: skip
    """Return the reading of the pointer, or of the one that is asked for.

    Args:
        red_most: largest confidence of a red pointer that nobody asked for.
    """
    hands = find_hands(picture, circle, pointer)
    if isinstance(hands, str):
        return refused(hands)
    scale = told()
    if isinstance(scale, str):
        return refused(scale)
    on, most = scale
    seen = tuple(
        SeenPointer(colour=hand.colour, length=hand.length, value=shown.value)
        for hand in hands
        if len(hands) > 1 and (shown := answer_at(_shown(hand.fit, on), 0.0)).value is not None
    )
    most = min(hands[0].most, most)
    if hands[0].colour == "red" and pointer is None:
        most = min(most, red_most)
    status = replace(limited(_shown(hands[0].fit, on), most), pointers=seen, scale=on)
    if len(hands) > 1 and pointer is None:
        return doubted(status, _which_is_meant(seen))
    if not on.is_full_turn:  # on which a pointer may be a drop, which is short, as wide as a sector, and slow
        if hands[0].length < SHORTEST:
            return doubted(status, TOO_SHORT)
        if is_swept(as_gray(picture), hands[0].fit, *circle):
            return doubted(status, MOVES)
    return answer_at(gated(status), least_confidence)


def _shown(fit: PointerFit, on: SeenScale) -> PatchReading:
    """Return the reading of a pointer on a scale."""
    if not on.is_full_turn:
        scale = Scale(minimum=on.minimum, maximum=on.maximum, unit="", at_min=on.at_min_rad, at_max=on.at_max_rad)
        return status_of_pointer(fit, scale, 1.0)
    low_rad = min(on.at_min_rad, on.at_max_rad)
    share = (low_rad + (fit.angle_rad - low_rad) % (2 * np.pi) - on.at_min_rad) / (on.at_max_rad - on.at_min_rad)
    span = on.maximum - on.minimum
    return PatchReading(
        value=float(on.minimum + share * span), uncertainty=float(fit.sigma_rad / (2 * np.pi) * span),
        confidence=confidence_of(fit),
    )  # fmt: skip


def _full_turn(first: float, last: float, *, by_numerals: bool = False) -> SeenScale:
    """Return the scale of a full turn from straight up with these values at its ends, clockwise."""
    at_min, at_max = (0.0, 2 * np.pi) if first < last else (2 * np.pi, 0.0)
    return SeenScale(
        minimum=min(first, last),
        maximum=max(first, last),
        at_min_rad=at_min,
        at_max_rad=at_max,
        by_numerals=by_numerals,
    )


def _printed(scales: Sequence[PrintedScale]) -> Told:
    """Return the outer one of the scales that the numerals tell."""
    if not scales:
        return NO_SCALE
    turn = scales[0].full_turn()
    if turn is not None:
        return _full_turn(max(0.0, -turn), max(0.0, turn), by_numerals=True), scales[0].confidence
    whole = scales[0].whole()
    on = SeenScale(
        minimum=whole.minimum, maximum=whole.maximum, at_min_rad=whole.at_min, at_max_rad=whole.at_max, by_numerals=True
    )
    return on, whole.confidence


def _by_numerals(scales: Sequence[PrintedScale], values: tuple[float, float]) -> Told | None:
    """Return a scale of which only the end values are told, with its ends by its numerals; None without them."""
    low, high = min(values), max(values)
    for printed in scales:
        ends_rad = printed.ends_of(low, high)
        if ends_rad is None:
            continue
        if values[0] > values[1] and ends_rad[0] < ends_rad[1]:
            return _runs_clockwise(values)
        on = SeenScale(minimum=low, maximum=high, at_min_rad=ends_rad[0], at_max_rad=ends_rad[1], by_numerals=True)
        return on, SURE if printed.is_proven_if_told else BY_TICKS
    return None


def _scale_of(
    gray: Image, circle: tuple[float, float, float], values: tuple[float, float], ends_rad: tuple[float, float] | None,
    *, is_turn: bool,
) -> Told:  # fmt: skip
    """Return a scale that is told, with its ends by its ticks, or as usual, if they are not.

    Without the angles of its ends nothing says that the values rise clockwise, unless the numerals are legible.
    """
    first, last = values
    if is_turn:
        run = numerals_run(gray, *circle) if _has_ten_numerals(first, last) else 0
        if first > last and run > 0:
            return _runs_clockwise(values)
        ends = (last, first) if run < 0 and first < last else values
        return _full_turn(*ends), 1.0 if first > last or run > 0 else BY_NUMERALS
    low, high = ends_rad or _ends(gray, *circle)
    at_min, at_max = (low, high) if first < last else (high, low)
    most = BY_TICKS if ends_rad is None else NARROW if abs(high - low) < NARROW_RAD else 1.0
    return SeenScale(minimum=min(values), maximum=max(values), at_min_rad=at_min, at_max_rad=at_max), most


def _runs_clockwise(values: tuple[float, float]) -> str:
    """Return the reason for a refusal if a scale is told to fall clockwise and its numerals rise."""
    first, last = values
    return f"the numerals run clockwise, so {first:g} to {last:g} is not their scale: give the least value first"


def _has_ten_numerals(first: float, last: float) -> bool:
    """Return whether a full turn shows the digits 0 to 9, possibly followed by zeros or times a power of ten."""
    return 0.0 in (first, last) and math.log10(abs(last - first)) % 1.0 == 0.0


def _which_is_meant(seen: tuple[SeenPointer, ...]) -> str:
    """Return the reason for a refusal if there are several pointers and none is asked for."""
    told = " and ".join(f"a {p.colour} one ({p.length:.2f} of the radius long) at {p.value:.4g}" for p in seen)
    return f"there are two pointers: {told or 'a black one and a red one'}. Say which one is meant, black or red"


def _ends(gray: Image, u: float, v: float, radius: float) -> tuple[float, float]:
    """Return the pointer angles at the ends of the scale by its ticks, or the usual ones."""
    usual = (-SCALE_END_RAD, SCALE_END_RAD)
    by_ticks = scale_ends(gray, u, v, radius)
    if by_ticks is None:
        return usual
    wider_rad, turned_rad = by_ticks[1] - by_ticks[0] - 2 * SCALE_END_RAD, 0.5 * (by_ticks[0] + by_ticks[1])
    if abs(wider_rad) < SAME_SPAN_RAD and abs(turned_rad) > TURNED_RAD:
        return usual[0] + turned_rad, usual[1] + turned_rad
    nearly_usual = 0.5 * abs(wider_rad) + abs(turned_rad) < USUAL_RAD
    return usual if nearly_usual or abs(turned_rad) > LOPSIDED_RAD else by_ticks
