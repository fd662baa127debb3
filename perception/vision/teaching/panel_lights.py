"""Border lights of a new panel: clicked, or found in the four corners of its plate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.errors import InvalidRequest
from perception.vision.finding.features import PLATE_PX_PER_M
from perception.vision.teaching.lesson import Overview, plate_points, snapped
from perception.vision.teaching.sub_object import sub_objects

SIDES = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], float)
LIGHT_INSET_M = 0.015  # assumed distance of a light from both edges if none are found; the file says that it is a guess
LIGHT_REACH_M = 0.06  # largest distance of a border light from its corner
LIGHT_RADII_M = (0.003, 0.014)
LIGHTS_AGREE_M = 0.006  # largest difference between the positions of the lights relative to their corners
SNAP_M = 0.006  # a click is moved to a circle that is so near


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightsFound:
    """Border lights on the plate (4, 2), upper left first and clockwise; `are_seen` is False if they are a guess."""

    places_m: Array
    are_seen: bool


def find_border_lights(overview: Overview, clicks_px: Sequence[tuple[float, float]] = ()) -> LightsFound:
    """Return the four border lights: those clicked, or small circles at corresponding positions in the four corners.

    Raises:
        InvalidRequest: the number of clicks is neither zero nor four.
        NotFound: a click is not on the plate.
    """
    if len(clicks_px) not in (0, 4):
        raise InvalidRequest(
            f"{len(clicks_px)} lights were clicked on", hint="click on all four border lights, or none"
        )
    half = np.array(overview.plate_m) / 2
    low, high = LIGHT_RADII_M
    round_ones = [
        overview.on_plate(o.middle_px[None])[0]
        for o in sub_objects(overview.ground)
        if o.shape == "circle" and low <= o.size_px[0] / PLATE_PX_PER_M / 2 <= high
    ]
    circles = np.array(round_ones).reshape(-1, 2)
    if len(clicks_px) == 4:
        clicked = plate_points(overview.view, clicks_px, overview.plate_m)
        places = np.array([snapped(place, circles, SNAP_M) for place in clicked])
        return LightsFound(places_m=places[_clockwise(places)], are_seen=True)
    corners = SIDES * half
    found = [_in_corner(corner, circles) for corner in corners]
    if all(place is not None for place in found):
        insets = np.array([np.abs(corner - place) for corner, place in zip(corners, found, strict=True)])
        if np.ptp(insets, axis=0).max() < LIGHTS_AGREE_M:
            return LightsFound(places_m=np.array(found), are_seen=True)
    return LightsFound(places_m=corners - SIDES * LIGHT_INSET_M, are_seen=False)


def _in_corner(corner: Array, circles: Array) -> Array | None:
    """Return the circle nearest to a corner of the plate; None if none is near."""
    away = np.abs(circles - corner).max(axis=1, initial=0.0)
    near = np.flatnonzero(away < LIGHT_REACH_M)
    return circles[near[int(away[near].argmin())]] if len(near) else None


def _clockwise(places: Array) -> list[int]:
    """Return the order of four places: upper left, upper right, lower right, lower left."""
    rows = np.argsort(-places[:, 1], kind="stable")
    (a, b), (c, d) = (sorted(rows[k : k + 2], key=lambda i: float(places[i, 0])) for k in (0, 2))
    return [int(a), int(b), int(d), int(c)]
