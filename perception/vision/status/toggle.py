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
BAT = (0.62, 0.95)  # share of the length: the nut around the foot looks like a bar too
PIVOT_M = 0.004  # height above the plate of the point about which a bat turns
FLANK = (1.6, 1.9)  # distances from the axis of the stripes compared with the bat, over 0.8 of its radius
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
    contrast = _stretches(patch, spec, BAT, aside_m)
    status = choose(STATES, np.abs(contrast), noise=noise, seen=seen, what="bat")
    if status.state is None:
        return choose(STATES, np.abs(at_foot), noise=noise, seen=seen, what="bat")
    # A dark bar on this side, and a bright bat in front of its nut on the other.
    k = STATES.index(status.state)
    if contrast[k] < 0.0 < at_foot[1 - k]:
        return doubted(status, "something lies across the bat: move it or look past it")
    return status


def _aside_m(patch: Patch, spec: Toggle) -> float:
    """Return by how much the axis of the bat lies to the right of its place in the registered panel, m."""

    def stands_out(radii: float) -> float:
        aside_m = radii * spec.bat_radius_m
        return float(np.abs(_stretches(patch, spec, BAT, aside_m)).max()) * (1.0 - ASIDE_COST * abs(radii))

    return spec.bat_radius_m * max(ASIDE, key=stands_out)


def _at_foot(patch: Patch, spec: Toggle, noise: float, aside_m: float) -> Array:
    """Return the signed contrast (2,) of the bat in front of its nut, towards `LEANS`.

    Zeros unless on one side only.
    """
    contrast = _stretches(patch, spec, AT_FOOT, aside_m)
    size = np.abs(contrast)
    stands_out = size.max() > AT_FOOT_NOISE * noise and size.min() < 0.5 * size.max()
    return np.where(size == size.max(), contrast, 0.0) if stands_out else np.zeros(2)


def _stretches(patch: Patch, spec: Toggle, along: tuple[float, float], aside_m: float) -> Array:
    """Return the signed contrasts (2,) of a stretch of a bat that leans towards each of `LEANS`.

    `along`: shares of the bat's length; `aside_m`: see `_aside_m`.
    """
    reach, height = spec.bat_length_m * np.sin(spec.tilt_rad), spec.bat_length_m * np.cos(spec.tilt_rad)
    first, last = along
    return bar_contrast(
        patch, LEANS, along_m=(first * reach, last * reach), half_width_m=0.8 * spec.bat_radius_m, quantile=0.5,
        height_m=(PIVOT_M + first * height, PIVOT_M + last * height), flank=FLANK, beside_m=aside_m * np.cos(LEANS),
    )  # fmt: skip


READER = Reader[Toggle](read=read_toggle, guesses_right=0.45, leans=True)
