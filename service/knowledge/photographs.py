"""Reads instruments in users' photographs without teaching, and draws what was read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from service.schema.results import (
    PhotographFace,
    PhotographGuess,
    PhotographMotion,
    PhotographPointer,
    PhotographReading,
    PhotographScale,
)

if TYPE_CHECKING:
    from service.knowledge.images import ImageStore
    from service.schema.requests import InstrumentKind, ReadPhotographRequest

TURN_RAD = 2 * np.pi - 1e-6  # of a scale that is a full turn


def read_stored_photograph(images: ImageStore, request: ReadPhotographRequest) -> PhotographReading:
    """Read the instrument in a stored photograph, or in several.

    Raises:
        NoSuchImage: there is no such image.
        InvalidRequest: the scale does not fit the kind.
        NotObservable: no instrument can be read in the image.
    """
    pictures = [images.pixels(image) for image in (request.image, *request.further)]
    return read_pictures(
        pictures, request.kind, scale=request.scale, ends_rad=request.ends_rad, pointer=request.pointer, unit=request.unit,
        is_scene=request.is_scene, least_confidence=request.least_confidence,
    )  # fmt: skip


def read_pictures(
    pictures: Sequence[NDArray[np.uint8]],
    kind: InstrumentKind | None,
    *,
    scale: tuple[float, float] | None,
    ends_rad: tuple[float, float] | None,
    pointer: Literal["black", "red"] | None = None,
    unit: str,
    is_scene: bool,
    least_confidence: float,
) -> PhotographReading:
    """Read the instrument in one picture, or in several, oldest first; errors as for `read_stored_photograph`."""
    from perception.vision import over_pictures, read_photograph

    readings = [
        read_photograph(
            pixels, kind, scale=scale, ends_rad=ends_rad, pointer=pointer, is_scene=is_scene,
            least_confidence=least_confidence,
        )
        for pixels in pictures
    ]  # fmt: skip
    found = readings[0] if len(readings) == 1 else over_pictures(readings)
    guess = found.guess
    reading = PhotographReading(
        kind=kind,
        answered=found.answered,
        value=found.value,
        unit=unit or found.unit,
        uncertainty=found.uncertainty,
        text=found.text,
        confidence=found.confidence,
        reason=found.reason,
        guess=None if guess is None else PhotographGuess.model_validate(guess),
        pointers=tuple(PhotographPointer.model_validate(seen) for seen in found.pointers),
        scale=None if found.scale is None else PhotographScale.model_validate(found.scale),
        face=None if found.face is None else PhotographFace.model_validate(found.face),
        motion=None if found.motion is None else PhotographMotion.model_validate(found.motion),
    )
    return reading if kind else reading.model_copy(update={"kind": _kind_of(reading)})


def _kind_of(found: PhotographReading) -> InstrumentKind | None:
    """Return the kind of instrument that a reading is of; None if none was found."""
    if found.face is not None:
        is_turn = found.scale is not None and abs(found.scale.at_max_rad - found.scale.at_min_rad) > TURN_RAD
        return "dial" if is_turn else "gauge"
    return None if found.text is None and found.guess is None else "display"


def draw_reading(pixels: NDArray[np.uint8], found: PhotographReading) -> Image:
    """Return the picture with the face that was found, the ends of its scale and its pointer, each with its value."""
    from perception.vision import draw_outlines

    face = found.face
    if face is None:
        return draw_outlines(pixels, [], [], [])
    guess = found.value if found.guess is None else found.guess.value
    outlines, texts = [_places(face, np.linspace(0, 2 * np.pi, 90), (1.0,))], [f"{found.kind}"]
    if found.scale is not None:
        low, high = found.scale.minimum, found.scale.maximum
        for value, text in ((low, f"{low:g}"), (high, f"{high:g}"), (guess, "" if guess is None else f"{guess:.4g}")):
            if value is not None:
                share = (value - low) / (high - low)
                angle_rad = found.scale.at_min_rad + share * (found.scale.at_max_rad - found.scale.at_min_rad)
                outlines.append(
                    _places(face, np.array([angle_rad]), (0.0, 0.9) if text and value == guess else (0.9, 1.1))
                )
                texts.append(text)
    return draw_outlines(pixels, outlines, texts, [found.answered] * len(texts))


def _places(face: PhotographFace, angles_rad: NDArray[np.float64], shares: tuple[float, ...]) -> NDArray[np.float64]:
    """Return the places (N, 2) of directions, clockwise from up, at shares of the radius of a face."""
    ways = np.column_stack([np.sin(angles_rad), np.cos(angles_rad)]) @ np.array([face.right, face.up])
    return np.concatenate([np.asarray(face.middle) + share * ways for share in shares])
