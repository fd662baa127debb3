"""Search for a red pointer on a dial, and a picture without it: many gauges have a red pointer for the maximum beside
the black one.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from perception.vision.patch import Patch
from perception.vision.status.pointer import PointerFit, PointerSearch, find_pointer, wrapped

HUE_RAD = np.deg2rad(28.0)  # of red in the colour plane of Lab: from orange red to crimson
HUE_OFF_RAD = np.deg2rad(38.0)
LEAST_RED, LEAST_CONTRAST = 5.0, 2.5  # redness of the reddest parts, and of the pointer itself, units of Lab
INNER, OUTER, FINE = 0.18, 0.52, 0.60  # shares of the radius: beyond the hub's cap, within every pointer, to refine
WIDE_RAD = np.deg2rad(24.0)  # anything wider than this is no pointer
HALF_OF_RED = 0.4  # share of a pointer's own redness from which a pixel belongs to it
BESIDE_RAD = np.deg2rad(10.0)  # a pointer's pixels are within this of its direction
BESIDE = 0.13  # of the radius, or within this of its axis, as a counterweight is
LEAST_SUPPORTED, LEAST_STRENGTH, MOST_RIVAL = 0.6, 40.0, 0.5
ACROSS, FACE_BESIDE = np.linspace(-0.08, 0.08, 17), np.linspace(0.12, 0.2, 9)  # of the radius, across a pointer
BEYOND_TAIL = (0.42, 0.6)  # of the radius: beyond the other end of another pointer, and within every red one
LEAST_LACKING, RED_LACKS = 0.02, 0.75  # green that a pointer takes from the strip, and red that a red one lacks at most
LENGTHS = np.linspace(0.3, 1.0, 36)  # shares of the radius


def redness(picture: Image, u: float, v: float, radius: float) -> NDArray[np.float32]:
    """Return for each pixel (H, W) by how much it is redder than the face, in units of Lab; 0 for other hues.

    Args:
        picture: (H, W, 3) RGB uint8.
        u, v, radius: the dial in it, px.
    """
    lab = cv2.cvtColor(np.ascontiguousarray(picture[:, :, :3]), cv2.COLOR_RGB2LAB).astype(np.float32)
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]]
    disc = np.hypot(x - u, y - v) < 0.9 * radius
    a, b = (cv2.GaussianBlur(lab[:, :, k], (0, 0), 0.8) - float(np.median(lab[:, :, k][disc])) for k in (1, 2))
    along = a * np.cos(HUE_RAD) + b * np.sin(HUE_RAD)
    across = np.abs(b * np.cos(HUE_RAD) - a * np.sin(HUE_RAD))
    return np.asarray(np.maximum(along - across / np.tan(HUE_OFF_RAD) * 0.5, 0.0), np.float32)


def find_red_pointer(red: NDArray[np.float32], u: float, v: float, radius: float) -> PointerFit | None:
    """Return the red pointer of a dial; None if none reaches from the hub outwards.

    Args:
        red: (H, W) redness of the picture, from `redness`.
    """
    y, x = np.mgrid[: red.shape[0], : red.shape[1]]
    away = np.hypot(x - u, y - v)
    ring = red[(away > INNER * radius) & (away < FINE * radius)]
    most = float(np.percentile(ring, 99.7)) if ring.size else 0.0
    if most < LEAST_RED:
        return None
    coded = np.clip(red * (200.0 / most), 0, 255).astype(np.uint8)
    patch = patch_about(coded, u, v)
    search = PointerSearch(
        pivot_m=(0.0, 0.0), inner_m=INNER * radius, outer_m=OUTER * radius, fine_m=(INNER * radius, FINE * radius),
        width_rad=float(WIDE_RAD), quantile=0.3, dark=False, pivot_sigma_px=0.02 * radius,
    )  # fmt: skip
    fit = find_pointer(patch, search)
    if fit is None or fit.contrast * most / 200.0 < LEAST_CONTRAST or fit.supported < LEAST_SUPPORTED:
        return None
    return fit if fit.rival_ratio < MOST_RIVAL and fit.strength > LEAST_STRENGTH else None


def is_red(picture: Image, fit: PointerFit, u: float, v: float, radius: float) -> bool:
    """Return whether a pointer lacks green of the face's light much more than it lacks red.

    The ratio does not change with light, blur and width, unlike a colour. A black pointer lacks both alike.
    """
    away = np.linspace(*BEYOND_TAIL, 24)[:, None] * radius

    def mean(off: NDArray[np.float64]) -> NDArray[np.float64]:
        x = u + away * np.sin(fit.angle_rad) + off * radius * np.cos(fit.angle_rad)
        y = v - away * np.cos(fit.angle_rad) + off * radius * np.sin(fit.angle_rad)
        seen = cv2.remap(picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        return np.asarray(np.median(seen.astype(float).mean(axis=1), axis=0))

    face = 0.5 * (mean(FACE_BESIDE) + mean(-FACE_BESIDE)) + 1.0
    lacking = 1.0 - mean(ACROSS) / face
    return bool(lacking[1] > LEAST_LACKING and lacking[0] < RED_LACKS * lacking[1])


def without(picture: Image, red: NDArray[np.float32], fit: PointerFit, u: float, v: float, radius: float) -> Image:
    """Return the picture with the red pointer painted over by what is beside it, on both sides of the hub."""
    y, x = np.mgrid[: red.shape[0], : red.shape[1]]
    right, up = x - u, v - y
    away = np.hypot(right, up)
    turn = np.asarray(wrapped(np.arctan2(right, up) - fit.angle_rad))
    axis = np.abs(np.sin(turn)) * away
    near = (axis < BESIDE * radius) | (np.minimum(np.abs(turn), np.pi - np.abs(turn)) < BESIDE_RAD)
    own = red[
        (axis < 0.01 * radius + 0.7) & (np.abs(turn) < 0.5 * np.pi) & (away > INNER * radius) & (away < OUTER * radius)
    ]
    level = HALF_OF_RED * float(np.median(own)) if own.size else LEAST_RED
    mask = (near & (red > max(level, 0.3 * LEAST_RED)) & (away < radius)).astype(np.uint8)
    wide = cv2.dilate(mask, np.ones((3, 3), np.uint8))
    return np.asarray(cv2.inpaint(np.ascontiguousarray(picture[:, :, :3]), wide, 3.0, cv2.INPAINT_TELEA), np.uint8)


def length_of(ink: NDArray[np.uint8], angle_rad: float, u: float, v: float, radius: float) -> float:
    """Return how far a pointer that is bright in `ink` (H, W) reaches from the middle, as a share of the radius."""
    beside = np.linspace(-0.02, 0.02, 5)[:, None] * radius
    x = u + LENGTHS * radius * np.sin(angle_rad) + beside * np.cos(angle_rad)
    y = v - LENGTHS * radius * np.cos(angle_rad) + beside * np.sin(angle_rad)
    seen = cv2.remap(ink.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR).max(axis=0)
    low = seen < 0.4 * float(np.median(seen[: len(LENGTHS) // 4]))
    return float(LENGTHS[max(0, int(low.argmax()) - 1)] if low.any() else LENGTHS[-1])


def patch_about(channel: Image, u: float, v: float) -> Patch:
    """Return a channel as a patch with the dial's middle as origin and pixels as unit."""
    return Patch(
        gray=channel, colour=None, inside=np.ones(channel.shape, bool), px_per_m=1.0, image_px_per_m=1.0,
        origin_px=np.array([u, v]), parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip
