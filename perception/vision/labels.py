"""Placement of names in a picture: beside their objects, never over other names, over objects if space is short."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

GAP_PX = 4
ROWS = 4  # number of lines by which a name may move up or down to find room
OVER_A_NAME, OVER_AN_OBJECT, OVER_ITS_OWN = 1e6, 1.0, 0.5  # cost of each covered pixel


@dataclass(frozen=True, slots=True)
class PixelBox:
    """A rectangle in pixels, from (x, y) to (x + width, y + height)."""

    x: int
    y: int
    width: int
    height: int

    def overlap_px(self, other: PixelBox) -> int:
        """Return the area in pixels that both boxes cover."""
        width = min(self.x + self.width, other.x + other.width) - max(self.x, other.x)
        height = min(self.y + self.height, other.y + other.height) - max(self.y, other.y)
        return max(0, width) * max(0, height)

    def inside(self, width: int, height: int) -> PixelBox:
        """Return the box moved into a picture of the given size, as far as it fits."""
        x, y = (max(0, min(at, most)) for at, most in ((self.x, width - self.width), (self.y, height - self.height)))
        return PixelBox(x, y, self.width, self.height)


def place_labels(
    objects: Sequence[PixelBox], sizes: Sequence[tuple[int, int]], picture: tuple[int, int]
) -> list[PixelBox]:
    """Return a box for each object's name; names are placed one after the other, each at the cheapest of a few places.

    Args:
        objects: the named objects.
        sizes: width and height of each name, pixels.
        picture: width and height of the picture, pixels.
    """
    placed: list[PixelBox] = []
    for own, size in zip(objects, sizes, strict=True):

        def cost(box: PixelBox, own: PixelBox = own) -> float:
            over_names = sum(box.overlap_px(name) for name in placed)
            over_objects = sum(box.overlap_px(other) for other in objects if other is not own)
            over_own = box.overlap_px(own)
            return OVER_A_NAME * over_names + OVER_AN_OBJECT * over_objects + OVER_ITS_OWN * over_own

        # Of equal costs `min` keeps the first, and the places come in the order in which a reader looks for them.
        placed.append(min((place.inside(*picture) for place in _places(own, *size)), key=cost))
    return placed


def _places(own: PixelBox, width: int, height: int) -> Iterator[PixelBox]:
    """Yield places above, below and beside the object, near ones first."""
    flush = (own.x, own.x + (own.width - width) // 2, own.x + own.width - width)
    for row in range(ROWS):
        away = GAP_PX + row * (height + GAP_PX)
        for y in (own.y - away - height, own.y + own.height + away):
            for x in flush:
                yield PixelBox(x, y, width, height)
        if row == 0:
            middle = own.y + (own.height - height) // 2
            yield PixelBox(own.x + own.width + GAP_PX, middle, width, height)
            yield PixelBox(own.x - GAP_PX - width, middle, width, height)
