"""Reader of quarter-turn levers: a bar that points from the hub towards one of the taught angles."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.arrays import Array
from hal.panel import Lever
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, doubted
from perception.vision.status.bar import bar_contrast
from perception.vision.status.choice import choose, contrast_noise
from perception.vision.status.occluder_bands import cables_across
from perception.vision.status.reader import Reader

BAR = (0.40, 0.92)  # share of the length: outside the hub, inside the tip
FLANK = (1.35, 1.6)  # in half widths; pipes and flanges are close by
BESIDE = np.linspace(-0.75, 0.75, 13)  # in widths; a shadow falls to one side
WIDE_OR_SHADOW = (1.0, 0.4)  # widths of the bar and of its shadow, over the bar's width
CLEAR_OF_TIP = 1.25  # in lengths; pipes usually end within this radius too
BEYOND = (1.12, 1.30)  # in lengths: clear of the tip, and still in the patch
ASIDE = (-0.5, 0.0, 0.5)  # in widths: places where a cable may continue
GOES_ON = 2.0  # weight of the contrast beyond the tip; a flange or a pipe's end sometimes lies there
SWEEP_RAD = np.deg2rad(np.arange(-30.0, 30.5, 1.0))
BETWEEN_RAD = 0.16  # a quarter-turn valve 9 degrees away from its stop is neither open nor closed
ANGLE_SIGMA_RAD = 0.02
LIGHT_SIGMA, MIDDLE_GRAY = 1.4, 128.0  # of the bar's width; gray levels
MOST_IN_GLARE = 0.79  # largest confidence of the second pass, of whose answers about one in thirty was wrong
WOBBLE_RAD = np.deg2rad(np.linspace(-10, 10, 9))  # tried deviations from the nominal angles


def read_lever(patch: Patch, spec: Lever) -> PatchReading:
    """Return the state of a lever valve. `patch` shows the plane of the bar; several states may share a name.

    Beside glare one side of the bar has little contrast. If no bar stands out, the patch is read again without its
    gradients.
    """
    angles = np.array([state.angle_rad for state in spec.states])
    r = np.linspace(*BAR, 8)[:, None] * spec.length_m
    seen = patch.seen(r * np.sin(angles), r * np.cos(angles))
    status, nominal, hidden = _direction(patch, spec, seen)
    if not status.answered:
        patch = _flattened(patch, spec)
        again, nominal, hidden = _direction(patch, spec, seen)
        if not again.answered:
            return status
        status = replace(again, confidence=min(again.confidence, MOST_IN_GLARE))
    angle = _bar_angle(patch, spec, nominal, hidden)
    # In an oblique view the bar's walls rotate its image by up to the displacement of its top over its length.
    lean_m = float(np.linalg.norm(patch.parallax_px_per_m)) * spec.height_m / patch.px_per_m
    if abs(angle - nominal) <= BETWEEN_RAD + lean_m / spec.length_m:
        return replace(status, value=angle, unit="rad", uncertainty=ANGLE_SIGMA_RAD)
    if _is_parallel(patch, spec, nominal):
        return replace(status, value=nominal, unit="rad", uncertainty=BETWEEN_RAD)
    between = replace(status, value=angle, unit="rad", uncertainty=ANGLE_SIGMA_RAD)
    return doubted(between, f"the lever stands between its states, at {angle:.2f} rad: turn it to its stop")


def _direction(patch: Patch, spec: Lever, seen: float) -> tuple[PatchReading, float, NDArray[np.bool_] | None]:
    """Return the state whose bar has the most contrast, its direction, and the mask of occluders."""
    angles = np.array([state.angle_rad for state in spec.states])
    tried = (angles[:, None] + WOBBLE_RAD).ravel()
    hidden = cables_across(patch, radius_m=CLEAR_OF_TIP * spec.length_m, own_rad=angles)
    contrast, noise = _bar(patch, spec, tried, hidden=hidden), contrast_noise(patch)
    lost = ~patch.inside if hidden is None else hidden | ~patch.inside  # outside the image, its border is repeated
    beyond = [_bar(patch, spec, tried, along=BEYOND, beside=aside, quantile=0.5, hidden=lost) for aside in ASIDE]
    goes_on = np.maximum(np.sign(contrast) * beyond - noise, 0.0).max(axis=0)  # a handle ends there, a cable does not
    evidence = np.maximum(np.abs(contrast) - GOES_ON * goes_on, 0.0).reshape(len(angles), -1).max(axis=1)
    status = choose([s.name for s in spec.states], evidence, noise=noise, seen=seen, what="lever")
    return status, float(angles[int(np.argmax(evidence))]), hidden


def _flattened(patch: Patch, spec: Lever) -> Patch:
    """Return the patch without variations wider than the bar, around middle gray."""
    gray = patch.gray.astype(np.float32)
    light = cv2.GaussianBlur(gray, (0, 0), LIGHT_SIGMA * spec.width_m * patch.px_per_m)
    return replace(patch, gray=np.clip(np.round(gray - light + MIDDLE_GRAY), 0, 255).astype(np.uint8))


def _is_parallel(patch: Patch, spec: Lever, nominal: float) -> bool:
    """Return whether the visible line is parallel to the state's direction and beside it, and no bar at an angle to it.

    A handle as gray as the plate is visible only by the shadow along its side; a handle between two states is not
    parallel.
    """
    turned = max(float(np.abs(_bar(patch, spec, nominal + SWEEP_RAD, wide=wide)).max()) for wide in WIDE_OR_SHADOW)
    lines = (_bar(patch, spec, nominal, wide=wide, beside=beside) for wide in WIDE_OR_SHADOW for beside in BESIDE)
    return max(abs(float(line[0])) for line in lines) > turned


def _bar_angle(patch: Patch, spec: Lever, nominal: float, hidden: NDArray[np.bool_] | None) -> float:
    """Return the direction near a state's nominal angle in which the bar has the most contrast."""
    tried = nominal + SWEEP_RAD
    smooth = np.convolve(np.abs(_bar(patch, spec, tried, hidden=hidden)), np.ones(5) / 5.0, "same")
    return float(tried[2 + int(np.argmax(smooth[2:-2]))])


def _bar(
    patch: Patch, spec: Lever, angles_rad: ArrayLike, *, along: tuple[float, float] = BAR, wide: float = 1.0, beside: float = 0.0,
    quantile: float = 0.3, hidden: NDArray[np.bool_] | None = None,
) -> Array:  # fmt: skip
    """Return the contrasts (N,) of a bar between two shares of the lever's length; `wide` and `beside` in the lever's widths."""
    first_m, last_m = (share * spec.length_m for share in along)
    return bar_contrast(
        patch, angles_rad, along_m=(first_m, last_m), half_width_m=wide * spec.width_m / 2, quantile=quantile, flank=FLANK,
        beside_m=beside * spec.width_m, hidden=hidden,
    )  # fmt: skip


READER = Reader[Lever](read=read_lever, guesses_right=0.45)
