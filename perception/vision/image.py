"""Decoding and checking of images that callers supply; later steps need no further checks."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from hal.errors import InvalidRequest, NotObservable

MIN_SIDE_PX = 24  # in smaller images no object has readable detail
MAX_PIXELS = 40_000_000  # larger images could be used to exhaust the memory
FORMATS = ("PNG", "JPEG", "BMP")  # few, because every decoder can be attacked
BLACK_LEVEL = 6  # gray level up to which a pixel is black
WHITE_LEVEL = 250  # gray level from which a pixel counts as saturated


def decode(data: bytes) -> Image:
    """Decode PNG, JPEG or BMP bytes to an RGB (H, W, 3) or gray (H, W) uint8 image.

    Raises:
        InvalidRequest: not an image, truncated, too large, or with more than 8 bits per channel.
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
        upright = ImageOps.exif_transpose(picture)  # as browsers show it, because users click on what they see
        return np.asarray(upright.convert("L" if upright.mode in ("1", "L", "LA") else "RGB"), np.uint8)
    except UnidentifiedImageError:
        raise InvalidRequest("the bytes are not an image that can be read", hint="send PNG, JPEG or BMP") from None
    except (OSError, SyntaxError, ValueError, Pillow.DecompressionBombError) as error:
        raise InvalidRequest(f"the image is damaged: {error}", hint="take or send it again") from error


def _is_deep_png(data: bytes) -> bool:
    """Return whether the bytes are a PNG with 16 bits per channel (byte 24 of IHDR).

    Pillow would silently drop the lower 8 bits of a colour PNG.
    """
    return data.startswith(b"\x89PNG") and len(data) > 24 and data[24] == 16


def as_gray(image: NDArray[Any]) -> Image:
    """Return the gray (H, W) uint8 image of a gray or RGB one, after checking size, depth and brightness.

    Raises:
        InvalidRequest: wrong type, shape or size.
        NotObservable: all black or all saturated.
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
    dark, bright = np.percentile(gray[::4, ::4], (2.0, 99.5))
    if bright <= BLACK_LEVEL:
        raise NotObservable("the image is black", hint="more light or a longer exposure; check the lens cap")
    if dark >= WHITE_LEVEL:
        raise NotObservable("the image is saturated", hint="less light or a shorter exposure")
    return np.require(gray, requirements=("C", "W"))  # the layout that compiled loops require


def check_image(image: NDArray[Any]) -> None:
    """Check that an image is 8-bit gray or RGB and of a sensible size.

    Raises:
        InvalidRequest: it is not; the message says why.
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
    """Return the error for an image with too many pixels."""
    return InvalidRequest(f"image of {width}x{height} px is too large", hint=f"at most {MAX_PIXELS} pixels")
