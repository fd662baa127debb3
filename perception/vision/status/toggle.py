"""Reader of toggle switches: a bat that leans up (`on`) or down (`off`) and stands out of the plate."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.panel import Toggle
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, doubted
from perception.vision.status.bar import bar_contrast
from perception.vision.status.choice import choose, contrast_noise
from perception.vision.status.reader import Reader

STATES, LEANS = ("on", "off"), (0.0, np.pi)  # clockwise from up
BAT_FROM, BAT_TO = 0.62, 0.95  # share of the length: the nut around the foot looks like a bar too
BRIGHT_ODDS = 2.0  # prior for a bright bat: bats are usually metal or white, rarely darker than their base
BEYOND = (1.5, 3.0)  # in bat radii past its tip, outside its round end
BEHIND = (0.8, 1.7)  # in bat radii behind the foot, not yet at the nut
GOES_ON = 3.0  # weight of the contrast beyond the ends, which may be weaker there
PIVOT_M = 0.004  # height above the plate of the point about which a bat turns
# Distances from the axis of the stripes that are compared with the bat, over 0.8 of its radius.
FLANK, WIDE_FLANK = (1.6, 1.9), (2.3, 2.6)
AT_FOOT = (0.15, 0.5)  # share of the length in which a bat as gray as the plate contrasts with the nut around its foot
#: Places of the bat's axis beside the one of the registered panel, in bat radii. Where few edges of the panel are in view,
#: its registered pose is wrong by as much, and there the other side of the nut looked like a bat.
ASIDE = (0.0, -0.35, 0.35, -0.7, 0.7)
ASIDE_COST = 0.2  # share of the contrast that a place a radius aside must have more
AT_FOOT_NOISE = 3.0  # times the noise of a contrast; less is no evidence there


def read_toggle(patch: Patch, spec: Toggle) -> PatchReading:
    """Return the state of a toggle switch. `patch` shows the plate, or any other plane, as heights are considered."""
    reach = spec.bat_length_m * np.sin(spec.tilt_rad)
    y = np.linspace(-1, 1, 12)[:, None] * reach
    seen = patch.seen(np.array([-1.0, 0.0, 1.0]) * spec.bat_radius_m + 0 * y, y + np.zeros(3))
    noise = contrast_noise(patch)
    aside_m = _aside_m(patch, spec)
    at_foot = _at_foot(patch, spec, noise, aside_m)
    for flank in (FLANK, WIDE_FLANK):
        contrast = np.array([_bat(patch, spec, angle, flank, aside_m) for angle in LEANS])
        status = choose(STATES, _of_one_colour(contrast), noise=noise, seen=seen, what="bat")
        if status.answered and status.state is not None:
            k = STATES.index(status.state)
            # A dark bar on this side, and a bright bat in front of its nut on the other.
            if contrast[k] < 0.0 < at_foot[1 - k]:
                return doubted(status, "something lies across the bat: move it or look past it")
            return status
    return choose(STATES, np.abs(at_foot), noise=noise, seen=seen, what="bat")


def _aside_m(patch: Patch, spec: Toggle) -> float:
    """Return by how much the axis of the bat lies to the right of its place in the registered panel, m."""

    def stands_out(radii: float) -> float:
        aside_m = radii * spec.bat_radius_m
        contrast = [_bat(patch, spec, angle, FLANK, aside_m) for angle in LEANS]
        return float(np.abs(contrast).max()) * (1.0 - ASIDE_COST * abs(radii))

    return spec.bat_radius_m * max(ASIDE, key=stands_out)


def _of_one_colour(contrast: Array) -> Array:
    """Return the evidence (2,) per state.

    If one side is dark and the other bright, the dark one is the rest of the switch.
    """
    rivals = (np.maximum(contrast, 0.0), BRIGHT_ODDS), (np.maximum(-contrast, 0.0), 1.0)
    return np.asarray(max(rivals, key=lambda e: e[0].max() * e[1])[0])


def _at_foot(patch: Patch, spec: Toggle, noise: float, aside_m: float) -> Array:
    """Return the signed contrast (2,) of the bat in front of its nut, towards `LEANS`.

    Zeros unless on one side only.
    """
    contrast = np.array([_stretch(patch, spec, angle, AT_FOOT, FLANK, aside_m) for angle in LEANS])
    size = np.abs(contrast)
    stands_out = size.max() > AT_FOOT_NOISE * noise and size.min() < 0.5 * size.max()
    return np.where(size == size.max(), contrast, 0.0) if stands_out else np.zeros(2)


def _stretch(
    patch: Patch, spec: Toggle, angle_rad: float, along: tuple[float, float], flank: tuple[float, float], aside_m: float
) -> float:
    """Return the signed contrast of a stretch of a bat that leans towards an angle.

    `along`: shares of the bat's length; `flank`: see `FLANK`; `aside_m`: see `_aside_m`.
    """
    reach, height = spec.bat_length_m * np.sin(spec.tilt_rad), spec.bat_length_m * np.cos(spec.tilt_rad)
    first, last = along
    contrast = bar_contrast(
        patch, angle_rad, along_m=(first * reach, last * reach), half_width_m=0.8 * spec.bat_radius_m, quantile=0.5,
        height_m=(PIVOT_M + first * height, PIVOT_M + last * height), flank=flank,
        beside_m=aside_m * float(np.cos(angle_rad)),
    )  # fmt: skip
    return float(contrast[0])


def _bat(patch: Patch, spec: Toggle, angle_rad: float, flank: tuple[float, float], aside_m: float) -> float:
    """Return the signed contrast of a bat that leans towards an angle, minus that of its continuation.

    The continuation is beyond the tip or behind the foot. A bat ends there. A cable does not, nor does the bat in its
    other position if the view runs along both.
    """
    reach, height = spec.bat_length_m * np.sin(spec.tilt_rad), spec.bat_length_m * np.cos(spec.tilt_rad)
    bat = _stretch(patch, spec, angle_rad, (BAT_FROM, BAT_TO), flank, aside_m)
    foot, tip = (
        np.array(patch.pixel_of(k * reach * np.sin(angle_rad), k * reach * np.cos(angle_rad), PIVOT_M + k * height))
        for k in (0.0, 1.0)
    )
    radii = (
        spec.bat_radius_m * patch.px_per_m / max(float(np.linalg.norm(tip - foot)), 1e-9)
    )  # of the bat as it appears
    if radii > 1.0:
        return bat  # seen from its end, the bat has no length
    beyond, behind = (
        _stretch(patch, spec, angle_rad, along, flank, aside_m)
        for along in ((1.0 + BEYOND[0] * radii, 1.0 + BEYOND[1] * radii), (-BEHIND[1] * radii, -BEHIND[0] * radii))
    )
    goes_on = max(beyond, 0.0) if bat > 0 else max(-beyond, -behind, 0.0)  # behind a bright bat its nut may reflect
    return float(np.sign(bat) * max(abs(bat) - GOES_ON * goes_on, 0.0))


READER = Reader[Toggle](read=read_toggle, guesses_right=0.45, leans=True)
