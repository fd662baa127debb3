"""The sensor's dynamic range: choosing the window, coding and decoding (paper, Fig. 7).

A code c of a linear window stands for `near + c (far - near) / levels`, 0 near. Stretching coded values afterwards adds
no information; what helps is to program the window before coding, and `choose_window` says to what.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.arrays import Array
from hal.errors import InvalidRequest, NotFound

TAIL = 0.005  # share of the pixels at each end that may be gross errors
MARGIN = 0.05  # of the span, kept free at both ends


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """A linear mapping of depth to codes: `near_m` at code 0, `far_m` at code `levels`."""

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
        """Depth between neighbouring codes."""
        return (self.far_m - self.near_m) / self.levels

    @property
    def quantisation_sigma_m(self) -> float:
        """What coding adds to the noise: a uniform error of one step has sigma step / sqrt(12)."""
        return self.step_m / float(np.sqrt(12.0))

    def decode(self, codes: ArrayLike, *, invalid: int | None = None) -> Array:
        """Depth in metres, float64, of integer codes of any shape; `invalid` codes become NaN."""
        raw = np.asarray(codes)
        if raw.dtype.kind not in "iu":
            raise InvalidRequest(f"codes must be integers, not {raw.dtype}", hint="pass the coded image itself")
        depth = self.near_m + raw.astype(np.float64) * self.step_m
        if invalid is not None:
            depth[raw == invalid] = np.nan
        return depth

    def encode(self, depth_m: ArrayLike) -> NDArray[np.int64]:
        """Codes of depths in metres, clipped to the window; NaN becomes the farthest code."""
        depth = np.nan_to_num(np.asarray(depth_m, float), nan=self.far_m)
        codes = np.clip(np.rint((depth - self.near_m) / self.step_m), 0, self.levels)
        return np.asarray(codes, np.int64)

    def share_used(self, depth_m: ArrayLike) -> float:
        """Share of the window that the depths fill, gross errors aside: the paper's 0.1, 0.25 ... 1."""
        near, far = _robust_span(np.asarray(depth_m, float))
        return float(np.clip((far - near) / (self.far_m - self.near_m), 0.0, 1.0))


def choose_window(depth_m: ArrayLike, *, levels: int = 255, region: NDArray[np.bool_] | None = None) -> Window:
    """The window that a sensor should be programmed to for this scene.

    Args:
        depth_m: (H, W) depth, metres, NaN where missing.
        levels: highest code.
        region: (H, W) bool, the area of interest (the panel) if it is known.

    Raises:
        NotFound: no valid depth in the region.
    """
    depth = np.asarray(depth_m, float)
    if region is not None:
        depth = depth[region]
    near, far = _robust_span(depth)
    span = max(far - near, 1e-3)
    return Window(near_m=near - MARGIN * span, far_m=far + MARGIN * span, levels=levels)


def stretch(codes: ArrayLike, source: Window, target: Window) -> NDArray[np.int64]:
    """Codes of `target` for an image coded in `source`: the paper's linear scaling, for eyes, not for accuracy."""
    return target.encode(source.decode(codes))


def decode_scaled(codes: ArrayLike, scale_m: float, *, invalid: int = 0) -> Array:
    """Depth in metres of integer codes of `scale_m` metres each (0.001 for millimetre images); `invalid` is NaN."""
    if not (scale_m > 0 and np.isfinite(scale_m)):
        raise InvalidRequest(f"scale of {scale_m} m a code is not positive", hint="0.001 for millimetres")
    raw = np.asarray(codes)
    if raw.dtype.kind not in "iu":
        raise InvalidRequest(f"codes must be integers, not {raw.dtype}", hint="float depth needs no decoding")
    depth = raw.astype(np.float64) * scale_m
    depth[raw == invalid] = np.nan
    return depth


def _robust_span(depth: Array) -> tuple[float, float]:
    values = depth[np.isfinite(depth)]
    if values.size == 0:
        raise NotFound("no valid depth to choose a window from", hint="check the region and the sensor")
    near, far = np.quantile(values, [TAIL, 1.0 - TAIL])
    return float(near), float(far)
