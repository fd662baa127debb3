"""Reader of one instrument in a photograph, of which nothing need be known: neither place, nor kind, nor scale."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hal.errors import InvalidRequest
from perception.vision.image import check_image
from perception.vision.photographs.anywhere import read_anything, read_face_anywhere
from perception.vision.photographs.dial import MOVES, read_dial
from perception.vision.photographs.hands import Pointer
from perception.vision.photographs.photo_display import read_photographed_display
from perception.vision.reading import ANSWER_AT, PatchReading

PhotographKind = Literal["gauge", "dial", "display"]


def read_photograph(
    image: NDArray[Any],
    kind: PhotographKind | None = None,
    *,
    scale: tuple[float, float] | None = None,
    ends_rad: tuple[float, float] | None = None,
    pointer: Pointer | None = None,
    is_scene: bool = False,
    least_confidence: float = ANSWER_AT,
) -> PatchReading:
    """Read the instrument that fills a photograph, or is somewhere in it.

    A round face may be seen aslant by up to 50 degrees. A picture of several instruments is refused.

    Args:
        image: (H, W) gray or (H, W, 3) RGB uint8.
        kind: `gauge`: a pointer over a part of a turn; `dial`: a pointer over a full turn that begins straight up, as
            in a water meter; `display`: seven-segment digits, or the drums of a counter. None: whichever is found
            anywhere in the picture.
        scale: values at the ends of a gauge's or a dial's scale, in the clockwise sense; the first is the greater one
            where the values fall clockwise. Without it a gauge is read by its numerals.
        ends_rad: pointer angles of a gauge there, clockwise from straight up. If None, they are the ends of the ticks,
            or three quarters of a turn if these are not found.
        pointer: which pointer is read where a red one stands beside another one; `black` is the one that is not red.
        is_scene: whether an instrument whose kind is told is somewhere in the picture, not cropped.
        least_confidence: 0 to 1; less certain readings are refused, with a guess.

    Raises:
        InvalidRequest: a scale is missing, or given for a kind that has none; a bad image.
        NotObservable: the image is black or saturated.
    """
    _check(kind, scale=scale, ends_rad=ends_rad, pointer=pointer)
    check_image(image)
    if kind == "display":
        return read_photographed_display(image, scene=is_scene, least_confidence=least_confidence)
    read = partial(
        read_dial, scale=scale, is_turn=kind == "dial", ends_rad=ends_rad, pointer=pointer, least_confidence=least_confidence
    )  # fmt: skip
    if kind is None and scale is None and pointer is None:
        return read_anything(image, read, least_confidence)
    if kind is None or is_scene:
        return read_face_anywhere(image, read, is_scene=is_scene)
    filling = read(image)
    if filling.answered or filling.pointers or filling.reason == MOVES:  # several pointers need a word of the caller
        return filling
    found = read_face_anywhere(image, read, is_scene=True)
    return found if found.answered else filling


def _check(
    kind: PhotographKind | None, *, scale: tuple[float, float] | None, ends_rad: tuple[float, float] | None,
    pointer: Pointer | None,
) -> None:  # fmt: skip
    """Check that scale, ends and pointer suit the kind.

    Raises:
        InvalidRequest: they do not.
    """
    if kind == "display":
        if scale is not None or ends_rad is not None or pointer is not None:
            raise InvalidRequest(
                "a display has no scale and no pointer",
                hint="leave scale, ends and pointer out, or say which kind it is",
            )
        return
    if scale is None:
        if kind == "dial":
            raise InvalidRequest("a dial is read by its scale", hint="give the values of one turn, for example 0 to 10")
        if ends_rad is not None:
            raise InvalidRequest("ends without a scale", hint="give the values at the ends, too, or leave both out")
        return
    if not np.isfinite(scale).all() or scale[0] == scale[1]:
        raise InvalidRequest(
            f"a scale from {scale[0]:g} to {scale[1]:g} cannot be",
            hint="give two different numbers, the values at its ends",
        )
    if ends_rad is None:
        return
    if kind == "dial":
        raise InvalidRequest("a dial is a full turn that begins straight up", hint="leave the ends out, or say gauge")
    if not 0.0 < abs(ends_rad[1] - ends_rad[0]) <= 2 * np.pi or max(map(abs, ends_rad)) > 2 * np.pi:
        raise InvalidRequest(
            f"pointer angles of {ends_rad[0]:g} and {ends_rad[1]:g} rad cannot be",
            hint="give radians clockwise from straight up, at most a turn apart; 135 degrees are 2.356",
        )
