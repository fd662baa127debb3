"""Reader of one dial that fills a photograph of a meter or gauge; nothing is taught, and at most its scale is told.

The search for its pointers is in `hands`, that for the ends of its scale in `scale_ends`, and that for the scale itself, by its
numerals, in `numerals` and `numeral_scale`. `units` reads the unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
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


def read_dial(
    image: NDArray[Any], *, minimum: float, maximum: float, circular: bool, ends_rad: tuple[float, float] | None = None,
    pointer: Pointer | None = None, least_confidence: float = ANSWER_AT,
) -> PatchReading:  # fmt: skip
    """Read the dial that fills the picture.

    Args:
        image: gray or RGB uint8, cropped to the dial.
        minimum, maximum: values at the ends of the scale, of which the first is left when the scale runs clockwise; a
            minimum above the maximum says that the values fall clockwise.
        circular: whether the scale is a full turn that begins straight up.
        ends_rad: pointer angles at minimum and maximum of a scale that is not circular. If None, the numerals tell them,
            else the ends of the ticks, or they are three quarters of a turn if these are not found.
        pointer: which one is read if there is a red one beside another one; `black` is the one that is not red.
        least_confidence: as of `inspection.inspect`.

    Raises:
        InvalidRequest, NotObservable: bad image.
    """
    picture, circle, face = _at_reading_size(image)
    if circular or ends_rad is not None:
        scale = partial(_scale_of, as_gray(picture), circle, (minimum, maximum), ends_rad, circular=circular)
    else:
        scale = partial(_told_scale, as_gray(image), as_gray(picture), circle, (minimum, maximum))
    red_most = 1.0 if circular else RED_UNASKED
    found = _read(picture, circle, scale, pointer, red_most=red_most, least_confidence=least_confidence)
    return replace(found, face=face, unit=_unit_in(as_gray(image), circle, found))


def read_by_numerals(
    image: NDArray[Any], *, pointer: Pointer | None = None, least_confidence: float = ANSWER_AT
) -> PatchReading:
    """Read the dial that fills the picture by the scale that its numerals tell; arguments and errors as of `read_dial`.

    Of several scales the outer one is read.
    """
    picture, circle, face = _at_reading_size(image)
    scale = partial(_printed_scale, as_gray(image), circle)
    found = _read(picture, circle, scale, pointer, red_most=RED_UNASKED, least_confidence=least_confidence)
    return replace(found, face=face, unit=_unit_in(as_gray(image), circle, found))


def _unit_in(gray: Image, circle: tuple[float, float, float], found: PatchReading) -> str:
    """Return the unit that is printed on the dial of an answer, in a picture at its own size; `circle` as of `_printed_scale`."""
    ratio = max(gray.shape) / SIDE_PX
    return find_unit(gray, *(ratio * one for one in circle)) if found.answered else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class _ReadScale:
    """What reads a pointer on a scale, the largest confidence that the scale justifies, and what it is."""

    status_of: Callable[[PointerFit], PatchReading]
    most: float
    seen: SeenScale

    @staticmethod
    def on(scale: Scale, most: float, *, by_numerals: bool = False) -> _ReadScale:
        """Return what reads a pointer on a scale over a part of a turn; `by_numerals` as of `SeenScale`."""
        return _ReadScale(
            status_of=partial(status_of_pointer, scale=scale, seen=1.0), most=most,
            seen=SeenScale(
                minimum=scale.minimum, maximum=scale.maximum, at_min_rad=scale.at_min, at_max_rad=scale.at_max,
                by_numerals=by_numerals,
            ),
        )  # fmt: skip

    @staticmethod
    def on_full_turn(ends: tuple[float, float], most: float, *, by_numerals: bool = False) -> _ReadScale:
        """Return what reads a pointer on a full turn from straight up with these values at its ends, clockwise."""
        first, last = ends
        at_min, at_max = (0.0, 2 * np.pi) if first < last else (2 * np.pi, 0.0)
        return _ReadScale(
            status_of=partial(_on_full_turn, minimum=first, maximum=last), most=most,
            seen=SeenScale(
                minimum=min(ends), maximum=max(ends), at_min_rad=at_min, at_max_rad=at_max, by_numerals=by_numerals
            ),
        )  # fmt: skip


def _read(
    picture: Image, circle: tuple[float, float, float], scale_of: Callable[[], _ReadScale | str], pointer: Pointer | None,
    *, red_most: float, least_confidence: float,
) -> PatchReading:  # fmt: skip
    """Return the reading of the pointer, or of the one that is asked for.

    Args:
        scale_of: returns the scale, or why it cannot be.
        red_most: largest confidence of a red pointer that nobody asked for.
    """
    hands = find_hands(picture, circle, pointer)
    if isinstance(hands, str):
        return refused(hands)
    scale = scale_of()
    if isinstance(scale, str):
        return refused(scale)
    seen = tuple(
        SeenPointer(colour=hand.colour, length=hand.length, value=shown.value)
        for hand in hands
        if len(hands) > 1 and (shown := answer_at(scale.status_of(hand.fit), 0.0)).value is not None
    )
    most = min(hands[0].most, scale.most)
    if hands[0].colour == "red" and pointer is None:
        most = min(most, red_most)
    status = replace(limited(scale.status_of(hands[0].fit), most), pointers=seen, scale=scale.seen)
    if len(hands) > 1 and pointer is None:
        return doubted(status, _which_is_meant(seen))
    if scale.seen.is_full_turn:  # its pointer may be a drop, which is short, as wide as a sector, and slow
        return answer_at(gated(status), least_confidence)
    if hands[0].length < SHORTEST:
        return doubted(status, TOO_SHORT)
    if is_swept(as_gray(picture), hands[0].fit, *circle):
        return doubted(status, MOVES)
    return answer_at(gated(status), least_confidence)


def _printed_scale(gray: Image, circle: tuple[float, float, float]) -> _ReadScale | str:
    """Return the outer one of the scales that the numerals of a picture at its own size tell.

    Args:
        circle: of the dial at the reading size.
    """
    scales = _scales_in(gray, circle)
    if not scales:
        return NO_SCALE
    turn = scales[0].full_turn()
    if turn is not None:
        ends = (0.0, turn) if turn > 0.0 else (-turn, 0.0)
        return _ReadScale.on_full_turn(ends, scales[0].confidence, by_numerals=True)
    printed = scales[0].whole()
    scale = Scale(
        minimum=printed.minimum, maximum=printed.maximum, unit="", at_min=printed.at_min, at_max=printed.at_max
    )
    return _ReadScale.on(scale, printed.confidence, by_numerals=True)


def _scales_in(gray: Image, circle: tuple[float, float, float]) -> list[PrintedScale]:
    ratio = max(gray.shape) / SIDE_PX
    return printed_scales(find_numbers(gray, *(ratio * one for one in circle)))


def _told_scale(
    gray: Image, reduced: Image, circle: tuple[float, float, float], values: tuple[float, float]
) -> _ReadScale | str:
    """Return a scale of which only the end values are told, with its ends by its numerals, or else by its ticks.

    Args:
        gray, reduced: the picture at its own and at the reading size.
    """
    low, high = min(values), max(values)
    for printed in _scales_in(gray, circle):
        ends_rad = printed.ends_of(low, high)
        if ends_rad is None:
            continue
        if values[0] > values[1] and ends_rad[0] < ends_rad[1]:
            return _runs_clockwise(values)
        scale = Scale(minimum=low, maximum=high, unit="", at_min=ends_rad[0], at_max=ends_rad[1])
        return _ReadScale.on(scale, SURE if printed.is_proven_if_told else BY_TICKS, by_numerals=True)
    return _scale_of(reduced, circle, values, None, circular=False)


def _scale_of(
    gray: Image, circle: tuple[float, float, float], values: tuple[float, float], ends_rad: tuple[float, float] | None,
    *, circular: bool,
) -> _ReadScale | str:  # fmt: skip
    """Return what a pointer shows, and the largest confidence that the scale justifies; or why it cannot be the scale.

    Without the angles of its ends nothing says that the values rise clockwise, unless the numerals are legible.
    """
    first, last = values
    if circular:
        run = numerals_run(gray, *circle) if _has_ten_numerals(first, last) else 0
        if first > last and run > 0:
            return _runs_clockwise(values)
        told = first > last or run > 0
        ends = (last, first) if run < 0 and first < last else values
        return _ReadScale.on_full_turn(ends, 1.0 if told else BY_NUMERALS)
    low, high = ends_rad or _ends(gray, *circle)
    at_min, at_max = (low, high) if first < last else (high, low)
    scale = Scale(minimum=min(values), maximum=max(values), unit="", at_min=at_min, at_max=at_max)
    most = BY_TICKS if ends_rad is None else NARROW if abs(high - low) < NARROW_RAD else 1.0
    return _ReadScale.on(scale, most)


def _runs_clockwise(values: tuple[float, float]) -> str:
    """Return the reason for a refusal if a scale is told to fall clockwise and its numerals rise."""
    first, last = values
    return f"the numerals run clockwise, so {first:g} to {last:g} is not their scale: give the least value first"


def _has_ten_numerals(first: float, last: float) -> bool:
    """Return whether a full turn shows the digits 0 to 9, possibly followed by zeros or times a power of ten."""
    return 0.0 in (first, last) and math.log10(abs(last - first)) % 1.0 == 0.0


def _on_full_turn(fit: PointerFit, *, minimum: float, maximum: float) -> PatchReading:
    """Return the reading of a pointer on a scale that is a full turn and begins straight up."""
    share = fit.angle_rad % (2 * np.pi) / (2 * np.pi)
    sigma = fit.sigma_rad / (2 * np.pi) * abs(maximum - minimum)
    return PatchReading(
        value=float(minimum + share * (maximum - minimum)), uncertainty=float(sigma), confidence=confidence_of(fit)
    )


def _which_is_meant(seen: tuple[SeenPointer, ...]) -> str:
    """Return the reason for a refusal if there are several pointers and none is asked for."""
    told = " and ".join(f"a {p.colour} one ({p.length:.2f} of the radius long) at {p.value:.4g}" for p in seen)
    return f"there are two pointers: {told or 'a black one and a red one'}. Say which one is meant, black or red"


def _at_reading_size(image: NDArray[Any]) -> tuple[Image, tuple[float, float, float], SeenFace]:
    """Return the picture with its longer side scaled to `SIDE_PX`, the dial in it (u, v and radius), and in the image."""
    scale = SIDE_PX / max(image.shape[:2])
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    picture = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=interpolation), np.uint8)
    u, v, radius = dial_circle(as_gray(image), scale)
    face = SeenFace(middle=(u / scale, v / scale), right=(radius / scale, 0.0), up=(0.0, -radius / scale))
    return picture, (u, v, radius), face


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
