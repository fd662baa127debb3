"""Reads instruments in users' photographs from their kind, and their scale if it is told, without teaching."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from service.schema.results import PhotographGuess, PhotographPointer, PhotographReading, PhotographScale

if TYPE_CHECKING:
    from perception.vision import PhotographKind
    from service.knowledge.images import ImageStore
    from service.schema.requests import ReadPhotographRequest


def read_stored_photograph(images: ImageStore, request: ReadPhotographRequest) -> PhotographReading:
    """Read the instrument in a stored photograph.

    Raises:
        NoSuchImage: there is no such image.
        InvalidRequest: the scale does not fit the kind.
        NotObservable: no instrument can be read in the image.
    """
    return read_pixels(
        images.pixels(request.image), request.kind, scale=request.scale, ends_rad=request.ends_rad,
        pointer=request.pointer, unit=request.unit, is_scene=request.is_scene, least_confidence=request.least_confidence,
    )  # fmt: skip


def read_pixels(
    pixels: NDArray[np.uint8],
    kind: PhotographKind,
    *,
    scale: tuple[float, float] | None,
    ends_rad: tuple[float, float] | None,
    pointer: Literal["black", "red"] | None = None,
    unit: str,
    is_scene: bool,
    least_confidence: float,
) -> PhotographReading:
    """Read the instrument in a photograph; errors as for `read_stored_photograph`."""
    from perception.vision import read_photograph

    found = read_photograph(
        pixels,
        kind,
        scale=scale,
        ends_rad=ends_rad,
        pointer=pointer,
        is_scene=is_scene,
        least_confidence=least_confidence,
    )
    guess = found.guess
    return PhotographReading(
        kind=kind,
        answered=found.answered,
        value=found.value,
        unit=unit,
        uncertainty=found.uncertainty,
        text=found.text,
        confidence=found.confidence,
        reason=found.reason,
        guess=None if guess is None else PhotographGuess.model_validate(guess),
        pointers=tuple(PhotographPointer.model_validate(seen) for seen in found.pointers),
        scale=None if found.scale is None else PhotographScale.model_validate(found.scale),
    )
