"""Bad input is refused with a typed error before anything is computed."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image as Pillow

from hal.errors import InvalidRequest, NotObservable
from perception.vision.image import as_gray, decode


def png(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Pillow.fromarray(array).save(buffer, "PNG")
    return buffer.getvalue()


def test_what_was_encoded_comes_back() -> None:
    image = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
    assert (decode(png(image)) == image).all()
    assert decode(png(image[:, :, 0])).shape == (40, 50)


@pytest.mark.parametrize(
    "data", [b"", b"not an image", png(np.zeros((50, 50), np.uint8))[:-30], b"\x89PNG\r\n\x1a\n" + b"\0" * 64]
)
def test_damaged_bytes_are_an_invalid_request(data: bytes) -> None:
    with pytest.raises(InvalidRequest):
        decode(data)


def test_sixteen_bits_and_huge_sizes_are_refused_before_decoding() -> None:
    with pytest.raises(InvalidRequest, match="8 bits"):
        decode(png(np.zeros((40, 40), np.uint16)))
    import cv2

    deep_colour = cv2.imencode(".png", np.zeros((40, 40, 3), np.uint16))[1].tobytes()
    with pytest.raises(InvalidRequest, match="8 bits"):
        decode(deep_colour)
    buffer = io.BytesIO()
    Pillow.new("1", (12_000, 9_000)).save(buffer, "PNG")
    with pytest.raises(InvalidRequest, match="large"):
        decode(buffer.getvalue())


def test_a_photograph_is_turned_as_its_camera_was_held() -> None:
    image = np.zeros((40, 60), np.uint8)
    image[:20] = 200
    exif = Pillow.Exif()
    exif[0x0112] = 6  # the camera was held at 90 degrees
    buffer = io.BytesIO()
    Pillow.fromarray(image).save(buffer, "JPEG", exif=exif)
    turned = decode(buffer.getvalue())
    assert turned.shape == (60, 40)
    assert turned[30, 35] > 150 > turned[30, 5]


@pytest.mark.parametrize(
    ("image", "error"),
    [
        (np.zeros((1, 1), np.uint8), InvalidRequest),
        (np.zeros((50, 50, 2), np.uint8), InvalidRequest),
        (np.zeros((50, 50), np.float32), InvalidRequest),
        (np.zeros((50, 50), np.uint8), NotObservable),
        (np.full((50, 50, 3), 255, np.uint8), NotObservable),
    ],
)
def test_arrays_are_checked(image: np.ndarray, error: type[Exception]) -> None:
    with pytest.raises(error):
        as_gray(image)
