"""Images as callers hand them in, checked once: typed refusals here keep every later step free of special cases."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from hal.errors import InvalidRequest, NotObservable

MIN_SIDE_PX = 24  # no object has readable detail below this
MAX_PIXELS = 40_000_000  # beyond it a decoder could be used to exhaust the memory
FORMATS = ("PNG", "JPEG", "BMP")  # a decoder fewer is an attack fewer
BLACK_LEVEL = 6
WHITE_LEVEL = 250


def decode(data: bytes) -> Image:
    """An RGB (H, W, 3) or gray (H, W) uint8 image from PNG, JPEG or BMP bytes.

    Raises:
        InvalidRequest: not an image, truncated, too large, or deeper than 8 bits a channel.
    """
    from PIL import Image as Pillow
    from PIL import ImageOps, UnidentifiedImageError

    try:
        picture = Pillow.open(io.BytesIO(data), formats=FORMATS)
        if picture.width * picture.height > MAX_PIXELS:
            raise _too_large(picture.width, picture.height)
        if picture.mode.startswith(("I", "F")) or _is_deep_png(data):
            raise InvalidRequest(
                "the image has more than 8 bits a channel",
                hint="convert it to 8 bit, with the exposure that you want",
            )
        upright = ImageOps.exif_transpose(picture)  # as every browser shows it: clicks are made on that
        return np.asarray(upright.convert("L" if upright.mode in ("1", "L", "LA") else "RGB"), np.uint8)
    except UnidentifiedImageError:
        raise InvalidRequest("the bytes are not an image that can be read", hint="send PNG, JPEG or BMP") from None
    except (OSError, SyntaxError, ValueError, Pillow.DecompressionBombError) as error:
        raise InvalidRequest(f"the image is damaged: {error}", hint="take or send it again") from error


def _is_deep_png(data: bytes) -> bool:
    """A colour PNG with 16 bits a channel, of which Pillow would drop the lower 8 without a word: byte 24 of IHDR."""
    return data.startswith(b"\x89PNG") and len(data) > 24 and data[24] == 16


def as_gray(image: NDArray[Any]) -> Image:
    """The gray (H, W) uint8 image of a gray or RGB one, checked for size, depth and light.

    Raises:
        InvalidRequest: wrong type, shape or size.
        NotObservable: all black, all saturated, or without any structure.
    """
    import cv2

    check_image(image)
    gray = (
        image
        if image.ndim == 2
        else image[:, :, 0]
        if image.shape[2] == 1
        else cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_RGB2GRAY)
    )
    sample = gray[::4, ::4]
    if np.percentile(sample, 99.5) <= BLACK_LEVEL:
        raise NotObservable("the image is black", hint="more light or a longer exposure; check the lens cap")
    if np.percentile(sample, 2.0) >= WHITE_LEVEL:
        raise NotObservable("the image is saturated", hint="less light or a shorter exposure")
    return np.require(gray, requirements=("C", "W"))  # compiled loops take no other layout


def check_image(image: NDArray[Any]) -> None:
    """Refuse what is not an 8-bit gray or RGB image of a sensible size.

    Raises:
        InvalidRequest: says what is wrong.
    """
    if (
        not isinstance(image, np.ndarray)
        or image.ndim not in (2, 3)
        or (image.ndim == 3 and image.shape[2] not in (1, 3, 4))
    ):
        raise InvalidRequest(
            f"an image is (H, W) or (H, W, 3), not {getattr(image, 'shape', type(image).__name__)}",
            hint="give gray or RGB",
        )
    if image.dtype != np.uint8:
        raise InvalidRequest(f"an image has 8 bits a channel, not {image.dtype}", hint="convert it to uint8")
    height, width = image.shape[:2]
    if width * height > MAX_PIXELS:
        raise _too_large(width, height)
    if min(width, height) < MIN_SIDE_PX:
        raise InvalidRequest(
            f"image of {width}x{height} px is too small to show a panel", hint=f"at least {MIN_SIDE_PX} px a side"
        )


def _too_large(width: int, height: int) -> InvalidRequest:
    return InvalidRequest(f"image of {width}x{height} px is too large", hint=f"at most {MAX_PIXELS} pixels")
