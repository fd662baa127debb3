"""Selection of the panel's four lights among the bright blobs by the taught quadrangle (paper, Section II-B).

A hypothesis assigns up to four blobs to lights. Its score rates how lamp-like they are, how equal in true size and
contrast, how plausible the camera's attitude is, and how well the fourth light agrees with the place that the other
three predict.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import undistort_pixels
from hal.errors import Ambiguous, InvalidRequest, NotFound
from perception.vision.lights.find import LightBlobs
from perception.vision.lights.search import UNCHECKED, alike, insert, search, unseen

UPRIGHT = np.diag([1.0, -1.0, -1.0])  # camera x right, y down, z forward; panel x right, y up, z towards the viewer
CANDIDATES = 16  # blobs at most that are considered
LEAST_SCORE = 0.1  # of a blob that is considered
# Focal lengths per image width if the camera is unknown; the gate of 4 px covers values in between.
FOCAL_TRIALS = (1.25, 0.95, 1.65)
USUAL_RADIUS_M = 0.006  # of a lamp
TILT_SIGMA_RAD = 0.4
ROLL_SIGMA_RAD = 0.35
LEAST_TOTAL = -2.0  # two dim lights in a tilted view reach 0; what is upside down or implausibly skewed has less
PLAIN_SCORE = 8.0  # score of a clear result; four lamp-like blobs at the right places reach 15
RIVAL_MARGIN = 2.0  # log-odds; hypotheses with other blobs that are closer than this make the result ambiguous


class LightMissing(NotFound):
    """Fewer lights than needed are visible; the message names the missing ones."""


class WrongLamp(NotFound):
    """Enough bright blobs are visible, but they are not arranged like the panel's lights."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AssignedLights:
    """The panel's lights in the image, in the order of the taught ones.

    Attributes:
        points_px: (4, 2) centres as measured (not undistorted); NaN for a light that is not visible.
        covariance_px: (4, 2, 2); NaN likewise.
        seen: (4,) whether each light is visible.
        blobs: (4,) index into the blobs, -1 for a light that is not visible.
        score: log-odds of this choice.
        margin: lead of the score over that of the best choice with other blobs.
    """

    points_px: Array
    covariance_px: Array
    seen: NDArray[np.bool_]
    blobs: NDArray[np.intp]
    score: float
    margin: float


def assign_lights(
    blobs: LightBlobs,
    lights_m: ArrayLike,
    *,
    image_size_px: tuple[int, int],
    intrinsics: CameraIntrinsics | None = None,
    upright: ArrayLike = UPRIGHT,
    radius_m: float = USUAL_RADIUS_M,
    least: int = 4,
) -> AssignedLights:
    """Choose the panel's lights among the blobs of `find_lights`.

    Args:
        blobs: candidates.
        lights_m: (4, 3) or (4, 2) positions of the lights in the panel's frame, m.
        image_size_px: (width, height).
        intrinsics: the camera; without it several focal lengths and an ideal lens are tried.
        upright: (3, 3) expected rotation camera_from_panel, accurate to some tens of degrees. A panel that looks the
        same
            upside down needs it; the default is an upright panel seen from the front.
        radius_m: approximate radius of the lamps.
        least: least number of visible lights, 2 to 4; the pose needs 4.

    Raises:
        LightMissing: fewer than `least` lights are visible.
        WrongLamp: four or more lamp-like blobs, but not at the positions of the panel's lights.
        Ambiguous: two choices of blobs fit equally well.
        InvalidRequest: wrong shapes.
    """
    lights = _lights(lights_m)
    if not 2 <= least <= 4:
        raise InvalidRequest(f"least must be 2, 3 or 4, not {least}", hint="the pose needs 4")
    usable = _usable(blobs)
    if len(usable) < 2:
        raise LightMissing(
            f"{len(usable)} lamp-like blobs became brighter, {least} lights are needed",
            hint="check that the panel's lights switch, and that the camera sees all of them",
        )
    view = (image_size_px, intrinsics, np.asarray(upright, float), radius_m)
    best, chosen = _hypotheses(blobs, usable, lights, view)
    if best[0] < LEAST_TOTAL:
        raise WrongLamp(
            f"{len(usable)} blobs became brighter, but no choice of them stands as the taught lights",
            hint="check the panel file's lights and the camera calibration",
        )
    return _accept(blobs, usable, best, chosen, least)


def _lights(lights_m: ArrayLike) -> Array:
    """Return the lights as an array (4, 3).

    Raises:
        InvalidRequest: wrong shape or not finite.
    """
    lights = np.asarray(lights_m, float)
    if lights.shape == (4, 2):
        lights = np.column_stack([lights, np.zeros(4)])
    if lights.shape != (4, 3) or not np.isfinite(lights).all():
        raise InvalidRequest(f"lights must be (4, 3) and finite, not {lights.shape}", hint="see the panel file")
    return lights


def _usable(blobs: LightBlobs) -> NDArray[np.intp]:
    """Return the indices of the lamp-like blobs, best first, without those on a better one."""
    keep: list[int] = []
    for i in np.argsort(-blobs.score, kind="stable"):
        if blobs.score[i] < LEAST_SCORE or len(keep) == CANDIDATES:
            break
        radius = np.sqrt(blobs.area_px[i] / np.pi)
        if all(np.linalg.norm(blobs.centres_px[i] - blobs.centres_px[k]) > radius for k in keep):
            keep.append(int(i))
    return np.array(keep, np.intp)


