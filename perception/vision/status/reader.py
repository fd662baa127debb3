"""Registration of readers: per kind, a function from a rectified patch to a status, and the patch that it needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from hal.arrays import Array, Image
from hal.panel import PanelObject
from hal.panel.kinds import READERS, part_of
from perception.vision.patch import Patch, rectify
from perception.vision.projection import PanelProjection
from perception.vision.reading import PatchReading, as_often_right

MARGIN = 1.25  # times the face, because readers also need the plate around the object
LAMP_MARGIN = 2.0
K = TypeVar("K", bound=PanelObject)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hints:
    """Knowledge beyond the image.

    Attributes:
        before: the previous reading, which decides between numbers that are about equally likely.
        digits_taught: whether the panel file states the number of digits and decimals of its displays.
    """

    before: float | None = None
    digits_taught: bool = True


@dataclass(frozen=True, kw_only=True)
class Reader(Generic[K]):
    """The reader of one kind.

    Attributes:
        read: returns the status of an object from a patch that shows the plane of its face, origin at its middle.
        guesses_right: share of its guesses that are correct even with weak evidence.
        is_telling: whether a confident reading proves that the object is present even if its outline has the plate's
            gray.
        margin, side_m: the patch is `margin` times the object's face plus `side_m` on every side, because a raised part
            appears displaced from its foot and the patch must contain both.
        leans: whether the object stands out like a bat; the patch then shows the plane of the plate and extends to
            where the tip appears.
    """

    read: Callable[[Patch, K], PatchReading]
    guesses_right: float = 0.0
    is_telling: bool = False
    margin: float = MARGIN
    side_m: float = 0.003
    leans: bool = False

    def status(self, patch: Patch, spec: K, hints: Hints) -> PatchReading:  # noqa: ARG002 - of use to some
        """Return the status of an object; `hints` only matter to kinds whose reader overrides this method."""
        return self.read(patch, spec)


def reader_of(kind: str) -> Reader[Any]:
    """Return the reader of a kind.

    Raises:
        Unsupported: the kind has none.
    """
    reader: Reader[Any] = part_of(READERS, kind)
    return reader


def read_patch(
    patch: Patch, spec: PanelObject, *, digits_taught: bool = True, before: float | None = None
) -> PatchReading:
    """Read one object with the reader of its kind; `before` helps to decide between a display's likely numbers."""
    reader = reader_of(spec.kind)
    status = reader.status(patch, spec, Hints(before=before, digits_taught=digits_taught))
    return as_often_right(status, reader.guesses_right)


def patch_of(image: Image, gray: Image, view: PanelProjection, spec: PanelObject, shift_px: Array) -> Patch:
    """Return the rectified patch that the reader of this object needs."""
    face, reader = spec.face, reader_of(spec.kind)
    side = reader.side_m
    if reader.leans:  # and the plate beyond its tip, to check that it ends there
        side += _lean_m(view, spec, face.height_m) + spec.envelope().half_m[0]
    return rectify(
        image,
        view,
        spec.position_m,
        half_width_m=reader.margin * face.half_width_m + side,
        half_height_m=reader.margin * face.half_height_m + side,
        plane_z_m=0.0 if reader.leans else face.height_m,
        shift_px=shift_px,
        gray=gray,
    )


def _lean_m(view: PanelProjection, spec: PanelObject, height_m: float) -> float:
    """Return the distance on the plate, m, by which a point at that height appears displaced from its foot."""
    x, y = spec.position_m
    px = view.project([[x, y, 0.0], [x, y, height_m], [x + 0.01, y, 0.0], [x, y + 0.01, 0.0]])
    scale = min(float(np.linalg.norm(px[2] - px[0])), float(np.linalg.norm(px[3] - px[0]))) / 0.01
    return float(np.linalg.norm(px[1] - px[0])) / max(scale, 1e-9)
