"""Decodes the pixel formats of GenICam cameras (Pixel Format Naming Convention of the EMVA) to 8-bit grey or RGB."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.transport.link import BadAnswer

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """One format: its name, the bits of one pixel on the wire, and how its rows become 8-bit samples.

    Attributes:
        depth: significant bits of a sample; larger samples are shifted to 8 bits.
        colour: code of OpenCV that makes RGB of the samples; None for grey, 0 for RGB itself.
    """

    name: str
    bits: int
    depth: int = 8
    colour: int | None = None
    is_packed: bool = False

    @property
    def is_colour(self) -> bool:
        """Return whether the format carries colour."""
        return self.colour is not None


def _mosaics() -> dict[int, PixelFormat]:
    """Return the Bayer formats; OpenCV names a pattern by its first two rows, GenICam by its first two pixels."""
    codes = {
        "GR": cv2.COLOR_BayerGRBG2RGB,
        "RG": cv2.COLOR_BayerRGGB2RGB,
        "GB": cv2.COLOR_BayerGBRG2RGB,
        "BG": cv2.COLOR_BayerBGGR2RGB,
    }
    firsts = {8: 0x01080008, 10: 0x0110000C, 12: 0x01100010, 16: 0x0110002E}
    return {
        first + i: PixelFormat(f"Bayer{name}{depth}", 8 if depth == 8 else 16, depth, code)
        for depth, first in firsts.items()
        for i, (name, code) in enumerate(codes.items())
    }


FORMATS: dict[int, PixelFormat] = {
    0x01080001: PixelFormat("Mono8", 8),
    0x01100003: PixelFormat("Mono10", 16, 10),
    0x01100005: PixelFormat("Mono12", 16, 12),
    0x01100025: PixelFormat("Mono14", 16, 14),
    0x01100007: PixelFormat("Mono16", 16, 16),
    0x010A0046: PixelFormat("Mono10p", 10, 10, is_packed=True),
    0x010C0047: PixelFormat("Mono12p", 12, 12, is_packed=True),
    0x02180014: PixelFormat("RGB8", 24, colour=0),
    0x02180015: PixelFormat("BGR8", 24, colour=cv2.COLOR_BGR2RGB),
    0x02100032: PixelFormat("YUV422_8", 16, colour=cv2.COLOR_YUV2RGB_YUY2),
    0x0210001F: PixelFormat("YUV422_8_UYVY", 16, colour=cv2.COLOR_YUV2RGB_UYVY),
    **_mosaics(),
}


def decode(data: Bytes, code: int, *, width_px: int, height_px: int, is_colour: bool) -> Bytes:
    """Return the pixels of a frame, (H, W, 3) RGB or (H, W) grey.

    Raises:
        BadAnswer: the format is not known, or the frame has too few bytes.
    """
    form = FORMATS.get(code)
    if form is None:
        raise BadAnswer(f"the pixel format {code:#010x} is not known: set `pixel_format` to one of {_names()}")
    needed = (width_px * height_px * form.bits + 7) // 8
    if len(data) < needed:
        raise BadAnswer(f"a frame of {width_px}x{height_px} {form.name} has {len(data)} of {needed} bytes")
    samples = _samples(data[:needed], form, width_px, height_px)
    return _coloured(samples, form) if is_colour else _grey(samples, form)


def _names() -> str:
    return ", ".join(form.name for form in FORMATS.values())


def _samples(data: Bytes, form: PixelFormat, width_px: int, height_px: int) -> Bytes:
    """Return the 8-bit samples, (H, W) or (H, W, channels)."""
    if form.is_packed:
        return _high_bits(data, form.bits, width_px * height_px).reshape(height_px, width_px)
    if form.depth > 8:
        wide = data.view("<u2").reshape(height_px, width_px)
        return np.asarray(np.minimum(wide >> (form.depth - 8), 255), np.uint8)
    channels = form.bits // 8
    return data.reshape((height_px, width_px) if channels == 1 else (height_px, width_px, channels))


def _high_bits(data: Bytes, bits: int, count: int) -> Bytes:
    """Return the 8 high bits of samples that are packed without gaps, lowest bit first."""
    starts = np.arange(count) * bits + (bits - 8)
    first, shift = starts // 8, starts % 8
    padded = np.append(data, np.uint8(0)).astype(np.uint16)
    return np.asarray(((padded[first] | (padded[first + 1] << 8)) >> shift) & 0xFF, np.uint8)


def _coloured(samples: Bytes, form: PixelFormat) -> Bytes:
    if form.colour is None:
        return _contiguous(cv2.cvtColor(samples, cv2.COLOR_GRAY2RGB))
    return _contiguous(samples if form.colour == 0 else cv2.cvtColor(samples, form.colour))


def _grey(samples: Bytes, form: PixelFormat) -> Bytes:
    return _contiguous(cv2.cvtColor(_coloured(samples, form), cv2.COLOR_RGB2GRAY) if form.is_colour else samples)


def _contiguous(pixels: NDArray[Any]) -> Bytes:
    return np.ascontiguousarray(pixels, dtype=np.uint8)