def _hypotheses(
    blobs: LightBlobs,
    usable: NDArray[np.intp],
    lights: Array,
    view: tuple[tuple[int, int], CameraIntrinsics | None, Array, float],
) -> tuple[Array, NDArray[np.int64]]:
    """Return the best scores (8,) and their blobs (8, 4).

    `view`: image size, camera if known, upright rotation, and lamp radius.
    """
    size, intrinsics, upright, radius_m = view
    centres = blobs.centres_px[usable]
    traits = np.stack([
        4.0 + 2.0 * np.log(blobs.score[usable]), 0.5 * np.log(blobs.area_px[usable]), np.log(blobs.contrast[usable]),
        blobs.aspect[usable],
    ])  # fmt: skip
    best, chosen = np.full(8, -np.inf), np.full((8, 4), -1, np.int64)
    frame = np.array(size, float)
    X = lights - lights.mean(axis=0)
    cameras = _cameras(centres, size, intrinsics)
    for omit in (3, 2, 1, 0):
        for camera, ideal, gate_px in cameras:
            prior = np.array([TILT_SIGMA_RAD, ROLL_SIGMA_RAD, gate_px, radius_m])
            search(ideal, traits, X, upright, camera, frame, prior, omit, best, chosen)
        if best[0] > PLAIN_SCORE and (chosen[0] >= 0).all():
            break  # all four are found, so predicting another one from three would give the same
    _pairs(centres, traits, X @ upright.T, frame, (best, chosen))
    return best, chosen


def _cameras(
    centres: Array, size: tuple[int, int], intrinsics: CameraIntrinsics | None
) -> list[tuple[Array, Array, float]]:
    """Return the known camera, or several guesses, each as (fx, fy, cx, cy), ideal pixels and a tolerance.

    The tolerance is the standard deviation of the fourth light's predicted position in px.
    """
    if intrinsics is not None:
        camera = np.array([intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px])
        return [(camera, undistort_pixels(centres, intrinsics), 2.5)]
    width, height = size
    centre = [(width - 1) / 2.0, (height - 1) / 2.0]
    return [(np.array([k * width, k * width, *centre]), centres, 4.0) for k in FOCAL_TRIALS]


def _pairs(centres: Array, traits: Array, model: Array, frame: Array, into: tuple[Array, NDArray[np.int64]]) -> None:
    """Add hypotheses with two lights only: a similarity of the plane (near-frontal view) predicts the other two."""
    reward, log_size, log_contrast, _ = traits
    flat = model[:, :2]
    for a, b in combinations(range(4), 2):
        for i, j in permutations(range(len(centres)), 2):
            taught, image = complex(*(flat[b] - flat[a])), complex(*(centres[j] - centres[i]))
            if taught == 0:
                continue
            ratio = image / taught
            roll = float(np.angle(ratio))
            order = np.full(4, -1, np.int64)
            order[a], order[b] = i, j
            others = [k for k in range(4) if k not in (a, b)]
            offsets = [ratio * complex(*(flat[k] - flat[a])) for k in others]
            places = [centres[i] + [o.real, o.imag] for o in offsets]
            score = reward[i] + reward[j] + UNCHECKED + alike(log_size[[i, j]], log_contrast[[i, j]], 2)
            score += sum(unseen(u, v, frame) for u, v in places) - 0.5 * (roll / (0.5 * ROLL_SIGMA_RAD)) ** 2
            insert(float(score), order, *into)


def _accept(
    blobs: LightBlobs, usable: NDArray[np.intp], best: Array, chosen: NDArray[np.int64], least: int
) -> AssignedLights:
    """Return the best hypothesis as the result, unless a light is missing or another hypothesis is nearly as good.

    Raises:
        LightMissing, WrongLamp, Ambiguous: see `assign_lights`.
    """
    first = chosen[0]
    seen = first >= 0
    if seen.sum() < least:
        missing = ", ".join(str(k) for k in np.flatnonzero(~seen))
        if len(usable) >= 4 and seen.sum() < 3:
            raise WrongLamp(
                f"{len(usable)} blobs became brighter, but only {int(seen.sum())} of them stand as the taught lights",
                hint="check the panel file's lights, and that no other lamps were switched in between",
            )
        raise LightMissing(
            f"light {missing} is not seen",
            hint="look for something in front of it, or move until all four are in view",
            missing=missing,
        )
    rivals = [
        r
        for r in range(1, len(best))
        if np.isfinite(best[r]) and set(chosen[r]) - {-1} != set(first) - {-1} and (chosen[r] >= 0).sum() >= seen.sum()
    ]
    margin = float(best[0] - best[rivals[0]]) if rivals else float(best[0])
    if margin < RIVAL_MARGIN and seen.all():
        raise Ambiguous(
            "two choices of lamps fit the taught lights equally well",
            hint="keep other lamps steady between the two images, or move closer",
        )
    index = np.where(seen, usable[np.where(seen, first, 0)], -1)
    return AssignedLights(
        points_px=np.where(seen[:, None], blobs.centres_px[index], np.nan),
        covariance_px=np.where(seen[:, None, None], blobs.covariance_px[index], np.nan),
        seen=seen, blobs=index, score=float(best[0]), margin=margin,
    )  # fmt: skip
