"""Reader of round pointer gauges with a linear or taught non-linear scale and any polarity."""

from __future__ import annotations

import numpy as np

from hal.panel import Gauge, Scale
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, doubted, gated, probability, refused
from perception.vision.status.occluder_bands import lying_across
from perception.vision.status.pointer import PointerFit, PointerSearch, find_pointer, wrapped
from perception.vision.status.reader import Reader

# Share of the radius over which every gauge pointer has ink and there are no numerals
POINTER_FROM, POINTER_TO = 0.25, 0.60
FINE_TO = 0.48  # numerals begin at half of the radius; when blurred, they shift a nearby pointer by up to 6 degrees
STOP_RAD = np.deg2rad(6.0)  # a pointer rests at most this far beyond its scale
LEAST_SEEN = 0.25  # share of the face that must be visible
MOST_SIGMA_RAD = 0.03
# Score of the best rival over that of the pointer: half and scale. Numerals may lie where a gauge's pointer is searched.
# Of 330 synthetic pointers read correctly 98 % have less than 0.45; half of the misread ones have more than 0.6
RIVAL = (0.50, 0.03)
SIGMA_RAD = (0.026, 0.003)  # 99 % of the pointers read correctly have less than 0.026
LEAST_SHOWN = 0.52  # visible share of the pointer's radii: beside a cable, a numeral alone could reach less than this


def read_gauge(patch: Patch, spec: Gauge) -> PatchReading:
    """Return the value of a round gauge. `patch` shows the plane of the face, origin at its middle."""
    R = spec.radius_m
    a, r = np.linspace(0, 2 * np.pi, 48, endpoint=False), R * np.array([[0.2], [0.4], [0.6], [0.75]])
    seen = patch.seen(r * np.sin(a), r * np.cos(a))
    search = PointerSearch(
        pivot_m=(0.0, 0.0),
        inner_m=POINTER_FROM * R,
        outer_m=POINTER_TO * R,
        fine_m=(POINTER_FROM * R, FINE_TO * R),
        from_hub=True,
    )
    cover = lying_across(patch, half_width_m=R, half_height_m=R, is_round=True)
    fit = find_pointer(patch, search, cover=cover)
    if fit is None:
        return no_pointer(seen, spec.scale.unit)
    return status_of_pointer(fit, spec.scale, seen)


def no_pointer(seen: float, unit: str) -> PatchReading:
    """Return the refusal for a face without a pointer; the reason depends on the visible share of the face."""
    if seen < LEAST_SEEN:
        return refused("the face cannot be seen (glare, shadow or cover): change the angle or the light", unit=unit)
    return refused("no pointer stands out on the face: come closer or add light", unit=unit)


def status_of_pointer(
    fit: PointerFit, scale: Scale, seen: float, *, rival: tuple[float, float] = RIVAL, sigma_rad: tuple[float, float] = SIGMA_RAD
) -> PatchReading:  # fmt: skip
    """Return value and confidence of a pointer on a scale, or a refusal if the pointer is off the scale.

    Args:
        rival, sigma_rad: see `pointer_confidence`.
    """
    lo, hi = sorted((scale.at_min, scale.at_max))
    middle = (lo + hi) / 2
    place = middle + float(wrapped(np.array(fit.angle_rad - middle)))
    if not lo - STOP_RAD <= place <= hi + STOP_RAD:
        return refused(
            "the pointer is off its scale, so what was found may not be the pointer: look again, closer",
            unit=scale.unit,
        )
    value = scale.value_at(place)
    slope = abs(scale.value_at(place + 1e-3) - scale.value_at(place - 1e-3)) / 2e-3
    status = PatchReading(
        value=float(value),
        unit=scale.unit,
        uncertainty=float(slope * fit.sigma_rad),
        confidence=pointer_confidence(fit, seen, rival=rival, sigma_rad=sigma_rad),
    )
    if fit.sigma_rad <= MOST_SIGMA_RAD:
        return gated(status)
    return doubted(
        status,
        f"the pointer's direction is uncertain by {fit.sigma_rad:.2f} rad: come closer, or change the angle or the light",
    )


def pointer_confidence(
    fit: PointerFit, seen: float, *, rival: tuple[float, float], sigma_rad: tuple[float, float]
) -> float:
    """Return the confidence of a pointer from contrast, rival, support, straightness and visibility.

    A dark pointer is visible on a saturated face as well; parts that saturation hides are missing from its support.

    Args:
        rival: (half, scale) of a logistic in the best rival's share of the score; at `half`, half of the readings are
            wrong.
        sigma_rad: (half, scale) in the standard deviation of the direction, which is large for anything but a straight
            pointer.
    """
    return probability(
        [
            (np.log(fit.strength), np.log(11.0), 0.15),
            (rival[0] - fit.rival_ratio, 0.0, rival[1]),
            (sigma_rad[0] - fit.sigma_rad, 0.0, sigma_rad[1]),
            (fit.supported, 0.72, 0.03),
            (fit.shown, LEAST_SHOWN, 0.02),
            (1.0 if fit.is_dark else seen, 0.35, 0.08),
            (0.35 - fit.unknown, 0.0, 0.05),
        ]
    )


READER = Reader[Gauge](read=read_gauge, is_telling=True)
