"""Conversion of the integer codes of a range sensor to depth (paper, Fig. 7).

A code c of a linear window stands for the depth `near + c (far - near) / levels`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hal.arrays import Array
from hal.errors import InvalidRequest


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """Linear mapping of depth to codes: `near_m` at code 0, `far_m` at code `levels`."""

    near_m: float
    far_m: float
    levels: int = 255

    def __post_init__(self) -> None:
        if not (np.isfinite([self.near_m, self.far_m]).all() and self.far_m > self.near_m and self.levels >= 1):
            raise InvalidRequest(
                f"window {self.near_m} to {self.far_m} m with {self.levels} levels is empty",
                hint="far must lie beyond near, and there must be at least one level",
            )

    @property
    def step_m(self) -> float:
        """Difference in depth between neighbouring codes."""
        return (self.far_m - self.near_m) / self.levels

    def decode(self, codes: ArrayLike) -> Array:
        """Return the depth in metres, as float64, of integer codes of any shape."""
        return self.near_m + _whole(codes) * self.step_m


def decode_scaled(codes: ArrayLike, scale_m: float, *, invalid: int = 0) -> Array:
    """Return the depth in metres of integer codes; the code `invalid` becomes NaN.

    `scale_m`: metres per code, 0.001 for images in millimetres.
    """
    if not (scale_m > 0 and np.isfinite(scale_m)):
        raise InvalidRequest(f"scale of {scale_m} m a code is not positive", hint="0.001 for millimetres")
    whole = _whole(codes)
    return np.where(whole == invalid, np.nan, whole * scale_m)


def _whole(codes: ArrayLike) -> Array:
    """Return integer codes as float64."""
    raw = np.asarray(codes)
    if raw.dtype.kind not in "iu":
        raise InvalidRequest(
            f"codes must be integers, not {raw.dtype}", hint="pass the coded image; depth needs no decoding"
        )
    return raw.astype(np.float64)
