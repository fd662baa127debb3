"""Shading of a raised round cap seen from the front: its shadow or side on one side, and a highlight on its face.

Both are measured around the cap by angle and radius. Occluded or saturated pixels and those outside the image are
ignored; the illumination gradient over face and plate is removed first.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.vision.image import WHITE_LEVEL
from perception.vision.patch import Patch, sample_at
from perception.vision.status.occluder_bands import cables_across

ANGLES = np.linspace(0, 2 * np.pi, 72, endpoint=False)
WAVES = np.column_stack([np.ones(len(ANGLES)), np.cos(ANGLES), np.sin(ANGLES)])
FACE, RIM, RING, PLATE = (0.10, 0.62), (0.46, 0.62), (0.86, 1.06), (1.12, 1.32)  # in cap radii
FACE_RADII = np.linspace(*FACE, 11)
# Radii at which a gap around the cap is searched for; inner part of the face
GAP, INNER = np.linspace(0.5, 1.12, 32), (0.35, 0.50)
GAP_DARK = 0.85  # share of the gray of face and plate: a gap is darker than both
BLACK = 20.0  # gray levels: noise on a darker face is as strong as a highlight, or as a gap
LEAST_BEYOND = 0.5  # share that must be visible beyond a spot: glare that comes from there is saturated at first
LEAST_GAP = 0.6  # share of it that must be visible
SPOT_TO = 0.46  # in radii: glare from beside the cap is brightest farther out
CLEAR_OF_RING = 1.4  # in radii: anything that crosses a circle of this size does not belong to the button
BLUR_PX = 2.0  # px by which an occluder's blur extends beyond its mask
LEAST_RING, LEAST_FACE = 0.4, 0.5  # share that must be visible
HEADROOM = 0.2  # share of the plate's gray left above a face: with less, no highlight can show
SMOOTH = 0.01  # share of the plate's gray by which a face may deviate from the smooth model
ROUNDS = 4
BLOB = (9, 3)  # angles and radii that a highlight fills


@dataclass(frozen=True, slots=True, kw_only=True)
class Shades:
    """Shading of a cap; NaN if too little is visible.

    Attributes:
        shade: first harmonic of the ring around the cap, minus that of face and plate, over the plate's gray.
        spot: excess of the face's brightest spot over its smooth illumination, relative to the residual of the rest of
            the face (its noise plus a hundredth of the plate's gray).
        below: darkness of a gap around the cap, below minus above, relative to the gray beside it and the radius; 0 if
            there is no gap, or too little of it is visible. Light comes from above, so a cap's side and shadow are
            below; if the cap is pushed in, the collar's shadow is above.
    """

    shade: float
    spot: float
    below: float = 0.0


def cap_shades(patch: Patch, radius_m: float) -> Shades:
    """Measure shadow and highlight of a round cap of that radius around the patch's middle."""
    hidden = cables_across(patch, radius_m=CLEAR_OF_RING * radius_m)
    lost = ~patch.inside | (patch.gray >= WHITE_LEVEL)
    if hidden is not None:
        size = round(2 * BLUR_PX) + 1
        lost |= cv2.dilate(hidden.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        u, v = patch.pixel_of(*(radius_m * np.outer(FACE_RADII, wave) for wave in (np.sin(ANGLES), np.cos(ANGLES))))
        if float(sample_at(hidden.astype(np.uint8), u, v).mean()) > 1.0 - LEAST_FACE:
            return Shades(shade=np.nan, spot=np.nan)
    unknown = np.asarray(lost, np.uint8)
    ring, no_ring = _mean_round(patch, unknown, radius_m * np.linspace(*RING, 5))
    plate, no_plate = _mean_round(patch, unknown, radius_m * np.linspace(*PLATE, 5))
    rim, no_rim = _mean_round(patch, unknown, radius_m * np.linspace(*RIM, 4))
    level = max(float(np.median(plate[~no_plate] if not no_plate.all() else plate)), 8.0)
    spot, below = _spot(patch, unknown, radius_m, level), _below(patch, unknown, radius_m)
    if no_plate.mean() > 1.0 - LEAST_RING:
        return Shades(shade=np.nan, spot=spot, below=below)
    around = _wave(plate, ~no_plate)
    odd = no_plate | no_ring
    if odd.mean() > 1.0 - LEAST_RING:
        return Shades(shade=np.nan, spot=spot, below=below)
    within = around if no_rim.mean() > LEAST_FACE else _wave(rim, ~no_rim)
    harmonic = (_wave(ring, ~odd) - (around + within) / 2)[1:]
    return Shades(shade=float(np.linalg.norm(harmonic)) / level, spot=spot, below=below)


def _spot(patch: Patch, unknown: NDArray[np.uint8], radius_m: float, level: float) -> float:
    """Return `Shades.spot`; the illumination of a face without a highlight varies smoothly."""
    x, y = np.outer(FACE_RADII, np.sin(ANGLES)), np.outer(FACE_RADII, np.cos(ANGLES))
    u, v = patch.pixel_of(radius_m * x, radius_m * y)
    gray = np.asarray(sample_at(patch.gray, u, v), float)
    known = sample_at(unknown, u, v) < 0.5
    if known.mean() < LEAST_FACE:
        return np.nan
    form = np.stack([np.ones_like(x), x, y, x**2 + y**2], axis=-1).reshape(-1, 4)
    smooth, scale = _fitted(form, gray.ravel(), (known * FACE_RADII[:, None]).ravel())
    off = gray - (form @ smooth).reshape(gray.shape)
    turns = np.concatenate([np.stack([off * known, known.astype(float)])] * 3, axis=2)
    total, count = (cv2.blur(part, BLOB)[:, len(ANGLES) : 2 * len(ANGLES)] for part in turns)
    mean = np.where(count > 0.6, total / np.maximum(count, 0.1), -np.inf)
    inner = FACE_RADII <= SPOT_TO
    row, turn = np.unravel_index(int(mean[inner].argmax()), mean[inner].shape)
    beyond = mean[-2:, (int(turn) + np.arange(-3, 4)) % len(ANGLES)]
    is_known = np.isfinite(beyond)
    face = float(np.median(gray[known]))
    is_blind = not BLACK < face < WHITE_LEVEL - HEADROOM * level or is_known.mean() < LEAST_BEYOND
    found = float(mean[row, turn]) - max(float(beyond[is_known].mean()) if is_known.any() else 0.0, 0.0)
    return np.nan if is_blind or not np.isfinite(found) else found / (scale + SMOOTH * level)


def _below(patch: Patch, unknown: NDArray[np.uint8], radius_m: float) -> float:
    """Return `Shades.below`.

    A registration error moves both edges of a gap alike, so it does not change the gap's thickness on either side.
    """
    u, v = patch.pixel_of(radius_m * np.outer(GAP, np.sin(ANGLES)), radius_m * np.outer(GAP, np.cos(ANGLES)))
    gray = np.asarray(sample_at(patch.gray, u, v), float)
    known = (sample_at(unknown, u, v) > 0.5).mean(axis=0) < 0.2
    if known.mean() < LEAST_GAP:
        return 0.0
    face, _ = _mean_round(patch, unknown, radius_m * np.linspace(*INNER, 4))
    beside = np.minimum(*(WAVES @ _wave(part, known) for part in (face, gray[-6:].mean(axis=0))))
    beside = np.maximum(beside, 1.0)
    if float(np.median(beside)) < BLACK or float(np.median((gray.min(axis=0) / beside)[known])) > GAP_DARK:
        return 0.0
    dark = np.maximum(beside - gray, 0.0).sum(axis=0) * (GAP[1] - GAP[0])
    return -float(_wave(dark, known)[1] / np.median(beside))


def _mean_round(patch: Patch, unknown: NDArray[np.uint8], radii_m: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the mean gray (angles,) over some radii, and the angles at which most of them are unknown."""
    u, v = patch.pixel_of(np.outer(radii_m, np.sin(ANGLES)), np.outer(radii_m, np.cos(ANGLES)))
    return np.asarray(sample_at(patch.gray, u, v).mean(axis=0), float), sample_at(unknown, u, v).mean(axis=0) > 0.4


def _wave(values: Array, known: NDArray[np.bool_]) -> Array:
    """Return mean, cosine and sine (3,) of the known values around the cap."""
    return _fitted(WAVES, values, known.astype(float))[0]


def _fitted(form: Array, values: Array, area: Array) -> tuple[Array, float]:
    """Return the coefficients (P,) of a linear form (N, P) of the values (N,), and the scale of the residual.

    By iteratively reweighted least squares; `area` is the weight (N,) of the values, 0 for unknown ones.
    """
    weight, scale = area, 1.0
    found: Array = np.zeros(form.shape[1])
    for _ in range(ROUNDS):
        weighted = form * weight[:, None]
        found = np.asarray(np.linalg.solve(weighted.T @ form + 1e-9 * np.eye(form.shape[1]), weighted.T @ values))
        off = values - form @ found
        scale = max(1.4826 * float(np.median(np.abs(off[area > 0]))), 1.0)
        weight = area / (1.0 + (off / (2 * scale)) ** 2)
    return found, scale
