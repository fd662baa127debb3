"""Turns an ideal rendering into a realistic camera image: lens, glow, glare, vignette, blur, exposure, noise.

The rendering has no anti-aliasing, so it is made larger and then reduced. Without the glow around a lamp, subtracting
the lights-off image from the lights-on image would be unrealistically perfect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from simbackend.wire import Emitter, PictureInfo

Grey = NDArray[np.float32]
Pixels = NDArray[np.uint8]

NOMINAL_EXPOSURE_S = 0.010
GLOW_RADIUS_M = 0.035
GLOW_GAIN = 0.4
GLARE_RADIUS_M = 0.006
GLARE_GAIN = 0.3
GLOW_STEP_PX = 4  # the glow is smooth: computed on every fourth pixel


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorOptions:
    """Degradations of an image; radiance 1 at 10 ms is full scale."""

    oversample: float
    blur_px: float
    vignette: float
    full_well_electrons: float
    read_noise_electrons: float
    is_colour: bool


class CameraSensor:
    """Camera sensor behind one true lens."""

    def __init__(self, lens: CameraIntrinsics, options: SensorOptions) -> None:
        self._lens, self._options = lens, options
        ideal = _ideal_grid(lens)
        low, high = ideal.reshape(-1, 2).min(axis=0), ideal.reshape(-1, 2).max(axis=0)
        f = np.array([lens.fx_px, lens.fy_px])
        margin_px = 2.0
        size = np.ceil((high - low) * f + 2 * margin_px).astype(int)
        s = options.oversample
        self.drawn = (round(float(size[0]) * s), round(float(size[1]) * s))
        scale = np.array(self.drawn) / size
        centre = -low * f + margin_px
        self.focal = (float(f[0] * scale[0]), float(f[1] * scale[1]))
        # A reduced pixel covers `scale` rendered ones: its centre u is at scale (u + 1/2) - 1/2.
        drawn_centre = scale * (centre + 0.5) - 0.5
        self.centre = (float(drawn_centre[0]), float(drawn_centre[1]))
        self._reduced = (int(size[0]), int(size[1]))
        places = (ideal * f + centre).astype(np.float32)
        self._maps = cv2.convertMaps(places[:, :, 0].copy(), places[:, :, 1].copy(), cv2.CV_16SC2)
        self._table = np.empty(0, np.float32)
        self._vignette = _vignette(lens, options.vignette)

    def expose(self, info: PictureInfo, radiance: Grey, exposure_s: float, random: np.random.Generator) -> Pixels:
        """Return the image, (H, W) or (H, W, 3) uint8, from an ideal rendering of size `drawn`."""
        reduced = cv2.resize(radiance, self._reduced, interpolation=cv2.INTER_AREA)
        places, fractions = self._maps
        bent = cv2.remap(reduced, places, fractions, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        seen = self._glow(info, np.asarray(bent, np.float32))
        if self._options.blur_px > 0.0:
            seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), self._options.blur_px), np.float32)
        gain = np.float32(exposure_s / NOMINAL_EXPOSURE_S)
        vignette = self._vignette if seen.ndim == 2 else self._vignette[:, :, None]
        return self._digitise(seen * (vignette * gain), random)

    def _glow(self, info: PictureInfo, radiance: Grey) -> Grey:
        """Return the light that lamps throw on the plate around them (times its radiance), and glare in the lens (added)."""
        h, w = radiance.shape[:2]
        v, u = np.mgrid[0:h:GLOW_STEP_PX, 0:w:GLOW_STEP_PX].astype(np.float32)
        spill = np.zeros_like(u)
        glare = np.zeros_like(u)
        tint = np.zeros((*u.shape, 3), np.float32)
        for emitter in info.lit:
            place = self._pixel(info.camera_from_base, emitter)
            if place is None:
                continue
            (x, y), px_per_m = place
            strength = 1.0 if emitter.is_border_light else 0.15
            r2 = (u - np.float32(x)) ** 2 + (v - np.float32(y)) ** 2
            near = 1.0 + r2 / np.float32((GLOW_RADIUS_M * px_per_m) ** 2)
            lens = 1.0 + r2 / np.float32((GLARE_RADIUS_M * px_per_m) ** 2)
            thrown = np.float32(strength * GLOW_GAIN) / (near * np.sqrt(near))
            spill += thrown
            glare += np.float32(strength * GLARE_GAIN) / (lens * np.sqrt(lens))
            tint += thrown[:, :, None] * np.asarray(emitter.colour, np.float32)
        if not info.lit:
            return radiance
        glare = _enlarge(glare, w, h)
        if radiance.ndim == 2:
            return radiance * (1.0 + _enlarge(spill, w, h)) + glare
        return radiance * (1.0 + _enlarge(tint, w, h)) + glare[:, :, None]

    def _pixel(self, camera_from_base: RigidTransform, emitter: Emitter) -> tuple[tuple[float, float], float] | None:
        point = camera_from_base.apply(emitter.position_m)
        if point[2] < 0.02:
            return None
        lens = self._lens
        matrix = np.array([[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]])
        pixel, _ = cv2.projectPoints(point.reshape(1, 3), np.zeros(3), np.zeros(3), matrix, np.array(lens.distortion))
        u, v = pixel.reshape(2)
        return (float(u), float(v)), float(lens.fx_px / point[2])

    def _noise(self, shape: tuple[int, ...], random: np.random.Generator) -> Grey:
        """Return normal noise from a random offset in a long table: drawing it anew took half of the time of every image."""
        count = int(np.prod(shape))
        if self._table.size < 4 * count:
            self._table = np.random.default_rng(0).standard_normal(4 * count, np.float32)
        first = int(random.integers(self._table.size - count))
        return self._table[first : first + count].reshape(shape)

    def _digitise(self, radiance: Grey, random: np.random.Generator) -> Pixels:
        """Apply shot noise (variance = mean, in electrons), read noise, full well, and quantisation to eight bits."""
        well = np.float32(self._options.full_well_electrons)
        electrons = np.minimum(radiance, np.float32(1.2)) * well
        sigma = np.sqrt(electrons + np.float32(self._options.read_noise_electrons**2))
        electrons += sigma * self._noise(electrons.shape, random)
        levels = electrons * (np.float32(255.0) / well) + np.float32(0.5)
        return np.asarray(np.clip(levels, 0, 255), np.uint8)


def _enlarge(image: Grey, width: int, height: int) -> Grey:
    """Return the image enlarged to full size: coarse pixel i is at fine pixel i * step."""
    step = GLOW_STEP_PX
    matrix = np.array([[step, 0, 0], [0, step, 0]], np.float32)
    large = cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(large, np.float32)


def _ideal_grid(lens: CameraIntrinsics) -> Array:
    """Return (H, W, 2) undistorted normalised coordinates of every pixel."""
    u, v = np.meshgrid(np.arange(lens.width_px, dtype=float), np.arange(lens.height_px, dtype=float))
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-10)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
    undistort: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # OpenCV 5 has one function for both
    ideal = undistort(pixels, matrix, np.asarray(lens.distortion), R=np.eye(3), P=np.eye(3), criteria=criteria)
    return np.asarray(ideal, float).reshape(lens.height_px, lens.width_px, 2)


def _vignette(lens: CameraIntrinsics, strength: float) -> Grey:
    """Return the cosine-fourth fall-off; `strength` 1 applies all of it."""
    u, v = np.meshgrid(np.arange(lens.width_px), np.arange(lens.height_px))
    tan2 = ((u - lens.cx_px) / lens.fx_px) ** 2 + ((v - lens.cy_px) / lens.fy_px) ** 2
    return (1.0 - strength * (1.0 - 1.0 / (1.0 + tan2) ** 2)).astype(np.float32)
